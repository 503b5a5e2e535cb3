"""Sources of views with holes, crops and files of samples."""

from __future__ import annotations

import itertools
import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import DATA
from helpers.photos import metres, picture, write_depth, write_photo
from helpers.scenes import (
    Scene,
    away,
    box_before_wall,
    psnr,
    shifted,
    slanted_plane,
    tensors_of,
    wall,
)
from PIL import Image
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.core.camera import Camera
from spackle.core.filters import maximum_filter
from spackle.paper.training import composites, measured_photos, samples, sources
from spackle.paper.training.recipe import DataRecipe
from spackle.paper.training.sample_factory import Source, make_samples
from spackle.paper.training.samples import (
    FIELDS_BY_FILE_NAME,
    FLOAT32_TENSORS,
    HOLE_RATIO_RANGE,
    Sample,
    load_sample,
    save_sample,
)
from spackle.paper.training.samples import random_crops as crops_of
from spackle.render import CpuRenderer
from spackle.render.protocol import tile_mask
from spackle.residual import MIN_AUX_GAUSSIANS
from spackle.residual.composer import DELTA_CHANNELS, compose
from spackle.residual.features import CELL, cell_centers
from spackle.runtime.errors import InputError

CPU = CpuRenderer()
RIM_PX = 2  # tolerance for the size of Gaussians at outlines


def grow(mask: Tensor, pixels: int = 1) -> Tensor:
    return maximum_filter(mask, pixels)


def outline(scene: Scene) -> Tensor:
    """[H, W] bool: pixels at depth edges."""
    far, near = (
        max_pool2d(sign * scene.depth[None], 3, stride=1, padding=1)[0] for sign in (1, -1)
    )
    return far + near > 0.5


def looking(camera: Camera, *eye: float) -> Camera:
    return camera.looking(torch.tensor(eye), torch.tensor([0.0, 0.0, 4.0]))


def surface(scene: Scene) -> Tensor:
    """[H, W, 3]: the points of the pixels."""
    return scene.camera.unproject(scene.camera.pixel_centers(), scene.depth)


def outside(scene: Scene, viewer: Camera, margin: float = 0.0) -> Tensor:
    """[H, W] bool: pixels whose points lie more than `margin` pixels outside of another camera's
    frame.
    """
    uv, z = viewer.project(surface(scene))
    size = torch.tensor([viewer.width, viewer.height])
    return ((uv < -margin) | (uv > size + margin)).any(-1) | (z <= 0)


def hidden(scene: Scene, viewer: Camera) -> Tensor:
    """[H, W] bool: pixels of frontal surfaces whose line to another camera meets another surface
    of the photo.
    """
    points, eye, (height, width) = surface(scene), viewer.position, scene.depth.shape
    covered = torch.zeros(height, width, dtype=torch.bool)
    for z in scene.depth.unique():
        share = (z - eye[2]) / (points[..., 2] - eye[2])  # of the line from the camera to the point
        uv, _ = scene.camera.project(eye + share[..., None] * (points - eye))
        column, row = uv.floor().long().unbind(-1)
        between = (
            (column >= 0)
            & (row >= 0)
            & (column < width)
            & (row < height)
            & (share > 0)
            & (share < 0.999)
        )
        covered |= between & (
            scene.depth[row.clamp(0, height - 1), column.clamp(0, width - 1)] == z
        )
    return covered


def reverse(scene: Scene, viewer: Camera) -> Sample:
    return sources.reverse_view(scene.lift(), scene.rgb, viewer, CPU)


@pytest.mark.parametrize(
    "eye", [(0.35, 0.0, 0.0), (-0.35, 0.0, 0.0), (0.25, -0.2, 0.15), (-0.2, 0.2, -0.3)]
)
def test_holes_are_pixels_hidden_from_the_virtual_camera(eye: tuple[float, float, float]) -> None:
    scene = box_before_wall()
    viewer = looking(scene.camera, *eye)
    behind, beside = hidden(scene, viewer), outside(scene, viewer)
    hole = reverse(scene, viewer).hole
    expected = behind | beside
    assert int(behind.sum()) > 100
    assert not (hole & ~grow(expected, RIM_PX) & ~outline(scene)).any()
    assert not (~hole & ~grow(~expected, RIM_PX)).any()
    assert not (~hole & outside(scene, viewer, margin=1)).any()


def test_views_without_holes_or_without_base() -> None:
    scene, box, small = wall(), box_before_wall(), box_before_wall(width=31, height=64)
    closed, empty = reverse(scene, scene.camera), reverse(scene, away(scene.camera))
    assert not closed.hole.any()
    assert empty.hole.all()
    assert not (reverse(box, box.camera).hole & ~outline(box)).any()
    for view in (closed, empty, reverse(small, shifted(small.camera, 0.35))):
        assert not crops_of(view, np.random.default_rng(0), 3, 16)


