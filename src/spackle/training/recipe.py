"""Recipes of training runs: settings with bounds, read from YAML and overridden by `key=value`."""

from __future__ import annotations

import os
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from spackle.camera_path import MAX_DISPARITY
from spackle.device import Precision
from spackle.errors import InputError, reading, shown
from spackle.files import check_file
from spackle.residual.view_features import CELL
from spackle.weights import installed

PACKAGED = Path(__file__).parent / "recipes"
MAX_BYTES = 1 << 16
LEAST_SIDE = 36  # pixels a side that the feature networks need at least
# Marks keys that may change when a run resumes: its length, how often it validates, where its files lie. Whether the
# samples are the same is decided by their digest.
FREE = "free"


def _as_number(value: object) -> object:
    """Convert text such as 1e3, which YAML 1.1 does not read as a number."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _odd(value: int) -> int:
    if value % 2 == 0:
        raise ValueError(f"{value} is even; a square around a pixel has an odd side")
    return value


def _ascending(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError(f"runs from {value[0]:g} down to {value[1]:g}; give the smaller one first")
    return value


Whole = Annotated[int, BeforeValidator(_as_number)]
Share = Annotated[float, Field(ge=0, le=1e6)]
Count = Annotated[Whole, Field(ge=1, le=1_000_000)]  # file names of samples have six digits
Beta = Annotated[float, Field(ge=0, lt=1)]
Disparity = Annotated[float, Field(ge=0, le=MAX_DISPARITY)]
Interval = Annotated[Whole, Field(ge=1), FREE]  # steps
Place = Annotated[Path | None, FREE]
Seed = Annotated[Whole, Field(ge=0, le=2**31 - 2)]


class RecipePart(BaseModel):
    """A section of a recipe; an empty section keeps the defaults."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _not_empty(cls, value: Any) -> Any:
        return {} if value is None else value


class RgbdFolder(RecipePart):
    """The frames of one depth camera: NAME.color.jpg and NAME.depth.png."""

    folder: Path
    focal_px: Annotated[float, Field(ge=1, le=1e6)]
    unit_m: Annotated[float, Field(gt=0, le=1e3)] = 0.001  # metres in one step of the depth files


class Shares(RecipePart):
    """The share of views from each source; shares need not add up to 1, and a source without data gets none."""

    composites: Share = 0.66
    rgbd: Share = 0.12
    stereo: Share = 0.10  # `reverse_view` of the left photo
    pairs: Share = 0.12  # the right photo as the target
    pseudo: Annotated[Share, FREE] = 1.0  # renderings with completed targets; absent from older checkpoints


class DataRecipe(RecipePart):
    """Where views with holes and their truth come from, and how many there are."""

    photos: Place = None  # a folder, with its subfolders
    rgbd: Annotated[tuple[RgbdFolder, ...], FREE] = ()
    stereo: Place = None  # a folder of scenes, each with a scene.json
    pseudo: Place = None  # a dataset that `spackle dataset build` made
    shares: Shares = Shares()
    # The least and the greatest disparity of the virtual camera.
    disparity: Annotated[tuple[Disparity, Disparity], AfterValidator(_ascending)] = (0.1, 0.6)
    views: Count = 20_000  # the paper's: 1,000 photos, 20 views of each
    crops: Annotated[Whole, Field(ge=1, le=100)] = 3  # at most, per view
    cells: Annotated[Whole, Field(ge=16, le=768)] = 96  # cells of 2×2 pixels along a crop's side
    validation_views: Count = 100
    cache: Place = None  # a folder for the samples; None: inside the output
    seed: Seed = 0  # for the samples alone: runs that differ only in run.seed share them


class LossRecipe(RecipePart):
    """The weights of eq. 12's terms, and the perceptual term's network (paper, "Training Details and Loss Weights")."""

    color: Share = 10.0
    alpha: Share = 0.5
    perceptual: Share = 1.0
    preserve: Share = 5.0
    features: Literal["resnet50", "squeezenet", "none"] = "resnet50"
    features_path: Place = None
    # Longer side in pixels to which crops are resized for the feature network; None: not resized.
    feature_size: Annotated[Whole, Field(ge=64, le=4096)] | None = 512
    dilation: Annotated[Whole, Field(ge=1, le=1001), AfterValidator(_odd)] = 21  # pixels
    color_blur: Annotated[float, Field(ge=0, le=64)] = 0.0  # pixels; if > 0 only low frequencies count
    gram: Share = 1.0  # weight of the perceptual term's Gram statistics

    @property
    def features_file(self) -> Path | None:
        """The feature network's weights: `features_path`, else what `spackle weights get features` fetched."""
        return self.features_path or (installed("features") if self.features == "resnet50" else None)


class OptimRecipe(RecipePart):
    """AdamW with a linear warm-up and a cosine after it (paper, "Training Details and Loss Weights")."""

    lr: Annotated[float, Field(gt=0, le=1)] = 1.6e-4
    min_lr: Annotated[float, Field(ge=0, le=1)] = 1.6e-5
    warmup: Annotated[Whole, Field(ge=0)] = 10_000  # steps
    steps: Interval = 100_000
    batch: Annotated[Whole, Field(ge=1, le=100_000)] = 16  # crops per step, over all processes
    betas: tuple[Beta, Beta] = (0.9, 0.999)
    weight_decay: Annotated[float, Field(ge=0, le=10)] = 1e-4
    clip: Annotated[float, Field(gt=0)] = 1.0  # the gradient's maximum norm
    ema: Beta = 0.999  # decay of the averaged weights, which are validated and exported; 0: no average
    precision: Precision = "auto"  # of the network; auto: bf16 if the hardware supports it natively

    @model_validator(mode="after")
    def _falls(self) -> OptimRecipe:
        if self.min_lr > self.lr:
            raise ValueError(f"min_lr {self.min_lr:g} is above lr {self.lr:g}")
        return self


