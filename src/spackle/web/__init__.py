"""The page, and the server of the page and of the HTTP interface. Read `create_app`."""

from spackle.web.app import create_app

__all__ = ["create_app"]
