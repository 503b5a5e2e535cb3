"""Videos and pictures, read back by an independent decoder."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image
from scenes import psnr
from torch import Tensor

from spackle.errors import InputError
from spackle.formats import VideoWriter, save_gray_png, save_png, save_video


def frames(count: int, height: int, width: int) -> list[Tensor]:
    """A smooth picture that moves."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    return [torch.stack([x * (20 - k) / 20, y, 0.5 + 0.3 * torch.sin(x + y + k / 5)], dim=-1) for k in range(count)]


@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 65), (1, 1)])
def test_video_decodes_to_what_went_in(tmp_path: Path, height: int, width: int) -> None:
    given = frames(12, height, width)
    path = tmp_path / "a.mp4"
    save_video(iter(given), path, fps=25)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.average_rate == 25
        decoded = list(container.decode(stream))
    assert len(decoded) == 12
    for sent, got in zip(given, decoded, strict=True):
        assert (got.height, got.width) == (height + height % 2, width + width % 2)
        assert got.format.name == "yuv420p"
        assert (got.colorspace, got.color_primaries, got.color_trc, got.color_range) == (1, 1, 1, 1)
        rgb = torch.from_numpy(got.to_ndarray(format="rgb24")).float() / 255
        assert psnr(rgb[:height, :width], sent) > 35
    assert os.listdir(tmp_path) == ["a.mp4"]


@pytest.mark.parametrize("color", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.2, 0.6, 0.4)])
def test_colours_are_bt709(tmp_path: Path, color: tuple[float, float, float]) -> None:
    save_video([torch.tensor(color).expand(32, 32, 3)], tmp_path / "a.mp4")
    with av.open(str(tmp_path / "a.mp4")) as container:
        planes = next(container.decode(video=0)).to_ndarray()
    luma = 0.2126 * color[0] + 0.7152 * color[1] + 0.0722 * color[2]
    expected = [16 + 219 * luma, 128 + 224 * (color[2] - luma) / 1.8556, 128 + 224 * (color[0] - luma) / 1.5748]
    assert [planes[5, 5], planes[34, 5], planes[42, 5]] == pytest.approx(expected, abs=2)


def test_index_comes_first_and_odd_rates_last(tmp_path: Path) -> None:
    save_video(frames(3, 16, 16), tmp_path / "a.mp4", fps=30000 / 1001)
    content = (tmp_path / "a.mp4").read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].average_rate == Fraction(30000, 1001)


def test_strange_values_are_clamped(tmp_path: Path) -> None:
    frame = torch.full((16, 16, 3), 7.0, dtype=torch.float64, requires_grad=True)
    with VideoWriter(tmp_path / "a.mov") as writer:
        writer.add(frame)
        writer.add(torch.full((16, 16, 3), math.nan))
    with av.open(str(tmp_path / "a.mov")) as container:
        means = [f.to_ndarray(format="rgb24").mean() for f in container.decode(video=0)]
    assert means == pytest.approx([255, 0], abs=2)


def failing() -> Iterator[Tensor]:
    yield from frames(3, 16, 16)
    raise RuntimeError("the renderer broke")


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a.webp", "a.webm"])
def test_a_failed_video_leaves_the_old_file(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="renderer"):
        save_video(failing(), path)
    with pytest.raises(ValueError, match="at least one frame"):
        save_video([], path)
    with pytest.raises(ValueError, match="frame 1 is"):
        save_video([*frames(1, 16, 16), *frames(1, 16, 18)], path)
    with pytest.raises(ValueError, match="a video frame is"):
        save_video([torch.zeros(3, 16, 16)], path)
    assert os.listdir(tmp_path) == [name]
    assert path.read_bytes() == b"old"


def animation(path: Path) -> tuple[list[Tensor], list[int], int | None]:
    """Frames, their milliseconds and the loop count of a GIF or WebP, by Pillow."""
    shown, times = [], []
    with Image.open(path) as image:
        loop = image.info.get("loop")
        for index in range(getattr(image, "n_frames", 1)):
            image.seek(index)
            rgba = torch.from_numpy(np.array(image.convert("RGBA"))).float() / 255
            assert bool((rgba[..., 3] == 1).all())
            shown.append(rgba[..., :3])
            times.append(round(image.info["duration"]))
    return shown, times, loop


@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 65), (1, 1)])
@pytest.mark.parametrize(("name", "least"), [("a.gif", 22), ("a.webp", 33)])
def test_animations_decode_to_what_went_in(tmp_path: Path, name: str, least: float, height: int, width: int) -> None:
    given = frames(6, height, width)
    save_video(iter(given), tmp_path / name, fps=12)
    shown, times, loop = animation(tmp_path / name)
    assert loop == 0
    if height > 1:  # a picture that stays the same is stored once
        assert len(shown) == 6
        assert sum(times) == pytest.approx(500, abs=10)
        assert max(times) - min(times) <= 10
    for sent, got in zip(given, shown, strict=False):
        assert got.shape == (height, width, 3)
        assert psnr(got, sent) > least
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("name", ["a.gif", "a.webp"])
def test_an_animation_says_how_often_it_plays(tmp_path: Path, name: str) -> None:
    # GIF counts repetitions, and says nothing where there is none; WebP counts showings.
    expected = {0: 0, 1: None, 3: 2} if name == "a.gif" else {0: 0, 1: 1, 3: 3}
    for plays, stored in expected.items():
        save_video(frames(2, 8, 8), tmp_path / name, loop=plays)
        assert animation(tmp_path / name)[2] == stored


