"""Files that others publish: fetched once, whole or not at all, and recorded."""

from spackle.downloads.fetch import Record, check_recorded, download, read_record, weights_folder
from spackle.downloads.known import WEIGHTS, KnownWeights, installed, known_weights

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
