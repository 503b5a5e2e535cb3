"""Recipes: settings of training runs, read from YAML and overridden by `key=value`."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from spackle.core.trajectories import MAX_DISPARITY
from spackle.residual.architectures import ARCHITECTURES
from spackle.residual.completion import CellChoice
from spackle.runtime.device import Precision
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file
from spackle.runtime.suggestions import closest_name
from spackle.runtime.validation import validated
from spackle.runtime.yaml_text import parse_yaml
from spackle.weights import installed_weights

PACKAGED_RECIPES = Path(__file__).parent / "recipes"
# Marks keys that may change when a run resumes; the samples are compared by digest, not by these
# keys.
MAY_CHANGE_ON_RESUME = "may change on resume"
T = TypeVar("T")


def must_hold(message: str, condition: Callable[[Any], bool]) -> AfterValidator:
    """A validator of pydantic that refuses a value for which `condition` is false.

    The refusal says `message`.
    """

    def check(value: Any) -> Any:
        """The value itself; ValueError, which pydantic reports to the user, if it is refused."""
        if not condition(value):
            raise ValueError(message)
        return value

    return AfterValidator(check)


def empty_section_as_defaults(value: object) -> object:
    """An empty dictionary for None, which is how YAML reads a section without keys."""
    return {} if value is None else value


def scientific_as_number(value: object) -> object:
    """The number for a text such as 1e3, which YAML takes for text; other values unchanged."""
    if re.fullmatch(r"\d+(\.\d*)?[eE]\+?\d+", str(value)):
        return float(str(value))
    return value


def as_locations(value: object) -> object:
    """A list of places for a single place, and an empty one for None; other values unchanged."""
    if value is None:
        return ()
    places = [value] if isinstance(value, str | os.PathLike) else value
    if not isinstance(places, list | tuple):
        return value
    return tuple(os.fspath(place) if isinstance(place, os.PathLike) else place for place in places)


Section = Annotated[T, BeforeValidator(empty_section_as_defaults)]
Int = Annotated[int, BeforeValidator(scientific_as_number)]
NonNegative = Annotated[float, Field(ge=0, le=1e6)]
Count = Annotated[Int, Field(ge=1, le=1_000_000)]  # file names of samples have six digits
Beta = Annotated[float, Field(ge=0, lt=1)]
Disparity = Annotated[float, Field(ge=0, le=MAX_DISPARITY)]
Interval = Annotated[Int, Field(ge=1), MAY_CHANGE_ON_RESUME]  # steps
OptionalPath = Annotated[Path | None, MAY_CHANGE_ON_RESUME]
# Folders, patterns of folders, or addresses, whose "//" a Path would lose.
Locations = Annotated[tuple[str, ...], BeforeValidator(as_locations), MAY_CHANGE_ON_RESUME]
Seed = Annotated[Int, Field(ge=0, le=2**31 - 2)]  # training and validation use 2 · seed and more


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
    stereo: NonNegative = (
        0.10  # the left photo is the target, with holes where a virtual camera sees nothing
    )
    pairs: NonNegative = 0.12  # the right photo is the target
    pseudo: Annotated[NonNegative, MAY_CHANGE_ON_RESUME] = 1.0  # views of a dataset


class DataRecipe(RecipePart):
    """Sources and numbers of the training views."""

    photos: OptionalPath = None  # a folder, with its subfolders
    rgbd: Annotated[tuple[RgbdFolder, ...], MAY_CHANGE_ON_RESUME] = ()
    stereo: OptionalPath = None  # a folder of scenes, each with a scene.json
    pseudo: Locations = ()  # datasets that `spackle dataset build` made, joined to one
    shares: Section[Shares] = Shares()
    # Least and greatest disparity of the virtual camera.
    disparity: Annotated[
        tuple[Disparity, Disparity], must_hold("must ascend", lambda pair: pair[0] <= pair[1])
    ] = (0.1, 0.6)
    views: Count = 20_000  # the paper: 20 views of 1,000 photos
    # Most crops of a view; null: no crops, but the whole views of `pseudo`, as in evaluation.
    crops: Annotated[Int, Field(ge=1, le=100)] | None = 3
    cells: Annotated[Int, Field(ge=16, le=768)] = 96  # cells of 2×2 pixels along a crop's side
    validation_views: Count = 100
    cache: OptionalPath = None  # a folder for the crops; None: inside the output
    seed: Seed = 0  # for the samples alone: runs that differ only in run.seed share samples


class LossRecipe(RecipePart):
    """Weights of the terms of eq. 12, and their settings.

    The values are the paper's ("Training Details and Loss Weights").
    """

    color: NonNegative = 10.0
    alpha: NonNegative = 0.5
    perceptual: NonNegative = 1.0
    preserve: NonNegative = 5.0
    features: Literal["resnet50", "squeezenet", "none"] = "resnet50"
    features_path: OptionalPath = None
    # Longer side in pixels to which crops are resized for the feature network; None: not resized.
    feature_size: Annotated[Int, Field(ge=64, le=4096)] | None = 512
    # Side in pixels of the square by which the perceptual term extends a hole.
    dilation: Annotated[
        Int, Field(ge=1, le=1001), must_hold("must be odd", lambda side: side % 2 == 1)
    ] = 21
    # Standard deviation in pixels of a Gaussian that blurs the colour difference; 0: no blur.
    color_blur: Annotated[float, Field(ge=0, le=64)] = 0.0
    gram: NonNegative = 1.0  # weight of Gram matrices within the perceptual term

    @property
    def features_file(self) -> Path | None:
        """The file of the feature network's weights; None if there is none.

        `features_path` comes first. Only the weights of ResNet-50 can have been downloaded.
        """
        if self.features_path is None and self.features == "resnet50":
            return installed_weights("features")
        return self.features_path


class OptimRecipe(RecipePart):
    """AdamW with a linear warm-up, then a cosine decay.

    The values are the paper's ("Training Details and Loss Weights").
    """

    lr: Annotated[float, Field(gt=0, le=1)] = 1.6e-4
    min_lr: Annotated[float, Field(ge=0, le=1)] = 1.6e-5
    warmup: Annotated[Int, Field(ge=0)] = 10_000  # steps
    steps: Interval = 100_000
    batch: Annotated[Int, Field(ge=1, le=100_000)] = 16  # crops per step, over all processes
    betas: tuple[Beta, Beta] = (0.9, 0.999)
    weight_decay: Annotated[float, Field(ge=0, le=10)] = 1e-4
    clip: Annotated[float, Field(gt=0)] = 1.0  # largest norm of the gradient
    # Decay of the averaged weights, which are validated and exported; 0: no average.
    ema: Beta = 0.999
    precision: Precision = "auto"  # of the network; auto: bf16 if the hardware supports it natively


class RunRecipe(RecipePart):
    """Settings of the run."""

    seed: Seed = 0  # for initial weights and the order of samples
    validate_every: Interval = 1000
    save_every: Interval = 1000
    log_every: Interval = 50
    patience: Interval = 10  # validations without improvement before the run ends
    # Smaller improvements do not count.
    min_delta: Annotated[float, Field(ge=0), MAY_CHANGE_ON_RESUME] = 1e-4
    # Of the networks, not of the renderer.
    device: Annotated[Literal["auto", "cpu", "cuda"], MAY_CHANGE_ON_RESUME] = "auto"


class AnyRecipe(RecipePart):
    """The sections that all recipes have."""

    optim: Annotated[
        Section[OptimRecipe],
        must_hold("min_lr must be <= lr", lambda optim: optim.min_lr <= optim.lr),
    ] = OptimRecipe()
    run: Section[RunRecipe] = RunRecipe()


def check_network_name(name: str) -> str:
    """The name itself; ValueError if it neither is built in nor has the form of a class's name."""
    if name in ARCHITECTURES or ":" in name:
        return name
    suggestion = closest_name(name, ARCHITECTURES)
    question = "" if suggestion is None else f" (did you mean {suggestion}?)"
    raise ValueError(f"must be {', '.join(ARCHITECTURES)} or package.module:Class{question}")


