"""The pseudo-supervised dataset: the same bytes however it is built, every damage found, every view read once."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import re
import resource
import runpy
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest
import torch
from command import Run, names_in, run
from photos import metres, picture, write_depth
from PIL import Image
from scenes import box_before_wall, psnr, shifted
from sharp_weights import write_tiny
from torch.utils.data import DataLoader

from spackle.bases.lift import lift
from spackle.camera import Camera
from spackle.camera_path import TRAJECTORIES, DepthRange, TrajectoryKind
from spackle.dataset import DatasetFiles, DatasetView, ViewDataset
from spackle.dataset import build as building
from spackle.dataset.encode import (
    decode_alpha,
    decode_depth,
    decode_gaussians,
    encode_alpha,
    encode_depth,
    encode_gaussians,
)  # fmt: skip
from spackle.dataset.maker import Job, Made, Maker, _results
from spackle.dataset.photos import choose, find_photos
from spackle.dataset.sample import END, pack, unpack
from spackle.dataset.shards import load_manifest
from spackle.dataset.views import (
    APART,
    PathChoice,
    ViewChoices,
    draw_path,
    path_cameras,
    render_views,
    scene_completion,
)
from spackle.errors import InputError
from spackle.gaussians import Gaussians
from spackle.inpaint import Inpainter, InpainterOptions, get_inpainter
from spackle.render import get_renderer
from spackle.residual import hole_mask
from spackle.training.data import Supply
from spackle.training.recipe import DataRecipe
from spackle.training.sources import PseudoViews

VIEWS = 4
SHORT = ["--base", "rgbd", "--views", VIEWS, "--shard-size", 2, "--threads", 1]


def write_inputs(place: Path, count: int = 5, width: int = 72, height: int = 54) -> Path:
    """Photos in a folder and its subfolder, and their depth."""
    for number in range(count):
        name = f"{'deep/' if number == 1 else ''}{number}"
        path = place / "photos" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.clip(picture(width, height).astype(int) + 8 * number, 0, 255).astype(np.uint8)
        Image.fromarray(pixels).save(path)
        write_depth(place / "depth" / f"{name}.npy", metres(width, height))
    return place


def build(place: Path, output: Path, *more: object) -> Run:
    options = ["--photos", place / "photos", "--depth", place / "depth", "-o", output]
    return run("dataset", "build", *options, *SHORT, *more)


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five photos and their depth."""
    return write_inputs(tmp_path_factory.mktemp("dataset"))


@pytest.fixture(scope="module")
def whole(place: Path) -> tuple[Path, Run]:
    """A dataset built in one go."""
    return place / "whole", build(place, place / "whole")


@pytest.fixture
def copy(whole: tuple[Path, Run], tmp_path: Path) -> Path:
    """The dataset, to be damaged."""
    return shutil.copytree(whole[0], tmp_path / "copy")


# What comes out -----------------------------------------------------------------------------------


def test_a_build_leaves_shards_and_a_manifest(whole: tuple[Path, Run]) -> None:
    folder, done = whole
    assert done.code == 0, done.err
    assert names_in(folder) == {"manifest.json", "shard-000000.tar", "shard-000001.tar", "shard-000002.tar"}
    manifest = load_manifest(folder)
    assert manifest.complete
    assert [sample.photo for _, sample in manifest.samples] == ["0.png", "2.png", "3.png", "4.png", "deep/1.png"]
    assert [len(shard.samples) for shard in manifest.shards] == [2, 2, 1]
    assert manifest.views == 5 * VIEWS
    for shard in manifest.shards:
        data = (folder / shard.file).read_bytes()
        assert hashlib.sha256(data).hexdigest() == shard.sha256
        for sample in shard.samples:
            part = data[sample.offset : sample.offset + sample.size]
            assert hashlib.sha256(part).hexdigest() == sample.sha256
            assert sample.holes[0] == 0
            assert max(sample.holes) > 0.02
    assert "photos an hour; seconds a photo: load" in done.err
    for stage in ("base", "render", "inpaint", "encode", "write"):
        assert re.search(rf"{stage} \d+\.\d\d", done.err)


