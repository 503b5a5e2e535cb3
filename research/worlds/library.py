"""All models of the catalogues on disk as arrays, read once and then fast to load."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from spackle.runtime.files import atomic_path, write_json
from worlds.catalogue import Entry, read_catalogue, read_model
from worlds.meshes import Material, Mesh

INDEX_FILE = "index.json"
LIBRARY_VERSION = 2  # increases whenever the same catalogues would give other arrays
MAX_TEXTURE_PX = 1024  # a larger picture is shrunk
ReadPicture = Callable[[str], tuple[str, bytes] | None]  # the full name and content, by a name
KEPT_MODELS = 400  # in memory; a model has 2 MB on average


@dataclasses.dataclass(frozen=True)
class Model:
    """A catalogue's model: what it is, and its number of triangles."""

    entry: Entry
    triangles: int
    file: str  # below the library's folder


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
        """A library of models whose arrays are in `folder`; writes its index."""
        content = [dataclasses.asdict(model) for model in models]
        write_json({"version": LIBRARY_VERSION, "models": content}, folder / INDEX_FILE)
        return Library(folder, tuple(models))

    @staticmethod
    def open(folder: Path, catalogues: list[Path], log: Callable[[str], None]) -> Library:
        """The library in `folder`, which is made from catalogue files if it is not there yet.

        Models that cannot be read are left out and reported to `log`.
        """
        found = Library.read(folder)
        if found is not None:
            return found
        folder.mkdir(parents=True, exist_ok=True)
        models = []
        for path in catalogues:
            log(f"reading {path.name}")
            models += _convert(path, folder, log)
        return Library.write(folder, models)

    def mesh(self, model: Model) -> Mesh:
        """The triangles of a model; see `catalogue.read_model` for how it stands."""
        return _load_mesh(self.folder / model.file)


def _model(facts: dict[str, object]) -> Model:
    """A model from the index."""
    entry = dict(facts["entry"])  # type: ignore[call-overload]
    entry["size_m"] = tuple(entry["size_m"])
    entry["turn"] = None if entry["turn"] is None else tuple(entry["turn"])
    return Model(Entry(**entry), int(str(facts["triangles"])), str(facts["file"]))


def _convert(path: Path, folder: Path, log: Callable[[str], None]) -> list[Model]:
    """Write the models and pictures of a catalogue; returns what could be read."""
    models = []
    with zipfile.ZipFile(path) as archive:
        names = {name.lower(): name for name in archive.namelist()}

        def read(picture: str) -> tuple[str, bytes] | None:
            """The name and content of a picture in the catalogue, in any case of letters."""
            name = names.get(picture.lower())
            return None if name is None else (name, archive.read(name))

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
    """The material with its picture's file in the library; without a picture if it is missing.

    Args:
        material: its texture is a name that `read` knows.
        read: gives the picture's full name and its content; None if it is missing.
        folder: the library's.
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
        except (OSError, ValueError) as error:  # Pillow says ValueError of rare SGI files
            log(f"broken picture: {material.texture}: {error}")
            return dataclasses.replace(material, texture=None)
        has_alpha = "A" in picture.getbands() or "transparency" in picture.info
        picture = picture.convert("RGBA" if has_alpha else "RGB")
        picture.thumbnail((MAX_TEXTURE_PX, MAX_TEXTURE_PX))
        with atomic_path(folder / file) as temporary:
            picture.save(temporary)
    return dataclasses.replace(material, texture=str(file))


def save_mesh(mesh: Mesh, path: Path) -> None:
    """Write a mesh as arrays; its materials as JSON among them."""
    materials = json.dumps([dataclasses.asdict(material) for material in mesh.materials])
    with atomic_path(path) as temporary:
        np.savez(
            temporary,
            corners=mesh.corners,
            normals=mesh.normals.astype(np.float16),
            uv=mesh.uv,
            material=mesh.material,
            materials=np.frombuffer(materials.encode(), np.uint8),
        )


@functools.lru_cache(KEPT_MODELS)
def _load_mesh(path: Path) -> Mesh:
    """Read what `save_mesh` has written; pictures get their full path."""
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
