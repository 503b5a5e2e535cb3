"""The animations of the README: a flight around a scene, to the left its base with the holes, to the right all of it.

    python docs/pictures.py SCENE.ply OUT.webp [FRAMES]

SCENE.ply is what `spackle demo` or `spackle predict` writes.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import torch
from PIL import Image
from torch.nn.functional import interpolate

from spackle import Scene, get_renderer
from spackle.color import to_bytes

WIDTH, GAP, MILLISECONDS, QUALITY = 440, 6, 90, 65


def frames(scene: Scene, count: int) -> Iterator[Image.Image]:
    """Of half the size in which they are drawn."""
    renderer = get_renderer()
    for camera in scene.path("rotate-forward", frames=count + 1)[:count]:
        height = round(WIDTH * camera.height / camera.width)
        drawn = camera.resized(2 * WIDTH, 2 * height)
        pictures = [renderer.render(sets, drawn).rgb for sets in ([scene.base], [scene.base, scene.aux])]
        halves = [interpolate(p.permute(2, 0, 1)[None], (height, WIDTH), mode="area")[0] for p in pictures]
        gap = torch.ones(3, height, GAP)
        yield Image.fromarray(to_bytes(torch.cat([halves[0], gap, halves[1]], dim=2).permute(1, 2, 0)).numpy())


if __name__ == "__main__":
    source, target, *more = sys.argv[1:]
    with torch.no_grad():
        first, *others = frames(Scene.load(source), int(more[0]) if more else 30)
    first.save(target, save_all=True, append_images=others, duration=MILLISECONDS, loop=0, quality=QUALITY, method=6)
