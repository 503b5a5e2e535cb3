"""Renderers: Gaussians and a camera in, an image, its depth and its opacity out."""
