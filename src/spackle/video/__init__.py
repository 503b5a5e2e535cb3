"""Videos of scenes: what a frame shows, and how frames are encoded.

Read `frames.py` first, which makes frames from renderings. `options.py` says what a video may look
like, `stereo.py` makes views for two eyes, and `encoding.py` writes files.
"""
