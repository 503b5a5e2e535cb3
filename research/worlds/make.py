"""Make worlds: rooms, streets or tracks as photos with depth, and up to six more views of each.

    PYTHONPATH=src:research python -m worlds.make -o OUT --worlds 1000 --photos PHOTOS
    PYTHONPATH=src:research python -m worlds.make -o OUT --worlds 500 --kind streets

The names of archives with streets and gardens begin with `streets-`, those with rooms seen from
close to a thing with `closeups-`, those with tracks with `tracks-`. Tracks are made of the second
set of models, which `worlds.torcs` gets and whose terms are others (README.md); all else is made of
the first set, which `worlds.fetch` gets.

A world depends on the seed, its number and the number of its views alone. `--views 1` makes the
photo alone, which is all that depth is learned from: more worlds in the same time. The command goes
on where it was stopped; archives that are there are kept. Two processes share the work by
`--part 1/2` and `--part 2/2`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from spackle.cli.script_command import run_script
from spackle.core.image_formats import PHOTO_SUFFIXES
from spackle.runtime.errors import InputError
from spackle.runtime.files import list_files
from spackle.runtime.folders import file_lock, make_folder
from worlds.caster import World
from worlds.fetch import cache_folder, open_library
from worlds.furniture import Furniture
from worlds.library import Library
from worlds.photo_camera import Development, choose_development, photographed
from worlds.photo_camera import developed as develop
from worlds.plans import WorldPlan
from worlds.rooms import DrawPhoto, furnish
from worlds.shards import ROOMS_PREFIX, WORLDS_PER_SHARD, pack_world, shard_file, write_shard
from worlds.streets import street_or_garden
from worlds.torcs import open_torcs
from worlds.tracks import track
from worlds.viewpoints import (
    CANDIDATES,
    SECOND_VIEWS,
    Viewpoint,
    best_viewpoint,
    pixel_grid,
    second_cameras,
)
from worlds.views import VALID, View, render

Rng = np.random.Generator
SIZE = (336, 448)  # height and width of pictures
UPRIGHT = 0.25  # share of worlds whose photo is upright
ATTEMPTS = 20  # how many rooms or places are tried until one shows enough
VERSION = 2  # increases whenever the same seed gives other worlds
# How the names of archives begin, by the kind of worlds in them.
PREFIXES = {"rooms": ROOMS_PREFIX, "closeups": "closeups", "streets": "streets", "tracks": "tracks"}
DrawPlan = Callable[[Rng], WorldPlan]  # gives a random room, street, garden or track


class PackedWorld(NamedTuple):
    """A world, ready for an archive."""

    data: bytes  # its files, as part of a tar archive
    views: int  # how many views it has, the photo's included


MakeWorld = Callable[[int], PackedWorld]  # makes the world of a number


def photos_of(folder: Path | None) -> DrawPhoto | None:
    """A source of photos for picture frames and for what is behind windows; None without a folder.

    Photos that cannot be read are named on standard error, once, and passed over.

    Raises:
        InputError: the folder has no photos; or, when one is drawn, none that can be read.
    """
    if folder is None:
        return None
    files = list_files(folder, tuple(PHOTO_SUFFIXES), below=True) if folder.is_dir() else []
    none_left = InputError(f"{folder}: contains no photos: give another folder as --photos")
    if not files:
        raise none_left

    def draw(rng: Rng) -> NDArray[np.uint8]:
        """A random photo [H, W, 3]."""
        while files:
            file = files[int(rng.integers(len(files)))]
            try:
                with Image.open(file) as photo:
                    return np.asarray(photo.convert("RGB"))
            except (OSError, ValueError, Image.DecompressionBombError):
                print(f"passed over: {file}: not a photo, or damaged", file=sys.stderr)
                files.remove(file)
        raise none_left

    return draw


def make_world(
    draw: DrawPlan,
    library: Library,
    seed: int,
    number: int,
    size: tuple[int, int] = SIZE,
    second_views: int = SECOND_VIEWS,
) -> PackedWorld:
    """A room, street, garden or track, packed: its photo and second views.

    Args:
        draw: gives a random one.
        library: the models it is made of.
        seed, number: determine the world.
        size: height and width in pixels, swapped in upright photos.
        second_views: how many views there are besides the photo's, at most `SECOND_VIEWS`.

    Raises:
        InputError: no world in a row of `ATTEMPTS` shows enough.
    """
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([VERSION, seed, number, attempt])
        height, width = size if rng.random() >= UPRIGHT else size[::-1]
        plan = draw(rng)
        world = World(plan.mesh, plan.pictures)
        candidates = [plan.draw_viewpoint(rng, height, width) for _ in range(CANDIDATES)]
        viewpoint = best_viewpoint(world, candidates, plan.setting.near_m)
        if viewpoint is None:
            continue
        pictures = _pictures(rng, world, viewpoint, plan, second_views)
        if pictures is None:
            continue
        facts = {"version": VERSION, "seed": seed, "number": number}
        facts |= _facts(plan, library) | {"trajectories": pictures.trajectories}
        data = pack_world(
            f"{seed:02d}-{number:06d}", pictures.photo, pictures.views, pictures.settings, facts
        )
        return PackedWorld(data, len(pictures.views))
    raise InputError(f"world {number}: {ATTEMPTS} in a row show too little")


class Pictures(NamedTuple):
    """All pictures of a world."""

    photo: bytes  # a JPEG, as a real camera would have taken it
    views: list[View]  # the photo's view without the camera's faults, then the second views
    settings: Development  # the camera's, which all views share
    trajectories: list[str]  # along which path of the package each second camera lies


def _pictures(
    rng: Rng, world: World, viewpoint: Viewpoint, plan: WorldPlan, second_views: int
) -> Pictures | None:
    """The pictures of a world; None if its photo shows too few surfaces.

    Args:
        rng: for second cameras, rays and the photo's settings.
        world: the plan's triangles.
        viewpoint: the photo's camera.
        plan: what the world consists of, with its light.
        second_views: how many views there are besides the photo's.
    """
    camera = viewpoint.camera
    pixels = pixel_grid(camera.height, camera.width)
    hits = world.first_hits(*viewpoint.rays(camera, pixels))
    known = hits.triangle >= 0
    # Looked at before rendering, which takes long; what is behind glass is only known after it.
    if known.mean() < plan.setting.min_known:
        return None
    cameras, trajectories = second_cameras(rng, world, viewpoint, hits.distance[known])
    chosen = [camera, *cameras[:second_views]]
    views = render(rng, world, plan.lights, viewpoint, chosen, plan.coarse_m)
    if (views[0].valid == VALID).mean() < plan.setting.min_known:
        return None
    settings = choose_development(rng, views[0].radiance, plan.setting.balanced)
    photo = photographed(rng, develop(views[0].radiance, settings), settings)
    return Pictures(photo, views, settings, trajectories[:second_views])


def _facts(plan: WorldPlan, library: Library) -> dict[str, Any]:
    """What a world's JSON says of its content, with the creators and terms of its models."""
    entries = {model.entry.key: model.entry for model in library.models}
    # Bookcases that `shell.made_shelf` builds are no one else's, so the library lacks them.
    used = [entries[key] for key in plan.models if key in entries]
    return {
        "kind": plan.kind,
        "models": list(plan.models),
        "triangles": plan.mesh.count,
        "creators": sorted({one.creator for one in used if one.creator}),
        "licences": sorted({one.licence for one in used}),
    }


