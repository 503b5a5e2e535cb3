"""The page's files, and the page as one file."""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from importlib import resources

from spackle.viewer.scene import PageScene

TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "txt": "text/plain"}
FILES = ("index.html", "viewer.js", "viewer.css", "licenses.txt")
STYLE = '<link rel="stylesheet" href="viewer.css">'
SCRIPT = '<script src="viewer.js" defer></script>'


def page_files() -> dict[str, tuple[str, bytes]]:
    """What a server hands out: URL path to content type and bytes; "/" is the page."""
    kinds = {name: f"{TYPES[name.rpartition('.')[2]]}; charset=utf-8" for name in FILES}
    return {"/" if name == "index.html" else f"/{name}": (kinds[name], _read(name)) for name in FILES}


def single_html(scene: PageScene) -> bytes:
    """The page with a scene in it, which opens from a disk or a mail; nothing is ever fetched."""
    page, css, js = (_read(name).decode() for name in ("index.html", "viewer.css", "viewer.js"))
    held = {name: base64.b64encode(_gzipped(data)).decode() for name, data in scene.files.items()}
    data = json.dumps({"description": scene.description, "files": held}, ensure_ascii=True, separators=(",", ":"))
    data = data.replace("<", "\\u003c")  # nothing in a name may end the element
    style, script = f"<style>{css}</style>", f"<script>{js}</script>"
    embedded = f'<script type="application/json" id="spackle-scene">{data}</script>'
    page = page.replace(STYLE, f"{_policy(css, js)}\n{style}").replace(SCRIPT, f"{embedded}\n{script}")
    return page.encode()


def _policy(css: str, js: str) -> str:
    """Only these scripts and styles run, and nobody is asked for anything."""
    parts = {
        "default-src": "'none'",
        "script-src": f"{_digest(js)} 'wasm-unsafe-eval'",
        "style-src": _digest(css),
        "worker-src": "blob:",
        "img-src": "data: blob:",
        "media-src": "blob:",
        "form-action": "'none'",
        "base-uri": "'none'",
    }
    policy = "; ".join(f"{name} {value}" for name, value in parts.items())
    return f'<meta http-equiv="Content-Security-Policy" content="{policy}">'


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _gzipped(data: bytes) -> bytes:
    """The same bytes at any time: there is no clock in them."""
    packer = zlib.compressobj(6, wbits=31)
    return packer.compress(data) + packer.flush()


def _read(name: str) -> bytes:
    return resources.files("spackle.viewer").joinpath("page", name).read_bytes()
