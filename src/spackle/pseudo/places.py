"""Files of a dataset, in a folder or at an address (optional: pip install fsspec, and what the address needs)."""

from __future__ import annotations

import os
from typing import IO, Any

from spackle.errors import InputError, reason_in_a_line


def is_address(location: str | os.PathLike[str]) -> bool:
    """Whether this is a URL such as s3://bucket/dataset and not a folder."""
    return "://" in str(location)


def open_in(location: str | os.PathLike[str], name: str) -> IO[bytes]:
    """Open a file of a dataset for reading; it can be sought in.

    Args:
        location: a folder, or an address that fsspec understands.
        name: of the file in it.

    Raises:
        InputError: it is not there or cannot be read, or fsspec is missing.
    """
    place = f"{str(location).rstrip('/')}/{name}"
    try:
        return _open_remote(place) if is_address(location) else open(os.path.join(location, name), "rb")
    except FileNotFoundError as error:
        raise InputError(f"{place}: not there: is {location} a dataset of `spackle dataset build`?") from error
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{place}: cannot be read: {error.strerror or reason_in_a_line(error)}") from error


def _open_remote(url: str) -> IO[bytes]:
    try:
        import fsspec
    except ImportError as error:
        raise InputError(f"{url}: addresses need a package: pip install fsspec") from error
    try:
        file: Any = fsspec.open(url, "rb").open()
        opened: IO[bytes] = file
        return opened
    except (ValueError, ImportError) as error:  # an unknown protocol, or one whose package is missing
        raise InputError(f"{url}: cannot be opened: {reason_in_a_line(error)}") from error
