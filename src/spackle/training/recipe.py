"""What a training run is made of, as values; `spackle.training.recipe_file` reads them from YAML."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal, Protocol

from spackle.device import Precision
from spackle.training.losses import LossWeights

FeatureName = Literal["resnet50", "squeezenet", "none"]
DeviceName = Literal["auto", "cpu", "cuda"]


@dataclasses.dataclass(frozen=True)
class RgbdFolder:
    """What one depth camera took: NAME.color.jpg and NAME.depth.png."""

    folder: Path
    focal_px: float
    unit_m: float = 0.001  # metres in one step of the depth files


@dataclasses.dataclass(frozen=True)
class Shares:
    """How often a view comes from each source; they need not add up to 1. One without data counts as 0."""

    composites: float = 0.66
    rgbd: float = 0.12
    stereo: float = 0.10  # reverse_view of the left photo
    pairs: float = 0.12  # the true right photo
    pseudo: float = 1.0  # renderings with completed targets


@dataclasses.dataclass(frozen=True)
class DataRecipe:
    """Where views with holes and their truth come from, and how many there are."""

    photos: Path | None = None  # a folder, with its subfolders
    rgbd: tuple[RgbdFolder, ...] = ()
    stereo: Path | None = None  # a folder of scenes, each with a scene.json
    pseudo: Path | None = None  # a dataset that `spackle dataset build` made
    shares: Shares = Shares()
    disparity: tuple[float, float] = (0.1, 0.6)  # how far the virtual camera goes
    views: int = 20_000  # the paper's: 1,000 photos, 20 views of each
    crops: int = 3  # of a view, at most
    cells: int = 96  # along a crop's side, of 2×2 pixels
    validation_views: int = 100
    cache: Path | None = None  # a folder for the samples; inside the output where None
    seed: int = 0  # of the samples alone, so that runs with other seeds learn from the same ones


@dataclasses.dataclass(frozen=True)
class LossRecipe:
    """The four terms and what the perceptual one looks with (paper, "Training Details and Loss Weights")."""

    color: float = 10.0
    alpha: float = 0.5
    perceptual: float = 1.0
    preserve: float = 5.0
    features: FeatureName = "resnet50"
    features_path: Path | None = None
    feature_size: int | None = 512  # the longer side of what that network sees; None: the crop as it is
    dilation: int = 21  # pixels

    @property
    def weights(self) -> LossWeights:
        """The weights alone."""
        return LossWeights(self.color, self.alpha, self.perceptual, self.preserve)


@dataclasses.dataclass(frozen=True)
class OptimRecipe:
    """AdamW with a linear warm-up and a cosine after it (paper, "Training Details and Loss Weights")."""

    lr: float = 1.6e-4
    min_lr: float = 1.6e-5
    warmup: int = 10_000  # steps
    steps: int = 100_000
    batch: int = 16  # crops of a step, of all processes together
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 1e-4
    clip: float = 1.0  # the gradient's largest norm
    ema: float = 0.999  # decay of the averaged weights, which are validated and exported; 0: no average
    precision: Precision = "auto"  # of the network; auto: bf16 where the hardware multiplies it natively


@dataclasses.dataclass(frozen=True)
class RunRecipe:
    """What has no part in what is learned, but for the seed and when to stop."""

    seed: int = 0  # of the first weights and of the samples' order
    validate_every: int = 1000  # steps
    save_every: int = 1000
    log_every: int = 50
    patience: int = 10  # validations without improvement before the run ends
    min_delta: float = 1e-4  # a smaller improvement is none
    device: DeviceName = "auto"  # of the networks; the renderer draws where it can


@dataclasses.dataclass(frozen=True)
class Recipe:
    """All of a training run."""

    data: DataRecipe = DataRecipe()
    loss: LossRecipe = LossRecipe()
    optim: OptimRecipe = OptimRecipe()
    run: RunRecipe = RunRecipe()
    init: Path | None = None  # weights to start from


class AnyRecipe(Protocol):
    """What every recipe has, whatever its network learns from."""

    @property
    def optim(self) -> OptimRecipe:
        """How it learns."""

    @property
    def run(self) -> RunRecipe:
        """How often it looks up."""


# What may differ when a run goes on: how long it is, how often it looks up, and where its files lie.
# The samples themselves are held together by their digest.
FREE: tuple[str, ...] = (
    "optim.steps",
    "run.validate_every",
    "run.save_every",
    "run.log_every",
    "run.patience",
    "run.min_delta",
)
FREE += ("run.device", "loss.features_path", "data.cache", "data.photos", "data.stereo", "data.rgbd")
FREE += ("data.pseudo", "data.shares.pseudo")  # younger than some checkpoints
FREE += ("data.validation_stereo",)


def plain(value: Any) -> Any:
    """A recipe as dictionaries, lists, numbers and strings."""
    if dataclasses.is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, (tuple, list)):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def differences(one: dict[str, Any], other: dict[str, Any], where: str = "") -> list[str]:
    """The keys in which two plain recipes are different runs."""
    found: list[str] = []
    for name in sorted({*one, *other}):
        key = where + name
        a, b = one.get(name), other.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            found += differences(a, b, key + ".")
        elif a != b and key not in FREE:
            found.append(key)
    return found
