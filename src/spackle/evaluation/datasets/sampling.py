"""A fixed number of frames, spread evenly over many scenes, the same on every machine."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")


def spread(scenes: Sequence[str], frames: Callable[[str], Sequence[T]], count: int) -> list[tuple[str, T]]:
    """At most `count` frames, as many from each scene as there is room for.

    Names alone seed the choice: the scenes are taken in the order of their hashed names, and `GROUP/REST` in
    turns by group, so that no group is favoured. With more scenes than frames, the first scenes give one each.
    With fewer, all give the same number, or all they have; within a scene the frames stand at equal distances,
    from a start that the scene's name decides.

    Args:
        scenes: names, no two alike.
        frames: a scene's frames in their order; asked only for scenes that are used.
        count: how many frames are wanted in all.

    Returns:
        (scene, frame), by the order of `scenes`, then of the scene's frames.
    """
    order = _in_turns(scenes)
    if len(order) >= count:
        order = order[:count]
    held = {scene: frames(scene) for scene in order}
    shares = _shares({scene: len(held[scene]) for scene in order}, count)
    return [
        (scene, frame) for scene in scenes if scene in held for frame in _equally(held[scene], shares[scene], scene)
    ]


def frames_of(scene: str, picked: Sequence[tuple[str, T]]) -> list[T]:
    """What `spread` took of one scene."""
    return [frame for name, frame in picked if name == scene]


def _in_turns(scenes: Sequence[str]) -> list[str]:
    """Round after round, one scene of each group."""
    groups: dict[str, list[str]] = {}
    for scene in sorted(scenes, key=_hash):
        groups.setdefault(scene.partition("/")[0] if "/" in scene else "", []).append(scene)
    rounds = [(place, _hash(group), scene) for group, names in groups.items() for place, scene in enumerate(names)]
    return [scene for _, _, scene in sorted(rounds)]


def _shares(sizes: dict[str, int], count: int) -> dict[str, int]:
    """How many each gives: what is left is divided evenly until it is gone, or nobody has more."""
    shares = dict.fromkeys(sizes, 0)
    left = min(count, sum(sizes.values()))
    while left:
        open_ = [name for name in sizes if shares[name] < sizes[name]]
        each = max(1, left // len(open_))
        for name in open_[:left]:
            more = min(each, sizes[name] - shares[name])
            shares[name] += more
            left -= more
    return shares


def _equally(frames: Sequence[T], count: int, seed: str) -> list[T]:
    """`count` frames at equal distances."""
    if not count:
        return []
    start = _hash(seed) % len(frames) / len(frames)
    return [frames[int((place + start) * len(frames) / count)] for place in range(count)]


def _hash(name: str) -> int:
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
