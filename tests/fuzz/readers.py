"""Readers of foreign files, and small valid files for each."""

from __future__ import annotations

import collections
import contextlib
import gzip
import hashlib
import io
import json
import struct
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from helpers import DATA

from spackle.clips.files import clip_frames, is_clip, read_clip
from spackle.core.image_files import upright_size
from spackle.core.keyframes import PathError
from spackle.core.photo import load_photo, resize_photo
from spackle.core.photo_lists import photos_of
from spackle.depth.in_photo.layouts import load_photo_depth
from spackle.depth.readers import DepthValue, load_depth
from spackle.depth.units import parse_depth_unit
from spackle.formats import PlyFile, load_cameras, load_path
from spackle.formats.camera_readers import camera_source_files, is_path_file, read_camera_set
from spackle.formats.scene_files import load_scene
from spackle.paper.dataset import DatasetFiles
from spackle.paper.dataset.inspect import find_problems
from spackle.paper.dataset.shards import load_manifest
from spackle.paper.evaluation.case import load_case
from spackle.paper.evaluation.datasets import find_dataset, find_scenes, read_cases
from spackle.paper.evaluation.datasets.labels import read_label
from spackle.paper.evaluation.folder import load_run
from spackle.paper.evaluation.tables import make_tables
from spackle.paper.training.checkpoint import load_checkpoint
from spackle.paper.training.recipe import Recipe, load_recipe
from spackle.runtime.digests import json_digest
from spackle.runtime.errors import InputError, printable_line
from spackle.web.decoding import check_photo
from spackle.weights.checkpoints import read_tensors

Files = dict[str, bytes]  # name in the case's folder → content


def stored_files(name: str) -> list[Files]:
    """Sets of files for a reader, each from a folder 0, 1, … of its archive; `sealed` packs .npz
    and .spz.
    """
    found: dict[str, Files] = collections.defaultdict(dict)
    with tarfile.open(DATA / "fuzz" / f"{name}.tar.xz") as archive:
        for member in archive:
            number, _, file = member.name.partition("/")
            content = archive.extractfile(member)
            assert content is not None
            found[number][file] = content.read()
    return list(found.values())


def sealed(files: Files) -> Files:
    """The files with correct checksums, so that readers do not stop at the checksums."""
    done = {name: _sealed(name, data) for name, data in files.items()}
    if "manifest.json" in done:
        try:
            content = json.loads(done["manifest.json"])
            del content["sha256"]
            for sample, data in (
                (s, done[shard["file"]]) for shard in content["shards"] for s in shard["samples"]
            ):
                sample["sha256"] = hashlib.sha256(
                    data[sample["offset"] :][: sample["size"]]
                ).hexdigest()
            done["manifest.json"] = json.dumps(content | {"sha256": json_digest(content)}).encode()
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
    printable_line(line).encode()  # a report encodes its lines


def _read_depth(folder: Path) -> None:
    path = _only(folder)
    # The bytes of a damaged file are also the text of a unit, and the numbers of a value.
    content = path.read_bytes()
    unit = content[:12].decode("latin-1")
    bytes_of_value = content[-200:].ljust(200, b"\0")
    values = [
        np.frombuffer(bytes_of_value, dtype).reshape(shape)
        for dtype, shape in ((">f4", (1, 5, 10)), ("<f2", (10, 10, 1)), ("<i8", (5, 5)))
    ]
    values.append(np.ma.masked_less(values[0], 1.0))
    attempts: list[Callable[[], object]] = [
        lambda: load_depth(path, kind="near-white"),
        lambda: load_depth(path, unit="1/m"),
        lambda: parse_depth_unit(unit),
        *(partial(load_depth, DepthValue(value)) for value in values),
        *(partial(load_depth, DepthValue(value), kind="near-black") for value in values),
    ]
    for attempt in attempts:
        with contextlib.suppress(InputError):
            attempt()
    load_depth(path)


def _read_ply(folder: Path) -> None:
    for read in (PlyFile.camera, PlyFile.base_count, PlyFile.disparity, PlyFile.gaussians):
        read(PlyFile(_only(folder)))


