"""The training batches and the validation of the lite base."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from depth_loss import DepthJudge, DepthLossWeights
from frames import MINGLED_SCALE, Frame, Measured, mingled, warp_to_right
from lite_data import write_data
from mixture import GuessedPhotos, Kept, Mixture, sure_inverse_depth
from recipe import LiteData, LiteFiles
from torch import nn
from torch.nn.functional import avg_pool2d, interpolate

from spackle.bases.lite import LiteBase
from spackle.paper.training.recipe import RgbdFolder
from spackle.runtime.errors import InputError

pytestmark = pytest.mark.slow  # not part of the package: `make test-slow` runs it


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with frames of a depth camera and stereo pairs."""
    place = tmp_path_factory.mktemp("lite")
    write_data(place)
    return place


def frame(seed: int) -> tuple[str, Frame]:
    rng = torch.Generator().manual_seed(seed)
    depth = 0.5 + torch.rand(48, 64, generator=rng)
    return str(seed), Frame(
        torch.rand(3, 48, 64, generator=rng), depth, torch.ones(48, 64, dtype=torch.bool)
    )


def blurred(rgb: torch.Tensor) -> torch.Tensor:
    return avg_pool2d(rgb[None], 9, 1, 4, count_include_pad=False)[0]


def test_a_place_in_a_step_decides_what_stands_there_and_nothing_else() -> None:
    mixture = Mixture(
        [Kept([frame(n) for n in range(5)]), Kept([frame(9)])], [1.0, 0.5], (64, 96), 0
    )
    batch = mixture.batch(7, [0, 1, 2])
    assert (
        batch.inverse_depth.shape
        == batch.valid.shape
        == (3, *(side // 2 for side in batch.rgb.shape[2:]))
    )
    for place in range(3):
        alone = mixture.batch(7, [place])
        assert torch.equal(alone.rgb[0], batch.rgb[place])
        assert torch.equal(alone.inverse_depth[0], batch.inverse_depth[place])
    assert not torch.equal(batch.rgb[0], batch.rgb[1])
    sizes = [tuple(mixture.batch(step, [0]).rgb.shape[2:]) for step in range(100)]
    assert set(sizes) == {(64, 96), (96, 64)}
    assert 10 < sizes.count((96, 64)) < 30
    names = [mixture.name(step, 0) for step in range(300)]
    assert 70 < sum(name.startswith("9") for name in names) < 130
    assert 70 < sum(" and " in name for name in names) < 140
    # merged from two sources
    assert any(name.startswith("9 and") and name != "9 and 9" for name in names)


def test_a_step_sees_its_pictures_large_or_small() -> None:
    smooth = [
        Kept(
            [
                (name, dataclasses.replace(one, rgb=blurred(one.rgb)))
                for name, one in map(frame, range(5))
            ]
        )
    ]
    whole = Mixture(smooth, [1.0], (128, 192), 0)
    mixed = Mixture(smooth, [1.0], (128, 192), 0, (1.0, 0.5, 0.3))
    heights = []
    for step in range(40):
        large, small = whole.batch(step, [0, 1]), mixed.batch(step, [0, 1])
        heights.append(min(small.rgb.shape[2:]))
        assert all(side % 32 == 0 for side in small.rgb.shape[2:])
        assert (
            small.inverse_depth.shape
            == small.valid.shape
            == (2, *(side // 2 for side in small.rgb.shape[2:]))
        )
        assert (
            small.rgb - interpolate(large.rgb, size=small.rgb.shape[2:], mode="area")
        ).abs().mean() < 0.02
        if heights[-1] == 128:
            assert torch.equal(small.rgb, large.rgb)
            assert torch.equal(small.inverse_depth, large.inverse_depth)
    assert set(heights) == {128, 64, 32}
    assert 5 < heights.count(128) < 25


def test_of_two_frames_in_one_picture_the_nearer_one_shows() -> None:
    """The front frame's median becomes e^scale of the back frame's; where one is unknown, the back
    frame stays.
    """
    depth = torch.tensor([[1.0, 1.0, 4.0, 9.0, 1.0]])
    valid = torch.tensor([[True, True, True, False, True]])
    back = Frame(
        torch.zeros(3, 1, 5),
        torch.full((1, 5), 2.0),
        torch.tensor([[True, True, True, True, False]]),
    )
    front = Frame(torch.ones(3, 1, 5), depth, valid)
    shown = mingled(np.random.default_rng(0), back, front)
    # medians where both are known
    scale = 2 * math.exp(np.random.default_rng(0).uniform(*MINGLED_SCALE))
    assert scale > 2
    expected = torch.tensor([[scale, scale, 4 * scale, 2.0, 2.0]])
    torch.testing.assert_close(shown.inverse_depth, expected)
    assert torch.equal(shown.rgb, (expected != 2).float().expand(3, 1, 5))
    assert torch.equal(shown.valid, back.valid)
    behind = dataclasses.replace(back, inverse_depth=torch.tensor([[100.0, 0.1, 0.1, 0.1, 0.1]]))
    assert mingled(np.random.default_rng(0), behind, front).rgb[0, 0].tolist() == [0, 1, 1, 0, 0]
    unknown = dataclasses.replace(front, valid=torch.zeros_like(valid))
    assert mingled(np.random.default_rng(0), back, unknown) is back


def test_the_last_frames_of_a_folder_judge_and_the_others_teach(place: Path) -> None:
    camera = RgbdFolder(folder=place / "kitchen", focal_px=60)
    data = LiteData(rgbd=(camera, camera.model_copy(update={"unit_m": 0.002})))
    files = LiteFiles.of(data)
    assert [file.path.name[0] for file in files.rgbd] == ["0", "1", "2", "3"] * 2
    assert {group.name: [file.path.name[0] for file in group.files] for group in files.groups} == {
        "kitchen": ["4", "5"],
        "kitchen-2": ["4", "5"],
    }
    assert files.digest != LiteFiles.of(data.model_copy(update={"validation": 0.5})).digest
    (near, far) = (file.read(480).inverse_depth for file in (files.rgbd[0], files.rgbd[4]))
    torch.testing.assert_close(near, 2 * far)
    assert float(near.max()) == pytest.approx(1.0)  # 1/m


def test_the_right_photo_has_the_depth_of_the_left_one() -> None:
    """A near object moves by 3 pixels and hides what is there; what it uncovers is unknown."""
    depth = torch.tensor([[8.0, 8.0, 8.0, 8.0, 2.0, 2.0, 8.0, 8.0]])
    valid = torch.tensor([[True, True, True, True, True, True, True, False]])
    seen, known = warp_to_right(depth, valid, -6 / depth + 0.75)  # far: 0; near: 2.25 to the left
    assert known.tolist() == [[True, True, True, True, False, False, True, False]]
    assert seen[known].tolist() == [8, 8, 2, 2, 8]
    # A slope that becomes wider has a crack one pixel wide, which is closed if it is empty or shows
    # the background.
    slope, shift = (
        torch.tensor([[9.0, 2.0, 2.02, 2.04, 2.06]]),
        torch.tensor([[3.0, 0.0, 0.0, 1.0, 1.0]]),
    )
    for behind in (True, False):
        seen, known = warp_to_right(slope, torch.tensor([[behind, True, True, True, True]]), shift)
        assert known.tolist() == [[False, True, True, True, True]]
        torch.testing.assert_close(seen[0, 1:], torch.tensor([2.0, 2.02, 2.04, 2.04]))


def test_both_photos_of_a_pair_teach_and_the_left_one_judges(place: Path) -> None:
    files = LiteFiles.of(LiteData(stereo=place / "pairs", validation_stereo=place / "others"))
    assert [(file.path.name, file.right) for file in files.stereo] == [
        ("one", False),
        ("one", True),
    ]
    assert [file.right for group in files.groups for file in group.files] == [False]
    left, right = (file.read(480) for file in files.stereo)
    near, far = sorted(left.inverse_depth.unique().tolist(), reverse=True)
    assert sorted(
        right.inverse_depth[right.valid].unique().tolist(), reverse=True
    ) == pytest.approx([near, far])
    # 6 f b / z: the near part by 2 pixels, the far one by 1.
    columns = torch.arange(64.0)
    edges = [columns[(frame.inverse_depth > 0.9 * near).any(0)] for frame in (left, right)]
    assert float(edges[0].max() - edges[1].max()) == 2
    assert files.stereo[1].name == f"{place / 'pairs' / 'one'} (right)"


def test_guesses_are_kept_where_the_looks_agree_and_are_not_steep() -> None:
    looks = torch.zeros(3, 8, 12)
    looks[:, :, 7:] += 1  # an outline
    looks += torch.tensor([0.0, 5.0, -2.0])[:, None, None]  # each prediction has its own factor
    looks[0, 2, 2] += 0.4  # predictions disagree here
    guess = sure_inverse_depth(looks)
    known = guess > 0
    assert not known[:, 6:8].any()
    assert not known[2, 2]
    assert known[:, 9:].all()
    assert guess[known].log().round(decimals=4).unique().tolist() == [0, 1]


def test_another_teacher_is_another_run_wherever_it_lies(place: Path, tmp_path: Path) -> None:
    data = LiteData(
        photos=place / "photos", stereo=place / "pairs", validation_stereo=place / "others"
    )
    for name, content in (("one", b"1"), ("same", b"1"), ("two", b"2")):
        (tmp_path / name).write_bytes(content)
    teachers = [None, *(tmp_path / name for name in ("one", "same", "two"))]
    none, one, same, two = (
        LiteFiles.of(data.model_copy(update={"teacher": teacher})) for teacher in teachers
    )
    assert one.digest == same.digest
    assert len({files.digest for files in (none, one, two)}) == 3
    assert (len(none.photos_to_guess), len(one.photos_to_guess)) == (0, 3)
    fewer = LiteFiles.of(data.model_copy(update={"teacher": tmp_path / "one", "guesses": 2}))
    assert [photo.name for photo in fewer.photos_to_guess] == [
        photo.name for photo in one.photos_to_guess[:2]
    ]
    assert len(fewer.photos) == 3


def test_photos_come_with_what_a_teacher_guesses_of_them(place: Path, tmp_path: Path) -> None:
    photos = sorted((place / "photos").rglob("*.*"))
    source, said = GuessedPhotos(tmp_path / "guesses", photos), list[str]()
    with pytest.raises(InputError, match="guesses are missing"):
        source.draw(np.random.default_rng(0))
    base = LiteBase.load(device="cpu")
    source.fill(base, lambda done, total: None, said.append)
    assert len(said) == 1
    assert "broken.jpg" in said[0]
    drawn = [source.draw(np.random.default_rng(seed)) for seed in range(20)]
    assert {Path(name.removeprefix("guessed ")).name for name, _ in drawn} == {"a.png", "b.png"}
    for name, frame in drawn:
        assert frame.rgb.shape[1:] == frame.inverse_depth.shape == frame.valid.shape, name
        assert float(frame.valid.float().mean()) > 0.3
        assert torch.equal(frame.valid, frame.inverse_depth > 0)
    files = sorted((tmp_path / "guesses").iterdir())
    before = [file.stat().st_mtime_ns for file in files]
    source.fill(base, lambda done, total: None, lambda line: None)
    assert [file.stat().st_mtime_ns for file in files] == before
    for file in files:
        file.write_bytes(b"nothing")
    with pytest.raises(InputError, match="no guess, or damaged: delete it"):
        source.draw(np.random.default_rng(0))


def test_a_large_frame_is_reduced_and_its_depths_are_not_mixed(place: Path) -> None:
    frame = Measured(place / "pairs" / "one").read(32)
    assert (frame.rgb.shape, frame.inverse_depth.shape) == ((3, 24, 32), (24, 32))
    assert sorted(frame.inverse_depth.unique().tolist()) == pytest.approx([1 / 6, 1 / 3])


def test_a_network_that_knows_the_depth_has_a_perfect_score(place: Path) -> None:
    frame = Measured(place / "kitchen" / "0.color.jpg", 0.001).read(480)

    class Knowing(nn.Module):
        def forward(self, rgb: torch.Tensor) -> torch.Tensor:
            # between two pixels, the later one is sampled
            return frame.inverse_depth[1::2, 1::2].log()[None]

    judge = DepthJudge(DepthLossWeights(), 64 * 64, torch.float32, torch.device("cpu"))
    frame = Frame(
        *(
            torch.cat([part, part[..., :16, :]], -2)
            for part in (frame.rgb, frame.inverse_depth, frame.valid)
        )
    )
    found = judge.measure(Knowing(), frame)
    assert found["factor"] == found["steps"] == 0
    # The depth of pixels at outlines is between those of both sides.
    assert found["abs_rel"] < 0.1 < found["ramp_abs_rel"]
    assert found["delta"] > 0.9
