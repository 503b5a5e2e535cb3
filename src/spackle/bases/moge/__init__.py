"""MoGe-2: a network from one photo to metric depth and the lens, written anew in plain PyTorch."""
