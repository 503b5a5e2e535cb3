"""Videos and pictures, read back by an independent decoder."""

from __future__ import annotations

import ctypes
import math
import os
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from helpers.scenes import psnr
from PIL import Image
from torch import Tensor

from spackle.depth.readers import load_depth
from spackle.depth.writers import save_depth
from spackle.formats import save_gray_png, save_png
from spackle.runtime.errors import InputError
from spackle.video.encoding import VideoWriter, save_video


def frames(count: int, height: int, width: int) -> list[Tensor]:
    """Frames of a smooth moving picture."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    return [
        torch.stack([x * (20 - k) / 20, y, 0.5 + 0.3 * torch.sin(x + y + k / 5)], dim=-1)
        for k in range(count)
    ]


def decoded(path: Path) -> tuple[str, list[av.VideoFrame], list[Tensor]]:
    """A video's codec, its frames, and their colours [H, W, 3] in 0..1."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        kind = stream.codec_context.name
        found = list(container.decode(stream))
    return (
        kind,
        found,
        [torch.from_numpy(frame.to_ndarray(format="rgb24")).float() / 255 for frame in found],
    )


CUES = b"\x1c\x53\xbb\x6b"
CLUSTER = b"\x1f\x43\xb6\x75"
SIZES = [(48, 64), (47, 65)]


@pytest.mark.parametrize(
    ("name", "codec", "index"), [("a.mp4", "h264", b"moov"), ("a.webm", "vp9", CUES)]
)
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_a_video_decodes_to_what_went_in_and_plays_while_it_loads(
    tmp_path: Path, name: str, codec: str, index: bytes, height: int, width: int
) -> None:
    given = frames(7, height, width)
    path = tmp_path / name
    reused = torch.empty(height, width, 3, dtype=torch.uint8)
    save_video((reused.copy_(255 * frame) for frame in given), path, fps=25, loop=2)
    kind, shown, colors = decoded(path)
    assert kind == codec
    assert [round(frame.time * 25) for frame in shown] == list(
        range(14)
    )  # each repetition is stored
    for sent, frame, rgb in zip(given * 2, shown, colors, strict=True):
        assert (frame.height, frame.width) == (height + height % 2, width + width % 2)
        assert frame.format.name == "yuv420p"
        assert (frame.colorspace, frame.color_primaries, frame.color_trc, frame.color_range) == (
            1,
            1,
            1,
            1,
        )
        assert psnr(rgb[:height, :width], sent) > (35 if codec == "h264" else 33)
    content = path.read_bytes()
    assert 0 < content.index(index) < content.index(b"mdat" if codec == "h264" else CLUSTER)
    assert os.listdir(tmp_path) == [name]


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="fills new memory by glibc")
@pytest.mark.parametrize("name", ["a.mp4", "a.webm", "a.gif", "a.webp"])
def test_the_same_frames_give_the_same_bytes_whatever_memory_held(
    tmp_path: Path, name: str
) -> None:
    perturb = -6
    found = set()
    mallopt = ctypes.CDLL(None).mallopt
    for byte in (1, 85, 254):
        mallopt(perturb, byte)
        try:
            save_video(frames(20, 48, 64), tmp_path / name)
        finally:
            mallopt(perturb, 0)
        found.add((tmp_path / name).read_bytes())
    assert len(found) == 1


