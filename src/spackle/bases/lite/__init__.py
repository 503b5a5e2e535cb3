"""Depth from the photo alone, by two small networks that ship with the package."""
