"""All models of catalogues on disk as arrays, read once and then fast to load.

A library is a folder: an NPZ file for each model, PNG files of their pictures, and an index. There
are two: that of the catalogues of furniture, houses and plants, and that of `worlds.torcs`.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from spackle.runtime.files import atomic_path, write_json
from worlds.catalogue import Entry, read_catalogue, read_model
from worlds.meshes import Material, Mesh

INDEX_FILE = "index.json"
LIBRARY_VERSION = 2  # increases whenever the same catalogues would give other arrays
MAX_TEXTURE_PX = 1024  # a larger picture is shrunk
KEPT_MODELS = 400  # in memory; a model has 2 MB on average


class NamedPicture(NamedTuple):
    """A picture's file, as a catalogue has it."""

    name: str  # identifies the picture among all that a library gets
    content: bytes


ReadPicture = Callable[[str], NamedPicture | None]  # by the name in a model; None: it is missing


@dataclasses.dataclass(frozen=True)
class Model:
    """A catalogue's model: what it is, and where its triangles are."""

    entry: Entry
    triangles: int  # their number
    file: str  # of the mesh, below the library's folder


@dataclasses.dataclass(frozen=True)
class Library:
    """A folder of models as arrays."""

    folder: Path
    models: tuple[Model, ...]

    @staticmethod
    def read(folder: Path) -> Library | None:
        """The library in `folder`; None if it is not there yet, or of another version."""
        index = folder / INDEX_FILE
        if not index.is_file():
            return None
        facts = json.loads(index.read_text(encoding="utf-8"))
        if facts["version"] != LIBRARY_VERSION:
            return None
        return Library(folder, tuple(_model(one) for one in facts["models"]))

    @staticmethod
    def write(folder: Path, models: list[Model]) -> Library:
        """Write the index of a library; returns the library.

        Args:
            folder: has the models' files already.
            models: all of them.
        """
        content = [dataclasses.asdict(model) for model in models]
        write_json({"version": LIBRARY_VERSION, "models": content}, folder / INDEX_FILE)
        return Library(folder, tuple(models))

    @staticmethod
    def open(folder: Path, catalogues: list[Path], log: Callable[[str], None]) -> Library:
        """The library in `folder`, which is made from catalogue files if it is not there yet.

        Args:
            folder: of the library; it is made if it is missing.
            catalogues: files of Sweet Home 3D (.sh3f), each with many models.
            log: called with a line for each catalogue, and for each model or picture that cannot
                be read and is left out.
        """
        found = Library.read(folder)
        if found is not None:
            return found
        folder.mkdir(parents=True, exist_ok=True)
        models = []
        for path in catalogues:
            log(f"reading {path.name}")
            models += _convert_catalogue(path, folder, log)
        return Library.write(folder, models)

    def mesh(self, model: Model) -> Mesh:
        """The triangles of a model in metres, z up, its front towards −y.

        Furniture stands on z = 0 with its box's middle at x = y = 0. Cars stand on z = 0, too.
        Tracks lie as their files say.
        """
        return _load_mesh(self.folder / model.file)


def _model(facts: dict[str, object]) -> Model:
    """A model from its facts in the index, which are JSON: there tuples are lists."""
    entry = dict(facts["entry"])  # type: ignore[call-overload]
    entry["size_m"] = tuple(entry["size_m"])
    entry["turn"] = None if entry["turn"] is None else tuple(entry["turn"])
    return Model(Entry(**entry), int(str(facts["triangles"])), str(facts["file"]))


def _convert_catalogue(path: Path, folder: Path, log: Callable[[str], None]) -> list[Model]:
    """Write a catalogue's models and pictures into a library; returns the models that were read.

    Args:
        path: the catalogue, a ZIP archive (.sh3f).
        folder: of the library.
        log: called with a line for each model or picture that cannot be read and is left out.
    """
    models = []
    with zipfile.ZipFile(path) as archive:
        names = {name.lower(): name for name in archive.namelist()}

        def read(picture: str) -> NamedPicture | None:
            """A picture of the catalogue by its name, in any case of letters; None if missing."""
            name = names.get(picture.lower())
            return None if name is None else NamedPicture(name, archive.read(name))

        for entry in read_catalogue(path):
            try:
                mesh = read_model(archive, entry)
            except ValueError as error:
                log(f"left out: {entry.key}: {error}")
                continue
            materials = [with_picture(one, read, folder, log) for one in mesh.materials]
            file = entry.key.replace("#", "-").replace(" ", "_").replace("/", "_") + ".npz"
            save_mesh(mesh.with_materials(materials), folder / file)
            models.append(Model(entry, mesh.count, file))
    return models


def with_picture(
    material: Material,
    read: ReadPicture,
    folder: Path,
    log: Callable[[str], None],
) -> Material:
    """The material with a file of the library as its texture; the file is written if it is missing.

    A texture that cannot be read becomes None: the material then has one colour.

    Args:
        material: its texture is a name that `read` knows.
        read: gives the picture, or None if it is missing.
        folder: the library's; textures are names of files in it.
        log: called with a line for each picture that is missing or broken.
    """
    if material.texture is None:
        return material
    found = read(material.texture)
    if found is None:
        log(f"missing picture: {material.texture}")
        return dataclasses.replace(material, texture=None)
    name, content = found
    file = name.replace("/", "-").replace(" ", "_")
    file = file.rsplit(".", 1)[0] + ".png"
    if not (folder / file).is_file():
        try:
            picture: Image.Image = Image.open(io.BytesIO(content))
            picture.load()
        except (OSError, ValueError) as error:  # Pillow raises ValueError for some SGI files
            log(f"broken picture: {material.texture}: {error}")
            return dataclasses.replace(material, texture=None)
        has_alpha = "A" in picture.getbands() or "transparency" in picture.info
        picture = picture.convert("RGBA" if has_alpha else "RGB")
        picture.thumbnail((MAX_TEXTURE_PX, MAX_TEXTURE_PX))
        with atomic_path(folder / file) as temporary:
            picture.save(temporary)
    return dataclasses.replace(material, texture=str(file))


def save_mesh(mesh: Mesh, path: Path) -> None:
    """Write a mesh to an NPZ file; its materials are bytes of JSON among the arrays.

    Args:
        mesh: textures are names of files in the folder of `path`.
        path: ends in .npz.
    """
    materials = json.dumps([dataclasses.asdict(material) for material in mesh.materials])
    with atomic_path(path) as temporary:
        np.savez(
            temporary,  # ends in .npz, too
            corners=mesh.corners,
            # Unit vectors serve for shading alone, for which three digits are enough.
            normals=mesh.normals.astype(np.float16),
            uv=mesh.uv,
            material=mesh.material,
            materials=np.frombuffer(materials.encode(), np.uint8),
        )


@functools.lru_cache(KEPT_MODELS)
def _load_mesh(path: Path) -> Mesh:
    """The mesh that `save_mesh` has written to a file; its textures become full paths."""
    with np.load(path) as arrays:
        facts = json.loads(arrays["materials"].tobytes().decode())
        materials = []
        for one in facts:
            if one["texture"] is not None:
                one["texture"] = str(path.parent / one["texture"])
            materials.append(
                Material(**{**one, "color": tuple(one["color"]), "tint": tuple(one["tint"])})
            )
        return Mesh(
            arrays["corners"],
            arrays["normals"].astype(np.float32),
            arrays["uv"],
            arrays["material"],
            tuple(materials),
        )
