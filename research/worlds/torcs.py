"""The second set of models: tracks and cars of the racing game TORCS, by Debian.

    PYTHONPATH=src:research python -m worlds.torcs

The first set are the catalogues of furniture, houses and plants that `worlds.fetch` gets. The terms
of this one (GPL 2 or later, Free Art License) ask that what is made of it is shared alike, so it is
fetched, kept and used apart from the first set, and what is learnt from it is never in weights
that anyone may use.
"""

from __future__ import annotations

import argparse
import dataclasses
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from spackle.cli.script_command import run_script
from spackle.runtime.errors import InputError
from worlds.ac3d_files import read_ac3d
from worlds.catalogue import Entry
from worlds.fetch import cache_folder, download
from worlds.library import Library, Model, NamedPicture, ReadPicture, save_mesh, with_picture
from worlds.meshes import Mesh, joined

PACKAGE = "torcs-data"
GAME = "usr/share/games/torcs"  # in the unpacked package
COPYRIGHT = "usr/share/doc/torcs-data/copyright"
FREE_ART = "Free Art License 1.3"
GPL = "GPL-2.0-or-later"
TRACK, CAR = "Tracks", "Cars"  # categories of models in the library
INCH_M = 0.0254
SKIN_M = 0.004  # half of a car body's thickness
# Cars with fewer triangles look like boxes.
CARS = (
    "car1-stock1", "car1-stock2", "car1-trb1", "car1-trb3", "car2-trb1", "car3-trb1",
    "car4-trb1", "car5-trb1", "car6-trb1", "car7-trb1", "car8-trb1", "p406",
)  # fmt: skip
# Left out: two tracks that were taken over from other games, and those of walls and grass alone.
NO_TRACKS = (
    "brondehach", "forza", "a-speedway", "b-speedway", "c-speedway", "d-speedway", "e-speedway",
    "f-speedway", "g-speedway", "e-track-4", "e-track-5", "eroad", "g-track-2", "mixed-2",
    "ole-road-1", "spring", "dirt-1", "dirt-2", "dirt-3", "dirt-4", "dirt-5", "dirt-6",
)  # fmt: skip
USUAL_WHEEL = "trb1-1"  # for cars that name none


def open_torcs(cache: Path | None = None) -> Library:
    """The library of all tracks and cars, in metres.

    The package is fetched and converted at the first call, which takes minutes.

    Args:
        cache: the folder in which models are kept; None: the usual one, see `cache_folder`.

    Raises:
        InputError: the package cannot be fetched.
    """
    folder = cache_folder(cache)
    root = folder / "torcs"
    if not (root / GAME).is_dir():
        download((PACKAGE,), folder / "debs-torcs", root)
    library = folder / "library-torcs"
    return convert(root, library, lambda line: print(line, file=sys.stderr))


def convert(root: Path, folder: Path, log: Callable[[str], None]) -> Library:
    """The library in `folder`, which is made from the package if it is not there yet.

    Args:
        root: where the package is unpacked.
        folder: of the library.
        log: called with a line for each model that is read, and for each that cannot be read and
            is left out.

    Raises:
        InputError: no model could be read.
    """
    found = Library.read(folder)
    if found is not None:
        return found
    folder.mkdir(parents=True, exist_ok=True)
    game = root / GAME
    terms = (root / COPYRIGHT).read_text(encoding="utf-8")
    free_art = free_art_names(terms)
    tracks = [path for path in sorted(game.glob("tracks/*/*")) if path.is_dir()]
    files = [(TRACK, path) for path in tracks if path.name not in NO_TRACKS]
    files += [(CAR, game / "cars" / name) for name in CARS if (game / "cars" / name).is_dir()]
    models = []
    for category, path in files:
        name = path.name
        log(f"reading {name}")
        try:
            mesh = _read_car(path) if category == CAR else _read_model(path / name)
        except (OSError, ValueError) as error:
            log(f"left out: {name}: {error}")
            continue
        read = _picture_reader(path, game)
        mesh = mesh.with_materials([with_picture(one, read, folder, log) for one in mesh.materials])
        width, depth, height = (float(side) for side in mesh.high - mesh.low)
        entry = Entry(
            key=f"torcs#{name}",
            name=name,
            category=category,
            file=str(path.relative_to(root)),
            size_m=(width, depth, height),
            elevation_m=0.0,  # it stands on the ground
            top_m=None,  # things may stand on it
            opening=False,  # no door or window
            turn=None,  # the mesh stands as it should
            creator=_creators(path),
            licence=_licence(mesh, name in free_art),
        )
        save_mesh(mesh, folder / f"{name}.npz")
        models.append(Model(entry, mesh.count, f"{name}.npz"))
    if not models:
        raise InputError(f"{game}: no track or car could be read: delete {root} to fetch it again")
    return Library.write(folder, models)


def free_art_names(terms: str) -> set[str]:
    """The names of tracks and cars that Debian's copyright file puts under the Free Art License.

    The file's paragraphs each have lines of files, such as "data/tracks/road/e-track-1/*", and a
    line "License: ...".
    """
    names: set[str] = set()
    for paragraph in re.split(r"\n\s*\n", terms):
        if re.search(r"^License: Free-Art-License", paragraph, re.MULTILINE):
            names |= set(re.findall(r"([\w-]+)/\*$", paragraph, re.MULTILINE))
    return names


