"""Synthetic scenes: their content, how they are stored, and that their depth is exact."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import synthetic_scenes
import torch
from helpers.photos import write_photo
from lite_data import f32, photo
from ray_tracer import SHEET, Solid
from scene_kinds import Scene
from standing import SMALLEST, labelled_scene, score_standing
from synthetic_scenes import SyntheticScenes, synthetic_scene
from textures import FIRST_SHAPE, PEAK, RING, SIDE, WHOLE, textures

from spackle.runtime.errors import InputError

pytestmark = pytest.mark.slow  # not part of the package: `make test-slow` runs it

Kind = Callable[[np.random.Generator], Scene]


def test_a_made_scene_has_the_inverse_depth_of_its_planes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plane's inverse depth is an affine function of the pixel, whatever the lens and however the
    camera rolls.
    """

    def ground(rng: np.random.Generator) -> tuple[list[Solid], float]:
        """Ground 1.5 m below the eye, in front of a wall at 16 m."""
        flat = f32([[50, 0, 0], [0, 0, -1], [0, 50, 0]])
        floor = Solid(SHEET, f32([0, 1.5, 0]), flat, 0, (1.0, 1.0))
        return [floor, Solid(SHEET, f32([0, 0, 16]), f32(np.diag([50, 50, 1])), 1, (1.0, 1.0))], 0.0

    monkeypatch.setattr(synthetic_scenes, "KINDS", ((ground, 1.0),))
    rgb, inverse_depth = synthetic_scene(np.random.default_rng(3), photo, 64, 96)
    assert (rgb.shape, inverse_depth.shape) == ((64, 96, 3), (64, 96))
    assert 0 <= float(rgb.min()) < float(rgb.max()) <= 1
    assert 0.2 < float(rgb.mean()) < 0.65  # brightness as in photos
    wall = (inverse_depth - 1 / 16).abs() < 1e-6
    assert wall[0].all()
    floor = ~wall
    assert 0.1 < float(floor.float().mean()) < 0.5
    assert (inverse_depth[floor] > 1 / 16).all()
    rows, columns = (place.double() for place in floor.nonzero(as_tuple=True))
    A = torch.stack([rows, columns, torch.ones_like(rows)], 1)
    fitted = torch.linalg.lstsq(A, inverse_depth[floor].double()[:, None]).solution
    torch.testing.assert_close((A @ fitted)[:, 0], inverse_depth[floor].double(), rtol=0, atol=1e-5)
    # Its slope is one over eye height and focal length, which was drawn between 0.7 and 1.5 widths.
    focal = 1 / (1.5 * float(fitted[:2].norm()))
    assert 0.7 * 96 < focal < 1.5 * 96


def test_the_same_numbers_make_the_same_scene_and_others_another() -> None:
    one, same, other = (
        synthetic_scene(np.random.default_rng([seed, 1]), photo, 64, 64) for seed in (0, 0, 1)
    )
    assert all(map(torch.equal, one, same))
    assert not torch.equal(one[1], other[1])
    assert all(torch.isfinite(part).all() and (part >= 0).all() for part in (*one, *other))


