"""The names, texts and plot styles of the compared methods (which are in methods.py)."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True, kw_only=True)
class MethodDescription:
    """How tables and plots present a method."""

    title: str  # its name in tables
    summary: str  # half a sentence for the notes below a table
    color: str  # in plots; from the palette of Okabe and Ito, which colour-blind readers can tell
    marker: str  # its shape in plots, in matplotlib's notation
    uses_residual: bool = False  # whether the residual network runs


# Methods of other packages look alike in plots.
PLUGIN_COLOR = "#000000"
PLUGIN_MARKER = "*"

METHODS = {
    "base": MethodDescription(
        title="base alone",
        summary="the base's render, holes black",
        color="#5b6066",
        marker="o",
    ),
    "paper-initial": MethodDescription(
        title="Initial Gaussians, eqs. 2 to 9",
        summary=(
            "our initial Gaussians alone, in the paper's pass without a network; the paper does "
            "not say what its network starts from"
        ),
        color="#4dae86",
        marker=">",
    ),
    "paper": MethodDescription(
        title="Spackle, eqs. 2 to 9",
        summary=(
            "the paper's method: one pass for each view, an aux Gaussian for each masked cell, "
            "which the network makes from our initial Gaussian"
        ),
        color="#7a4fb5",
        marker="<",
        uses_residual=True,
    ),
    "spackle": MethodDescription(
        title="Spackle",
        summary=(
            "ours: each view by itself in two passes, behind what the photo shows, with texture"
        ),
        color="#0072b2",
        marker="D",
        uses_residual=True,
    ),
    "spackle-scene": MethodDescription(
        title="Spackle, one scene",
        summary="one set of aux Gaussians for all views of a setting",
        color="#3a9fd8",
        marker="P",
        uses_residual=True,
    ),
    "initial": MethodDescription(
        title="Initial Gaussians, two passes",
        summary="as Spackle, without network and texture",
        color="#008a66",
        marker="^",
    ),
    "dense": MethodDescription(
        title="dense grid",
        summary="an aux Gaussian for every cell, in one pass",
        color="#b5568c",
        marker="s",
        uses_residual=True,
    ),
    "inpaint2d": MethodDescription(
        title="2D inpainting",
        summary="the base's render, its hole inpainted as a flat picture",
        color="#c87f00",
        marker="v",
    ),
    "direct-ft": MethodDescription(
        title="direct FT",
        summary="the base fine-tuned on completed views, no aux Gaussians",
        color="#d55e00",
        marker="X",
    ),
}


def describe_method(name: str) -> MethodDescription:
    """How tables and plots present one of `METHODS`, or a plug-in `package.module:Name`."""
    if name in METHODS:
        return METHODS[name]

    # Of "package.module:Name" the title is what follows the colon. Without a colon, as in results
    # of another version of Spackle, it is the whole name.
    _, _, plugin_name = name.rpartition(":")
    return MethodDescription(
        title=plugin_name,
        summary=f"the function {plugin_name} of another package",
        color=PLUGIN_COLOR,
        marker=PLUGIN_MARKER,
    )
