"""A photo and its depth map become Gaussians.

Read `lift.py` first: it is the way from the map to the Gaussians. On it, `smoothing.py` removes
noise, `edges.py` finds depth edges, `resampling.py` brings the map to the photo's size,
`open_pixels.py` moves edges to the photo's outlines and fills gaps. Then `splats.py` makes
Gaussians: `silhouettes.py` separates near and far colours beside depth steps, `quadtree.py` decides
which pixels share a Gaussian, and `backing.py` closes the surface from behind.
"""
