"""Spackle: one photo in, a 3D Gaussian scene out that survives a large camera move."""
