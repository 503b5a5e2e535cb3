"""What a whole drawing leaves behind: to draw a few more Gaussians into some of its tiles then costs only those."""

from __future__ import annotations

import dataclasses
import threading
import weakref
from collections.abc import Sequence

import numpy as np
from torch import Tensor

from spackle._numba import Array, kernel
from spackle.device import run_chunks
from spackle.gaussians import Gaussians
from spackle.render.binning import TileLists, list_tiles, sort_by_depth
from spackle.render.pipeline import Drawing, blend, project
from spackle.render.project import DEPTH, KernelCamera, Splats
from spackle.render.protocol import Rendering

MERGE_GRAIN = 64  # tiles a thread merges at a time


class Snapshot:
    """Tensors as they are now; they may go when nobody else holds them."""

    def __init__(self, tensors: Sequence[Tensor]) -> None:
        self._seen = [(weakref.ref(tensor), _state(tensor)) for tensor in tensors]

    @staticmethod
    def possible(tensors: Sequence[Tensor]) -> bool:
        """Whether changes of these would be noticed: tensors of inference mode do not count theirs."""
        return not any(tensor.is_inference() for tensor in tensors)

    def shows(self, tensors: Sequence[Tensor]) -> bool:
        """Whether these are the same tensors, unchanged."""
        return len(tensors) == len(self._seen) and all(
            ref() is tensor and state == _state(tensor)
            for (ref, state), tensor in zip(self._seen, tensors, strict=True)
        )


def _state(tensor: Tensor) -> tuple[int, int]:
    """What changes when PyTorch changes a tensor in place; a write to its memory by others is not seen."""
    return tensor._version, tensor.data_ptr()


@dataclasses.dataclass(frozen=True)
class CachedDrawing:
    """What was projected and dealt out to tiles, and the tensors that it came from as they were then."""

    view: KernelCamera
    splats: Splats  # with room for more
    lists: TileLists
    snapshot: Snapshot
    sets: int
    count: int  # Gaussians in those sets

    def shows(self, sets: Sequence[Gaussians], view: KernelCamera) -> bool:
        """Whether these sets begin with those that were drawn, unchanged, and are seen from the same camera."""
        flat = [tensor for part in sets[: self.sets] for tensor in part.tensors]
        return self.view.same_as(view) and self.snapshot.shows(flat)


class ProjectionCache:
    """The last whole drawing of a renderer; one thread at a time may draw onto it."""

    def __init__(self) -> None:
        self._kept: CachedDrawing | None = None
        self._lock = threading.Lock()

    def keep(self, sets: Sequence[Gaussians], drawing: Drawing) -> None:
        """Remember a drawing of all tiles."""
        flat = [tensor for part in sets for tensor in part.tensors]
        self._kept = None
        if Snapshot.possible(flat):
            count = sum(len(part) for part in sets)
            self._kept = CachedDrawing(drawing.view, drawing.splats, drawing.lists, Snapshot(flat), len(sets), count)

    def redraw(
        self, sets: Sequence[Gaussians], view: KernelCamera, wanted: Array, onto: Rendering | None
    ) -> Drawing | None:
        """What `draw` would give, bit for bit, or None where the last whole drawing is of no help."""
        if not self._lock.acquire(blocking=False):
            return None
        try:
            kept = self._kept
            if kept is None or not kept.shows(sets, view):
                return None
            more = sets[kept.sets :]
            if kept.count + sum(len(part) for part in more) > len(kept.splats.records):
                return None
            splats = kept.splats
            _, spans = project(more, view, wanted, splats, kept.count)
            added = list_tiles(sort_by_depth(splats.keys, splats.ids, spans), splats.boxes, wanted)
            lists = merged(kept.lists, added, wanted, splats.records)
            return blend(splats, lists, view, wanted, onto, False)
        finally:
            self._lock.release()


def merged(there: TileLists, more: TileLists, wanted: Array, records: Array) -> TileLists:
    """The lists of the wanted tiles, front to back; of equal depths those that are there come first."""
    lengths = np.where(wanted.ravel(), np.diff(there.starts) + np.diff(more.starts), 0)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    ids = np.empty(starts[-1], np.int32)
    tiles = np.flatnonzero(lengths)
    run_chunks(
        lambda a, b: merge_tiles(a, b, tiles, there.ids, there.starts, more.ids, more.starts, records, starts, ids),
        len(tiles),
        MERGE_GRAIN,
    )
    return TileLists(ids, starts)


@kernel
def merge_tiles(
    first: int,
    last: int,
    tiles: Array,
    there_ids: Array,
    there_starts: Array,
    more_ids: Array,
    more_starts: Array,
    records: Array,
    starts: Array,
    ids: Array,
) -> None:
    """Merge the two lists of tiles first..last of the list `tiles` [K] by depth."""
    for k in range(first, last):
        tile = tiles[k]
        a, b, out = there_starts[tile], more_starts[tile], starts[tile]
        a_end, b_end = there_starts[tile + 1], more_starts[tile + 1]
        while a < a_end and b < b_end:
            if records[there_ids[a], DEPTH] <= records[more_ids[b], DEPTH]:
                ids[out] = there_ids[a]
                a += 1
            else:
                ids[out] = more_ids[b]
                b += 1
            out += 1
        for i in range(a, a_end):
            ids[out + i - a] = there_ids[i]
        for i in range(b, b_end):
            ids[out + i - b] = more_ids[i]
