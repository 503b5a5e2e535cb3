"""Values and their arithmetic: cameras, Gaussians, photos, colours, image filters, hole filling.

Read `camera.py` and `gaussians.py` first: every other room uses them. Nothing here knows of
networks, files of scenes, or renderers.
"""
