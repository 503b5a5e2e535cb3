"""Layers of a page that is sent: how many bytes they take, and how little the picture changes."""

from __future__ import annotations

import base64
import gzip
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.browser import opened, pixels, settled
from helpers.scenes import psnr

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.formats.compact_layer import compact_layer
from spackle.formats.html import encode_layer, page_scene, single_html
from spackle.render import CpuRenderer

SIDE = 256  # Gaussians to a side: more than a page keeps exactly
CAMERA = Camera.from_focal(250.0, 256, 256)


def hills() -> Gaussians:
    """One Gaussian a pixel of a coloured, hilly picture, in the order of its rows."""
    rows, columns = torch.meshgrid(
        torch.arange(SIDE) + 0.5, torch.arange(SIDE) + 0.5, indexing="ij"
    )
    uv = torch.stack([columns, rows], dim=-1)
    depth = 3 + torch.sin(columns / 20) + 0.5 * torch.cos(rows / 9)
    means = CAMERA.unproject(uv, depth).reshape(-1, 3)
    count = len(means)
    steps = torch.linspace(0, 60, count)
    colors = torch.stack([steps.sin(), (1.7 * steps).cos(), (0.3 * steps).sin()], dim=1)
    scales = (depth.reshape(-1, 1) * 0.7 / 250).repeat(1, 3)
    quats = torch.nn.functional.normalize(torch.randn(count, 4), dim=1)
    return Gaussians(
        means=means,
        quats=quats,
        scales=scales * torch.tensor([1.0, 0.8, 1.2]),
        opacities=torch.full((count,), 0.9),
        colors=0.4 + 0.3 * colors,
    )


@pytest.mark.slow
def test_a_sent_page_takes_less_than_half_and_looks_the_same(browser: Any, tmp_path: Path) -> None:
    torch.manual_seed(4)
    scene = hills()
    page = page_scene("Hills", scene, Gaussians.empty(), CAMERA, None)
    html = single_html(page)
    (inside,) = re.findall(rb'id="spackle-scene">(.*?)</script>', html)
    content = json.loads(inside)
    assert content["compact"] == ["base.splats", "aux.splats"]
    packed = base64.b64decode(content["files"]["base.splats"])
    assert len(packed) < 0.5 * len(gzip.compress(page.files["base.splats"], 9))

    (tmp_path / "hills.html").write_bytes(html)
    found = opened(browser, (tmp_path / "hills.html").as_uri())
    settled(found.page, "spackle.ready")
    for view in (0.0, 0.3):  # at the photo's place, and to the side
        found.page.evaluate("(move) => spackle.setView('swipe', move, 1)", view)
        url: str = found.page.evaluate("spackle.picture(256, 256)")
        eye = torch.tensor(found.page.evaluate("spackle.pose().eye"))
        focus = torch.tensor([0.0, 0.0, found.page.evaluate("spackle.description.focus")])
        exact = CpuRenderer().render(scene, CAMERA.looking(eye, focus)).rgb
        assert psnr(pixels(base64.b64decode(url.partition(",")[2])), exact) > 40
    assert found.said == []
    found.page.context.close()


def test_surfaces_that_nearly_touch_keep_their_order() -> None:
    pair = hills().select(slice(0, 2))
    pair.means[1] = pair.means[0] * (1 + 1 / 8000)  # right behind the other, as seen by the camera
    layer, _, _ = encode_layer(pair)
    lens = {"K": CAMERA.K.tolist(), "width": CAMERA.width, "height": CAMERA.height}
    compact = compact_layer(layer, lens)
    assert compact is not None
    low_bytes_of_depth_step = np.frombuffer(compact, np.uint8).reshape(20, 2)[6]
    assert low_bytes_of_depth_step[1] in (2, 4)  # one or two steps farther


@pytest.mark.parametrize("center", [(0.0, 0.0, -1.0), (1e6, 0.0, 1e-3)])
def test_what_lies_behind_or_far_aside_is_kept_exactly(center: tuple[float, ...]) -> None:
    scene = hills().select(slice(0, 4))
    scene.means[2] = torch.tensor(center)
    layer, _, _ = encode_layer(scene)
    lens = {"K": CAMERA.K.tolist(), "width": CAMERA.width, "height": CAMERA.height}
    assert compact_layer(layer, lens) is None