def make_shards(
    output: Path,
    make: MakeWorld,
    worlds: int,
    part: tuple[int, int],
    log: Callable[[str], None],
    prefix: str = ROOMS_PREFIX,
) -> None:
    """Write all archives of this process's part that are missing.

    Args:
        output: their folder.
        make: makes the world of a number; numbers begin at 0.
        worlds: how many there shall be in all archives together.
        part: this process's part, from 0, and the number of parts.
        log: called with a line for each archive that was written.
        prefix: how the archives' names begin, before "-00000.tar".
    """
    make_folder(output)
    shards = -(-worlds // WORLDS_PER_SHARD)
    for shard in range(part[0], shards, part[1]):
        path = shard_file(output, shard, prefix)
        if path.is_file():
            continue
        begin = time.perf_counter()
        work_begin = time.process_time()
        first = shard * WORLDS_PER_SHARD
        numbers = range(first, min(first + WORLDS_PER_SHARD, worlds))
        made = [make(number) for number in numbers]
        write_shard(path, [world.data for world in made])
        views = sum(world.views for world in made)
        seconds = time.perf_counter() - begin
        work = time.process_time() - work_begin
        log(
            f"{path.name}: {len(made)} worlds, {views} views, {path.stat().st_size / 1e6:.1f} MB, "
            f"{views / work:.2f} views a second of processor time, {views / seconds:.2f} of clock"
        )


def _maker_of_kind(
    kind: str, cache: Path, photo: DrawPhoto | None, seed: int, second_views: int
) -> MakeWorld:
    """The function that makes worlds of a kind, each by its number.

    It opens the library of the kind's models, which is fetched first if it is missing.

    Args:
        kind: a key of `PREFIXES`.
        cache: the folder in which models and drawn textures are kept.
        photo: gives photos for rooms, or None.
        seed: determines the worlds, together with their numbers.
        second_views: how many views a world has besides the photo's.
    """
    library = open_torcs(cache) if kind == "tracks" else open_library(cache)
    furniture = Furniture(library) if kind in ("rooms", "closeups") else None

    def draw(rng: Rng) -> WorldPlan:
        """A random world of the kind."""
        if furniture is not None:
            return furnish(rng, furniture, cache, photo, close=kind == "closeups")
        return track(rng, library) if kind == "tracks" else street_or_garden(rng, library, cache)

    return lambda number: make_world(draw, library, seed, number, second_views=second_views)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="a folder for archives")
    parser.add_argument(
        "--kind",
        choices=sorted(PREFIXES),
        default="rooms",
        help="of worlds; streets: and gardens; closeups: rooms from close to a thing",
    )
    parser.add_argument("--worlds", type=int, default=48, help="how many there shall be")
    parser.add_argument("--photos", type=Path, help="photos for frames and windows")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--views",
        type=int,
        choices=range(1, SECOND_VIEWS + 2),
        default=SECOND_VIEWS + 1,
        help="of each world, the photo's included; 1 is enough to learn depth from",
    )
    parser.add_argument("--cache", type=Path, help="where models are kept")
    parser.add_argument("--part", default="1/1", help="1/2: the first of two processes")
    options = parser.parse_args(arguments)
    part = part_of(options.part)
    cache = cache_folder(options.cache)
    make = _maker_of_kind(
        options.kind, cache, photos_of(options.photos), options.seed, options.views - 1
    )
    make_folder(options.output)
    prefix = PREFIXES[options.kind]
    with file_lock(options.output / f".{prefix}-{part[0] + 1}.lock"):
        make_shards(
            options.output,
            make,
            options.worlds,
            part,
            lambda line: print(line, flush=True),
            prefix,
        )
    return 0


def part_of(text: str) -> tuple[int, int]:
    """Which part of the work is meant, from 0, and how many parts there are: (0, 2) for "1/2".

    Raises:
        InputError: the text is no such pair of numbers.
    """
    words = text.split("/")
    if len(words) == 2 and all(word.isdecimal() for word in words):
        number, count = int(words[0]), int(words[1])
        if 1 <= number <= count:
            return number - 1, count
    raise InputError(f"--part {text}: must be a number and a count, such as 1/2 and 2/2")


if __name__ == "__main__":
    sys.exit(run_script(main))
