"""Files of clips."""

from __future__ import annotations

import sys
import wave
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from clips import moving, write_clip
from command import refuses, report_of, run
from photos import picture, write_depth
from PIL import Image
from scenes import psnr

from spackle.clips.files import clip_frames, is_clip, read_clip
from spackle.errors import InputError
from spackle.formats import save_video

pytest.importorskip("cv2")


KINDS = {".mp4": ("libx264", "yuv420p"), ".mkv": ("libx264", "yuv444p"), ".webm": ("libvpx-vp9", "yuv420p")}


@pytest.mark.parametrize(("suffix", "coding"), [*KINDS.items(), (".gif", ("gif", "rgb8"))])
def test_frames_come_as_they_were(tmp_path: Path, suffix: str, coding: tuple[str, str]) -> None:
    given = moving(5, 47, 65) if suffix == ".mkv" else moving(5)
    clip = read_clip(write_clip(tmp_path / f"a{suffix}", given, *coding))
    assert is_clip(clip.path)
    assert (len(clip), clip.width, clip.height) == (5, given[0].shape[1], given[0].shape[0])
    assert float(clip.rate) == pytest.approx(10, rel=0.01)
    assert [float(t) for t in clip.times] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4], abs=0.002)
    for sent, got in zip(given, clip_frames(clip), strict=True):
        assert psnr(got, torch.from_numpy(sent).float() / 255) > (18 if suffix == ".gif" else 24)


def test_uneven_times_are_kept_and_the_first_frames_may_be_all(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "a.mkv", moving(4), ticks=[3, 4, 8, 9])
    clip = read_clip(path)
    assert [round(10 * t) for t in clip.times] == [0, 1, 5, 6]
    assert float(clip.start) == pytest.approx(0.3, abs=0.01)
    clip = read_clip(path, first=2)
    assert len(list(clip_frames(clip))) == len(clip) == 2
    assert float(clip.seconds) == pytest.approx(0.2, abs=0.01)


@pytest.mark.skipif(not hasattr(av.video.stream.VideoStream, "set_display_rotation"), reason="an older PyAV")
@pytest.mark.parametrize(("degrees", "quarters"), [(90, 1), (180, 2)])
def test_a_clip_is_turned_upright(tmp_path: Path, degrees: int, quarters: int) -> None:
    given = moving(2)
    clip = read_clip(write_clip(tmp_path / "a.mp4", given, turned=degrees))
    upright = np.ascontiguousarray(np.rot90(given[0], quarters))
    assert (clip.height, clip.width) == upright.shape[:2]
    assert psnr(next(clip_frames(clip)), torch.from_numpy(upright).float() / 255) > 24


def test_a_gif_with_one_picture_is_a_photo(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "a.gif")
    assert not is_clip(tmp_path / "a.gif")


def cut_off(path: Path) -> None:
    save_video(torch.rand(12, 48, 64, 3, generator=torch.Generator().manual_seed(0)), path)  # index first
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


def sound_alone(path: Path) -> None:
    with wave.open(str(path), "wb") as file:
        file.setparams((1, 2, 8000, 0, "NONE", ""))
        file.writeframes(bytes(16_000))


def unknown_codec(path: Path) -> None:
    write_clip(path, moving(2))
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzzz"))


def listing(path: Path) -> None:
    write_clip(path.with_name("other.mp4"), moving(2))
    path.write_text("ffconcat version 1.0\nfile other.mp4\n")


BAD: dict[str, Callable[[Path], object]] = {  # by a part of the message
    "damaged": lambda path: path.write_bytes(write_clip(path, moving(4)).read_bytes()[:-200]),
    "truncated": cut_off,
    "a list of other files": listing,
    "no moving picture": sound_alone,
    "codec": unknown_codec,
}


@pytest.mark.parametrize("said", BAD)
def test_a_bad_clip_is_one_line(tmp_path: Path, said: str) -> None:
    BAD[said](tmp_path / "bad.mp4")
    refuses(run("predict", tmp_path / "bad.mp4", "-o", tmp_path / "out"), "bad.mp4", said)
    assert not (tmp_path / "out").exists()


def depths(folder: Path, count: int) -> Path:
    for index in range(count):
        write_depth(folder / f"{index:06d}.npy")
    return folder


def test_a_clip_becomes_one_of_the_same_times_and_sound(tmp_path: Path) -> None:
    write_clip(tmp_path / "a.mp4", moving(5), ticks=[0, 1, 2, 5, 6], sound="aac")
    done = run(
        *("predict", tmp_path / "a.mp4", "-o", tmp_path / "out", "--depth", depths(tmp_path / "d", 5)),
        *("--residual", "seeds", "--trajectory", "rotate", "--disparity", 0.1),
    )
    assert done.code == 0, done.err
    assert {path.name for path in (tmp_path / "out/a").iterdir()} == {"video.mp4", "report.json"}
    with av.open(str(tmp_path / "out/a/video.mp4")) as container:
        frames = list(container.decode(video=0))
        assert [round(10 * frame.time) for frame in frames] == [0, 1, 2, 5, 6]
        assert (frames[0].width, frames[0].height) == (64, 48)
        assert container.streams.audio[0].codec_context.name == "aac"
    report = report_of(tmp_path / "out/a")
    assert (report["clip"]["frames"], report["clip"]["cuts"]) == (5, [])
    assert report["clip"]["sound"] == {"codec": "aac", "copied": True}
    assert report["hole_area_ratio"]["before"] > 0.02
    assert report["hole_area_ratio"]["after"] < 0.001


def test_a_frame_that_fails_is_named_and_nothing_is_left(tmp_path: Path) -> None:
    clip, depth = write_clip(tmp_path / "a.mp4", moving(3)), depths(tmp_path / "d", 1)
    done = run("predict", clip, "-o", tmp_path / "out", "--depth", depth, "--residual", "none")
    assert done.code == 2
    assert "a.mp4/000001" in done.lines[-1]
    assert not (tmp_path / "out").exists()
    opened = read_clip(clip)
    clip.write_bytes(b"gone")
    with pytest.raises(InputError, match=r"a\.mp4"):
        next(clip_frames(opened))


REFUSED = ["--cameras v.json", "--no-render", "--depth a.npy", "--stereo sbs", "--format gif", "no cv2"]


@pytest.mark.parametrize("option", REFUSED)
def test_what_a_clip_cannot_have_is_one_line(tmp_path: Path, option: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words, says = option.split(), option.split()[0]
    if option == "no cv2":
        monkeypatch.setitem(sys.modules, "cv2", None)
        words, says = [], "pip install 'spackle-nvs[opencv]'"
    refuses(run("predict", write_clip(tmp_path / "a.mp4", moving(2)), "-o", tmp_path / "out", *words), says)
    assert not (tmp_path / "out").exists()
