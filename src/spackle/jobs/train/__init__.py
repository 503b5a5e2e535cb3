"""`spackle train`: a recipe into weights, whichever of the three methods learns."""