class Recipe(AnyRecipe):
    """The recipe of a training run of the residual or of direct-ft."""

    data: Section[DataRecipe] = DataRecipe()
    loss: Section[LossRecipe] = LossRecipe()
    # Architecture of the residual: a built-in name, or a class of another package.
    network: Annotated[str, AfterValidator(check_network_name), MAY_CHANGE_ON_RESUME] = "unet"
    # Which cells of a view (2×2 pixels) get an aux Gaussian in training: "masked" are those in
    # holes, "all" is the paper's dense grid. Inference keeps the masked ones.
    cells: CellChoice = "masked"
    init: Path | None = None  # initial weights; sharp-decoder also takes SHARP's checkpoint


R = TypeVar("R", bound=AnyRecipe)


def changed_keys(stored: Mapping[str, Any], recipe: RecipePart, prefix: str = "") -> list[str]:
    """The sorted keys in which a recipe differs from a stored one, such as "optim.lr".

    Keys that are marked as `MAY_CHANGE_ON_RESUME` are ignored.

    Args:
        stored: the earlier recipe, or a section of it, ready for JSON.
        recipe: the recipe, or the same section of it.
        prefix: the name of the section and a dot; it comes before the keys.
    """
    fields = type(recipe).model_fields
    values = recipe.model_dump(mode="json")

    # A key that only the stored recipe has, from another version of the program, matters only if it
    # had a value.
    changes = []
    for name, stored_value in stored.items():
        if name not in fields and stored_value is not None:
            changes.append(prefix + name)

    for name, field in fields.items():
        value = getattr(recipe, name)
        if isinstance(value, RecipePart):
            stored_section = stored.get(name) or {}
            changes += changed_keys(stored_section, value, f"{prefix}{name}.")
        elif MAY_CHANGE_ON_RESUME not in field.metadata and stored.get(name) != values[name]:
            changes.append(prefix + name)
    return sorted(changes)