# Crops --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["box from aside", "ground in reverse"])
def whole(request: pytest.FixtureRequest) -> Sample:
    if request.param == "box from aside":
        scene = box_before_wall(width=144, height=112, focal=120)
        view, base = shifted(scene.camera, 0.4), scene.base()
        return Sample.of(base, CPU.render(base, view), view, scene.camera, scene.rgb, scene.rgb)
    scene = slanted_plane(1.5, 4.5, 0, 144, 112, 120)
    scene.depth[40:80, 50:90] = 1.2  # a stone
    return reverse(scene, looking(scene.camera, -0.4, 0.1, 0.1))


@pytest.mark.parametrize(
    ("row", "column"), [(0, 0), (32, 48), (13, 27), (7, 20)]
)  # corners, and off the tiles' grid
def test_a_completed_crop_equals_a_part_of_the_completed_view(
    whole: Sample, row: int, column: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    side = 24  # cells
    monkeypatch.setattr(samples, "MAX_GAUSSIANS_PER_PIXEL", 9)
    crop = whole.crop(row, column, side, side)
    part = slice(CELL * row, CELL * (row + side)), slice(CELL * column, CELL * (column + side))
    cells = slice(row, row + side), slice(column, column + side)
    for name in ("features", "surroundings"):
        for mine, yours in zip(
            tensors_of(getattr(crop, name)), tensors_of(getattr(whole, name)), strict=True
        ):
            assert torch.equal(mine, yours[cells])
    assert torch.equal(crop.target, whole.target[part])
    assert torch.equal(crop.hole, whole.hole[part])
    assert torch.equal(crop.initial.uv, cell_centers(crop.camera))
    # Fewer Gaussians give the same image; the completed crop equals the crop of the completed view.
    assert len(crop.base) < 0.7 * len(whole.base)
    inside = tile_mask(crop.tiles, CELL * side, CELL * side)
    drawn = CPU.render(crop.base, crop.camera, tiles=crop.tiles)
    for name, tolerance in (("rgb", 3e-5), ("depth", 1e-4), ("alpha", 1e-5)):
        assert (getattr(drawn, name) - getattr(whole.rendering, name)[part]).abs()[
            inside
        ].max() < tolerance
    chosen = crop.view.cells(MIN_AUX_GAUSSIANS)
    masked = torch.zeros_like(whole.features.mask)
    masked[cells] = chosen
    deltas = 0.5 * torch.randn(
        int(chosen.sum()), DELTA_CHANNELS, generator=torch.Generator().manual_seed(row)
    )
    aux = compose(whole.initial.select(masked), deltas, whole.camera)
    crop_aux = compose(crop.initial.select(chosen), deltas, crop.camera)
    assert torch.allclose(aux.means, crop_aux.means, rtol=1e-5, atol=1e-5)
    expected = CPU.render([whole.base, aux], whole.camera)
    found = CPU.render(
        [crop.base, crop_aux], crop.camera, tiles=crop.tiles, previous_rendering=crop.rendering
    )
    assert crop.hole.any()
    assert (found.rgb - whole.rendering.rgb[part]).abs()[
        crop.hole
    ].max() > 0.05  # aux Gaussians are visible
    assert (found.rgb - expected.rgb[part]).abs()[inside].max() < 3e-5
    assert (found.alpha - expected.alpha[part]).abs()[inside].max() < 1e-5
    assert torch.equal(found.rgb[~inside], whole.rendering.rgb[part][~inside])


@pytest.mark.parametrize(("width", "height"), [(97, 71), (33, 33)])
def test_random_crops_have_holes_and_lie_within_the_picture(width: int, height: int) -> None:
    scene = box_before_wall(width=width, height=height)
    sample = reverse(scene, shifted(scene.camera, 0.35))
    found = [crops_of(sample, np.random.default_rng(seed), 4, 16) for seed in (*range(6), 0)]
    assert any(found)
    assert all(len(crops) <= 4 for crops in found)
    assert all(torch.equal(a.target, b.target) for a, b in zip(found[0], found[-1], strict=True))
    for crop in itertools.chain(*found):
        left, top = (round(float(k)) for k in (sample.camera.K[:2, 2] - crop.camera.K[:2, 2]))
        assert left % CELL == top % CELL == 0
        assert 0 <= left <= width - 32
        assert 0 <= top <= height - 32
        assert torch.equal(crop.target, scene.rgb[top : top + 32, left : left + 32])
        assert (
            HOLE_RATIO_RANGE[0]
            < float((crop.rendering.alpha < 0.95).float().mean())
            < HOLE_RATIO_RANGE[1]
        )


# Composites ---------------------------------------------------------------------------------------

PALETTE = torch.tensor(
    [[0.9, 0.1, 0.1], [0.1, 0.8, 0.2], [0.2, 0.2, 0.9], [0.9, 0.9, 0.1], [0.1, 0.9, 0.9]]
)


@pytest.mark.parametrize("seed", range(8))
def test_a_cut_out_is_nearer_than_its_background(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def composite(objects: int) -> tuple[Tensor, Tensor]:
        """A composite of photos with one colour each; more objects do not change earlier
        objects.
        """
        monkeypatch.setattr(composites, "CUTOUT_COUNT", (objects, objects))
        colors = iter(PALETTE)
        return composites.compose_cutouts(
            np.random.default_rng(seed), lambda rng: next(colors).expand(150, 200, 3), 120, 160
        )

    steps = [composite(count) for count in range(5)]
    assert all(map(torch.equal, steps[-1], composite(4)))
    for (rgb, inverse), (next_rgb, next_inverse) in itertools.pairwise(steps):
        assert 0.5 / 8.0 * 0.99 < next_inverse.min() < next_inverse.max() < 1.2 / 0.7
        moved, painted = next_inverse != inverse, (next_rgb - rgb).abs().amax(-1) > 1e-4
        assert (next_inverse > 1.03 * inverse)[moved].all()
        assert (
            not moved.any()
            or composites.CUTOUT_AREA[0] < float(moved.float().mean()) < composites.CUTOUT_AREA[1]
        )
        assert not (moved & ~painted).any()
        assert (painted & ~grow(moved)).float().mean() < 2e-3
    assert any((b[1] != a[1]).any() for a, b in itertools.pairwise(steps))


# Files --------------------------------------------------------------------------------------------


def test_a_sample_file_is_small_and_renders_the_same(tmp_path: Path) -> None:
    scene = box_before_wall(width=272, height=204, focal=226)
    view, base = shifted(scene.camera.resized(192, 144), 0.4), scene.base()
    target = (255 * CPU.render(base, view).rgb).round() / 255
    crop = Sample.of(base, CPU.render(base, view), view, scene.camera, scene.rgb, target).crop(
        4, 20, 64, 64
    )
    path = tmp_path / "0.safetensors"
    save_sample(crop, path)
    found, content = load_sample(path), path.read_bytes()
    assert len(content) < 55 * 128**2
    assert len(found.base) < 0.5 * len(base)
    assert torch.equal(found.initial.uv, crop.initial.uv)
    for name in FLOAT32_TENSORS:
        part, _, field = FIELDS_BY_FILE_NAME.get(name, name).partition(".")
        assert torch.equal(
            getattr(getattr(found, part), field), getattr(getattr(crop, part), field)
        ), name
    for mine, yours in (
        (found.surroundings, crop.surroundings),
        (found.initial, crop.initial),
        (found.rendering, crop.rendering),
    ):
        for one, other in zip(tensors_of(mine), tensors_of(yours), strict=True):
            torch.testing.assert_close(one, other, rtol=2**-11, atol=0.51 / 255)
    assert torch.equal(found.target, crop.target)
    assert torch.equal(found.features.mask, crop.features.mask)
    assert (found.camera.width, found.camera.height) == (128, 128)
    drawn, inside = (
        CPU.render(found.base, found.camera, tiles=found.tiles),
        tile_mask(found.tiles, 128, 128),
    )
    assert psnr(drawn.rgb[inside], crop.rendering.rgb[inside]) > 45
    save_sample(found, path)
    assert path.read_bytes() == content
    for keep in (0, 200, -1):
        path.write_bytes(content[:keep])
        with pytest.raises(InputError, match=r"0\.safetensors: not a training sample, or damaged"):
            load_sample(path)


def fill(folder: Path, killed_at: int | None = None) -> tuple[list[str], list[float]]:
    """Files of the samples of five views, and the camera positions of the views made in this
    call.
    """
    asked: list[float] = []

    def view(rng: np.random.Generator, number: int) -> Sample:
        if len(asked) == killed_at:
            raise KeyboardInterrupt
        asked.append(float(rng.uniform(-0.4, 0.4)))
        scene = box_before_wall()
        return reverse(scene, shifted(scene.camera, asked[-1]))

    warnings: list[str] = []
    data, source = DataRecipe(crops=2, cells=16), Source(1.0, view, [])
    files = make_samples(data, [source], folder, 7, 5, lambda done, total: None, warnings.append)
    assert not warnings
    return [file.name for file in files], asked


def test_making_samples_resumes_with_the_same_files(tmp_path: Path) -> None:
    def contents(folder: Path) -> dict[str, bytes]:
        return {file.name: file.read_bytes() for file in folder.iterdir()}

    files, asked = fill(tmp_path / "whole")
    expected, part = contents(tmp_path / "whole"), tmp_path / "part"
    assert len(set(asked)) == 5
    assert len(files) == len(set(files)) > 5
    assert {*files} | {f"{n:06d}.done" for n in range(5)} == expected.keys()
    with pytest.raises(KeyboardInterrupt):
        fill(part, killed_at=3)
    assert contents(part) == {name: data for name, data in expected.items() if name < "000003"}
    (part / "000001.done").unlink()  # killed before the marker was written
    (part / files[0]).unlink()  # deleted
    (part / "000002.done").write_text("")  # a power cut
    assert fill(part) == (files, asked)
    assert contents(part) == expected
    assert fill(part) == (files, [])  # nothing is made twice


# Sources ------------------------------------------------------------------------------------------


def pixels(photo: Path) -> Tensor:
    return torch.from_numpy(np.array(Image.open(photo))).float() / 255


@pytest.mark.parametrize("unit_m", [0.001, 0.0002])
def test_frames_of_a_depth_camera(tmp_path: Path, unit_m: float) -> None:
    stored = np.round(metres(96, 72) / unit_m).astype(np.uint16)
    stored[2:5, 2:5], stored[60:63, 80:83] = 0, 65535  # unknown
    color, depth = tmp_path / "frame-0.color.jpg", tmp_path / "frame-0.depth.png"
    Image.fromarray(stored).save(depth)
    Image.fromarray(picture(96, 72)).save(color, quality=95)
    rgb, known, camera = measured_photos.draw_rgbd_frame(
        np.random.default_rng(1), [color], 80.0, unit_m
    )
    assert torch.equal(rgb, pixels(color))
    assert camera.focal == (80.0, 80.0)
    assert int((~known.valid).sum()) == 2 * 9
    assert torch.allclose(
        known.depth[known.valid], torch.from_numpy(metres(96, 72))[known.valid], atol=unit_m
    )
    write_depth(depth, metres(40, 72))
    with pytest.raises(InputError, match=r"is 40×72 but photo .* is 96×72"):
        measured_photos.load_frame(color, unit_m)


WALL_PX, BOX_PX = 4, 12  # disparities; the file's values are smaller by 3, its `doffs_px`


def write_stereo(folder: Path, **changes: Any) -> Path:
    """Write a stereo pair of a box in front of a wall, with changes in scene.json."""
    shutil.copytree(DATA / "stereo", folder, dirs_exist_ok=True)
    facts = json.loads((folder / "scene.json").read_text())
    (folder / "scene.json").write_text(json.dumps({**facts, **changes}))
    return folder


def test_targets_of_a_stereo_pair(tmp_path: Path) -> None:
    folder = write_stereo(tmp_path, disparity="maps/left.npz")  # in another folder
    (folder / "maps").mkdir()
    (folder / "disparity.npz").rename(folder / "maps" / "left.npz")
    sample = sources.random_right_view(np.random.default_rng(0), [folder], CPU)
    right = pixels(folder / "right.png")
    assert torch.equal(sample.target, right)
    covered = ~grow(sample.hole)
    assert psnr(sample.rendering.rgb[covered], right[covered]) > 30
    # The two planes lie where the disparities say: depth = focal · baseline / disparity.
    depth = sample.rendering.depth
    assert torch.allclose(depth[10:20, 10:80], torch.tensor(80 * 0.3 / WALL_PX), rtol=0.01)
    assert torch.allclose(depth[30:42, 36:50], torch.tensor(80 * 0.3 / BOX_PX), rtol=0.01)
    # Hidden in the left photo: the wall beside the box's right side, and the last column.
    expected = torch.zeros_like(sample.hole)
    expected[24:48, 64 - 9 : 64 - 1] = True
    expected[:, 95:] = True
    assert not (sample.hole & ~grow(expected)).any()
    assert not (~sample.hole & ~grow(~expected)).any()
    assert sample.hole[26:46, 57:61].all()
    left = partial(measured_photos.draw_left_photo, folders=[folder])
    sample = sources.random_reverse_view(np.random.default_rng(0), left, (0.3, 0.6), CPU)
    assert torch.equal(sample.target, pixels(folder / "left.png"))
    assert torch.equal(sample.camera.world_to_camera, torch.eye(4))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"left": None}, "no stereo pair"),
        ({"focal_px": 10**400}, "scene.json"),
        ({"right": "small.png"}, "the two photos differ in size"),
        ({"disparity": "narrow.npy"}, "narrow.npy is 20×72 but photo"),
    ],
)
def test_unusable_pairs_are_refused(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    folder = write_stereo(tmp_path, **changes)
    write_photo(folder / "small.png", 32, 24)
    np.save(folder / "narrow.npy", np.full((72, 20), 4, np.float32))
    with pytest.raises(InputError, match=said) as caught:
        measured_photos.load_pair(folder)
    assert str(folder) in str(caught.value)
