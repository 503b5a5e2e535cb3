"""The rendered scenes of `make reproduce`: their pictures, depths and cameras belong together."""

from __future__ import annotations

import json
from pathlib import Path

import dataset_layouts as layouts
import numpy as np
import pytest
import rendered_scenes

from spackle.core.camera import Camera
from spackle.paper.evaluation.datasets import read_cases

WIDTH = 64  # pixels: enough to compare, and fast to render
WRITERS = {
    "booster": layouts.write_booster,
    "wildrgbd": layouts.write_wildrgbd,
    "tanks": layouts.write_tanks,
    "eth3d": layouts.write_eth3d,
    "llff": layouts.write_llff,
}
# Surfaces that another one hides from the second eye, and edges, have other depths there.
SEEN_SHARE = 0.85


@pytest.fixture(scope="module")
def frames() -> list[layouts.Frame]:
    return layouts.render_frames(rendered_scenes.still_life(), WIDTH, 3)


def share_of_agreement(first: layouts.Frame, second: layouts.Frame, camera: Camera) -> float:
    """The share of the first photo's surfaces that the second's depth confirms where `camera`
    sees them.
    """
    width, height = first.size
    y, x = np.mgrid[:height, :width] + 0.5
    points = np.stack(
        [
            (x - width / 2) * first.depth / first.focal,
            (y - height / 2) * first.depth / first.focal,
            first.depth,
            np.ones_like(first.depth),
        ],
        axis=-1,
    )
    camera = camera.resized(width, height)
    seen = points @ camera.world_to_camera.numpy().T.astype(float)
    place = seen[..., :3] @ camera.K.numpy().T.astype(float)
    column = np.floor(place[..., 0] / place[..., 2]).astype(int)
    row = np.floor(place[..., 1] / place[..., 2]).astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found_depth = second.depth[row[inside], column[inside]]
    return float(np.mean(np.abs(found_depth / seen[inside][:, 2] - 1) < 0.03))


@pytest.mark.parametrize("layout", WRITERS)
def test_second_views_of_a_layout_see_the_first_views_surfaces(
    tmp_path: Path, frames: list[layouts.Frame], layout: str
) -> None:
    shown = frames[:2] if layout == "booster" else frames
    WRITERS[layout](tmp_path, shown)
    case = read_cases(layout, tmp_path)[0]
    assert len(case.second_views) == len(shown) - 1
    for frame, view in zip(shown[1:], case.second_views, strict=True):
        assert share_of_agreement(frames[0], frame, view.camera) > SEEN_SHARE
        # The comparison sees a camera that did not move.
        assert case.camera is not None
        assert share_of_agreement(frames[0], frame, case.camera) < SEEN_SHARE


@pytest.mark.parametrize("name", rendered_scenes.SCENES)
def test_a_rendered_scene_looks_like_one(name: str) -> None:
    scene = rendered_scenes.SCENES[name]()
    rgb, depth = rendered_scenes.render(scene, WIDTH, WIDTH * 3 // 4)
    assert rgb.shape == (WIDTH * 3 // 4, WIDTH, 3)
    # It is neither dark nor burnt out, and has things at many depths.
    assert 60 < rgb.mean() < 190
    assert np.mean(rgb == 255) < 0.05
    near, far = np.quantile(depth, (0.05, 0.75))
    assert 0 < 1.3 * near < far


def test_scenes_have_a_name_of_their_own(tmp_path: Path) -> None:
    layouts.write_about(tmp_path, "Rendered hall", "rendered, in ETH3D's layout")
    about = json.loads((tmp_path / "about.json").read_text())
    assert about == {"title": "Rendered hall", "about": "rendered, in ETH3D's layout"}
