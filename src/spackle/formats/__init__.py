"""Read and write files of scenes, images and cameras."""

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
