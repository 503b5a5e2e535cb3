"""Fit the colours of aux Gaussians to a true photo with the differentiable renderer.

python examples/10_gradients.py out

A residual network is trained in the same way, with many photos, and with a network in place of the
colours.
"""

import dataclasses
import sys
from pathlib import Path

import torch

import spackle
from spackle.bases.depth import lift_rgbd
from spackle.formats import save_png
from spackle.paper.evaluation.datasets.stereo import load_motorcycle


def main(out: Path, steps: int = 25) -> None:
    pair = load_motorcycle()
    camera, renderer = pair.right_camera, spackle.get_renderer()
    base = lift_rgbd(pair.left, pair.depth, pair.left_camera).gaussians
    aux = spackle.fill_view(spackle.FillContext(base, pair.left_camera, renderer), camera).aux
    hole = spackle.hole_mask(renderer.render(base, camera).alpha)

    colors = aux.colors.clone().requires_grad_()
    optimizer = torch.optim.Adam([colors], lr=0.02)
    for step in range(steps):
        view = renderer.render([base, dataclasses.replace(aux, colors=colors)], camera)
        loss = (view.rgb - pair.right)[hole].square().mean()
        print(f"step {step}: {-10 * loss.detach().log10():.2f} dB in the hole")
        optimizer.zero_grad()
        torch.autograd.backward(loss)
        optimizer.step()
    save_png(view.rgb, out)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
