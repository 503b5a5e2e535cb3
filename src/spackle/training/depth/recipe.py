"""What a training run of the lite base is made of, as values."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from spackle.bases.lite.network import STAGES, STRIDE, Size
from spackle.errors import InputError
from spackle.training.depth.losses import DepthLossWeights
from spackle.training.recipe import OptimRecipe, RgbdFolder, RunRecipe

RANDOM = Path("random")  # in place of the encoder's file: weights that have seen nothing, for tests and experiments
WEIGHTS, RUN = DepthLossWeights(), RunRecipe()


@dataclasses.dataclass(frozen=True)
class LiteShares:
    """How often a picture comes from each source; they need not add up to 1. One without data counts as 0."""

    made: float = 0.4
    stereo: float = 0.28
    rgbd: float = 0.14
    guessed: float = 0.18  # where there is a teacher


@dataclasses.dataclass(frozen=True)
class LiteData:
    """Where photos with depth come from."""

    photos: Path | None = None  # a folder, with its subfolders: the surfaces of made scenes are cut from them
    rgbd: tuple[RgbdFolder, ...] = ()  # of these the focal length is not asked for
    stereo: Path | None = None  # a folder of scenes, each with a scene.json
    made: int = 4900  # made scenes
    teacher: Path | None = None  # weights of an earlier run: what they guess of `photos` is learned from as well
    guesses: int = 1500  # of so many photos at most
    shares: LiteShares = LiteShares()
    size: tuple[int, int] = (256, 320)  # height and width of what is learned from; a fifth of the steps stand upright
    scales: tuple[float, ...] = (1.0,)  # of that, one drawn for each step: the base looks at photos at several sizes
    cache: Path | None = None  # a folder for made scenes and guesses; inside the output where None
    seed: int = 0  # of the made scenes alone, so that runs with other seeds learn from the same ones
    validation: float = 0.2  # share of each folder of `rgbd`, the last frames by name: neighbours look alike
    validation_stereo: Path | None = None  # scenes to be judged by; those of `stereo` are learned from, all of them


@dataclasses.dataclass(frozen=True)
class LiteOptim(OptimRecipe):
    """As for the other methods, and what the encoder, which comes with weights of its own, does otherwise."""

    encoder_rate: float = 0.2  # factor on the encoder's learning rate
    frozen: int = 2  # the encoder's first stages stay as they are, and its stem with them; 0: all of it learns


@dataclasses.dataclass(frozen=True)
class LiteRecipe:
    """All of a training run of the lite base."""

    data: LiteData = LiteData()
    loss: DepthLossWeights = WEIGHTS
    optim: LiteOptim = LiteOptim()
    run: RunRecipe = RUN
    network: Size = "lite2"  # how large the encoder is: EfficientNet-Lite0's or -Lite2's
    encoder: Path | None = None  # its .pth; None: of the installed package; "random": none
    init: Path | None = None  # weights of the whole network to start from


def check_lite(recipe: LiteRecipe, file: str) -> None:
    """InputError for values that are possible each, but make no run."""
    for side in recipe.data.size:
        if side % STRIDE:
            raise InputError(f"{file}: data.size {list(recipe.data.size)}: both sides must be multiples of {STRIDE}")
    if not recipe.data.scales:
        raise InputError(f"{file}: data.scales is empty: give one number at least, such as [1]")


LITE_RANGES: dict[str, tuple[float, float]] = {
    **{f"data.shares.{name}": (0, 1e6) for name in ("made", "guessed")},
    "data.guesses": (1, 1e6),
    "data.made": (1, 1e6),  # six digits name a file
    "data.size": (STRIDE, 2048),
    "data.scales": (0.1, 2),
    "data.validation": (0, 0.9),
    **{f"loss.{name}": (0, 1e6) for name in ("factor", "line", "steps", "offset")},
    "optim.encoder_rate": (0, 10),
    "optim.frozen": (0, len(STAGES["lite2"])),
}