@pytest.mark.parametrize("color", [(1.0, 0.0, 0.0), (0.2, 0.6, 0.4)])
def test_colours_are_bt709(tmp_path: Path, color: tuple[float, float, float]) -> None:
    save_video([torch.tensor(color).expand(32, 32, 3)], tmp_path / "a.mp4", fps=30000 / 1001)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].average_rate == Fraction(30000, 1001)
        planes = next(container.decode(video=0)).to_ndarray()
    luma = 0.2126 * color[0] + 0.7152 * color[1] + 0.0722 * color[2]
    expected = [
        16 + 219 * luma,
        128 + 224 * (color[2] - luma) / 1.8556,
        128 + 224 * (color[0] - luma) / 1.5748,
    ]
    assert [planes[5, 5], planes[34, 5], planes[42, 5]] == pytest.approx(expected, abs=2)


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a.webp", "a.webm"])
def test_a_failed_video_leaves_the_old_file(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    one = torch.zeros(16, 16, 3)
    path.write_bytes(b"old")
    for wrong, says in (
        ([], "at least one"),
        ([one, torch.zeros(16, 18, 3)], "frame 1 is"),
        ([one, one, one[..., 0]], "a video frame"),
    ):
        with pytest.raises(ValueError, match=says):
            save_video(wrong, path)
    assert os.listdir(tmp_path) == [name]
    assert path.read_bytes() == b"old"


def animation(path: Path) -> tuple[list[Tensor], list[int], int | None]:
    """Frames, their milliseconds and the loop count of a GIF or WebP, by Pillow."""
    shown = []
    times = []
    with Image.open(path) as image:
        loop = image.info.get("loop")
        for index in range(getattr(image, "n_frames", 1)):
            image.seek(index)
            rgba = torch.from_numpy(np.array(image.convert("RGBA"))).float() / 255
            assert bool((rgba[..., 3] == 1).all())
            shown.append(rgba[..., :3])
            times.append(round(image.info["duration"]))
    return shown, times, loop


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize(("name", "least"), [("a.gif", 22), ("a.webp", 33)])
def test_animations_decode_to_what_went_in(
    tmp_path: Path, name: str, least: float, height: int, width: int
) -> None:
    given = frames(6, height, width)
    save_video(iter(given), tmp_path / name, fps=12)
    shown, times, loop = animation(tmp_path / name)
    assert loop == 0
    assert len(shown) == 6
    assert sum(times) == pytest.approx(500, abs=10)
    assert max(times) - min(times) <= 10
    for sent, got in zip(given, shown, strict=False):
        assert got.shape == (height, width, 3)
        assert psnr(got, sent) > least
    assert os.listdir(tmp_path) == [name]


def test_webp_keeps_no_old_blocks_in_what_changes_slowly(tmp_path: Path) -> None:
    ramp = torch.linspace(0.2, 0.5, 96)[None, :, None].expand(64, 96, 3)
    given = [
        ramp + 0.002 * k for k in range(20)
    ]  # each frame half a step of 8 bits brighter than the last
    save_video(iter(given), tmp_path / "a.webp", fps=12)
    shown, _, _ = animation(tmp_path / "a.webp")
    assert min(psnr(got, sent) for sent, got in zip(given, shown, strict=True)) > 45


@pytest.mark.parametrize("name", ["a.gif", "a.webp"])
def test_an_animation_says_how_often_it_plays(tmp_path: Path, name: str) -> None:
    # GIF counts repetitions, and says nothing where there is none; WebP counts showings.
    expected = {0: 0, 1: None, 3: 2} if name == "a.gif" else {0: 0, 1: 1, 3: 3}
    for plays, stored in expected.items():
        save_video(frames(2, 8, 8), tmp_path / name, loop=plays)
        assert animation(tmp_path / name)[2] == stored


def test_a_gif_keeps_rare_colours_and_spreads_a_gradient(tmp_path: Path) -> None:
    ramp = torch.linspace(0.1, 0.6, 160)
    orange = torch.tensor([1.0, 0.5, 0.1])
    pictures = [ramp[:, None].repeat(90, 1, 3) for _ in range(3)]
    for k, picture in enumerate(pictures):
        picture[40:46, 20 * k : 20 * k + 6] = orange
    save_video(pictures, tmp_path / "a.gif", fps=10)
    for k, got in enumerate(animation(tmp_path / "a.gif")[0]):
        lamp = got[41:45, 20 * k + 1 : 20 * k + 5].mean(dim=(0, 1))
        torch.testing.assert_close(lamp, orange, atol=0.03, rtol=0)
        torch.testing.assert_close(got[:30].mean(dim=(0, 2)), ramp, atol=0.01, rtol=0)


UNKNOWN = [
    ("a.gif", 51, None, "0.01 to 50"),
    ("a.gif", 30, -1, "loop count"),
    ("a.mp4", 30, 0, "play for ever"),
    ("a.mp4", math.nan, None, "frames a second"),
    ("a.avi", 30, None, r"a\.avi"),
    ("none/a.mp4", 30, None, "does not exist"),
]


@pytest.mark.parametrize(("name", "fps", "loop", "said"), UNKNOWN)
def test_what_a_format_does_not_know_is_refused(
    tmp_path: Path, name: str, fps: float, loop: int, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match=said):
        VideoWriter(tmp_path / name, fps, loop)
    with pytest.raises(InputError, match="too large"), VideoWriter(tmp_path / "b.webp") as writer:
        writer.add(torch.zeros(1, 16_384, 3))
    monkeypatch.setattr("spackle.video.encoding.MAX_GIF_PIXELS", 1000)
    with pytest.raises(InputError, match="write an mp4"):
        save_video(frames(2, 20, 30), tmp_path / "b.gif")
    assert not os.listdir(tmp_path)


def test_messages_name_the_file_as_the_caller_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spackle.video.encoding.MAX_GIF_PIXELS", 1000)
    path = tmp_path / "temporary.gif"
    with pytest.raises(InputError, match=r"^video\.gif: at most"):
        save_video(frames(2, 20, 30), path, name_in_messages="video.gif")
    with pytest.raises(InputError, match=r"^video\.gif: frames a second"):
        VideoWriter(path, fps=51, name_in_messages="video.gif")


def test_depth_maps_are_read_back_by_other_programs(tmp_path: Path) -> None:
    depth = torch.linspace(0, 9, 37 * 53).reshape(37, 53)
    for suffix in (".npy", ".exr", ".png"):
        save_depth(depth, tmp_path / f"a{suffix}")
    assert np.array_equal(np.load(tmp_path / "a.npy"), depth.numpy())
    assert torch.equal(load_depth(tmp_path / "a.exr").depth, depth)
    with Image.open(tmp_path / "a.png") as image:
        assert np.array_equal(np.array(image), np.round(1000 * depth.numpy()))
    with pytest.raises(InputError, match=r"a\.tiff"):
        save_depth(depth, tmp_path / "a.tiff")


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
