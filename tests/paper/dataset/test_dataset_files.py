"""Reading a dataset: damage is found, every view is read once and equals the rendered view."""

from __future__ import annotations

import hashlib
import json
import os
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.command import names_in, refuses, run
from helpers.dataset_builds import VIEWS
from helpers.scenes import psnr
from PIL import Image
from torch.utils.data import DataLoader

from spackle.paper.dataset import DatasetFiles
from spackle.paper.dataset.encoding import (
    decode_alpha,
    decode_depth,
    encode_alpha,
    encode_depth,
)
from spackle.paper.dataset.sample import END_OF_ARCHIVE
from spackle.paper.dataset.shards import load_manifest
from spackle.render import get_renderer
from spackle.residual import hole_mask
from spackle.runtime.digests import json_digest
from spackle.runtime.errors import InputError


@pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)  # webdataset leaves files open
def test_a_shard_is_a_plain_tar_that_webdataset_reads(whole: Path) -> None:
    with tarfile.open(whole / "shard-000000.tar") as archive:
        members = archive.getmembers()
    assert {(m.mtime, m.uid, m.gid, m.uname, m.mode) for m in members} == {(0, 0, 0, "", 0o644)}
    webdataset = pytest.importorskip("webdataset")
    groups = list(
        webdataset.WebDataset(
            [str(path) for path in sorted(whole.glob("*.tar"))], shardshuffle=False
        )
    )
    assert [group["__key__"] for group in groups] == [f"{number:06d}" for number in range(5)]
    for number, group in enumerate(groups):
        own = DatasetFiles(whole)[number]
        assert {
            f"{own.key}.{n}": data for n, data in group.items() if not n.startswith("__")
        } == dict(own.files)
        pictures = {
            f"{k:02d}.{kind}.png"
            for k in range(VIEWS)
            for kind in ("rgb", "target", "mask", "alpha", "depth")
        }
        assert {n for n in group if not n.startswith("__")} == {
            "json",
            "photo.png",
            "base.safetensors",
            *pictures,
        }


def test_views_are_read_as_they_were_rendered(whole: Path, place: Path) -> None:
    group = DatasetFiles(whole)[0]
    assert len(group.base) == group.facts["base"]["gaussians"]
    assert 0.1 <= group.facts["trajectory"]["disparity"] <= 0.6
    for index, view in enumerate(group.facts["views"]):
        sample = group.view(index)
        drawn = get_renderer().render(group.base, sample.camera)
        assert psnr(drawn.rgb, sample.rendering.rgb) > 55
        assert float((drawn.alpha - sample.rendering.alpha).abs().max()) < 0.01
        assert torch.equal(sample.mask, hole_mask(sample.rendering.alpha))
        assert float(sample.mask.double().mean()) == view["hole"]
        assert torch.equal(sample.target[~sample.mask], sample.rendering.rgb[~sample.mask])
        if bool(sample.mask.any()):  # holes are painted
            assert float(sample.target[sample.mask].amax(-1).min()) > 0.2
    first = group.view(0)
    assert torch.equal(first.camera.world_to_camera, torch.eye(4))
    stored = torch.from_numpy(np.array(Image.open(place / "photos" / "0.png"))).float() / 255
    assert torch.equal(first.photo, stored)
    assert psnr(first.rendering.rgb, first.photo) > 25


def test_verify_names_the_sample_of_any_flipped_byte(copy: Path) -> None:
    assert run("dataset", "verify", copy).code == 0
    manifest, rng = load_manifest(copy), np.random.default_rng(0)
    for shard in manifest.shards:
        path = copy / shard.file
        original = path.read_bytes()
        places = [
            0,
            len(original) - 1,
            len(original) - len(END_OF_ARCHIVE),
            int(rng.integers(len(original))),
        ]
        for place in places:
            path.write_bytes(
                original[:place] + bytes([original[place] ^ 1]) + original[place + 1 :]
            )
            done = run("dataset", "verify", copy)
            assert (done.code, len(done.lines)) == (1, 1)
            hit = [s for s in shard.samples if s.offset <= place < s.offset + s.size]
            expected = (
                f"sample {hit[0].key} ({hit[0].photo}) is damaged"
                if hit
                else "damaged after its last sample"
            )
            assert f"{shard.file}: {expected}" in done.err
        path.write_bytes(original)


