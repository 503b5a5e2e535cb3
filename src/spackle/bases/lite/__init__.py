"""Depth from the photo alone, by a small network that ships with the package."""
