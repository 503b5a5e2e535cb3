"""The single HTML file: how a layer is packed, how far the eye may go, and which scripts run."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import hashlib
import json
import math
import re
from typing import Any

import numpy as np
import pytest
import torch
from helpers.scenes import box_before_wall, random_harmonics

from spackle.core.color import extended_linear_to_srgb, linear_to_srgb
from spackle.core.gaussians import Gaussians
from spackle.core.gaussians import quat_to_matrix as matrices
from spackle.formats.html import (
    BYTES_PER_GAUSSIAN,
    encode_harmonics,
    encode_layer,
    page_scene,
    read_page_file,
    single_html,
)

EVIL = "</script><b>&\"'\ud800"
BOX = box_before_wall(width=64, height=48, focal=53)


def decoded(data: bytes, low: float, step: float) -> Gaussians:
    """Decode a layer in plain Python, by the docstring of `encode_layer`."""
    count = len(data) // BYTES_PER_GAUSSIAN
    planes = np.frombuffer(data, np.uint8).reshape(BYTES_PER_GAUSSIAN, count).astype(np.int64)
    rows = []
    for i in range(count):
        b = [int(value) for value in planes[:, i]]
        words = [b[3 * k] << 8 | b[3 * k + 1] << 16 | b[3 * k + 2] << 24 for k in range(3)]
        means = [float(np.uint32(word).view(np.float32)) for word in words]
        scales = [math.exp(low + step * value) for value in b[9:12]]
        quat = [(value - 128) / 127 / math.sqrt(2) for value in b[13:16]]
        quat.insert(b[12], math.sqrt(max(0.0, 1 - sum(part * part for part in quat))))
        rows.append([*means, *quat, *scales, b[19] / 255, *(value / 255 for value in b[16:19])])
    table = torch.tensor(rows)
    return Gaussians(table[:, :3], table[:, 3:7], table[:, 7:10], table[:, 10], table[:, 11:])


def random_gaussians(count: int = 200) -> Gaussians:
    """Near and far Gaussians of all shapes and rotations."""
    torch.manual_seed(3)
    means = torch.randn(count, 3) * torch.logspace(-1, 4, count)[:, None]
    scales = torch.exp(torch.rand(count, 3) * 14 - 9)
    return Gaussians(
        means, torch.randn(count, 4) * 3, scales, torch.rand(count), torch.rand(count, 3)
    )


def test_a_layer_is_read_back_as_precisely_as_it_says() -> None:
    wanted = random_gaussians()
    data, low, step = encode_layer(wanted)
    got = decoded(data, low, step)
    assert len(got) == len(wanted)
    torch.testing.assert_close(got.means, wanted.means, rtol=2.0**-16, atol=0)
    assert step < 0.06
    torch.testing.assert_close(got.scales.log(), wanted.scales.log(), rtol=0, atol=step / 2 + 1e-4)
    turn = matrices(got.quats) @ matrices(wanted.quats).transpose(1, 2)
    assert (
        float(torch.arccos(((turn.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1)).max())
        < 0.017
    )  # radians
    torch.testing.assert_close(got.colors, linear_to_srgb(wanted.colors), rtol=0, atol=0.502 / 255)
    torch.testing.assert_close(got.opacities, wanted.opacities, rtol=0, atol=0.502 / 255)
    # One broken size does not cost the others their precision.
    scales = torch.cat([torch.full((1, 3), 1e-37), wanted.scales[1:]])
    assert encode_layer(dataclasses.replace(wanted, scales=scales))[2] < 0.11
    assert page_scene("alone", wanted, Gaussians.empty(), BOX.camera).files["aux.splats"] == b""


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_are_read_back_as_precisely_as_they_are_small(degree: int) -> None:
    harmonics = random_harmonics(200, degree)
    harmonics[0, 0] = 5  # a single large one does not cost the others their precision
    colors = random_gaussians().colors * 3 - 1
    data, limit = encode_harmonics(colors, harmonics)
    assert limit == 5
    planes = torch.frombuffer(bytearray(data), dtype=torch.uint8).view(-1, 200).float() - 128
    values = (planes / 127) ** 2 * planes.sign() * limit
    srgb = extended_linear_to_srgb(colors)
    excess = torch.where(srgb < 0, srgb, (srgb - 1).clamp_min(0))
    wanted = torch.cat([excess.T, harmonics.flatten(1).T])
    steps = 2 * (wanted.abs() * limit).sqrt() / 127 + limit / 127**2
    assert bool(((values - wanted).abs() <= 0.51 * steps).all())


def test_harmonics_of_zero_are_read_back_as_zero() -> None:
    data, limit = encode_harmonics(torch.full((4, 3), 0.5), torch.zeros(4, 8, 3))
    assert limit == 0
    assert data == bytes([128]) * 3 * (1 + 8) * 4


def test_harmonics_are_a_file_of_the_layer_that_has_some() -> None:
    plain = page_scene("a", BOX.base(), BOX.base(), BOX.camera)
    assert set(plain.files) == {"base.splats", "aux.splats"}
    zeros = BOX.base().with_harmonics_count(8)  # as what was added to a scene that has harmonics
    count = len(zeros)
    shiny = dataclasses.replace(zeros, harmonics=random_harmonics(count, 2))
    page = page_scene("a", shiny, zeros, BOX.camera)
    assert {name: len(data) for name, data in page.files.items()} == {
        "base.splats": 20 * count,
        "base.harmonics": 27 * count,
        "aux.splats": 20 * count,
    }
    assert page.files["base.splats"] == plain.files["base.splats"]
    layers: Any = page.description["layers"]
    base, aux = layers
    assert base.pop("harmonics")["count"] == 8
    assert [base, aux] == plain.description["layers"]
    assert page_scene("a", zeros, zeros, BOX.camera) == plain


@pytest.mark.parametrize(
    ("disparity", "filled", "free"), [(0.2, 1, 0.2), (None, 1, 0.3), (None, 0, 0.6), (5, 1, 1)]
)
def test_the_eye_goes_as_far_as_the_scene_was_completed(
    disparity: float | None, filled: bool, free: float
) -> None:
    aux = random_gaussians() if filled else Gaussians.empty()
    orbit: Any = page_scene("a", BOX.base(), aux, BOX.camera, disparity).description["orbit"]
    assert (orbit["free"], orbit["limit"]) == (free, free)


def digest_of(text: str) -> str:
    """The digest by which a policy names a script or a style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def test_the_single_file_runs_its_own_script_and_style_alone() -> None:
    page = single_html(page_scene(EVIL, BOX.base(), Gaussians.empty(), BOX.camera))
    assert page == single_html(page_scene(EVIL, BOX.base(), Gaussians.empty(), BOX.camera))
    assert EVIL[:9].encode() + b"<b>" not in page
    (inside,) = re.findall(
        rb'<script type="application/json" id="spackle-scene">(.*?)</script>', page
    )
    assert json.loads(inside)["description"]["name"] == EVIL
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]+)"', page.decode())
    assert policy.startswith("default-src 'none';")
    assert "unsafe-inline" not in policy
    for element in ("script", "style"):
        (text,) = re.findall(rf"<{element}>(.*?)</{element}>", page.decode(), re.DOTALL)
        assert digest_of(text) in policy
    # The viewer travels packed.
    (packed,) = re.findall(rb'<script type="text/plain" id="spackle-viewer">(.*?)</script>', page)
    viewer = gzip.decompress(base64.b64decode(packed)).decode()
    assert viewer == read_page_file("viewer.js").decode()
    assert digest_of(viewer) in policy
    assert len(packed) < 0.7 * len(viewer)
    licences = read_page_file("licenses.txt")
    assert licences.strip() in page  # to be read by whoever opens the file
