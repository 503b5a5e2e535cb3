"""Small valid files for each reader of foreign files, and the readers."""

from __future__ import annotations

import dataclasses
import gzip
import hashlib
import io
import json
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import portraits
import test_ply
import torch
from clips import moving, write_clip
from photos import calibration, metres, picture, write_depth, write_photo
from PIL import Image
from safetensors.torch import save_file
from scenes import random_gaussians
from test_camera_files import CAMERAS, PATH
from test_eval_datasets import EYES, eth3d, llff, stored, tanks
from test_network_file import WHOLE, write_old, write_parameters, write_script

from spackle.bases.depth_map import load_depth
from spackle.bases.photo_depth.layouts import load_photo_depth
from spackle.camera import Camera
from spackle.clips.files import clip_frames, is_clip, read_clip
from spackle.dataset import DatasetFiles
from spackle.dataset.inspect import problems
from spackle.dataset.photos import find_photos
from spackle.dataset.shards import load_manifest
from spackle.errors import one_line
from spackle.evaluation.case import load_case
from spackle.evaluation.datasets import read_cases
from spackle.files import digest_of
from spackle.formats import PlyFile, load_cameras, load_path, save_ply
from spackle.formats.scene_files import SceneFile, encoder_of, load_scene
from spackle.image import load_photo, resize_photo
from spackle.network_file import read_tensors
from spackle.training.checkpoint import Checkpoint, Progress, load_checkpoint, save_checkpoint
from spackle.training.recipe import Recipe, load_recipe

Files = dict[str, bytes]  # name in the case's folder → content
Maker = Callable[[Path], object]


@dataclasses.dataclass(frozen=True)
class Reader:
    """Functions that write valid files into a folder, and the function that reads the files."""

    makers: Sequence[Maker]
    read: Callable[[Path], object]


def sealed(files: Files) -> Files:
    """The files with correct checksums, so that readers do not stop at the checksums."""
    done = {name: _sealed(name, data) for name, data in files.items()}
    if "manifest.json" in done:
        try:
            content = json.loads(done["manifest.json"])
            del content["sha256"]
            for sample, data in ((s, done[shard["file"]]) for shard in content["shards"] for s in shard["samples"]):
                sample["sha256"] = hashlib.sha256(data[sample["offset"] :][: sample["size"]]).hexdigest()
            done["manifest.json"] = json.dumps(content | {"sha256": digest_of(content)}).encode()
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            pass
    return done


def _sealed(name: str, data: bytes) -> bytes:
    if data.startswith(b"\x89PNG"):
        parts, at = [data[:8]], 8
        while at + 12 <= len(data):
            (length,) = struct.unpack_from(">I", data, at)
            body = data[at + 4 : at + 8 + length]
            parts += [data[at : at + 4], body, struct.pack(">I", zlib.crc32(body))]
            at += 12 + length
        return b"".join([*parts, data[at:]])
    if name.endswith(".npz") and not data.startswith(b"PK"):
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("depth.npy", data)
        return packed.getvalue()
    return gzip.compress(data, 1) if name.endswith(".spz") else data