@pytest.mark.parametrize(
    "kind", [kind for kind, _ in synthetic_scenes.KINDS], ids=lambda kind: kind.__name__
)
def test_every_kind_of_scene_has_things_before_others(
    kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(synthetic_scenes, "KINDS", ((kind, 1.0),))
    found = [
        synthetic_scene(np.random.default_rng([seed, 2]), photo, 32, 48)[1] for seed in range(12)
    ]
    steps = [
        float((depth.diff(dim=1).abs() > 0.1 * depth[:, 1:]).float().mean()) for depth in found
    ]
    assert sum(steps) / len(steps) > 0.003
    assert all(torch.isfinite(depth).all() and float(depth.max()) < 1 / 0.049 for depth in found)


def test_each_pixel_of_a_street_knows_whose_it_is_and_the_score_asks_for_true_shapes() -> None:
    frame, owner = labelled_scene(np.random.default_rng(4), photo, 64, 96)
    true = frame.inverse_depth
    assert (owner.shape, owner.dtype) == ((64, 96), torch.int64)
    assert int((owner > 0).sum()) > 100
    perfect = score_standing(3 * true + 0.2, frame, owner)
    assert perfect.things == sum(
        float(((owner == n) & (true > 0.01)).float().mean()) > SMALLEST
        for n in range(1, int(owner.max()) + 1)
    )
    assert perfect.within < 1e-6
    assert perfect.abs_rel < 1e-6
    # An object moved in depth keeps its shape; if it leans, its error is the logarithm of the
    # change in depth.
    near = owner == int(owner[owner > 0].mode().values)
    moved = score_standing(torch.where(near, 1.3 * true, true), frame, owner)
    rows = torch.arange(64)[:, None].expand(64, 96)
    leaning = score_standing(torch.where(near, true * torch.exp(0.02 * rows), true), frame, owner)
    assert moved.within < 0.5 * leaning.within
    assert moved.abs_rel > 0.01


def test_the_kinds_of_scenes_have_shares() -> None:
    assert sum(share for _, share in synthetic_scenes.KINDS) == pytest.approx(1)
    assert all(share > 0 for _, share in synthetic_scenes.KINDS)


def test_shapes_let_through_what_they_do_not_cover() -> None:
    found = textures(np.random.default_rng(0), photo)
    assert found.shape == (PEAK + 1, SIDE, SIDE, 4)
    assert 0 <= found.min() < found.max() <= 1
    covered = (found[..., 3] >= 0.5).mean((1, 2))
    assert (covered[:WHOLE] == 1).all()
    assert ((covered[FIRST_SHAPE:] > 0.02) & (covered[FIRST_SHAPE:] < 0.95)).all()
    ring, peak = found[RING, ..., 3], found[PEAK, ..., 3]
    assert ring[SIDE // 2, SIDE // 2] == 0 < ring[SIDE // 2].sum()
    assert peak[0].sum() < peak[SIDE // 2].sum() < peak[-1].sum()


def scenes(folder: Path, count: int) -> SyntheticScenes:
    return SyntheticScenes(
        folder / "made", sorted((folder / "photos").iterdir()), (32, 64), 0, count
    )


def filled(made: SyntheticScenes) -> list[str]:
    """Make the scenes; returns the warnings."""
    said: list[str] = []
    made.fill(lambda done, total: None, said.append)
    return said


def test_scenes_are_made_once_and_a_damaged_file_is_made_anew(tmp_path: Path) -> None:
    write_photo(tmp_path / "photos" / "a.png")
    (tmp_path / "photos" / "broken.jpg").write_bytes(b"\xff\xd8 no more")
    made = scenes(tmp_path, 6)
    said = filled(made)
    assert len(said) == 1
    assert said[0].startswith("passed over: ")
    assert "broken.jpg" in said[0]
    frames = [made.frame(index) for index in range(6)]
    assert {tuple(frame.rgb.shape) for frame in frames} == {(3, 32, 64), (3, 64, 32)}
    assert all(
        frame.inverse_depth.shape == frame.rgb.shape[1:] and frame.valid.all() for frame in frames
    )
    (file,) = (tmp_path / "made").iterdir()
    before, whole = file.stat().st_mtime_ns, file.read_bytes()
    assert not filled(made)
    assert file.stat().st_mtime_ns == before
    for damage in (whole[:-100], b"nothing", whole.replace(b'"U8"', b'"I8"')[:50]):
        file.write_bytes(damage)
        with pytest.raises(
            InputError, match=r"0000\.safetensors: no synthetic scenes, or damaged: delete it"
        ):
            made.frame(5)
        assert f"{file}: damaged, made anew" in filled(made)
        assert file.read_bytes() == whole
    # A larger set begins with the same scenes.
    more = scenes(tmp_path, 8)
    filled(more)
    assert all(torch.equal(more.frame(index).rgb, frames[index].rgb) for index in range(6))
    other = dataclasses.replace(made, folder=tmp_path / "other", seed=1)
    filled(other)
    assert not any(torch.equal(other.frame(index).rgb, frames[index].rgb) for index in range(6))


def test_photos_that_cannot_be_read_at_all_end_it(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "broken.jpg").write_bytes(b"\xff\xd8 no more")
    with pytest.raises(
        InputError, match=r"photos in a row cannot be read: give others as data\.photos"
    ):
        filled(scenes(tmp_path, 1))
