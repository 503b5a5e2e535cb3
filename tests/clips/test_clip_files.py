"""Files of clips."""

from __future__ import annotations

import shutil
import struct
import sys
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from helpers.command import refuses, report_of, run
from helpers.photo_files import HDR_CLIP_COLORS, colors_of
from helpers.photos import CLIPS, picture, write_depth
from helpers.scenes import psnr
from numpy.typing import NDArray
from PIL import Image

from spackle.clips.files import clip_frames, is_clip, read_clip
from spackle.runtime.errors import InputError


def moving(count: int, height: int = 48, width: int = 64) -> list[NDArray[np.uint8]]:
    """Frames of a picture that moves to the right by one pixel per frame."""
    wide = picture(width + count, height)
    return [np.ascontiguousarray(wide[:, count - k : count - k + width]) for k in range(count)]


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".webm", ".gif"])
def test_frames_come_as_they_were(suffix: str) -> None:
    given = moving(5, 47, 65) if suffix == ".mkv" else moving(5)
    clip = read_clip(CLIPS / f"five{suffix}")
    assert is_clip(clip.path)
    assert (len(clip), clip.width, clip.height) == (5, given[0].shape[1], given[0].shape[0])
    assert float(clip.rate) == pytest.approx(10, rel=0.01)
    assert [float(t) for t in clip.times] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4], abs=0.002)
    for sent, got in zip(given, clip_frames(clip), strict=True):
        assert psnr(got, torch.from_numpy(sent).float() / 255) > (18 if suffix == ".gif" else 24)


def test_uneven_times_are_kept_and_the_first_frames_may_be_all() -> None:
    clip = read_clip(CLIPS / "uneven.mkv")
    assert [round(10 * t) for t in clip.times] == [0, 1, 5, 6]
    assert float(clip.start) == pytest.approx(0.3, abs=0.01)
    clip = read_clip(CLIPS / "uneven.mkv", max_frames=2)
    assert len(list(clip_frames(clip))) == len(clip) == 2
    assert float(clip.seconds) == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize(("degrees", "quarters"), [(90, 1), (180, 2)])
def test_a_clip_is_turned_upright(degrees: int, quarters: int) -> None:
    clip = read_clip(CLIPS / f"turned {degrees}.mp4")
    upright = np.ascontiguousarray(np.rot90(moving(2)[0], quarters))
    assert (clip.height, clip.width) == upright.shape[:2]
    assert psnr(next(clip_frames(clip)), torch.from_numpy(upright).float() / 255) > 24


def test_a_gif_with_one_picture_is_a_photo(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "a.gif")
    assert not is_clip(tmp_path / "a.gif")


BAD = [
    "damaged",
    "truncated",
    "a list of other files",
    "no moving picture",
    "codec",
]  # parts of messages


@pytest.mark.parametrize("said", BAD)
def test_a_bad_clip_is_one_line(tmp_path: Path, said: str) -> None:
    refuses(run("predict", CLIPS / f"{said}.mp4", "-o", tmp_path / "out"), f"{said}.mp4: ", said)
    assert not (tmp_path / "out").exists()


def depths(folder: Path, count: int) -> Path:
    for index in range(count):
        write_depth(folder / f"{index:06d}.npy")
    return folder


def test_a_clip_becomes_one_of_the_same_times_and_sound(tmp_path: Path) -> None:
    done = run(
        *(
            "predict",
            CLIPS / "uneven with sound.mp4",
            "-o",
            tmp_path,
            "--depth",
            depths(tmp_path / "d", 5),
        ),
        *("--residual", "initial", "--trajectory", "rotate", "--disparity", 0.1),
    )
    assert done.code == 0, done.err
    out = tmp_path / "uneven with sound"
    assert {path.name for path in out.iterdir()} == {"video.mp4", "report.json"}
    with av.open(str(out / "video.mp4")) as container:
        frames = list(container.decode(video=0))
        assert [round(10 * frame.time) for frame in frames] == [0, 1, 2, 5, 6]
        assert (frames[0].width, frames[0].height) == (64, 48)
        assert container.streams.audio[0].codec_context.name == "aac"
    report = report_of(out)
    assert (report["clip"]["frames"], report["clip"]["cuts"]) == (5, [])
    assert report["clip"]["sound"] == {"codec": "aac", "copied": True}
    assert report["hole_area_ratio"]["before"] > 0.02
    assert report["hole_area_ratio"]["after"] < 0.001