def _licence(mesh: Mesh, is_free_art: bool) -> str:
    """The terms of a converted model, for its index entry.

    Args:
        mesh: its pictures' names tell whether it uses the game's common ones, which are GPL.
        is_free_art: whether the model itself is under the Free Art License; if not, it is GPL.
    """
    common = any(one.texture is not None and one.texture.startswith("textures-")
                 for one in mesh.materials)  # fmt: skip
    if not is_free_art:
        return GPL
    return f"{FREE_ART}; its common pictures: {GPL}" if common else FREE_ART


def _creators(path: Path) -> str:
    """The lines of a model's readme.txt that name authors; the game's authors if it has none."""
    readme = path / "readme.txt"
    content = readme.read_bytes() if readme.is_file() else b""
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:  # some files are older than UTF-8
        text = content.decode("latin1")
    lines = [line.strip() for line in text.splitlines()]
    found = [line for line in lines if re.search(r"copyright\b.*\d{4}|^track from", line, re.I)]
    return "; ".join(found) or "Eric Espié, Christophe Guionneau, Bernhard Wymann, Andrea Alfieri"


def _read_model(stem: Path) -> Mesh:
    """The mesh of the file STEM.acc, TORCS' own format, or else of STEM.ac; z up, in its unit."""
    path = stem.with_name(stem.name + ".acc")
    if not path.is_file():
        path = stem.with_name(stem.name + ".ac")
    return read_ac3d(path.read_text(encoding="latin1"))


def _picture_reader(path: Path, game: Path) -> ReadPicture:
    """A function that reads a picture by the name that a model's file gives.

    Args:
        path: the model's folder, where pictures are looked for first.
        game: the game's folder, with pictures of wheels and those that all models share.
    """

    def read(name: str) -> NamedPicture | None:
        """A name that tells the folder, too, and the file's content; None if it is nowhere."""
        for folder in (path, game / "wheels", game / "data" / "textures"):
            file = folder / name
            if file.is_file():
                return NamedPicture(f"{file.parent.name}-{file.name}", file.read_bytes())
        return None

    return read


def _read_car(path: Path) -> Mesh:
    """A car on its wheels, in metres. It looks towards −y and stands on z = 0, z up.

    The game's own cars have x forward, y to the left and z up. Their body is a model; their XML
    file says where wheels are and how large.

    Args:
        path: the car's folder, which is called as the car.

    Raises:
        ValueError: the car's files cannot be read.
    """
    body = _read_model(path / path.name)
    # Bodies have an outer and an inner skin at one place, whose normals are opposite. Each is moved
    # along its own normals, so that rays meet the outer one.
    apart = body.corners + SKIN_M * body.normals
    body = dataclasses.replace(body, corners=apart.astype(np.float32))
    facts = (path / f"{path.name}.xml").read_text(encoding="latin1")
    wheel_kinds = re.findall(r'name="3d wheel directory"[^>]*val="([^"]+)"', facts)
    wheel_kind = wheel_kinds[0] if wheel_kinds else USUAL_WHEEL
    wheel = _read_model(path.parents[1] / "wheels" / wheel_kind / "wheel0")
    # Pictures of all kinds of wheels have the same name, so the kind's folder is put before it.
    wheel = wheel.with_materials(
        [dataclasses.replace(one, texture=f"{wheel_kind}/{one.texture}") for one in wheel.materials]
    )
    parts = [body]
    for end in ("Front", "Rear"):
        x = _number(facts, f"{end} Axle", "xpos")
        for side in ("Right", "Left"):
            section = f"{end} {side} Wheel"
            y = _number(facts, section, "ypos")
            width = _number(facts, section, "tire width") / 1000  # the file gives millimetres
            rim = _number(facts, section, "rim diameter") * INCH_M
            # The tyre is above and below the rim.
            diameter = rim + 2 * width * _number(facts, section, "tire height-width ratio")
            # The wheel's model has a diameter and a width of 1, its middle at the origin, its axle
            # along y and its outer side towards −y, the right; on the left it is mirrored.
            scale = np.diag([diameter, width if y < 0 else -width, diameter])
            parts.append(wheel.moved(scale, (x, y, diameter / 2)))
    # From x forward and y left to −y forward and x left.
    return joined(parts).moved(np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]))


def _number(facts: str, section: str, name: str) -> float:
    """A number of a car's XML file, in the file's own unit.

    Args:
        facts: the file's text.
        section: of the file, such as "Front Axle".
        name: of the number in it, such as "xpos".

    Raises:
        ValueError: it is missing.
    """
    found = re.search(rf'section name="{section}">(.*?)</section>', facts, re.DOTALL)
    value = found and re.search(rf'name="{name}"[^>]*\bval="([^"]+)"', found.group(1))
    if not value:
        raise ValueError(f"no {name} of {section} in its XML file")
    return float(value.group(1))


def main() -> None:
    """Fetch the models, and print a line for each, with its terms and creators."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, help="where models are kept")
    for model in open_torcs(parser.parse_args().cache).models:
        entry = model.entry
        print(f"{entry.key}: {model.triangles:,} triangles, {entry.licence}, {entry.creator}")


if __name__ == "__main__":
    sys.exit(run_script(main))