class RunRecipe(RecipePart):
    """Settings of the run; only the seed and the stopping rule affect what is learned."""

    seed: Seed = 0  # for initial weights and the order of samples
    validate_every: Interval = 1000
    save_every: Interval = 1000
    log_every: Interval = 50
    patience: Interval = 10  # validations without improvement before the run ends
    min_delta: Annotated[float, Field(ge=0), FREE] = 1e-4  # smaller improvements do not count
    device: Annotated[Literal["auto", "cpu", "cuda"], FREE] = "auto"  # of the networks; the renderer picks its own


class AnyRecipe(RecipePart):
    """The sections that all recipes have."""

    optim: OptimRecipe = OptimRecipe()
    run: RunRecipe = RunRecipe()


class Recipe(AnyRecipe):
    """The recipe of a training run of the residual or of direct-ft."""

    data: DataRecipe = DataRecipe()
    loss: LossRecipe = LossRecipe()
    # The residual's architecture. Free because older checkpoints lack the key; weights of another one fail to load.
    network: Annotated[Literal["unet", "sharp-decoder"], FREE] = "unet"
    init: Path | None = None  # weights to start from; sharp-decoder also takes SHARP's own

    @model_validator(mode="after")
    def _has_features(self) -> Recipe:
        name, size = self.loss.features, self.loss.feature_size or CELL * self.data.cells
        if name != "none" and self.loss.features_file is None:
            raise ValueError(
                f"loss.features_path: missing; give the weights of {name}, fetch those of resnet50 with "
                "`spackle weights get features`, or do without: loss.features=none"
            )
        if name != "none" and size < LEAST_SIDE:
            raise ValueError(f"data.cells: too small for {name} ({LEAST_SIDE} pixels); raise it, or loss.feature_size")
        return self


R = TypeVar("R", bound=AnyRecipe)


def differences(stored: Mapping[str, Any], recipe: RecipePart, above: str = "") -> list[str]:
    """The keys, prefixed by `above`, in which a recipe differs from a `model_dump` of another; no `FREE` ones."""
    fields, now = type(recipe).model_fields, recipe.model_dump(mode="json")
    keys = [above + name for name, value in stored.items() if name not in fields and value is not None]
    for name, field in fields.items():
        part = getattr(recipe, name)
        if isinstance(part, RecipePart):
            keys += differences(stored.get(name) or {}, part, f"{above}{name}.")
        elif FREE not in field.metadata and stored.get(name) != now[name]:
            keys.append(above + name)
    return sorted(keys)


def load_recipe(kind: type[R], path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> R:
    """Read a recipe; values that it lacks are the defaults of `kind`.

    Args:
        kind: the class of the recipe, such as `Recipe`.
        path: a YAML file, or the name of a packaged one such as "cpu". Relative paths in it are relative to the
            working directory.
        overrides: texts `key=value`, such as optim.steps=100 or data.rgbd.0.folder=kitchen; values are YAML.

    Raises:
        InputError: the file is missing or broken, or has an unknown key or a value out of bounds, which is named.
    """
    names = sorted(file.stem for file in PACKAGED.glob("*.yaml"))
    if os.fspath(path) in names and not os.path.isfile(path):
        path = PACKAGED / f"{os.fspath(path)}.yaml"
    elif os.sep not in os.fspath(path) and not os.path.exists(path):
        raise InputError(f"{path}: no such recipe; there are {', '.join(names)}, or give a YAML file")
    if check_file(path, "recipe") > MAX_BYTES:
        raise InputError(f"{path}: too long for a recipe (at most {MAX_BYTES >> 10} KiB): is it the right file?")
    with reading(path, "not a recipe: {reason}", OSError, UnicodeDecodeError):
        text = Path(path).read_text(encoding="utf-8")
    content = _parse(text, path) or {}
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or not key:
            raise InputError(f"{override!r}: neither an option nor key=value, such as optim.steps=100")
        with reading(override, f"no place for it in {path} ({{reason}})"):
            _set(content, key.split("."), _parse(value, override))
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{path}: {_first_problem(kind, error)}") from error


def _parse(text: str, where: object) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise InputError("recipes are YAML, which needs a package: pip install 'spackle-nvs[train]'") from error
    with reading(where, "not YAML: {reason}"):
        return yaml.safe_load(text)


def _set(content: Any, keys: Sequence[str], value: object) -> None:
    """Set a value in nested dictionaries and lists; missing dictionaries are created."""
    for key, following in zip(keys, [*keys[1:], None], strict=True):
        index = int(key) if isinstance(content, list) else key
        if following is None:
            content[index] = value
        elif isinstance(content, dict) and not isinstance(content.get(index), (dict, list)):
            content[index] = {}
        content = content[index]


def _first_problem(kind: Any, error: ValidationError) -> str:
    """A message about the first invalid value: its key, and what it must be."""
    first = error.errors()[0]
    key = ".".join(str(name)[:60] for name in first["loc"])
    message = first["msg"][0].lower() + first["msg"][1:]
    if first["type"] == "extra_forbidden":
        for name in first["loc"][:-1]:
            kind = typing.get_args(kind)[0] if isinstance(name, int) else kind.model_fields[name].annotation
        message = f"there is no such key; there are {', '.join(kind.model_fields)}"
    elif first["type"] == "value_error":
        message = str(first["ctx"]["error"])
    elif first["type"] != "missing":
        message = f"{message}, not {shown(first['input'])}"
    return f"{key}: {message}" if key else message
