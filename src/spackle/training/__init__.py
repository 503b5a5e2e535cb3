"""How the residual learns: its samples, its losses, and the loop."""
