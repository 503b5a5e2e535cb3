"""The depth map that a portrait photo brings along: Apple's and Android's layouts, in HEIC and JPEG."""

from spackle.bases.photo_depth.load import load_photo_depth

__all__ = ["load_photo_depth"]
