"""Building a dataset: the same bytes with any number of workers and after a kill; bad input ends
in one line.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import DATA
from helpers.command import names_in, refuses, run
from helpers.dataset_builds import SHORT, build, content, dying_build, is_alive, write_inputs
from helpers.photos import picture
from helpers.systems import needs_posix_signals
from PIL import Image

from spackle.core.photo_lists import photos_of
from spackle.paper.dataset import DatasetFiles, shard_writer
from spackle.paper.dataset.build import PhotoResult, SampleMaker
from spackle.paper.dataset.photos import PhotoFile, choose_photos
from spackle.paper.dataset.shards import load_manifest
from spackle.paper.training.recipe import DataRecipe
from spackle.paper.training.sample_factory import Source, digest_of_samples
from spackle.paper.training.sources import find_sources
from spackle.render import get_renderer
from spackle.runtime.errors import InputError
from spackle.runtime.folders import file_lock


def test_one_worker_and_two_write_the_same_shards(
    whole: Path, place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert names_in(whole) == {
        "manifest.json",
        "shard-000000.tar",
        "shard-000001.tar",
        "shard-000002.tar",
    }
    manifest = load_manifest(whole)
    assert [sample.photo for _, sample in manifest.samples] == [
        "0.png",
        "2.png",
        "3.png",
        "4.png",
        "deep/1.png",
    ]
    assert [len(shard.samples) for shard in manifest.shards] == [2, 2, 1]
    assert all(sample.holes[0] == 0 < 0.02 < max(sample.holes) for _, sample in manifest.samples)
    # Workers are processes of their own; this one, the command's, is not to write any shard.
    monkeypatch.setattr(shard_writer, "write_shard", None)
    assert build(place, tmp_path / "two", "--workers", 2).code == 0
    assert content(tmp_path / "two") == content(whole)


@needs_posix_signals
@pytest.mark.parametrize(
    ("patched", "at", "left"),
    [
        ("build.SampleMaker.make", 4, {"manifest.json", "parts", "shard-000000.tar", ".lock"}),
        # The second shard is written, and its entry for the manifest is not.
        (
            "sys.modules['spackle.paper.dataset.shards'].ShardEntry.model_dump_json",
            2,
            {"manifest.json", "parts", "shard-000000.tar", "shard-000001.tar", ".lock"},
        ),
    ],
)
def test_a_killed_build_resumes_and_ends_the_same(
    whole: Path, place: Path, tmp_path: Path, patched: str, at: int, left: set[str]
) -> None:
    out = tmp_path / "out"
    patch = f"original, calls = {patched}, iter(range(1, 99))\n"
    patch += f"""
def dying(*given, **more):
    return die() if next(calls) == {at} else original(*given, **more)
{patched} = dying"""
    assert dying_build(tmp_path / "script.py", patch, place, out).wait() == -signal.SIGKILL
    assert names_in(out) == left
    assert "not finished" in run("dataset", "verify", out).err
    with pytest.raises(InputError, match="not finished"):
        DatasetFiles(out)
    (out / "parts" / f".000003.{'0' * 12}.tar").write_bytes(b"half")
    assert build(place, out).code == 0
    assert content(out) == content(whole)


@needs_posix_signals
def test_workers_end_with_a_killed_build(
    place: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    patch = """
def dying(*arguments):
    print(*(child.pid for child in multiprocessing.active_children()), flush=True)
    die()
