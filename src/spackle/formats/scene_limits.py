"""How much memory a scene may take when it is read: one rule for the files of all formats.

A file of a few bytes can claim millions of Gaussians. Readers call these functions before they
unpack or allocate anything.
"""

from __future__ import annotations

from spackle.core.spherical_harmonics import HARMONICS_COUNTS, MAX_DEGREE

# What a Gaussian takes in memory as float32: centre, quaternion, scales, opacity and colour; and
# for each spherical harmonic three coefficients.
GAUSSIAN_BYTES = 4 * (3 + 4 + 3 + 1 + 3)
HARMONIC_BYTES = 4 * 3

# So much every computer bears: a million Gaussians without harmonics. Readers take up to six times
# as much for a moment.
HARMLESS_BYTES = 1 << 26
# Beyond, a file may ask for at most so many bytes of memory for each of its own. The smallest files
# of real scenes, SOG with harmonics, have a twentieth of their size in memory.
MAX_BYTES_PER_FILE_BYTE = 64


def check_gaussian_count(count: int, harmonics_degree: int, file_bytes: int) -> None:
    """Raise a ValueError if a scene has so many Gaussians that its file must be a hostile one.

    Args:
        count: of the Gaussians that the file claims.
        harmonics_degree: of their spherical harmonics; those above degree 3 are not read.
        file_bytes: size of the file, or of all files of the scene.
    """
    harmonics_count = HARMONICS_COUNTS[min(harmonics_degree, MAX_DEGREE)]
    memory_bytes = count * (GAUSSIAN_BYTES + HARMONIC_BYTES * harmonics_count)
    if memory_bytes > most_memory(file_bytes):
        raise ValueError(f"it claims {count:,} Gaussians in {file_bytes:,} bytes")


def check_unpacked_bytes(what: str, unpacked_bytes: int, file_bytes: int) -> None:
    """Raise a ValueError if a part of a scene is too large for its file.

    Args:
        what: the name of the part, for the message.
        unpacked_bytes: what the part takes in memory once it is unpacked.
        file_bytes: size of the file, or of all files of the scene.
    """
    if unpacked_bytes > most_memory(file_bytes):
        raise ValueError(f"{what} claims {unpacked_bytes:,} bytes in a scene of {file_bytes:,}")


def most_memory(file_bytes: int) -> int:
    """The most bytes of memory that a scene of so many bytes may take."""
    return max(HARMLESS_BYTES, MAX_BYTES_PER_FILE_BYTE * file_bytes)