def test_verify_finds_cut_shards_and_a_changed_manifest(copy: Path) -> None:
    first, second, third = (copy / f"shard-00000{number}.tar" for number in range(3))
    os.truncate(first, first.stat().st_size // 2)
    second.unlink()
    os.truncate(third, third.stat().st_size + 1)
    done = run("dataset", "verify", copy)
    assert done.code == 1
    for words in (
        "sample 000001 (2.png) is damaged",
        "shard-000001.tar: no such file",
        "bytes instead of",
    ):
        assert words in done.err
    with pytest.raises(InputError, match=r"shard-000001\.tar: no such file"):
        DatasetFiles(copy)[2]
    manifest = copy / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"0.png"', '"9.png"'))
    refuses(run("dataset", "verify", copy), f"{manifest}: damaged")
    manifest.unlink()
    refuses(run("dataset", "info", copy), f"{manifest}: no such file")


def resealed(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change a manifest and its digest."""
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    del content["sha256"]
    change(content)
    path.write_text(json.dumps(content | {"sha256": json_digest(content)}))


@pytest.mark.parametrize(
    ("name", "value"), [("size", -1), ("file", "../photos.tar"), ("holes", [0.1]), ("key", "../a")]
)
def test_impossible_fields_are_refused_though_the_digest_fits(
    copy: Path, name: str, value: object
) -> None:
    def change(content: dict[str, Any]) -> None:
        shard = content["shards"][0]
        (shard if name in ("size", "file") else shard["samples"][0])[name] = value

    resealed(copy, change)
    with pytest.raises(InputError, match=r"manifest\.json: damaged"):
        load_manifest(copy)


def member(**fields: Any) -> bytes:
    info = tarfile.TarInfo("000000.json")
    for key, value in fields.items():
        setattr(info, key, value)
    return info.tobuf(tarfile.GNU_FORMAT)


@pytest.mark.parametrize(
    "data", [member(type=tarfile.SYMTYPE, linkname="/etc/passwd"), member(size=1 << 40), b"no tar"]
)
def test_odd_members_are_refused_though_all_digests_fit(copy: Path, data: bytes) -> None:
    def change(content: dict[str, Any]) -> None:
        shard = content["shards"][0]
        shard["samples"] = [
            shard["samples"][0] | {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        ]
        shard["size"] = len(data + END_OF_ARCHIVE)
        sizes = [shard["size"] for shard in content["shards"]]
        content["counts"] = {"photos": 4, "views": 4 * VIEWS, "bytes": sum(sizes)}

    (copy / "shard-000000.tar").write_bytes(data + END_OF_ARCHIVE)
    resealed(copy, change)
    with pytest.raises(InputError, match="sample 000000: not a photo of a dataset"):
        DatasetFiles(copy)[0]


def test_info_and_preview(whole: Path, tmp_path: Path) -> None:
    assert f"5 photos, {5 * VIEWS} views, 3 shards" in run("dataset", "info", whole).out
    done = run("dataset", "preview", whole, "-o", tmp_path / "look", "--photos", 2, "--views", 3)
    assert done.code == 0, done.err
    assert names_in(tmp_path / "look") == {"sheet.png", "trajectory.mp4"}
    with Image.open(tmp_path / "look" / "sheet.png") as sheet:
        assert sheet.size == (3 * 72, 2 * 3 * 54)


def test_a_loader_of_torch_reads_every_view_once(whole: Path) -> None:
    loader = DataLoader(DatasetFiles(whole), batch_size=None, shuffle=True, num_workers=2)
    found = [
        (photo.key, photo.view(index).index) for photo in loader for index in range(photo.views)
    ]
    assert sorted(found) == [(f"{photo:06d}", view) for photo in range(5) for view in range(VIEWS)]


def test_an_address_is_read_by_fsspec(whole: Path) -> None:
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    for path in whole.iterdir():
        memory.pipe(f"/there/{path.name}", path.read_bytes())
    assert DatasetFiles("memory://there")[4].files == DatasetFiles(whole)[4].files
    assert run("dataset", "verify", "memory://there").code == 0
    refuses(run("dataset", "info", "nothing://there"), "nothing://there/manifest.json")


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
