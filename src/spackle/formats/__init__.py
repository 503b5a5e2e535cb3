"""Files in and out: scenes, videos, pictures and cameras, each written whole or not at all."""

from spackle.formats.atomic import atomic_path, check_writable
from spackle.formats.cameras import load_cameras, save_cameras
from spackle.formats.ply import load_ply, load_ply_camera, save_ply

__all__ = [
    "atomic_path",
    "check_writable",
    "load_cameras",
    "load_ply",
    "load_ply_camera",
    "save_cameras",
    "save_ply",
]
