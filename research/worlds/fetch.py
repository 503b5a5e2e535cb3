"""Fetch the models by apt into a folder of their own; nothing is installed.

    PYTHONPATH=src:research python -m worlds.fetch

Debian's packages are downloaded and unpacked below the cache folder: WORLDS_CACHE, or
~/.cache/spackle-worlds.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from spackle.cli.script_command import run_script
from spackle.runtime.errors import InputError
from spackle.runtime.folders import make_folder
from worlds.library import Library

PACKAGES = ("sweethome3d-furniture", "sweethome3d")
CATALOGUES = "usr/share/sweethome3d/furniture"


def cache_folder(given: Path | None = None) -> Path:
    """Where models are kept: the given folder, WORLDS_CACHE, or a folder of the user."""
    if given is not None:
        return given
    default = Path.home() / ".cache" / "spackle-worlds"
    return Path(os.environ.get("WORLDS_CACHE", default))


def fetch(folder: Path) -> None:
    """Download and unpack Debian's packages, unless they are there.

    Raises:
        InputError: apt-get or dpkg is missing or fails.
    """
    root = folder / "root"
    if not (root / CATALOGUES).is_dir():
        download(PACKAGES, folder / "debs", root)


def download(packages: Sequence[str], archives: Path, root: Path) -> None:
    """Download packages of Debian and unpack them, without installing anything.

    Args:
        packages: their names.
        archives: the folder for their files (.deb); all files there are unpacked.
        root: the folder to unpack into; it becomes their root folder, with "usr" in it.

    Raises:
        InputError: the folder cannot be made, or apt-get or dpkg is missing or fails.
    """
    make_folder(archives)
    try:
        subprocess.run(["apt-get", "download", *packages], cwd=archives, check=True)
        for archive in sorted(archives.glob("*.deb")):
            subprocess.run(["dpkg", "-x", str(archive), str(root)], check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise InputError(
            f"{archives}: cannot fetch {' and '.join(packages)} ({error}): needs Debian or Ubuntu; "
            "run `apt-get update` first"
        ) from error


def open_library(cache: Path | None = None) -> Library:
    """All models; fetched and converted at the first call, which takes minutes."""
    folder = cache_folder(cache)
    fetch(folder)
    catalogues = sorted((folder / "root" / CATALOGUES).glob("*.sh3f"))
    return Library.open(folder / "library", catalogues, lambda line: print(line, file=sys.stderr))


def main() -> None:
    """Fetch the models, and print how many there are."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, help="where models are kept")
    models = open_library(parser.parse_args().cache).models
    print(f"{len(models)} models, {sum(model.triangles for model in models):,} triangles")


if __name__ == "__main__":
    sys.exit(run_script(main))
