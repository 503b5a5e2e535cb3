"""MoGe-2, a network that predicts metric depth and focal length from one photo, reimplemented in plain PyTorch."""
