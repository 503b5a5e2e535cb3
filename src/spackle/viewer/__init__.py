"""The page that people look at a scene with, by a server or as one file."""

from spackle.viewer.page import page_files, single_html
from spackle.viewer.scene import PageScene, page_scene

__all__ = ["PageScene", "page_files", "page_scene", "single_html"]