def _read_foreign_scene(folder: Path) -> None:
    names = [path.name for path in folder.iterdir()]
    scene = folder if "meta.json" in names else folder / min(names, key=lambda name: name[-3:])
    for name in names:
        if name.endswith("gltf"):
            scene = folder / name
    for loss in load_scene(scene).losses:
        _say(loss)


def _read_foreign_cameras(folder: Path) -> None:
    files = sorted(folder.rglob("*.json")) or sorted(folder.rglob("cameras.*"))
    path = next((file for file in files if file.name == "transforms.json"), files[0])
    # The cameras of Polycam and COLMAP are in several files of a folder.
    if path.suffix != ".json" or len(files) == 3:
        path = path.parent
    is_path_file(path)
    cameras = read_camera_set(path)
    camera_source_files(path)
    around = cameras.around_photo("b.jpg")
    around.views()
    try:
        around.path()
    except PathError as error:
        _say(str(error))


def _read_tree(name: str, folder: Path) -> None:
    read_label(find_dataset(name), list(find_scenes(name, folder).values()), folder)
    case = read_cases(name, folder)[0]
    load_case(case)
    for read in (case.read_depth, case.read_points):
        if read is not None:
            read()


def _read_dataset(folder: Path) -> None:
    list(find_problems(folder, load_manifest(folder), lambda done, total: None))
    files = DatasetFiles(folder)
    for place in range(len(files)):
        group = files[place]
        for index in range(group.views):
            group.view(index)
        _ = group.base


def _read_weights(folder: Path) -> None:
    if (folder / "checkpoint.pt").exists():
        load_checkpoint(folder)
        read_tensors(folder / "checkpoint.pt", "give others")
    else:
        read_tensors(_only(folder), "give others")


def _read_clip(folder: Path) -> None:
    path = _only(folder)
    if is_clip(path):
        for _ in clip_frames(read_clip(path, 4)):
            pass


def _read_photo(folder: Path) -> None:
    """A photo with a colour statement, of more than 8 bits, or inside a raw file."""
    path = _only(folder)
    for note in resize_photo(load_photo(path, keep_frame=False), 32).notes:
        _say(note)
    upright_size(path)
    with tempfile.TemporaryDirectory() as place:
        check_photo(path, "photo", Path(place, "preview.jpg"))


BOMBS = ("scene_bombs", "picture_bombs")  # readers whose seeds are refused

READERS: dict[str, Callable[[Path], object]] = {
    "pictures": lambda folder: resize_photo(load_photo(_only(folder), keep_frame=False), 32),
    "depth": _read_depth,
    "photos": _read_photo,
    "portraits": lambda folder: load_photo_depth(_only(folder)),
    "ply": _read_ply,
    "foreign_scenes": _read_foreign_scene,
    "foreign_cameras": _read_foreign_cameras,
    "scenes": lambda folder: load_scene(_only(folder)),
    "cameras": lambda folder: load_cameras(_only(folder)),
    "keyframes": lambda folder: load_path(_only(folder)),
    "calibrations": lambda folder: load_depth(next(folder.glob("disp*"))),
    "recipes": lambda folder: load_recipe(Recipe, _only(folder)),
    "coco": lambda folder: list(photos_of(folder / "a.json", folder=folder / "images", log=_say)),
    "datasets": _read_dataset,
    "weights": _read_weights,
    "runs": lambda folder: make_tables([load_run(folder)], with_unmeasured=True),
    "clips": _read_clip,
    # Small files that claim huge scenes and pictures: whole, they are refused.
    "scene_bombs": lambda folder: load_scene(_only(folder)),
    "picture_bombs": lambda folder: resize_photo(load_photo(_only(folder), keep_frame=False), 32),
    **{
        name: partial(_read_tree, name)
        for name in ("middlebury", "booster", "wildrgbd", "llff", "pairs")
    },
    "colmap": partial(_read_tree, "tanks"),
}
