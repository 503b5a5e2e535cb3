"""The depth map inside a portrait photo: Apple's and Android's, in HEIC and JPEG.

`layouts.load_photo_depth` is the entry.
"""