def test_a_shard_is_a_plain_tar_in_the_order_of_webdataset(whole: tuple[Path, Run]) -> None:
    with tarfile.open(whole[0] / "shard-000000.tar") as archive:
        members = archive.getmembers()
    keys = [member.name.partition(".")[0] for member in members]
    assert keys == sorted(keys)
    assert set(keys) == {"000000", "000001"}
    assert [m.name for m in members[:3]] == ["000000.json", "000000.photo.png", "000000.base.safetensors"]
    kinds = {m.name.split(".", 1)[1] for m in members[3:] if m.name.startswith("000000.")}
    assert kinds >= {
        f"{i:02d}.{kind}.png" for i in range(VIEWS) for kind in ("rgb", "target", "mask", "alpha", "depth")
    }
    assert {(m.mtime, m.uid, m.gid, m.uname, m.mode) for m in members} == {(0, 0, 0, "", 0o644)}


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")  # its own
def test_webdataset_reads_the_shards(whole: tuple[Path, Run]) -> None:
    webdataset = pytest.importorskip("webdataset")
    shards = [str(path) for path in sorted(whole[0].glob("*.tar"))]
    groups = list(webdataset.WebDataset(shards, shardshuffle=False))
    assert [group["__key__"] for group in groups] == [f"{number:06d}" for number in range(5)]
    for group, own in zip(groups, (DatasetFiles(whole[0]).group(number) for number in range(5)), strict=True):
        files = {f"{own.key}.{name}": data for name, data in group.items() if not name.startswith("__")}
        assert files == dict(own.files)


def test_the_files_say_what_the_paper_asks_for(whole: tuple[Path, Run]) -> None:
    group = DatasetFiles(whole[0]).group(4)
    facts = group.facts
    assert facts["photo"]["name"] == "deep/1.png"
    assert facts["trajectory"]["kind"] in TRAJECTORIES
    assert 0.1 <= facts["trajectory"]["disparity"] <= 0.6
    assert facts["inpainter"]["name"] == "geometry"
    assert facts["base"]["gaussians"] == len(group.base())
    for index, view in enumerate(facts["views"]):
        assert view.keys() >= {"K", "world_to_camera", "position", "width", "height", "depth_range", "hole"}
        with Image.open(io.BytesIO(group.files[f"{group.key}.{index:02d}.mask.png"])) as mask:
            assert set(np.unique(np.array(mask))) <= {0, 255}
            assert float((np.array(mask) == 255).mean()) == view["hole"]


def test_what_is_read_is_what_was_drawn(whole: tuple[Path, Run], place: Path) -> None:
    group = DatasetFiles(whole[0]).group(0)
    for index in range(group.views):
        sample = group.view(index, with_base=True)
        assert sample.base is not None
        drawn = get_renderer().render(sample.base, sample.camera)
        assert psnr(drawn.rgb, sample.rendering.rgb) > 55
        assert float((drawn.alpha - sample.rendering.alpha).abs().max()) < 0.01
        assert torch.equal(sample.mask, hole_mask(sample.rendering.alpha))
        assert torch.equal(sample.target[~sample.mask], sample.rendering.rgb[~sample.mask])
        if bool(sample.mask.any()):  # no hole is left black
            assert float(sample.target[sample.mask].amax(-1).min()) > 0.2
    first = group.view(0)
    assert first.camera.world_to_camera.tolist() == torch.eye(4).tolist()
    stored = torch.from_numpy(np.array(Image.open(place / "photos" / "0.png"))).float() / 255
    assert torch.equal(first.photo, stored)
    assert psnr(first.rendering.rgb, first.photo) > 25


# The same bytes, however --------------------------------------------------------------------------


def test_two_workers_make_the_same_bytes_as_one(whole: tuple[Path, Run], place: Path, tmp_path: Path) -> None:
    done = build(place, tmp_path / "two", "--workers", 2)
    assert done.code == 0, done.err
    assert content(tmp_path / "two") == content(whole[0])


KILL = """
import os, sys
sys.argv = {words!r}
import spackle.dataset.build as build, spackle.dataset.maker as worker
make, save, count = worker.Maker.make, build.Manifest.save, [0]
def dying(*arguments, **more):
    count[0] += 1
    if count[0] == {at}:
        os.kill(os.getpid(), 9)
    return {original}(*arguments, **more)
{patched} = dying
from spackle.cli import main
main()
"""


@pytest.mark.parametrize(
    ("patched", "original", "at", "left"),
    [
        ("worker.Maker.make", "make", 4, {"manifest.json", "parts", "shard-000000.tar", ".lock"}),
        # The second shard lies there, and the manifest does not know it yet.
        ("build.Manifest.save", "save", 3, {"manifest.json", "parts", "shard-000000.tar", "shard-000001.tar", ".lock"}),
    ],
)
def test_a_killed_build_goes_on_and_ends_with_the_same_bytes(
    whole: tuple[Path, Run], place: Path, tmp_path: Path, patched: str, original: str, at: int, left: set[str]
) -> None:
    out = tmp_path / "out"
    words = ["spackle", "dataset", "build", "--photos", place / "photos", "--depth", place / "depth", "-o", out, *SHORT]
    code = KILL.format(words=[str(word) for word in words], patched=patched, original=original, at=at)
    process = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True)
    assert process.returncode == -signal.SIGKILL
    assert names_in(out) == left
    assert "not finished" in run("dataset", "verify", out).err
    with pytest.raises(InputError, match="not finished"):
        ViewDataset(out)
    (out / "parts" / f".000003.{'0' * 12}.tar").write_bytes(b"half")
    done = build(place, out)
    assert done.code == 0, done.err
    assert f"{out}: going on" in done.err
    assert content(out) == content(whole[0])


