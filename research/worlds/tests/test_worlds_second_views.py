"""Second views of worlds as training data of the residual; the worlds are a board before a wall."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("embreex", reason="needs research/worlds/requirements.txt")

from worlds.judge_residual import ARCHIVES, files_in, judge, views_of_worlds
from worlds.photo_camera import Development, developed, photographed
from worlds.second_views import (
    DEPTH_KINDS,
    MAX_OUTLINE_ERROR_PX,
    as_colors,
    base_of_world,
    guessed_depth,
    line_of_least_differences,
    second_view,
    second_view_source,
    with_far_sky,
    with_wrong_outlines,
)
from worlds.shards import StoredView, pack_world, read_view, shard_file, write_shard
from worlds.train_residual import main, mixed
from worlds.views import View

from spackle.core.camera import Camera
from spackle.core.filters import maximum_filter
from spackle.paper.training.losses import hole_psnr
from spackle.render import get_renderer
from spackle.residual.architectures import load_residual
from spackle.residual.features import hole_mask

pytestmark = pytest.mark.slow
HEIGHT, WIDTH = 60, 80
BOARD_M, WALL_M = 1.5, 4.0  # depths
DEVELOPMENT = Development(
    exposure=1.0,
    white_balance=np.ones(3, np.float32),
    contrast=0.3,
    saturation=1.0,
    glare=0.0,
    vignette=0.0,
    blur_px=0.0,
    noise=0.02,
    jpeg=80,
)


def camera_at(x: float, y: float = 0.0) -> Camera:
    """A camera moved by x and y metres, not turned."""
    pose = torch.eye(4)
    pose[:2, 3] = -torch.tensor([x, y])
    return dataclasses.replace(Camera.from_focal(70.0, WIDTH, HEIGHT), world_to_camera=pose)


def seen(camera: Camera, phase: float = 0.0) -> View:
    """What a camera sees of a board, 0.8 m wide, before a wall; both have smooth patterns."""
    center = camera.position.numpy()
    rays = (camera.pixel_centers().numpy() - [WIDTH / 2, HEIGHT / 2]) / 70.0
    on_board = center[:2] + BOARD_M * rays
    is_board = (np.abs(on_board) < 0.4).all(-1)
    point = np.where(is_board[..., None], on_board, center[:2] + WALL_M * rays)
    wave = np.sin(3 * point[..., 0] + phase) * np.cos(2 * point[..., 1])
    wall_color = np.stack([0.3 + 0.2 * wave, 0.4 - 0.2 * wave, 0.3 + 0 * wave], -1)
    board_color = np.stack([0.1 + 0 * wave, 0.1 + 0.05 * wave, 0.5 + 0 * wave], -1)
    radiance = np.where(is_board[..., None], board_color, wall_color).astype(np.float32)
    depth = np.where(is_board, BOARD_M, WALL_M).astype(np.float32)
    normal = np.tile(np.array([0, 0, -1], np.float32), (HEIGHT, WIDTH, 1))
    return View(camera, radiance, depth, normal, np.ones((HEIGHT, WIDTH), np.uint8))


def stored(view: View) -> StoredView:
    """A view as an archive gives it."""
    rgb = (255 * developed(view.radiance, DEVELOPMENT)).round().astype(np.uint8)
    return StoredView(view.camera, rgb, view.depth, view.valid)


def write_worlds(path: Path, first: int, count: int = 2) -> None:
    """An archive of worlds that differ in the phase of their patterns."""
    worlds = []
    for number in range(first, first + count):
        steps = [(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.3, 0.1), (-0.3, 0), (0, 0.2), (0, -0.2)]
        views = [seen(camera_at(*step), number) for step in steps]
        srgb = developed(views[0].radiance, DEVELOPMENT)
        photo = photographed(np.random.default_rng(number), srgb, DEVELOPMENT)
        worlds.append(pack_world(f"00-{number:06d}", photo, views, DEVELOPMENT, {}))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_shard(path, worlds)


class ExactGuess:
    """A stand-in for `lite` that knows inverse depth up to a factor and a shift."""

    def __init__(self, inverse_depth: Tensor) -> None:
        self.inverse = inverse_depth

    def inverse_depth(self, rgb: Tensor) -> Tensor:
        """The true inverse depth [H, W], in other units, with some wrong rows."""
        guess = 5 * self.inverse - 0.7
        guess[:6] = 3.0
        return guess


def test_a_base_of_true_depth_shows_the_second_view_but_for_its_holes() -> None:
    base = base_of_world(stored(seen(camera_at(0))), "true", np.random.default_rng(0))
    truth = stored(seen(camera_at(0.2)))
    sample = second_view(base, truth, get_renderer())
    assert torch.equal(sample.target, as_colors(truth.rgb))
    # What the photo does not see: points of the wall beyond its border or behind the board.
    points = truth.camera.unproject(
        truth.camera.pixel_centers(), torch.from_numpy(truth.depth)
    ).numpy()
    in_photo = 70.0 * points[..., :2] / points[..., 2:]
    is_outside = (np.abs(in_photo) > [WIDTH / 2, HEIGHT / 2]).any(-1)
    is_behind = (truth.depth == WALL_M) & (np.abs(BOARD_M / WALL_M * points[..., :2]) < 0.4).all(-1)
    hidden = torch.from_numpy(is_outside | is_behind)
    assert float(sample.hole[hidden].float().mean()) > 0.95
    # Lifting leaves pixels partly open at outlines, too.
    is_board = torch.from_numpy(truth.depth == BOARD_M)
    outline = maximum_filter(is_board, 1) & maximum_filter(~is_board, 1)
    assert not (sample.hole & ~maximum_filter(hidden | outline, 2)).any()
    assert hole_psnr(sample.rendering.rgb, sample.target, ~sample.hole) > 30


def test_views_without_holes_and_views_of_another_world_are_refused() -> None:
    photo = stored(seen(camera_at(0)))
    base = base_of_world(photo, "true", np.random.default_rng(0))
    with pytest.raises(ValueError, match="without a hole"):
        second_view(base, photo, get_renderer())
    other = stored(seen(camera_at(0.2)))
    inverted = dataclasses.replace(other, rgb=255 - other.rgb)
    with pytest.raises(ValueError, match="does not fit"):
        second_view(base, inverted, get_renderer())


def test_wrong_outlines_lie_within_five_pixels_of_the_true_ones() -> None:
    depth = seen(camera_at(0)).depth
    changed = np.zeros_like(depth, bool)
    for seed in range(8):
        wrong = with_wrong_outlines(depth, np.random.default_rng(seed))
        assert set(np.unique(wrong)) == {np.float32(BOARD_M), np.float32(WALL_M)}
        assert (wrong != depth).any()
        changed |= wrong != depth
    # The distance to the outline by brute force: to the nearest pixel of the other surface.
    rows, columns = np.nonzero(changed)
    for row, column in zip(rows, columns, strict=True):
        others = np.argwhere(depth != depth[row, column])
        away = np.abs(others - [row, column]).max(1).min()
        assert away <= MAX_OUTLINE_ERROR_PX


def test_a_guess_becomes_the_true_depth_where_it_is_right() -> None:
    photo = stored(seen(camera_at(0)))
    inverse = torch.from_numpy(1 / photo.depth)
    guess = guessed_depth(as_colors(photo.rgb), inverse, ExactGuess(inverse))  # type: ignore[arg-type]
    np.testing.assert_allclose(guess.depth[6:], photo.depth[6:], rtol=0.01)
    negative = ExactGuess(-inverse)
    with pytest.raises(ValueError, match="near for far"):
        guessed_depth(as_colors(photo.rgb), inverse, negative)  # type: ignore[arg-type]


def test_the_line_of_least_differences_has_the_least_sum_of_all_lines_through_two_points() -> None:
    # A line of least absolute differences passes through two of the points, so trying all pairs
    # finds it.
    rng = np.random.default_rng(0)
    x = rng.uniform(0, 1, 40)
    y = 2 * x + 0.5 + rng.normal(0, 0.05, 40) + 3 * (rng.random(40) < 0.2)

    def total(scale: float, shift: float) -> float:
        return float(np.abs(scale * x + shift - y).sum())

    best = math.inf
    for one in range(40):
        for other in range(one):
            scale = (y[one] - y[other]) / (x[one] - x[other])
            best = min(best, total(scale, y[one] - scale * x[one]))
    found = line_of_least_differences(torch.from_numpy(x), torch.from_numpy(y))
    assert total(*found) < 1.02 * best


def test_the_sky_lies_behind_all_surfaces() -> None:
    depth = np.array([[0.0, 2.0, 5.0]], np.float32)
    assert with_far_sky(depth).tolist() == [[20.0, 2.0, 5.0]]


def test_all_bases_give_training_views_of_an_archive(tmp_path: Path) -> None:
    path = shard_file(tmp_path, 0)
    write_worlds(path, first=0, count=3)
    source = second_view_source(path, DEPTH_KINDS, get_renderer())
    assert source.views == 18
    for index in (0, 6, 12):
        sample = source.view(np.random.default_rng(0), index)
        truth = as_colors(read_view(path, f"00-{index // 6:06d}", 1).rgb)
        assert torch.equal(sample.target, truth)
    # The same view of the three worlds, whose shapes are the same, has another hole by each depth.
    holes = [source.view(np.random.default_rng(0), index).hole for index in (0, 6, 12)]
    assert not any(torch.equal(holes[one], holes[one - 1]) for one in range(3))


def test_mixed_files_have_the_share_and_leave_none_out() -> None:
    usual = [Path(f"u{number}") for number in range(10)]
    worlds = [Path(f"w{number}") for number in range(10)]
    for share in (0.1, 0.4, 0.8):
        files = mixed(usual, worlds, share)
        assert set(files) == {*usual, *worlds}
        found = sum(file.name.startswith("w") for file in files) / len(files)
        assert found == pytest.approx(share, abs=0.02)


def test_training_in_miniature_learns_from_worlds_and_resumes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from helpers.photos import write_photo

    write_photo(tmp_path / "photos" / "0.png", 112, 96)
    write_worlds(shard_file(tmp_path / "worlds", 0), first=0)
    write_worlds(shard_file(tmp_path / "held", 7), first=56)
    out = tmp_path / "out"
    command = [
        *("--recipe", "cpu", "-o", str(out), f"worlds.folder={tmp_path}/worlds"),
        *(f"data.photos={tmp_path}/photos", "data.stereo=null", "data.rgbd=[]", "data.views=3"),
        *("data.validation_views=1", "data.cells=16", "loss.features=none", "optim.batch=2"),
        *("optim.warmup=0", "run.validate_every=2", "run.save_every=2"),
    ]
    held = f"worlds.validation={tmp_path}/held"
    assert main([*command, held, "optim.steps=2"]) == 0
    assert load_residual(out / "best.safetensors").name == "unet"
    crops = len(list((out / "cache").glob("*/worlds-00000/*.safetensors")))
    report = json.loads((out / "run.json").read_text())
    usual = len(list((out / "cache").glob("*/train/*.safetensors")))
    assert crops > 6
    # Both kinds are there at least once, and worlds are 0.4 of all.
    assert report["samples"]["train"] >= max(crops / 0.4, usual / 0.6) - 1

    assert main([*command, held, "optim.steps=4"]) == 0
    assert json.loads((out / "run.json").read_text())["step"] == 4
    assert main([*command, f"worlds.validation={tmp_path}/worlds", "optim.steps=4"]) == 2
    assert "give each archive to one of them" in capsys.readouterr().err


def test_weights_are_judged_in_the_holes_of_the_true_second_views(tmp_path: Path) -> None:
    write_worlds(shard_file(tmp_path, 7), first=0, count=1)
    views = list(views_of_worlds(files_in(tmp_path, ARCHIVES)))
    assert {view.group for view in views} == {"worlds, true"}

    def features(images: Tensor) -> list[Tensor]:
        """The images themselves, as the features of a network."""
        return [images]

    figures, pictures = judge(views, [None, None], features, alone=True)  # type: ignore[arg-type]
    for row, shown, view in zip(figures["worlds, true"], pictures, views, strict=True):
        assert row[0] == row[1]
        assert torch.equal(shown[-1], view.truth)
        hole = hole_mask(get_renderer().render(view.base.gaussians, view.camera).alpha).numpy()
        difference = (shown[1] - view.truth).numpy().astype(float)[hole]
        assert row[0][0] == pytest.approx(-10 * math.log10((difference**2).mean()), abs=1e-3)
        # The hole is filled at all: black would be far from the wall's colours.
        assert row[0][0] > 15