def test_a_gif_keeps_rare_colours_and_spreads_a_gradient(tmp_path: Path) -> None:
    """One palette for all frames: a small orange lamp stays orange, and grey steps are not seen as bands."""
    ramp = torch.linspace(0.1, 0.6, 160).expand(90, 160)[..., None].repeat(1, 1, 3)
    pictures = [ramp.clone() for _ in range(3)]
    for k, picture in enumerate(pictures):
        picture[40:46, 20 * k : 20 * k + 6] = torch.tensor([1.0, 0.5, 0.1])
    save_video(pictures, tmp_path / "a.gif", fps=10)
    for k, got in enumerate(animation(tmp_path / "a.gif")[0]):
        lamp = got[41:45, 20 * k + 1 : 20 * k + 5].mean(dim=(0, 1))
        torch.testing.assert_close(lamp, torch.tensor([1.0, 0.5, 0.1]), atol=0.03, rtol=0)
        columns = got[:30].mean(dim=(0, 2))
        assert float((columns - ramp[0, :, 0]).abs().max()) < 0.01


def test_what_moves_leaves_no_trace_in_a_gif(tmp_path: Path) -> None:
    still = torch.zeros(20, 60, 3)
    pictures = [still.clone() for _ in range(5)]
    for k, picture in enumerate(pictures):
        picture[5:15, 10 * k : 10 * k + 10] = 1.0
    save_video(pictures, tmp_path / "a.gif")
    for sent, got in zip(pictures, animation(tmp_path / "a.gif")[0], strict=True):
        assert torch.equal(got, sent)


def test_webm_is_vp9_in_bt709_and_plays_while_it_loads(tmp_path: Path) -> None:
    given, path = frames(8, 47, 65), tmp_path / "a.webm"
    save_video(given, path, fps=25)
    content = path.read_bytes()
    assert 0 < content.index(b"\x1c\x53\xbb\x6b") < content.index(b"\x1f\x43\xb6\x75")  # cues before clusters
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name == "vp9"
        decoded = list(container.decode(video=0))
    assert [round(frame.time * 25) for frame in decoded] == list(range(8))
    for sent, got in zip(given, decoded, strict=True):
        assert (got.height, got.width) == (48, 66)
        assert (got.colorspace, got.color_primaries, got.color_trc, got.color_range) == (1, 1, 1, 1)
        assert psnr(torch.from_numpy(got.to_ndarray(format="rgb24")).float()[:47, :65] / 255, sent) > 33


@pytest.mark.parametrize("name", ["a.mp4", "a.webm"])
def test_a_video_without_a_count_holds_every_repetition(tmp_path: Path, name: str) -> None:
    given = frames(7, 32, 32)
    save_video(given, tmp_path / name, fps=30, loop=3)
    with av.open(str(tmp_path / name)) as container:
        decoded = list(container.decode(video=0))
    assert len(decoded) == 21
    assert [frame.time for frame in decoded] == pytest.approx([k / 30 for k in range(21)], abs=0.002)
    for k, got in enumerate(decoded):
        assert psnr(torch.from_numpy(got.to_ndarray(format="rgb24")).float() / 255, given[k % 7]) > 30


@pytest.mark.parametrize(
    ("name", "fps", "loop", "said"),
    [
        ("a.gif", 51, None, "0.01 to 50"),
        ("a.webp", 91, None, "0.01 to 90"),
        ("a.gif", 30, -1, "loop count"),
        ("a.webp", 30, 65_536, "loop count"),
        ("a.mp4", 30, 0, "play for ever"),
        ("a.webm", 30, 1001, "from 1 to 1000"),
        ("a.mp4", 0, None, "frames a second"),
        ("a.mp4", -1, None, "frames a second"),
        ("a.mp4", math.nan, None, "frames a second"),
        ("a.mp4", math.inf, None, "frames a second"),
        ("a.avi", 30, None, r"a\.avi"),
        ("a", 30, None, "not a name for a video"),
        ("none/a.mp4", 30, None, "does not exist"),
    ],
)
def test_what_a_format_does_not_know_is_refused(tmp_path: Path, name: str, fps: float, loop: int, said: str) -> None:
    with pytest.raises(InputError, match=said):
        VideoWriter(tmp_path / name, fps, loop)
    with pytest.raises(InputError, match="too large"), VideoWriter(tmp_path / "b.webp") as writer:
        writer.add(torch.zeros(1, 16_384, 3))
    assert not os.listdir(tmp_path)


def test_colour_and_grey_png(tmp_path: Path) -> None:
    rgb = frames(1, 9, 7)[0]
    save_png(rgb, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        assert (image.mode, image.size) == ("RGB", (7, 9))
        assert np.array_equal(np.array(image), np.round(rgb.numpy() * 255).astype(np.uint8))
    save_gray_png(torch.tensor([[0.0, 0.5], [2.0, math.nan]]), tmp_path / "g.png")
    with Image.open(tmp_path / "g.png") as image:
        assert np.array(image).tolist() == [[0, 128], [255, 0]]
    for save, shape in ((save_png, (4, 4)), (save_gray_png, (4, 4, 3))):
        with pytest.raises(ValueError, match="got"):
            save(torch.zeros(shape), tmp_path / "bad.png")
    with pytest.raises(InputError, match="cannot write"):
        save_png(rgb, tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["a.png", "g.png"]