def test_workers_end_with_a_killed_build(whole: tuple[Path, Run], place: Path, tmp_path: Path) -> None:
    out, note = tmp_path / "out", tmp_path / "children"
    words = ["spackle", "dataset", "build", "--photos", place / "photos", "--depth", place / "depth", "-o", out, *SHORT]
    code = f"""
import multiprocessing, os, sys
from pathlib import Path
sys.argv = {[str(word) for word in [*words, "--workers", 2]]!r}
import spackle.dataset.build as build
def dying(*arguments):
    Path({str(note)!r}).write_text(" ".join(str(child.pid) for child in multiprocessing.active_children()))
    os.kill(os.getpid(), 9)
if __name__ == "__main__":
    build._Build._note = dying
    from spackle.cli import main
    main()
"""
    (tmp_path / "script.py").write_text(code)
    process = subprocess.run([sys.executable, tmp_path / "script.py"], check=False, stderr=subprocess.DEVNULL)
    assert process.returncode == -signal.SIGKILL
    children = [int(pid) for pid in note.read_text().split()]
    assert len(children) == 2
    deadline = time.monotonic() + 20
    while any(is_alive(pid) for pid in children):
        assert time.monotonic() < deadline, "a worker goes on without its main process"
        time.sleep(0.05)
    assert build(place, out).code == 0
    assert content(out) == content(whole[0])


