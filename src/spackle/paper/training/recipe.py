"""Recipes: settings of training runs, read from YAML and overridden by `key=value`."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from spackle.core.trajectories import MAX_DISPARITY
from spackle.runtime.device import Precision
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file
from spackle.weights import installed_weights

PACKAGED = Path(__file__).parent / "recipes"
MAY_CHANGE_ON_RESUME = "free"  # marks keys that may change when a run resumes; samples are compared by digest, not by these keys


def must_hold(text: str, holds: Callable[[Any], bool]) -> AfterValidator:
    """A validator that refuses a value for which `holds` is false; the message is `text`."""

    def check(value: Any) -> Any:
        if not holds(value):
            raise ValueError(text)
        return value

    return AfterValidator(check)


T = TypeVar("T")
Section = Annotated[
    T, BeforeValidator(lambda value: {} if value is None else value)
]  # an empty section has defaults
# YAML reads 1e3 as text.
Int = Annotated[
    int,
    BeforeValidator(lambda v: float(v) if re.fullmatch(r"\d+(\.\d*)?[eE]\+?\d+", str(v)) else v),
]
NonNegative = Annotated[float, Field(ge=0, le=1e6)]
Count = Annotated[Int, Field(ge=1, le=1_000_000)]  # file names of samples have six digits
Beta = Annotated[float, Field(ge=0, lt=1)]
Disparity = Annotated[float, Field(ge=0, le=MAX_DISPARITY)]
Interval = Annotated[Int, Field(ge=1), MAY_CHANGE_ON_RESUME]  # steps
OptionalPath = Annotated[Path | None, MAY_CHANGE_ON_RESUME]
Seed = Annotated[Int, Field(ge=0, le=2**31 - 2)]


class RecipePart(BaseModel):
    """A section of a recipe."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RgbdFolder(RecipePart):
    """The frames of one depth camera: NAME.color.jpg and NAME.depth.png."""

    folder: Path
    focal_px: Annotated[float, Field(ge=1, le=1e6)]
    unit_m: Annotated[float, Field(gt=0, le=1e3)] = 0.001  # metres in one step of the depth files


class Shares(RecipePart):
    """Relative shares of the views from each source; a source without data gets no share."""

    composites: NonNegative = 0.66
    rgbd: NonNegative = 0.12
    stereo: NonNegative = 0.10  # `reverse_view` of the left photo
    pairs: NonNegative = 0.12  # the right photo is the target
    pseudo: Annotated[NonNegative, MAY_CHANGE_ON_RESUME] = 1.0  # views of a dataset


class DataRecipe(RecipePart):
    """Sources and numbers of the training views."""

    photos: OptionalPath = None  # a folder, with its subfolders
    rgbd: Annotated[tuple[RgbdFolder, ...], MAY_CHANGE_ON_RESUME] = ()
    stereo: OptionalPath = None  # a folder of scenes, each with a scene.json
    pseudo: OptionalPath = None  # a dataset that `spackle dataset build` made
    shares: Section[Shares] = Shares()
    # Least and greatest disparity of the virtual camera.
    disparity: Annotated[
        tuple[Disparity, Disparity], must_hold("must ascend", lambda of: of[0] <= of[1])
    ] = (0.1, 0.6)
    views: Count = 20_000  # the paper: 20 views of 1,000 photos
    crops: Annotated[Int, Field(ge=1, le=100)] = 3  # most crops of a view
    cells: Annotated[Int, Field(ge=16, le=768)] = 96  # cells of 2×2 pixels along a crop's side
    validation_views: Count = 100
    cache: OptionalPath = None  # a folder for the samples; None: inside the output
    seed: Seed = 0  # for the samples alone: runs that differ only in run.seed share samples


class LossRecipe(RecipePart):
    """Weights of the terms of eq. 12, and settings of the terms (paper, "Training Details and Loss Weights")."""

    color: NonNegative = 10.0
    alpha: NonNegative = 0.5
    perceptual: NonNegative = 1.0
    preserve: NonNegative = 5.0
    features: Literal["resnet50", "squeezenet", "none"] = "resnet50"
    features_path: OptionalPath = None
    # Longer side in pixels to which crops are resized for the feature network; None: not resized.
    feature_size: Annotated[Int, Field(ge=64, le=4096)] | None = 512
    dilation: Annotated[
        Int, Field(ge=1, le=1001), must_hold("must be odd", lambda side: side % 2 == 1)
    ] = 21  # pixels
    color_blur: Annotated[float, Field(ge=0, le=64)] = (
        0.0  # standard deviation in pixels, see `color_loss`
    )
    gram: NonNegative = 1.0  # weight of Gram matrices within the perceptual term

    @property
    def features_file(self) -> Path | None:
        """Weights of the feature network: `features_path`, else the file of `spackle weights get features`."""
        return self.features_path or (
            installed_weights("features") if self.features == "resnet50" else None
        )