def _only(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def _say(line: str) -> None:
    one_line(line).encode()  # a report encodes its lines


def _writes(name: str, data: bytes | str) -> Maker:
    return lambda folder: (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())


def _pictures(name: str, mode: str = "RGB", **options: Any) -> Maker:
    exif = Image.Exif()
    exif[0x0112], exif[0xA405] = 6, 28
    return lambda folder: Image.fromarray(picture()).convert(mode).save(folder / name, exif=exif, **options)


def _npz(folder: Path) -> None:
    np.save(folder / "a.npy", metres())
    (folder / "a.npy").rename(folder / "a.npz")  # `sealed` packs it


def _ply(folder: Path) -> None:
    camera = Camera.from_focal(50, 64, 48)
    save_ply(random_gaussians(9), folder / "a.ply", camera=camera, base_count=4, disparity=0.3)


def _encoded(kind: str) -> Maker:
    """A scene in another format than PLY; `sealed` packs a .spz."""

    def make(folder: Path) -> None:
        data = encoder_of(path := folder / f"a.{kind}")(SceneFile(path, random_gaussians(300)))
        path.write_bytes(gzip.decompress(data) if kind == "spz" else data)

    return make


def _read_ply(folder: Path) -> None:
    for read in (PlyFile.camera, PlyFile.base_count, PlyFile.disparity, PlyFile.gaussians):
        read(PlyFile(_only(folder)))


def _calib(folder: Path) -> None:
    write_depth(folder / "disp0.npy")
    calibration(folder / "calib.txt", 55.0, 193.0, 3.5)


def _described(folder: Path) -> None:
    write_depth(folder / "disp.npy")
    lens = {"focal_px": 55.5, "cx": 32.0, "cy": 24.0, "doffs_px": 0.5, "baseline_m": 0.2, "disparity_scale": 1.0}
    (folder / "scene.json").write_text(json.dumps({"disparity": "disp.npy", "invalid": 0, **lens}))


def _tree(name: str, *makers: Maker) -> Reader:
    def read(folder: Path) -> None:
        case = read_cases(name, folder)[0]
        load_case(case)
        for facts in (case.depth, case.points):
            if facts is not None:
                facts()

    return Reader(makers, read)


def _text_model(folder: Path) -> None:
    """COLMAP's text files in the layout of Tanks and Temples."""
    scene = eth3d(folder / "Truck")
    (scene / "dslr_calibration_undistorted").rename(scene / "sparse")


RECIPE = """
data: {photos: a, disparity: [0.1, 0.5], rgbd: [{folder: b, focal_px: 500}]}
loss: {features: none, color: 1e1}
optim: {lr: 1e-4, betas: [0.9, 0.99], steps: 100}
run: {seed: 3}
"""


def _coco(folder: Path) -> None:
    (folder / "images").mkdir()
    for name in ("a.jpg", "b.jpg"):
        write_photo(folder / "images" / name, 40, 32)
    images = [{"id": k, "file_name": f"{name}.jpg", "width": 40} for k, name in enumerate("abc")]
    (folder / "a.json").write_text(json.dumps({"info": {}, "images": images}))


def _dataset(folder: Path) -> None:
    from dataset_builds import build, write_inputs

    with tempfile.TemporaryDirectory() as inputs:
        place = write_inputs(Path(inputs, "in"), 2, 36, 32)
        assert build(place, folder / "out", "--views", 2, "--shard-size", 1).code == 0
    for path in (folder / "out").iterdir():
        path.rename(folder / path.name)
    (folder / "out").rmdir()


def _read_dataset(folder: Path) -> None:
    list(problems(folder, load_manifest(folder), lambda done, total: None))
    files = DatasetFiles(folder)
    for place in range(len(files)):
        group = files[place]
        for index in range(group.views):
            group.view(index)
        _ = group.base


def _checkpoint(folder: Path) -> None:
    progress = Progress(3, 0.5, history=[{"loss": 1.0}])
    save_checkpoint(Checkpoint(progress, WHOLE, WHOLE, {"state": {}}, {"run": {}}, "x"), folder)


def _weights(write: Callable[[dict[str, torch.Tensor], Path], None]) -> Maker:
    return lambda folder: write(WHOLE, folder / "a")


def _read_weights(folder: Path) -> None:
    if (folder / "checkpoint.pt").exists():
        load_checkpoint(folder)
        read_tensors(folder / "checkpoint.pt", "give others")
    else:
        read_tensors(_only(folder), "give others")


def _clip(name: str, **options: Any) -> Maker:
    return lambda folder: write_clip(folder / name, moving(3, 16, 24), **options)


def _read_clip(folder: Path) -> None:
    path = _only(folder)
    if is_clip(path):
        for _ in clip_frames(read_clip(path, 4)):
            pass


READERS: dict[str, Reader] = {
    "pictures": Reader(
        [
            *(_pictures(f"a.{kind}") for kind in ("jpg", "png", "webp", "tif", "heic")),
            *(_pictures("a.png", mode) for mode in ("P", "LA", "RGBA", "1")),
            _pictures("a.jpg", "CMYK"),
            _pictures("a.tif", compression="tiff_lzw"),
        ],
        lambda folder: resize_photo(load_photo(_only(folder), keep_frame=False), 32),
    ),
    "depth": Reader(
        [
            lambda folder: Image.fromarray((1000 * metres()).astype(np.uint16)).save(folder / "a.png"),
            _npz,
            _writes("a.pfm", b"Pf\n64 48\n-1.0\n" + metres()[::-1].tobytes()),
            lambda folder: np.save(folder / "a.npy", metres()),
        ],
        lambda folder: load_depth(_only(folder)),
    ),
    "portraits": Reader(
        [
            _writes("a.jpg", portraits.PORTRAIT),
            _writes("a.jpg", portraits.PORTRAITS["GDepth, extended: inverse, metres"]),
            _writes("a.jpg", portraits.PORTRAITS["Dynamic Depth: inverse, metres"]),
            _writes("a.heic", portraits.PORTRAITS["HEIC, Apple's disparity"]),
        ],
        lambda folder: load_photo_depth(_only(folder)),
    ),
    "ply": Reader([_ply, *(_writes("a.ply", content) for content in (test_ply.SHARP, test_ply.GOOD))], _read_ply),
    "scenes": Reader(
        [*map(_encoded, ("spz", "splat", "sog", "compressed.ply"))], lambda folder: load_scene(_only(folder))
    ),
    "cameras": Reader([_writes("a.json", json.dumps(CAMERAS))], lambda folder: load_cameras(_only(folder))),
    "keyframes": Reader([_writes("a.json", json.dumps(PATH))], lambda folder: load_path(_only(folder))),
    "calibrations": Reader([_calib, _described], lambda folder: load_depth(next(folder.glob("disp*")))),
    "recipes": Reader([_writes("a.yaml", RECIPE)], lambda folder: load_recipe(Recipe, _only(folder))),
    "coco": Reader([_coco], lambda folder: find_photos(folder / "a.json", folder / "images", _say)),
    "datasets": Reader([_dataset], _read_dataset),
    "weights": Reader(
        [_checkpoint, *map(_weights, (save_file, torch.save, write_script, write_old, write_parameters))], _read_weights
    ),
    "clips": Reader(
        [
            *(_clip("a.mp4"), _clip("a.mkv", sound="aac"), _clip("a.avi", codec="mpeg4")),
            _clip("a.gif", codec="gif", pix_fmt="rgb8"),
        ],
        _read_clip,
    ),
    "middlebury": _tree("middlebury", lambda folder: stored("middlebury", folder / "a")),
    "booster": _tree("booster", lambda folder: stored("booster", folder / "a")),
    "wildrgbd": _tree("wildrgbd", lambda folder: stored("wildrgbd", folder / "scenes" / "a")),
    "llff": _tree("llff", lambda folder: llff(folder / "fern", EYES[:2])),
    "colmap": _tree("tanks", lambda folder: tanks(folder / "Truck"), _text_model),
}


def contents(folder: Path) -> Files:
    """Every file below a folder."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
