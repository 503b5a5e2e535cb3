"""The page, and the server of the page and of the HTTP interface. Read `create_app`."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from spackle.web.app import create_app as create_app

__all__ = ["create_app"]


if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name != "create_app":
            raise AttributeError(f"module 'spackle.web' has no attribute {name!r}")
        from spackle.web.app import create_app  # FastAPI takes a second to load

        return create_app