def is_alive(pid: int) -> bool:
    """Whether a process still does anything; one that nobody has waited for yet does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_worker_that_dies_is_a_line() -> None:
    future: Future[Made] = Future()
    future.set_exception(BrokenProcessPool("gone"))
    with pytest.raises(InputError, match="a worker process died"):
        list(_results([future]))


def test_few_photos_wait_for_a_worker_at_a_time() -> None:
    asked: list[int] = []

    def futures() -> Iterator[Future[Made]]:
        for number in range(20):
            asked.append(number)
            future: Future[Made] = Future()
            future.set_result(Made(number, {}, None))
            yield future

    for given, _ in enumerate(_results(futures(), 4)):
        assert len(asked) <= given + 4
    assert asked == list(range(20))


def test_ctrl_c_ends_after_the_photo_at_work(
    whole: tuple[Path, Run], place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = Maker.make

    def interrupted(self: Maker, job: Job) -> Made:
        signal.raise_signal(signal.SIGINT)
        return make(self, job)

    with monkeypatch.context() as patch:
        patch.setattr(Maker, "make", interrupted)
        done = build(place, tmp_path / "out")
    assert done.code == 130
    assert "stopped; the same command goes on from here" in done.lines
    assert build(place, tmp_path / "out").code == 0
    assert content(tmp_path / "out") == content(whole[0])


def test_a_finished_build_has_nothing_to_do_and_a_lost_shard_is_made_again(
    whole: tuple[Path, Run], place: Path, copy: Path
) -> None:
    assert build(place, copy).code == 0
    assert content(copy) == content(whole[0])
    (copy / "shard-000001.tar").unlink()
    assert build(place, copy).code == 0
    assert content(copy) == content(whole[0])


def test_a_damaged_part_is_a_line_and_made_again_when_deleted(whole: tuple[Path, Run], place: Path, copy: Path) -> None:
    (copy / "shard-000001.tar").unlink()
    part = copy / "parts" / "000002.tar"
    part.parent.mkdir()
    part.write_bytes((whole[0] / "shard-000001.tar").read_bytes()[:1000])
    done = build(place, copy)
    assert done.code == 2
    assert f"{part}: not a photo of a dataset, or damaged" in done.lines[-1]
    assert "delete it, and the same command makes it again" in done.lines[-1]
    part.unlink()
    assert build(place, copy).code == 0
    assert content(copy) == content(whole[0])


def test_another_configuration_is_refused_and_the_difference_shown(place: Path, copy: Path) -> None:
    before = content(copy)
    done = build(place, copy, "--inpainter", "none", "--disparity", "0.2", "0.3")
    assert (done.code, len(done.lines)) == (2, 1)
    assert 'inpainter.name: "geometry" -> "none"' in done.err
    assert "views.disparity: [0.1, 0.6] -> [0.2, 0.3]" in done.err
    assert content(copy) == before


def test_a_folder_in_which_a_build_is_at_work_is_refused(place: Path, tmp_path: Path) -> None:
    from spackle.downloads import hold

    (tmp_path / "out").mkdir()
    with hold(tmp_path / "out" / ".lock"):
        done = build(place, tmp_path / "out")
    assert done.code == 2
    assert "another build is at work" in done.err


def test_a_full_disk_is_a_line_and_the_build_goes_on_later(
    whole: tuple[Path, Run], place: Path, tmp_path: Path
) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        done = build(place, tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert done.code == 2
    assert "cannot write" in done.lines[-1]
    assert names_in(tmp_path / "out" / "parts") == set()
    assert build(place, tmp_path / "out").code == 0
    assert content(tmp_path / "out") == content(whole[0])


# Damage -------------------------------------------------------------------------------------------


def test_verify_names_the_sample_of_any_flipped_byte(copy: Path) -> None:
    assert run("dataset", "verify", copy).code == 0
    manifest, rng = load_manifest(copy), np.random.default_rng(0)
    for shard in manifest.shards:
        path = copy / shard.file
        original = path.read_bytes()
        places = [0, len(original) - 1, len(original) - len(END), *rng.integers(0, len(original), 6).tolist()]
        for place in places:
            path.write_bytes(original[:place] + bytes([original[place] ^ 1]) + original[place + 1 :])
            done = run("dataset", "verify", copy)
            assert (done.code, len(done.lines)) == (1, 1)
            hit = [s for s in shard.samples if s.offset <= place < s.offset + s.size]
            expected = f"sample {hit[0].key} ({hit[0].photo}) is damaged" if hit else "damaged after its last sample"
            assert f"{shard.file}: {expected}" in done.err
        path.write_bytes(original)


def test_verify_finds_cut_and_missing_shards_and_a_changed_manifest(copy: Path) -> None:
    whole = (copy / "shard-000000.tar").read_bytes()
    (copy / "shard-000000.tar").write_bytes(whole[: len(whole) // 2])
    (copy / "shard-000001.tar").unlink()
    (copy / "shard-000002.tar").write_bytes((copy / "shard-000002.tar").read_bytes() + b"x")
    done = run("dataset", "verify", copy)
    assert done.code == 1
    for words in ("sample 000001 (2.png) is damaged", "shard-000001.tar: not there", "bytes instead of"):
        assert words in done.err
    with pytest.raises(InputError, match="000001"):
        list(ViewDataset(copy))
    text = (copy / "manifest.json").read_text()
    (copy / "manifest.json").write_text(text.replace('"0.png"', '"9.png"'))
    done = run("dataset", "verify", copy)
    assert (done.code, len(done.lines)) == (2, 1)
    assert run("dataset", "info", copy / "nothing").code == 2
    (copy / "manifest.json").unlink()
    (copy / "manifest.json").mkdir()
    done = run("dataset", "info", copy)
    assert (done.code, done.lines) == (2, [f"error: {copy}/manifest.json: cannot be read: Is a directory"])


def test_info_and_preview(whole: tuple[Path, Run], tmp_path: Path) -> None:
    done = run("dataset", "info", whole[0])
    assert done.code == 0
    assert f"5 photos, {5 * VIEWS} views, 3 shards" in done.out
    assert "holes of each view: 0.0%" in done.out
    done = run("dataset", "preview", whole[0], "-o", tmp_path / "look", "--photos", 2, "--views", 3)
    assert done.code == 0, done.err
    assert names_in(tmp_path / "look") == {"sheet.png", "trajectory.mp4"}
    with Image.open(tmp_path / "look" / "sheet.png") as sheet:
        assert sheet.size == (3 * 72, 2 * 3 * 54)


def test_info_spells_the_path_as_the_option_does(tmp_path: Path) -> None:
    write_inputs(tmp_path, count=1)
    for spelling in ("rotate_forward", "rotate-forward"):  # the same build, which is done the second time
        done = build(tmp_path, tmp_path / "out", "--trajectory", spelling, "--inpainter", "none")
        assert done.code == 0, done.err
    shown = run("dataset", "info", tmp_path / "out").out
    assert '"trajectory": "rotate-forward"' in shown
    assert DatasetFiles(tmp_path / "out").group(0).facts["trajectory"]["kind"] == "rotate_forward"  # as Python has it


# Readers ------------------------------------------------------------------------------------------


def names_of(samples: list[DatasetView]) -> list[tuple[str, int]]:
    return [(sample.key, sample.index) for sample in samples]


def test_ranks_and_workers_read_every_view_once(whole: tuple[Path, Run]) -> None:
    every = {(f"{photo:06d}", view) for photo in range(5) for view in range(VIEWS)}
    assert names_of(list(ViewDataset(whole[0]))) == sorted(every)
    for shuffle in (0, 7):
        for ranks in (1, 2, 3, 7):
            parts = [list(ViewDataset(whole[0], shuffle=shuffle, rank=r, ranks=ranks)) for r in range(ranks)]
            seen = [name for part in parts for name in names_of(part)]
            assert len(seen) == len(every)
            assert set(seen) == every
    seen = []
    for rank in range(2):
        loader = DataLoader(ViewDataset(whole[0], rank=rank, ranks=2), batch_size=None, num_workers=2)
        seen += names_of(list(loader))
    assert sorted(seen) == sorted(every)


def test_the_order_is_random_and_the_same_for_the_same_seed_and_epoch(whole: tuple[Path, Run]) -> None:
    def order(seed: int, epoch: int) -> list[tuple[str, int]]:
        dataset = ViewDataset(whole[0], shuffle=8, seed=seed)
        dataset.set_epoch(epoch)
        return names_of(list(dataset))

    assert order(0, 0) == order(0, 0)
    assert len({tuple(order(seed, epoch)) for seed in (0, 1) for epoch in (0, 1)}) == 4


def test_samples_are_values_of_the_house(whole: tuple[Path, Run]) -> None:
    sample = next(iter(ViewDataset(whole[0], with_base=True)))
    assert isinstance(sample.camera, Camera)
    assert isinstance(sample.base, Gaussians)
    assert sample.rendering.rgb.shape == sample.target.shape == (54, 72, 3)
    assert sample.mask.dtype == torch.bool
    assert next(iter(ViewDataset(whole[0]))).base is None
    with pytest.raises(ValueError, match="rank"):
        ViewDataset(whole[0], rank=2, ranks=2)


def test_an_address_is_read_by_fsspec_and_without_it_is_a_line(
    whole: tuple[Path, Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    for path in whole[0].iterdir():
        memory.pipe(f"/there/{path.name}", path.read_bytes())
    assert names_of(list(ViewDataset("memory://there"))) == names_of(list(ViewDataset(whole[0])))
    assert run("dataset", "verify", "memory://there").code == 0
    done = run("dataset", "info", "nothing://there")
    assert (done.code, len(done.lines)) == (2, 1)
    monkeypatch.setitem(sys.modules, "fsspec", None)
    assert "pip install fsspec" in run("dataset", "info", "memory://there").err


# Photos -------------------------------------------------------------------------------------------


def odd_photos(folder: Path) -> Path:
    """Every kind of photo that a folder may hold."""
    folder.mkdir(parents=True)
    image = Image.fromarray(picture(72, 54))
    image.convert("L").save(folder / "grey.png")
    image.convert("CMYK").save(folder / "cmyk.jpg")
    image.save(folder / "moving.gif", save_all=True, append_images=[image.rotate(90)])
    image.resize((8, 8)).save(folder / "tiny.png")
    image.save(folder / "one.png")
    shutil.copy(folder / "one.png", folder / "two.png")
    (folder / "cut.png").write_bytes((folder / "one.png").read_bytes()[:900])
    (folder / "empty.jpg").write_bytes(b"")
    (folder / "notes.txt").write_text("not a photo")
    return folder


def test_odd_photos_are_used_and_bad_ones_are_named(tmp_path: Path) -> None:
    odd_photos(tmp_path / "photos")
    for name in ("grey", "cmyk", "moving", "one"):
        write_depth(tmp_path / "depth" / f"{name}.npy", metres(72, 54))
    (tmp_path / "depth" / "cmyk.npy").unlink()
    done = build(tmp_path, tmp_path / "out", "--views", 2)
    assert done.code == 0, done.err
    assert [sample.photo for _, sample in load_manifest(tmp_path / "out").samples] == [
        "grey.png",
        "moving.gif",
        "one.png",
    ]
    passed = [line for line in done.lines if line.startswith("passed over: ")]
    assert len(passed) == 5
    for words in ("tiny.png: 8×8 pixels", "cut.png: cannot be decoded", "empty.jpg: the file is empty"):
        assert any(words in line for line in passed)
    assert any("two.png: the same photo as one.png" in line for line in passed)
    assert any("cmyk.jpg: no depth map" in line for line in passed)
    (entry,) = [line for shard in load_manifest(tmp_path / "out").shards for line in shard.passed_over]
    assert entry.startswith("cmyk.jpg: no depth map in --depth: ")


def test_coco_annotations_name_the_photos(place: Path, tmp_path: Path) -> None:
    file = place / "photos" / "coco.json"
    names = ["4.png", "gone.jpg", "0.png", "lost.jpg", "4.png"]
    file.write_text(json.dumps({"images": [{"file_name": name, "id": 1} for name in names]}))
    try:
        options = ["--depth", place / "depth", *SHORT, "--views", 2, "-o"]
        done = run("dataset", "build", "--photos", file, *options, tmp_path / "out")
        assert done.code == 0, done.err
        assert f"2 images that {file} names are not in {place}/photos: gone.jpg, lost.jpg" in done.lines
        assert [sample.photo for _, sample in load_manifest(tmp_path / "out").samples] == ["0.png", "4.png"]
        moved = shutil.move(file, tmp_path / "coco.json")
        done = run("dataset", "build", "--photos", moved, "--images", place / "photos", *options, tmp_path / "out")
        assert done.code == 0, done.err
    finally:
        file.unlink(missing_ok=True)


@pytest.mark.parametrize(
    "text",
    ["", "no json", "[]", '{"images": []}', '{"images": [{}]}', '{"images": [{"file_name": "../a.png"}]}',
     '{"images": [{"file_name": 3}]}', '{"images": [{"file_name": "/etc/passwd"}]}',
     '{"images": [{"file_name": "no.jpg"}]}'],
)  # fmt: skip
def test_bad_annotations_are_a_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "coco.json").write_text(text)
    done = run(
        "dataset", "build", "--photos", tmp_path / "coco.json", "--depth", tmp_path, "-o", tmp_path / "o", *SHORT
    )
    assert (done.code, len(done.lines)) == (2, 1)
    assert "coco.json" in done.err
    assert not (tmp_path / "o").exists()


def test_a_subset_depends_on_the_seed_alone(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def subset(count: int | None, seed: int) -> list[str]:
        chosen = choose(find_photos(place / "photos"), count, seed, lambda line: None, lambda done, total: None)
        return [photo.name for photo in chosen]

    before = subset(3, 0)
    assert len(before) == 3
    assert before == sorted(before)
    assert len({tuple(subset(2, seed)) for seed in range(6)}) > 1
    walk = os.walk

    def backwards(top: Path) -> object:
        return ((folder, folders, files[::-1]) for folder, folders, files in walk(top))

    monkeypatch.setattr(os, "walk", backwards)
    assert subset(3, 0) == before
    assert len(subset(None, 0)) == 5
    with pytest.raises(InputError, match="--sample asks for 6"):
        subset(6, 0)


@pytest.mark.parametrize(
    "options",
    [
        ("--views", 1), ("--views", 101), ("--workers", 0), ("--threads", 0), ("--shard-size", 0), ("--sample", 0),
        ("--disparity", 0.5, 0.1), ("--disparity", 0, 0.1), ("--disparity", 0.1, 9), ("--seed", -1),
        ("--inpainter", "propainter"), ("--trajectory", "loop"), ("--base", "none"), ("--base", "sharp"),
    ],
)  # fmt: skip
def test_bad_options_are_a_line_and_leave_nothing(place: Path, tmp_path: Path, options: tuple[object, ...]) -> None:
    done = build(place, tmp_path / "out", *options)
    assert (done.code, len(done.lines)) == (2, 1)
    assert not (tmp_path / "out").exists()


def test_no_photos_is_a_line(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "depth").mkdir()
    assert "no photos in this folder" in build(tmp_path, tmp_path / "out").err
    (tmp_path / "photos" / "a.png").write_bytes(b"no")
    assert "none of 1 photos can be used" in build(tmp_path, tmp_path / "out").lines[-1]
    write_inputs(tmp_path, 1)
    shutil.rmtree(tmp_path / "depth")
    (tmp_path / "depth").mkdir()
    for _ in range(2):  # nothing stays of the first, and the second says why again
        done = build(tmp_path, tmp_path / "out")
        assert (done.code, len(done.lines)) == (2, 3)  # a.png, 0.png, and what it comes to
        assert "none of 1 photos gave a sample, such as 0.png: no depth map in --depth: " in done.lines[-1]
        assert not (tmp_path / "out").exists()


def test_depth_has_to_be_a_folder(place: Path, tmp_path: Path) -> None:
    for depth in (place / "nowhere", place / "depth" / "0.npy"):
        done = build(place, tmp_path / "out", "--depth", depth)
        assert (done.code, len(done.lines)) == (2, 1)
        assert f"--depth {depth}: no such folder" in done.err
        assert not (tmp_path / "out").exists()


def test_more_photos_than_there_are_keys_are_a_line(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(building, "MAX_PHOTOS", 4)
    done = build(place, tmp_path / "out")
    assert (done.code, len(done.lines)) == (2, 1)
    assert "5 photos are too many for a dataset (at most 4): give --sample" in done.err
    assert not (tmp_path / "out").exists()


def test_sharp_needs_no_depth(tmp_path: Path) -> None:
    write_inputs(tmp_path, 1, 64, 48)
    weights = write_tiny(tmp_path / "tiny.safetensors")
    options = ["--base", "sharp", "-c", weights, "--views", 2, "--inpainter", "none", "-o", tmp_path / "out"]
    done = run("dataset", "build", "--photos", tmp_path / "photos", *options)
    assert done.code == 0, done.err
    config = load_manifest(tmp_path / "out").config
    assert config["base"]["name"] == "sharp"
    assert config["base"]["weights"] == hashlib.sha256(weights.read_bytes()).hexdigest()


# Views, encoding, inpainters ----------------------------------------------------------------------


@pytest.mark.parametrize("kind", TRAJECTORIES)
@pytest.mark.parametrize("views", [2, 3, 5, 19, 20])
def test_no_two_views_are_alike_and_the_first_is_the_photos(kind: TrajectoryKind, views: int) -> None:
    camera = Camera.from_focal(80.0, 96, 72)
    cameras = path_cameras(PathChoice(kind, 0.4), camera, DepthRange(2.0, 3.0), views)
    assert len(cameras) == views
    assert cameras[0] is camera
    eyes = torch.stack([view.position.double() for view in cameras])
    apart = torch.cdist(eyes, eyes) + torch.eye(views)
    assert float(apart.min()) > APART
    with pytest.raises(ValueError, match="different views"):
        path_cameras(PathChoice(kind, 0.0), camera, DepthRange(2.0, 3.0), views)


def test_a_photos_path_depends_on_the_photo_and_the_seed() -> None:
    drawn = [draw_path(ViewChoices(), hashlib.sha256(bytes([n])).hexdigest()) for n in range(40)]
    assert {path.kind for path in drawn} == set(TRAJECTORIES)
    assert all(0.1 <= path.disparity <= 0.6 for path in drawn)
    assert draw_path(ViewChoices(), "ab") == draw_path(ViewChoices(), "ab") != draw_path(ViewChoices(1), "ab")
    assert draw_path(ViewChoices(trajectory="swipe"), "ab").disparity == draw_path(ViewChoices(), "ab").disparity


def test_depth_and_opacity_come_back_within_what_the_page_says() -> None:
    rng = np.random.default_rng(0)
    z = torch.from_numpy(np.exp(rng.uniform(np.log(0.05), np.log(2e4), (40, 50)))).float()
    alpha = torch.from_numpy(rng.uniform(0, 1, (40, 50))).float()
    alpha[0] = 0
    data, (near, far) = encode_depth(z, alpha)
    back = decode_depth(data, near, far)
    known = alpha > 0
    assert bool((back[~known] == 0).all())
    error = ((back - z).abs() / z)[known]
    assert float(error.max()) < np.log(far / near) / 131068 + 1e-6 < 1.1e-4
    alpha[1] = 0.95 + torch.linspace(-2e-5, 2e-5, 50)
    mask = hole_mask(alpha)
    back = decode_alpha(encode_alpha(alpha, mask, 0.95))
    assert torch.equal(hole_mask(back), mask)
    assert float((back - alpha).abs().max()) <= 1 / 65535
    nothing, limits = encode_depth(torch.zeros(4, 4), torch.zeros(4, 4))
    assert not bool(decode_depth(nothing, *limits).any())


def test_gaussians_come_back_and_look_the_same() -> None:
    scene = box_before_wall()
    base = scene.base()
    data = encode_gaussians(base)
    back = decode_gaussians(data)
    assert len(data) < 35 * len(base) + 1000
    assert torch.equal(back.means, base.means)
    torch.testing.assert_close(back.scales, base.scales, rtol=3e-4, atol=0)
    view = shifted(scene.camera, 0.4)
    before, after = (get_renderer().render(gaussians, view) for gaussians in (base, back))
    assert psnr(before.rgb, after.rgb) > 60
    assert len(decode_gaussians(encode_gaussians(Gaussians.empty()))) == 0
    with pytest.raises(ValueError, match="no Gaussians"):
        decode_gaussians(b"nothing")


def test_archives_come_back_and_follow_one_another() -> None:
    one, other = [("a.txt", b"1" * 600), ("a.png", b"")], [("b.txt", b"2" * 512)]
    assert unpack(pack(one)) == dict(one)
    assert unpack(pack(one) + pack(other) + END) == dict(one + other)
    with pytest.raises(ValueError, match="archive"):
        unpack(b"nothing" * 100)


def inpainter(name: str) -> Inpainter:
    return get_inpainter(name, InpainterOptions(complete_scene=scene_completion(get_renderer())))


@pytest.mark.parametrize("name", ["geometry", "opencv", "none"])
def test_inpainters_touch_the_holes_alone(name: str) -> None:
    if name == "opencv":
        pytest.importorskip("cv2")
    scene = box_before_wall()
    prediction = lift(scene.rgb, scene.depth_map, scene.camera)
    views = [scene.camera, shifted(scene.camera, 0.4), shifted(scene.camera, -0.3)]
    stack = render_views(prediction.gaussians, scene.camera, views, get_renderer())
    targets = inpainter(name).complete(stack)
    assert targets.shape == stack.rgb.shape
    assert torch.equal(targets[~stack.mask], stack.rgb[~stack.mask])
    assert bool((targets[stack.mask].amax(-1) > 0.2).all()) == (name != "none")
    seen = dataclasses.replace(stack, mask=torch.zeros_like(stack.mask))
    assert torch.equal(inpainter(name).complete(seen), stack.rgb)


def test_geometry_is_calmer_than_views_completed_one_by_one() -> None:
    bench = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "flicker.py"))
    rgb, depth, camera = bench["scene"](128)
    base = lift(rgb, depth, camera).gaussians
    cameras = path_cameras(PathChoice("swipe", 0.4), camera, DepthRange.of(base), 8)
    stack = render_views(base, camera, cameras, get_renderer())
    order = list(range(1, len(cameras)))
    calm, off = bench["flicker"](stack, inpainter("geometry").complete(stack), order)
    restless, other_off = bench["flicker"](stack, bench["by_view"](stack), order)
    assert calm < restless / 3
    assert off < 1.1 * other_off


def test_without_its_package_opencv_is_a_line(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    done = build(place, tmp_path / "out", "--inpainter", "opencv")
    assert (done.code, len(done.lines)) == (2, 1)
    assert "pip install 'spackle-nvs[opencv]'" in done.err


# As a source of training -------------------------------------------------------------------------


def test_training_learns_from_a_dataset(whole: tuple[Path, Run], tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    (tmp_path / "recipe.yaml").write_text(
        f"""