build.DatasetBuild._note = dying"""
    process = dying_build(tmp_path / "script.py", patch, place, tmp_path / "out", "--workers", 2)
    assert process.wait() == -signal.SIGKILL
    workers = [int(pid) for pid in capfd.readouterr().out.split()]
    assert len(workers) == 2
    deadline = time.monotonic() + 300  # seconds; they end at once unless the machine is busy
    while any(is_alive(pid) for pid in workers):
        assert time.monotonic() < deadline, "a worker goes on without its main process"
        time.sleep(0.05)


def test_ctrl_c_ends_after_the_current_photo(
    whole: Path, place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = SampleMaker.make

    def interrupted(self: SampleMaker, photo: PhotoFile) -> PhotoResult:
        signal.raise_signal(signal.SIGINT)
        return make(self, photo)

    with monkeypatch.context() as patch:
        patch.setattr(SampleMaker, "make", interrupted)
        assert build(place, tmp_path / "out").code == 130
    assert build(place, tmp_path / "out").code == 0
    assert content(tmp_path / "out") == content(whole)


def test_a_lost_shard_is_made_again(whole: Path, place: Path, copy: Path) -> None:
    assert build(place, copy).code == 0  # nothing to do
    assert content(copy) == content(whole)
    (copy / "shard-000001.tar").unlink()
    part = copy / "parts" / "000002.tar"
    part.parent.mkdir()
    part.write_bytes((whole / "shard-000001.tar").read_bytes()[:1000])
    done = build(place, copy)
    assert (done.code, f"{part}: not a photo of a dataset, or damaged" in done.lines[-1]) == (
        2,
        True,
    ), done.err
    part.unlink()
    assert build(place, copy).code == 0
    assert content(copy) == content(whole)


def test_odd_photos_are_used_and_bad_ones_are_named(tmp_path: Path) -> None:
    shutil.copytree(DATA / "odd_photos", tmp_path, dirs_exist_ok=True)
    done = build(tmp_path, tmp_path / "out", "--views", 2)
    assert done.code == 0, done.err
    manifest = load_manifest(tmp_path / "out")
    assert [sample.photo for _, sample in manifest.samples] == ["grey.png", "moving.gif", "one.png"]
    assert sum(line.startswith("passed over: ") for line in done.lines) == 5
    for words in ("tiny.png: 8×8 pixels", "cut.png: ", "empty.jpg: ", "two.png: the same photo as"):
        assert words in done.err
    (entry,) = [line for shard in manifest.shards for line in shard.passed_over]
    assert entry.startswith("cmyk.jpg: no depth map in the depth folder: ")


def test_coco_annotations_name_the_photos(place: Path, tmp_path: Path) -> None:
    file = shutil.copytree(place / "photos", tmp_path / "photos") / "coco.json"
    names = ["4.png", "gone.jpg", "0.png", "lost.jpg", "4.png"]
    file.write_text(json.dumps({"images": [{"file_name": name, "id": 1} for name in names]}))
    options = ["--depth", place / "depth", *SHORT, "--views", 2, "-o", tmp_path / "out"]
    assert (
        f"2 images that {file} names are not in {file.parent}, such as gone.jpg"
        in run("dataset", "build", file, *options).err
    )
    assert [sample.photo for _, sample in load_manifest(tmp_path / "out").samples] == [
        "0.png",
        "4.png",
    ]
    moved = shutil.move(file, tmp_path / "coco.json")
    assert run("dataset", "build", moved, "--images", place / "photos", *options).code == 0
    for images in (
        [],
        [{}],
        None,
        *([{"file_name": name}] for name in ("", "../a.png", "/etc/passwd", "no.jpg")),
    ):
        moved.write_text(json.dumps({"images": images}))
        refuses(run("dataset", "build", moved, *options), "coco.json")


def test_a_manifest_names_photos_depth_maps_and_focal_lengths(place: Path, tmp_path: Path) -> None:
    manifest = tmp_path / "photos.jsonl"
    lines = [
        {"file_name": "photos/0.png", "depth_file_name": str(place / "depth" / "0.npy")},
        {"file_name": "photos/deep/1.png", "depth_file_name": "depth/deep/1.npy", "fov": 100},
        {"file_name": "photos/4.png"},
        {"file_name": "photos/3.png", "depth_file_name": "depth/gone.npy"},
    ]
    manifest.write_text("\n".join(map(json.dumps, lines)))
    options = ["--images", place, *SHORT, "--views", 2, "-o", tmp_path / "out"]
    done = run("dataset", "build", manifest, *options)
    assert done.code == 0, done.err
    photos = DatasetFiles(tmp_path / "out")
    assert [sample.photo for _, sample in photos.samples] == ["photos/0.png", "photos/deep/1.png"]
    assert photos[1].facts["photo"]["focal_source"] == "fov"
    # Photos without a usable depth map are named; the manifest has no path of this machine.
    first, second = [line for shard in photos.manifest.shards for line in shard.passed_over]
    assert first.startswith("photos/3.png: gone.npy: no such")
    assert second.startswith("photos/4.png: `base` rgbd needs depth")

    # Another focal length is another dataset.
    lines[1]["fov"] = 90
    manifest.write_text("\n".join(map(json.dumps, lines)))
    refuses(run("dataset", "build", manifest, *options), "holds a dataset with other options")


def test_a_subset_depends_on_the_seed_alone(place: Path) -> None:
    def subset(count: int, seed: int, order: int = 1) -> list[str]:
        photos = list(photos_of(place / "photos", recursive=True))
        return [
            photo.name
            for photo in choose_photos(
                place, photos[::order], count, seed, print, lambda done, total: None
            )
        ]

    assert subset(3, 0) == sorted(subset(3, 0)) == subset(3, 0, -1)
    assert len({tuple(subset(2, seed)) for seed in range(6)}) > 1
    with pytest.raises(InputError, match="`sample` asks for 6"):
        subset(6, 0)


def test_no_usable_photo_is_a_line(tmp_path: Path) -> None:
    for folder in ("photos", "depth"):
        (tmp_path / folder).mkdir()
    refuses(build(tmp_path, tmp_path / "out"), "no photos in this folder")
    (tmp_path / "photos" / "a.png").write_bytes(b"no")
    assert "none of 1 photos can be used" in build(tmp_path, tmp_path / "out").lines[-1]
    Image.fromarray(picture(72, 54)).save(tmp_path / "photos" / "0.png")
    done = build(tmp_path, tmp_path / "out")
    assert (
        "none of 1 photos gave a sample; for example 0.png: no depth map in the depth folder: "
        in done.lines[-1]
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--threads", 0), "--threads"),
        (("--disparity", 0.5, 0.1), "--disparity 0.5 0.1"),
        (("--disparity", 0.1, 9), "--disparity 0.1 9"),
        (("--base", "sharp"), "--depth"),
        (("--depth", __file__), f"--depth {__file__}: no such folder"),
        (("--inpainter", "nobody"), "--inpainter nobody"),
        (("--inpainter", "propainter"), "inpainter propainter"),
        (
            ("--inpainter", "geometry", "--inpainter-weights", "w"),
            "geometry takes neither --inpainter-weights",
        ),
        (
            ("--inpainter", "opencv", "--inpainter-side", 320),
            "opencv takes neither --inpainter-weights",
        ),
        (
            ("--inpainter", "propainter", "--inpainter-side", 64),
            "--inpainter-side must be between 128 and 1536",
        ),
    ],
)
def test_bad_options_leave_nothing(
    place: Path, tmp_path: Path, options: tuple[object, ...], said: str
) -> None:
    refuses(build(place, tmp_path / "out", *options), said)
    assert not (tmp_path / "out").exists()


def test_another_configuration_and_a_held_folder_are_refused(
    whole: Path, place: Path, copy: Path
) -> None:
    done = build(place, copy, "--inpainter", "none", "--disparity", "0.2", "0.3")
    refuses(
        done, 'inpainter.name: "exemplar" -> "none"', "views.disparity: [0.1, 0.6] -> [0.2, 0.3]"
    )
    assert content(copy) == content(whole)
    with file_lock(copy / ".lock"):
        refuses(build(place, copy), "another run is at work")
    (copy / ".lock").mkdir()
    refuses(build(place, copy), ".lock: cannot lock: Is a directory")


def test_depth_maps_are_read_in_their_unit(place: Path, tmp_path: Path) -> None:
    for file in (place / "depth").rglob("*.npy"):
        moved = tmp_path / "depth" / file.relative_to(place / "depth")
        moved.parent.mkdir(parents=True, exist_ok=True)
        np.save(moved, 100 * np.load(file))  # centimetres
    for folder, options in (
        (place, ["--inpainter", "none"]),
        (tmp_path, ["--inpainter", "none", "--depth-unit", "cm"]),
    ):
        words = ["dataset", "build", place / "photos", "--depth", folder / "depth"]
        done = run(*words, *SHORT, "--views", 2, "-o", tmp_path / f"out{len(options)}", *options)
        assert done.code == 0, done.err
    in_metres, in_centimetres = (DatasetFiles(tmp_path / f"out{count}") for count in (2, 4))
    for place_in_set in range(len(in_metres)):
        expected = in_metres[place_in_set].view(1)
        found = in_centimetres[place_in_set].view(1)
        torch.testing.assert_close(
            found.rendering.depth, expected.rendering.depth, rtol=1e-3, atol=0
        )
    assert in_centimetres.manifest.config["base"]["depth_unit"] == "cm"


def test_sharp_needs_no_depth(made: dict[str, Path], tmp_path: Path) -> None:
    write_inputs(tmp_path, 1, 64, 48)
    weights = made["sharp"]
    options = [
        "--base",
        "sharp",
        "-c",
        weights,
        "--views",
        2,
        "--inpainter",
        "none",
        "-o",
        tmp_path / "out",
    ]
    done = run("dataset", "build", tmp_path / "photos", *options, "--trajectory", "rotate-forward")
    assert done.code == 0, done.err
    config = load_manifest(tmp_path / "out").config
    assert (config["base"]["name"], config["views"]["trajectory"]) == ("sharp", "rotate-forward")
    assert config["base"]["weights"] == hashlib.sha256(weights.read_bytes()).hexdigest()


def test_training_takes_each_view_once_and_judges_by_others(whole: Path, copy: Path) -> None:
    def sources(folder: Path, validation_views: int = 8) -> tuple[DataRecipe, list[Source]]:
        recipe = DataRecipe(pseudo=folder, validation_views=validation_views)
        parts = [
            find_sources(recipe, get_renderer(), validation=judges) for judges in (False, True)
        ]
        return recipe, [source for (source,) in parts]

    files, rng, found = DatasetFiles(whole), np.random.default_rng(0), list[list[tuple[str, int]]]()
    views = [
        photo.view(number)
        for photo in map(files.__getitem__, range(5))
        for number in range(photo.views)
    ]
    for source in sources(whole)[1]:
        samples = [source.view(rng, number) for number in range(source.views or 0)]
        pairs = itertools.product(samples, views)
        found.append([(v.key, v.index) for s, v in pairs if torch.equal(v.target, s.target)])
        assert all(bool(sample.hole.any()) for sample in samples)
    learned, judged = found
    assert sorted(learned + judged) == [
        (view.key, view.index) for view in views if bool(view.mask.any())
    ]
    assert len({key for key, _ in judged}) == 2
    assert not {key for key, _ in learned} & {key for key, _ in judged}
    one, same, other = (digest_of_samples(*sources(*at)) for at in ((whole,), (copy,), (whole, 4)))
    assert one == same != other


def test_the_papers_recipe_learns_from_a_dataset(whole: Path, tmp_path: Path) -> None:
    options = f"data.pseudo={whole} data.validation_views=8"
    options += " loss.features=none optim.batch=2"
    done = run(
        "train", "--recipe", "paper", "-o", tmp_path / "out", *options.split(), "optim.steps=1"
    )
    assert done.code == 0, done.err
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (report["ended"], report["step"], report["recipe"]["network"]) == (
        "steps",
        1,
        "sharp-decoder",
    )
    (dataset,) = report["datasets"]
    assert (dataset["photos"], dataset["sha256"]) == (5, load_manifest(whole).digest)
    # Every view of the three photos that are left, those without a hole and small ones, too.
    assert report["samples"] == report["samples"] | {"kind": "whole views", "train": 12}
    assert report["hole_psnr"]["untrained"] + 3 < report["hole_psnr"]["colours of the targets"]