def test_a_frame_that_fails_is_named_and_nothing_is_left(tmp_path: Path) -> None:
    clip, depth = (
        Path(shutil.copy(CLIPS / "three.mp4", tmp_path / "a.mp4")),
        depths(tmp_path / "d", 1),
    )
    done = run("predict", clip, "-o", tmp_path / "out", "--depth", depth, "--residual", "none")
    assert done.code == 2
    assert "a.mp4/000001" in done.lines[-1]
    assert not (tmp_path / "out").exists()
    opened = read_clip(clip)
    clip.write_bytes(b"gone")
    with pytest.raises(InputError, match=r"a\.mp4"):
        next(clip_frames(opened))


REFUSED = [
    "--cameras v.json",
    "--no-render",
    "--depth a.npy",
    "--stereo sbs",
    "--format gif",
    "no cv2",
]


@pytest.mark.parametrize("option", REFUSED)
def test_what_a_clip_cannot_have_is_one_line(
    tmp_path: Path, option: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    words, says = option.split(), option.split()[0]
    if option == "no cv2":
        monkeypatch.setitem(sys.modules, "cv2", None)
        words, says = [], "pip install 'spackle-nvs[opencv]'"
    refuses(run("predict", CLIPS / "two.mp4", "-o", tmp_path / "out", *words), says)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("transfer", ["PQ", "HLG"])
def test_hdr_becomes_srgb_in_all_frames_alike(transfer: str) -> None:
    clip = read_clip(CLIPS / f"hdr {transfer}.mp4")  # made by make_hdr_clips.py beside it
    assert clip.hdr == transfer
    (rgb,) = clip_frames(clip)
    found = colors_of(rgb.numpy()) * 255
    assert abs(found[:4] - HDR_CLIP_COLORS[:4]).max() < 3
    # White makes room for brighter light that another frame may have.
    assert 200 < found[4].min() <= found[4].max() < 222


def test_a_clip_is_told_by_its_content_too(tmp_path: Path) -> None:
    for name in ("five.mp4", "five.mkv", "five.webm"):
        shutil.copy(CLIPS / name, tmp_path / "clip.insv")
        assert is_clip(tmp_path / "clip.insv")
    Image.fromarray(picture()).save(tmp_path / "photo", "AVIF")
    assert not is_clip(tmp_path / "photo")
    assert not is_clip(tmp_path / "nowhere")


def test_a_360_clip_is_refused(tmp_path: Path) -> None:
    description = (
        b'<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-'
        b'syntax-ns#" xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">'
        b"<GSpherical:StitchingSoftware>a camera</GSpherical:StitchingSoftware>"
        b"<GSpherical:Spherical>true</GSpherical:Spherical><GSpherical:Stitched>true"
        b"</GSpherical:Stitched><GSpherical:ProjectionType>equirectangular"
        b"</GSpherical:ProjectionType></rdf:SphericalVideo>"
    )
    box = bytes.fromhex("ffcc8263f8554a938814587a02521fdd") + description
    box = struct.pack(">I", len(box) + 8) + b"uuid" + box
    # The box belongs at the end of the track, whose size and that of its parent grow.
    content = bytearray((CLIPS / "five.mp4").read_bytes())
    for kind in (b"moov", b"trak"):
        place = content.index(kind) - 4
        (size,) = struct.unpack_from(">I", content, place)
        struct.pack_into(">I", content, place, size + len(box))
        end = place + size
    assert content.index(b"mdat") < content.index(b"moov")  # places of frames stay
    (tmp_path / "a.mp4").write_bytes(content[:end] + box + content[end:])
    with pytest.raises(InputError, match="a 360° panorama: cut a flat view out of it"):
        read_clip(tmp_path / "a.mp4")
