"""The page that people look at a scene with, by a server or as one file."""

from spackle.web.page import PageScene, page_files, page_scene, single_html

__all__ = ["PageScene", "page_files", "page_scene", "single_html"]