class OptimRecipe(RecipePart):
    """AdamW with a linear warm-up, then a cosine decay (paper, "Training Details and Loss Weights")."""

    lr: Annotated[float, Field(gt=0, le=1)] = 1.6e-4
    min_lr: Annotated[float, Field(ge=0, le=1)] = 1.6e-5
    warmup: Annotated[Int, Field(ge=0)] = 10_000  # steps
    steps: Interval = 100_000
    batch: Annotated[Int, Field(ge=1, le=100_000)] = 16  # crops per step, over all processes
    betas: tuple[Beta, Beta] = (0.9, 0.999)
    weight_decay: Annotated[float, Field(ge=0, le=10)] = 1e-4
    clip: Annotated[float, Field(gt=0)] = 1.0  # largest norm of the gradient
    ema: Beta = (
        0.999  # decay of the averaged weights, which are validated and exported; 0: no average
    )
    precision: Precision = "auto"  # of the network; auto: bf16 if the hardware supports it natively


class RunRecipe(RecipePart):
    """Settings of the run."""

    seed: Seed = 0  # for initial weights and the order of samples
    validate_every: Interval = 1000
    save_every: Interval = 1000
    log_every: Interval = 50
    patience: Interval = 10  # validations without improvement before the run ends
    min_delta: Annotated[float, Field(ge=0), MAY_CHANGE_ON_RESUME] = (
        1e-4  # smaller improvements do not count
    )
    device: Annotated[Literal["auto", "cpu", "cuda"], MAY_CHANGE_ON_RESUME] = (
        "auto"  # of the networks, not of the renderer
    )


class AnyRecipe(RecipePart):
    """The sections that all recipes have."""

    optim: Annotated[
        Section[OptimRecipe], must_hold("min_lr must be <= lr", lambda o: o.min_lr <= o.lr)
    ] = OptimRecipe()
    run: Section[RunRecipe] = RunRecipe()


class Recipe(AnyRecipe):
    """The recipe of a training run of the residual or of direct-ft."""

    data: Section[DataRecipe] = DataRecipe()
    loss: Section[LossRecipe] = LossRecipe()
    network: Annotated[Literal["unet", "sharp-decoder"], MAY_CHANGE_ON_RESUME] = (
        "unet"  # architecture of the residual
    )
    init: Path | None = None  # initial weights; sharp-decoder also takes SHARP's checkpoint


R = TypeVar("R", bound=AnyRecipe)


def changed_keys(stored: Mapping[str, Any], recipe: RecipePart, above: str = "") -> list[str]:
    """Keys in which a recipe differs from a `stored` model_dump, prefixed by `above`; `MAY_CHANGE_ON_RESUME` keys are ignored."""
    fields, now = type(recipe).model_fields, recipe.model_dump(mode="json")
    keys = [
        above + name for name, value in stored.items() if name not in fields and value is not None
    ]
    for name, field in fields.items():
        part = getattr(recipe, name)
        if isinstance(part, RecipePart):
            keys += changed_keys(stored.get(name) or {}, part, f"{above}{name}.")
        elif MAY_CHANGE_ON_RESUME not in field.metadata and stored.get(name) != now[name]:
            keys.append(above + name)
    return sorted(keys)


def load_recipe(kind: type[R], path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> R:
    """Read a recipe; missing values are the defaults of `kind`.

    Args:
        kind: the class of the recipe, such as `Recipe`.
        path: a YAML file, or the name of a packaged recipe such as "cpu". Relative paths in the file are relative to
            the working directory.
        overrides: texts `key=value`, such as optim.steps=100 or data.rgbd.0.folder=kitchen; values are YAML.

    Raises:
        InputError: the file is missing or broken, or has an unknown key or a value out of bounds.
    """
    names = sorted(file.stem for file in PACKAGED.glob("*.yaml"))
    if os.fspath(path) in names and not os.path.isfile(path):
        path = PACKAGED / f"{os.fspath(path)}.yaml"
    elif os.sep not in os.fspath(path) and not os.path.exists(path):
        raise InputError(
            f"{path}: no such recipe; choose from {', '.join(names)}, or give a YAML file"
        )
    check_file(path, "recipe")
    with as_input_error(path, "not a recipe: {reason}", OSError, UnicodeDecodeError):
        text = Path(path).read_text(encoding="utf-8")
    content = parse_yaml(text, path) or {}
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or not key:
            raise InputError(
                f"{override!r}: neither an option nor key=value, such as optim.steps=100"
            )
        with as_input_error(override, f"{path} has no such key ({{reason}})"):
            set_nested(content, key.split("."), parse_yaml(value, override))
    with as_input_error(path, "{reason}", ValidationError):
        return kind.model_validate(content)


def parse_yaml(text: str, where: object) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise InputError(
            "recipes need a package for YAML: pip install 'spackle-nvs[train]'"
        ) from error
    with as_input_error(where, "not YAML: {reason}"):
        return yaml.safe_load(text)


def set_nested(content: Any, keys: Sequence[str], value: object) -> None:
    """Set a value in nested dictionaries and lists; missing dictionaries are created."""
    for key, following in zip(keys, [*keys[1:], None], strict=True):
        index = int(key) if isinstance(content, list) else key
        if following is None:
            content[index] = value
        elif isinstance(content, dict) and not isinstance(content.get(index), (dict, list)):
            content[index] = {}
        content = content[index]
