"""A scene for the page: a description, Gaussians of 20 bytes each, and the page as one file."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import hashlib
import json
import math
from importlib import resources

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import (
    DEFAULT_OVERSCAN,
    SHARP_TRAJECTORIES,
    DepthRange,
    TrajectoryKind,
    disparity_to_offset,
    trajectory_cameras,
)
from spackle.formats.scene_files import encode_smallest_three
from spackle.runtime.errors import InputError

SAMPLES = 121  # positions along a path, between which the page interpolates linearly
USUAL, FOREIGN = (
    0.3,
    0.6,
)  # disparity limit of a completed scene, and of another program's, if none is stored
LEAST, MOST = 0.01, 1.0  # bounds of the disparity limit
BYTES_PER_GAUSSIAN = (
    20  # byte planes: 9 of centres, 3 of scales, 4 of rotations, 3 of colours, 1 of opacity
)
SMALLEST_SCALE, LARGEST_SCALE = (
    1e-7,
    1e5,
)  # bounds of scales, because an outlier would cost the others precision
BLOCK = 1 << 16  # Gaussians that are packed at a time, which fit the cache

STYLE = '<link rel="stylesheet" href="viewer.css">'
SCRIPT = '<script src="viewer.js" defer></script>'


@dataclasses.dataclass(frozen=True)
class PageScene:
    """A scene for the page: its description, and its packed Gaussians."""

    description: dict[str, object]  # to be written as JSON
    files: dict[str, bytes]  # the layers, by their file names in the description


def page_scene(
    name: str,
    base: Gaussians,
    aux: Gaussians,
    camera: Camera,
    disparity: float | None = None,
    note: str = "",
) -> PageScene:
    """Prepare a scene for the page.

    The description's `paths` have two lists of positions [SAMPLES, 3] in metres for each trajectory. The camera is at
    still + disparity · moving, because sideways motion grows with the disparity and forward motion does not.

    Args:
        name: the scene's name on the page.
        base: the base's Gaussians.
        aux: the Gaussians that completion added; may be empty.
        camera: the photo's camera, at the world's origin.
        disparity: the disparity for which the scene was completed; it limits the page's camera.
        note: a note for the user; the page always shows the part before the semicolon.

    Raises:
        InputError: no Gaussian lies in front of the camera.
    """
    if not bool((base.means[:, 2] > 0).any()):
        raise InputError(
            f"{name}: no Gaussian lies in front of the photo's camera: nothing can be shown"
        )
    depths = DepthRange.of(base)
    free = min(
        max((USUAL if len(aux) else FOREIGN) if disparity is None else disparity, LEAST), MOST
    )
    files, layers = {}, []
    for layer, gaussians in {"base": base, "aux": aux}.items():
        file = f"{layer}.splats"
        files[file], low, step = encode_layer(gaussians)
        layers.append(
            {
                "name": layer,
                "file": file,
                "count": len(gaussians),
                "scaleLow": low,
                "scaleStep": step,
            }
        )
    drawn = camera if disparity is None else camera.zoomed(1 + DEFAULT_OVERSCAN)
    description: dict[str, object] = {
        "name": name,
        "note": note,
        "camera": {"K": drawn.K.tolist(), "width": camera.width, "height": camera.height},
        "focus": depths.focus,
        "zNear": depths.near,
        "orbit": {"unit": disparity_to_offset(camera, 1.0, depths), "free": free, "limit": free},
        "paths": {kind: _path(kind, camera, depths) for kind in SHARP_TRAJECTORIES},
        "layers": layers,
    }
    return PageScene(description, files)


def _path(kind: TrajectoryKind, camera: Camera, depths: DepthRange) -> dict[str, list[list[float]]]:
    """Camera positions at disparity 0 (`still`), and their change for a disparity of 1 (`moving`), to nine digits."""
    still, wide = (
        torch.stack(
            [
                each.position
                for each in trajectory_cameras(
                    kind, camera.to("cpu", torch.float64), far, depths, SAMPLES
                )
            ]
        )
        for far in (0.0, 1.0)
    )
    parts = {"still": still, "moving": wide - still}
    return {
        name: [[float(f"{x:.9g}") + 0.0 for x in eye] for eye in eyes.tolist()]
        for name, eyes in parts.items()
    }


@torch.no_grad()
def encode_layer(gaussians: Gaussians) -> tuple[bytes, float, float]:
    """Pack N Gaussians for the page as byte planes, which compress well.

    A plane has N bytes. Nine planes hold x, y and z: the upper 24 bits of a float32, lowest byte first. The others hold
    the logarithms of the three scales; the index of the quaternion's largest component (wxyz), which is made positive;
    the other three components, ±127 for ±1/√2; red, green, blue in sRGB; opacity. Rounding to 24 bits moves a centre by
    at most 2⁻¹⁶ of its distance to the photo's camera, which is a hundredth of a pixel.

    Returns:
        The bytes [BYTES, N]; the logarithm of the scale for byte 0; the increase of the logarithm per step.
    """
    means, quats, scales, opacities, colors = (
        t.detach().to("cpu", torch.float32) for t in gaussians.tensors
    )
    low, step = _scale_range(scales)
    planes = np.empty((BYTES_PER_GAUSSIAN, len(gaussians)), np.uint8)
    for start in range(0, len(gaussians), BLOCK):
        part = slice(start, start + BLOCK)
        bits = (means[part].T.contiguous().numpy().view(np.uint32) + np.uint32(0x80)).view(
            np.uint8
        )  # little-endian
        planes[0:9, part] = bits.reshape(3, -1, 4)[:, :, 1:].transpose(0, 2, 1).reshape(9, -1)
        logs = scales[part].clamp(SMALLEST_SCALE, LARGEST_SCALE).log()
        planes[9:12, part] = _bytes((logs - low) / step)
        planes[12, part], others = encode_smallest_three(
            torch.nn.functional.normalize(quats[part], dim=-1).numpy()
        )
        planes[13:16, part] = _bytes(torch.from_numpy(others) * (127 * math.sqrt(2)) + 128)
        planes[16:19, part] = _bytes(linear_to_srgb(colors[part]) * 255)
        planes[19, part] = _bytes(opacities[part, None] * 255)
    return planes.tobytes(), low, step


def _scale_range(scales: Tensor) -> tuple[float, float]:
    if not scales.numel():
        return 0.0, 1.0
    low, high = (
        math.log(min(max(float(end), SMALLEST_SCALE), LARGEST_SCALE))
        for end in torch.aminmax(scales)
    )
    return low, max(high - low, 1e-3) / 255


def _bytes(values: Tensor) -> NDArray[np.uint8]:
    """Values [rows, C], rounded, clamped to 0..255 and transposed to [C, rows]."""
    return values.round().clamp(0, 255).to(torch.uint8).T.numpy()


def html_safe_json(value: object) -> bytes:
    """JSON in ASCII that is safe inside HTML."""
    text = json.dumps(value, allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text.encode("ascii")


def single_html(scene: PageScene) -> bytes:
    """The page with a scene embedded; it opens from a disk or an e-mail and fetches nothing."""
    page, css, js = (
        read_page_file(name).decode() for name in ("index.html", "viewer.css", "viewer.js")
    )
    held = {
        name: base64.b64encode(gzip.compress(data, 6, mtime=0)).decode()
        for name, data in scene.files.items()
    }
    data = html_safe_json({"description": scene.description, "files": held}).decode()
    style, script = f"<style>{css}</style>", f"<script>{js}</script>"
    embedded = f'<script type="application/json" id="spackle-scene">{data}</script>'
    policy = (  # allows only these scripts and styles
        f"default-src 'none'; script-src {_digest(js)} 'wasm-unsafe-eval'; style-src {_digest(css)}; worker-src blob:; "
        "img-src data: blob:; media-src blob:; form-action 'none'; base-uri 'none'"
    )
    meta = f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
    page = page.replace(STYLE, f"{meta}\n{style}").replace(SCRIPT, f"{embedded}\n{script}")
    return page.encode()


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def read_page_file(name: str) -> bytes:
    return (
        resources.files("spackle").joinpath("web", "page", name).read_bytes()
    )  # importing FastAPI would take a second
