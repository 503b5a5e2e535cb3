"""The renderer is differentiable: fit the colours of the added Gaussians to a true photo of the hole.

    python examples/03_train_view_gradients.py OUT

Training a residual network is this, with a network in place of the colours and many photos.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

import spackle
from spackle.bases.lift import lift
from spackle.color import linear_to_srgb, srgb_to_linear
from spackle.evaluation.datasets.stereo import load_motorcycle
from spackle.formats import save_png
from spackle.render import TILE

STEPS = 25
RATE = 0.05


def tiles_of(mask: Tensor) -> Tensor:
    """[ceil(H/16), ceil(W/16)] bool: the tiles in which a mask [H, W] is set. The rest need not be drawn again."""
    return max_pool2d(mask.float()[None, None], TILE, ceil_mode=True)[0, 0] > 0


def main(folder: Path) -> None:
    """Print the error in the hole as it falls, and save the view before and after."""
    folder.mkdir(parents=True, exist_ok=True)
    pair = load_motorcycle()
    camera, renderer = pair.right_camera, spackle.get_renderer()
    base = lift(pair.left, pair.depth, pair.left_camera).gaussians
    aux = spackle.fill_view(spackle.FillContext(base, pair.left_camera, renderer), camera).aux

    before = renderer.render(base, camera)
    hole = spackle.hole_mask(before.alpha)
    tiles = tiles_of(hole)
    srgb = linear_to_srgb(aux.colors).requires_grad_()  # as the eye counts: dark colours get their share
    optimizer = torch.optim.Adam([srgb], lr=RATE)
    for step in range(STEPS + 1):
        fitted = dataclasses.replace(aux, colors=srgb_to_linear(srgb))
        # The base asks for no gradient, so it costs none.
        view = renderer.render([base, fitted], camera, tiles=tiles, onto=before)
        loss: Tensor = (view.rgb - pair.right)[hole].square().mean()
        if step in (0, STEPS):
            save_png(view.rgb, folder / f"step_{step:02d}.png")
        if step % 5 == 0:
            print(f"step {step:2d}: {-10 * loss.detach().log10():.2f} dB in the hole")
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        with torch.no_grad():
            srgb.clamp_(0, 1)
    print(f"Look at step_00.png and step_{STEPS:02d}.png in {folder}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "motorcycle"))