def load_recipe(kind: type[R], path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> R:
    """Read a recipe; missing values are the defaults of `kind`.

    Args:
        kind: the class of the recipe, such as `Recipe`.
        path: a YAML file, or the name of a packaged recipe such as "cpu". Relative paths in the
            file are relative to the working directory.
        overrides: texts `key=value`, such as optim.steps=100 or data.rgbd.0.folder=kitchen; values
            are YAML.

    Raises:
        InputError: the file is missing or broken, or has an unknown key or a value out of bounds.
    """
    path = find_recipe(path)
    check_file(path, "recipe")
    with as_input_error(path, "not a recipe: {reason}", OSError, UnicodeDecodeError):
        text = Path(path).read_text(encoding="utf-8")
    content = parse_yaml(text, path) or {}  # an empty file has defaults only

    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or not key:
            raise InputError(
                f"{override!r}: neither an option nor key=value, such as optim.steps=100"
            )
        with as_input_error(override, f"{path} has no such key ({{reason}})"):
            set_nested(content, key.split("."), parse_yaml(value, override))

    return validated(kind, content, path)


def find_recipe(path: str | os.PathLike[str]) -> str | os.PathLike[str]:
    """The file of a packaged recipe, given by its name, such as "cpu"; other paths unchanged.

    A file in the working directory goes before a packaged recipe of the same name. InputError if a
    plain name is neither.
    """
    name = os.fspath(path)
    packaged_names = sorted(file.stem for file in PACKAGED_RECIPES.glob("*.yaml"))
    if name in packaged_names and not os.path.isfile(path):
        return PACKAGED_RECIPES / f"{name}.yaml"
    if os.sep not in name and not os.path.exists(path):
        suggestion = closest_name(name, packaged_names)
        question = "" if suggestion is None else f" (did you mean {suggestion}?)"
        raise InputError(
            f"{path}: no such recipe{question}; choose from {', '.join(packaged_names)}, or give a "
            "YAML file"
        )
    return path


def set_nested(content: Any, keys: Sequence[str], value: object) -> None:
    """Set `content[keys[0]][keys[1]]...` to a value, in nested dictionaries and lists.

    Missing dictionaries are created. Any exception may come if a key leads into something else, or
    a list has no such place.
    """
    for key in keys[:-1]:
        index = int(key) if isinstance(content, list) else key
        if isinstance(content, dict) and not isinstance(content.get(index), dict | list):
            content[index] = {}
        content = content[index]
    last_index = int(keys[-1]) if isinstance(content, list) else keys[-1]
    content[last_index] = value
