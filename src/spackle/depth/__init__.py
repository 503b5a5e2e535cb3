"""Depth maps of all kinds: a value for each pixel of a photo, in metres.

Read `depth_map` first, the value that all others make. `readers` reads files, `units` and
`calibration` turn their numbers into metres, `in_photo` reads the depth inside of portrait photos,
and `writers` writes depth.
"""
