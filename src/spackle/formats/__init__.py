"""Files of scenes, images and cameras.

Read `scene_files.py` first: it lists the formats of scenes, and says how to add one. Camera files
are in `camera_files.py`, images in `png.py`, and the scene for the page in `html.py`.
"""

from spackle.formats.camera_files import load_cameras, load_path
from spackle.formats.ply import PlyFile, load_ply, save_ply
from spackle.formats.png import save_gray_png, save_png

__all__ = [
    "PlyFile",
    "load_cameras",
    "load_path",
    "load_ply",
    "save_gray_png",
    "save_ply",
    "save_png",
]
