"""Files that others publish: fetched once, whole or not at all, and recorded."""

from spackle.downloads.fetch import (
    WEIGHTS,
    KnownWeights,
    Record,
    check_recorded,
    download,
    installed,
    known_weights,
    read_record,
    weights_folder,
)

__all__ = [
    "WEIGHTS",
    "KnownWeights",
    "Record",
    "check_recorded",
    "download",
    "installed",
    "known_weights",
    "read_record",
    "weights_folder",
]