data: {{pseudo: {whole[0]}, views: 4, validation_views: 2, crops: 2, cells: 16}}
loss: {{features: none}}
optim: {{steps: 2, batch: 2, warmup: 1, precision: fp32}}
run: {{validate_every: 2, save_every: 2}}
"""
    )
    done = run("train", "--recipe", tmp_path / "recipe.yaml", "-o", tmp_path / "out")
    assert done.code == 0, done.err
    assert json.loads((tmp_path / "out" / "run.json").read_text())["samples"]["train"] > 0


def test_a_sample_of_a_dataset_is_one_of_its_views(whole: tuple[Path, Run]) -> None:
    source = PseudoViews(whole[0])
    sample, again = (source.view(np.random.default_rng(3)) for _ in range(2))
    assert torch.equal(sample.target, again.target)
    assert bool(sample.hole.any())
    assert bool(sample.valid.all())
    drawn = get_renderer().render(sample.base, sample.camera)
    assert psnr(drawn.rgb, sample.rendering.rgb) > 55
    views = [view for view in ViewDataset(whole[0]) if torch.equal(view.target, sample.target)]
    assert len(views) == 1
    assert torch.equal(views[0].mask, sample.hole)


def test_a_dataset_that_teaches_nothing_is_refused(place: Path, tmp_path: Path) -> None:
    assert build(place, tmp_path / "out", "--inpainter", "none", "--sample", 1, "--views", 2).code == 0
    with pytest.raises(InputError, match="--inpainter none"):
        PseudoViews(tmp_path / "out")
    with pytest.raises(InputError, match="not there"):
        PseudoViews(tmp_path)


def test_samples_are_told_apart_by_their_dataset(whole: tuple[Path, Run], copy: Path) -> None:
    renderer = get_renderer()
    one, other = (Supply.of(DataRecipe(pseudo=place), renderer).digest for place in (whole[0], copy))
    assert one == other
    manifest = load_manifest(copy)
    dataclasses.replace(manifest, config={**manifest.config, "threads": 9}).save(copy)
    assert Supply.of(DataRecipe(pseudo=copy), renderer).digest != one
