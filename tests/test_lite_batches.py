"""What a step of the lite base's training is made of, and what its network is judged by."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from lite_data import write_data
from torch import nn

from spackle.errors import InputError
from spackle.training.ahead import Ahead
from spackle.training.depth.augment import MINGLED_SCALE, Frame, mingled
from spackle.training.depth.files import LiteFiles
from spackle.training.depth.frames import Measured
from spackle.training.depth.judging import DepthJudge
from spackle.training.depth.losses import DepthLossWeights
from spackle.training.depth.method import LiteMethod
from spackle.training.depth.mixture import Kept, Mixture
from spackle.training.depth.recipe import LiteData
from spackle.training.ranks import Ranks
from spackle.training.recipe import RgbdFolder


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of a depth camera and stereo pairs."""
    place = tmp_path_factory.mktemp("lite")
    write_data(place)
    return place


def frame(seed: int) -> tuple[str, Frame]:
    rng = torch.Generator().manual_seed(seed)
    depth = 0.5 + torch.rand(48, 64, generator=rng)
    return str(seed), Frame(torch.rand(3, 48, 64, generator=rng), depth, torch.ones(48, 64, dtype=torch.bool))


def test_a_place_in_a_step_decides_what_stands_there_and_nothing_else() -> None:
    mixture = Mixture([Kept([frame(n) for n in range(5)]), Kept([frame(9)])], [1.0, 0.5], (64, 96), 0)
    batch = mixture.batch(7, [0, 1, 2])
    assert batch.inverse_depth.shape == batch.valid.shape == (3, *(side // 2 for side in batch.rgb.shape[2:]))
    for place in range(3):
        alone = mixture.batch(7, [place])
        assert torch.equal(alone.rgb[0], batch.rgb[place])
        assert torch.equal(alone.inverse_depth[0], batch.inverse_depth[place])
    assert not torch.equal(batch.rgb[0], batch.rgb[1])
    sizes = [tuple(mixture.batch(step, [0]).rgb.shape[2:]) for step in range(100)]
    assert set(sizes) == {(64, 96), (96, 64)}
    assert 10 < sizes.count((96, 64)) < 30
    names = [mixture.name(step, 0) for step in range(300)]
    assert 70 < sum("9" in name for name in names) < 130
    assert 70 < sum(" and " in name for name in names) < 140


def test_of_two_frames_in_one_picture_the_nearer_one_shows() -> None:
    """The front one's median is put at e^scale of the back one's; where one is not known, the back one stays."""
    depth = torch.tensor([[1.0, 1.0, 4.0, 9.0, 1.0]])
    valid = torch.tensor([[True, True, True, False, True]])
    back = Frame(torch.zeros(3, 1, 5), torch.full((1, 5), 2.0), torch.tensor([[True, True, True, True, False]]))
    front = Frame(torch.ones(3, 1, 5), depth, valid)
    shown = mingled(np.random.default_rng(0), back, front)
    scale = 2 * math.exp(np.random.default_rng(0).uniform(*MINGLED_SCALE))  # both medians, over what both know
    assert scale > 2
    expected = torch.tensor([[scale, scale, 4 * scale, 2.0, 2.0]])
    torch.testing.assert_close(shown.inverse_depth, expected)
    assert torch.equal(shown.rgb, (expected != 2).float().expand(3, 1, 5))
    assert torch.equal(shown.valid, back.valid)
    behind = dataclasses.replace(back, inverse_depth=torch.tensor([[100.0, 0.1, 0.1, 0.1, 0.1]]))
    assert mingled(np.random.default_rng(0), behind, front).rgb[0, 0].tolist() == [0, 1, 1, 0, 0]
    unknown = dataclasses.replace(front, valid=torch.zeros_like(valid))
    assert mingled(np.random.default_rng(0), back, unknown) is back


def test_what_was_begun_ahead_is_what_would_have_been_made() -> None:
    made: list[int] = []

    def double(key: int) -> int:
        made.append(key)
        if key == 3:
            raise InputError("three")
        return 2 * key

    ahead = Ahead(double)
    assert ahead.take(1, 2) == 2
    assert ahead.take(2, 3) == 4
    assert ahead.take(5, 6) == 10  # not the one that was expected
    assert ahead.take(6, 3) == 12
    with pytest.raises(InputError, match="three"):
        ahead.take(3, 4)
    assert sorted(made) == [1, 2, 3, 3, 5, 6]


def test_the_last_frames_of_a_folder_judge_and_the_others_teach(place: Path) -> None:
    data = LiteData(rgbd=(RgbdFolder(place / "kitchen", 60.0), RgbdFolder(place / "kitchen", 60.0, 0.002)))
    files = LiteFiles.of(data)
    assert [file.path.name[0] for file in files.rgbd] == ["0", "1", "2", "3"] * 2
    assert {group.name: [file.path.name[0] for file in group.files] for group in files.groups} == {
        "kitchen": ["4", "5"],
        "kitchen-2": ["4", "5"],
    }
    assert files.digest != LiteFiles.of(dataclasses.replace(data, validation=0.5)).digest
    (near, far) = (file.read(480).inverse_depth for file in (files.rgbd[0], files.rgbd[4]))
    torch.testing.assert_close(near, 2 * far)
    assert float(near.max()) == pytest.approx(1.0)  # 1/m


def test_a_large_frame_is_reduced_and_its_depths_are_not_mixed(place: Path) -> None:
    frame = Measured(place / "pairs" / "one").read(32)
    assert (frame.rgb.shape, frame.inverse_depth.shape) == ((3, 24, 32), (24, 32))
    assert sorted(frame.inverse_depth.unique().tolist()) == pytest.approx([1 / 6, 1 / 3])


def test_a_network_that_knows_the_depth_has_a_perfect_score(place: Path) -> None:
    frame = Measured(place / "kitchen" / "0.color.jpg", 0.001).read(480)

    class Knowing(nn.Module):
        def forward(self, rgb: torch.Tensor) -> torch.Tensor:
            return frame.inverse_depth[1::2, 1::2].log()[None]  # in the middle of two pixels, the later one counts

    judge = DepthJudge(DepthLossWeights(), 64 * 64, torch.float32, torch.device("cpu"))
    frame = Frame(*(torch.cat([part, part[..., :16, :]], -2) for part in (frame.rgb, frame.inverse_depth, frame.valid)))
    found = judge.measure(Knowing(), frame)
    assert found["factor"] == found["steps"] == 0
    # The depth of pixels at outlines is between those of both sides.
    assert found["abs_rel"] < 0.1 < found["ramp_abs_rel"]
    assert found["delta"] > 0.9


def test_processes_share_a_step_between_them() -> None:
    mixture = Mixture([Kept([frame(n) for n in range(3)])], [1.0], (64, 64), 0)
    judge = DepthJudge(DepthLossWeights(), 64 * 64, torch.float32, torch.device("cpu"))
    methods = [
        LiteMethod(mixture, {}, judge, 4, Ranks(rank, count), 0, "") for count in (1, 2) for rank in range(count)
    ]
    assert [method.at_once for method in methods] == [4, 2, 2]
    assert [method.items for method in methods] == [4, 4, 4]
