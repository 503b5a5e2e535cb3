"""Groups of files as parts of a tar archive, in bytes that depend on nothing else."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterable, Mapping

BLOCK = 512
END = bytes(2 * BLOCK)  # of an archive


def pack(members: Iterable[tuple[str, bytes]]) -> bytes:
    """Named files as a stretch of a tar archive, without its end: stretches may follow one another.

    No time, owner or machine is in it.
    """
    parts: list[bytes] = []
    for name, data in members:
        header = tarfile.TarInfo(name)  # mtime 0, uid 0, gid 0, mode 644
        header.size = len(data)
        parts += [header.tobuf(tarfile.USTAR_FORMAT), data, bytes(-len(data) % BLOCK)]
    return b"".join(parts)


def unpack(data: bytes) -> Mapping[str, bytes]:
    """The files of such a stretch by name.

    Raises:
        ValueError: it is none.
    """
    found: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            for member in archive:
                file = archive.extractfile(member)
                if file is None:
                    raise ValueError(f"{member.name} is no plain file")
                found[member.name] = file.read()
    except tarfile.TarError as error:
        raise ValueError(f"no tar archive: {error}") from error
    return found
