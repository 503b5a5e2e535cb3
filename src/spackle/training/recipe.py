"""What a training run is made of: values, and how they are read from YAML with `key=value` on top.

A type says which numbers a key takes (`Range`), and whether two runs that differ in it may be one (`FREE`).
"""

from __future__ import annotations

import dataclasses
import math
import os
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Protocol, TypeVar, Union

from spackle.camera_path import MAX_DISPARITY
from spackle.device import Precision
from spackle.downloads import installed
from spackle.errors import InputError, reason_in_a_line, shown
from spackle.files import check_file
from spackle.residual.hole_features import CELL

PACKAGED = Path(__file__).parent / "recipes"
MAX_BYTES, MAX_DEPTH = 1 << 16, 20
POSITIVE = 1e-12
LEAST_SIDE = 36  # pixels that the feature networks need
# What may differ when a run goes on: how long it is, how often it looks up, and where its files lie.
# The samples themselves are held together by their digest.
FREE = "free"

FeatureName = Literal["resnet50", "squeezenet", "none"]
DeviceName = Literal["auto", "cpu", "cuda"]


@dataclasses.dataclass(frozen=True)
class Range:
    """The least and the greatest that a number may be."""

    low: float
    high: float

    def __str__(self) -> str:
        low, high = self.low, self.high
        return f"from {low:g} to {high:g}" if low != POSITIVE else f"above 0, up to {high:g}"


Share = Annotated[float, Range(0, 1e6)]
Count = Annotated[int, Range(1, 1e6)]  # six digits name a sample's file
Disparity = Annotated[float, Range(0, MAX_DISPARITY)]
Beta = Annotated[float, Range(0, 0.999999)]
Interval = Annotated[int, Range(1, 1e9), FREE]  # steps
Place = Annotated[Path | None, FREE]


@dataclasses.dataclass(frozen=True)
class RgbdFolder:
    """What one depth camera took: NAME.color.jpg and NAME.depth.png."""

    folder: Path
    focal_px: Annotated[float, Range(1, 1e6)]
    unit_m: Annotated[float, Range(POSITIVE, 1e3)] = 0.001  # metres in one step of the depth files


@dataclasses.dataclass(frozen=True)
class Shares:
    """How often a view comes from each source; they need not add up to 1. One without data counts as 0."""

    composites: Share = 0.66
    rgbd: Share = 0.12
    stereo: Share = 0.10  # reverse_view of the left photo
    pairs: Share = 0.12  # the true right photo
    pseudo: Annotated[Share, FREE] = 1.0  # renderings with completed targets; some checkpoints lack it


@dataclasses.dataclass(frozen=True)
class DataRecipe:
    """Where views with holes and their truth come from, and how many there are."""

    photos: Place = None  # a folder, with its subfolders
    rgbd: Annotated[tuple[RgbdFolder, ...], FREE] = ()
    stereo: Place = None  # a folder of scenes, each with a scene.json
    pseudo: Place = None  # a dataset that `spackle dataset build` made
    shares: Shares = Shares()
    disparity: tuple[Disparity, Disparity] = (0.1, 0.6)  # how far the virtual camera goes
    views: Count = 20_000  # the paper's: 1,000 photos, 20 views of each
    crops: Annotated[int, Range(1, 100)] = 3  # of a view, at most
    cells: Annotated[int, Range(16, 768)] = 96  # along a crop's side, of 2×2 pixels
    validation_views: Count = 100
    cache: Place = None  # a folder for the samples; inside the output where None
    seed: Annotated[int, Range(0, 2**31 - 2)] = 0  # of the samples alone: runs with other seeds share them


@dataclasses.dataclass(frozen=True)
class LossRecipe:
    """The four terms of eq. 6 and what the perceptual one looks with (paper, "Training Details and Loss Weights")."""

    color: Share = 10.0
    alpha: Share = 0.5
    perceptual: Share = 1.0
    preserve: Share = 5.0
    features: FeatureName = "resnet50"
    features_path: Place = None
    feature_size: Annotated[int, Range(64, 4096)] | None = 512  # the longer side of what it sees; None: the crop's own
    dilation: Annotated[int, Range(1, 1001)] = 21  # pixels
    color_blur: Annotated[float, Range(0, 64)] = 0.0  # pixels; above 0 the colour term sees low frequencies alone
    gram: Share = 1.0  # how much the perceptual term's Gram statistics count

    @property
    def features_file(self) -> Path | None:
        """The feature network's weights: `features_path`, else what `spackle weights get features` fetched."""
        return self.features_path or (installed("features") if self.features == "resnet50" else None)


@dataclasses.dataclass(frozen=True)
class OptimRecipe:
    """AdamW with a linear warm-up and a cosine after it (paper, "Training Details and Loss Weights")."""

    lr: Annotated[float, Range(POSITIVE, 1)] = 1.6e-4
    min_lr: Annotated[float, Range(0, 1)] = 1.6e-5
    warmup: Annotated[int, Range(0, 1e9)] = 10_000  # steps
    steps: Interval = 100_000
    batch: Annotated[int, Range(1, 1e5)] = 16  # crops of a step, of all processes together
    betas: tuple[Beta, Beta] = (0.9, 0.999)
    weight_decay: Annotated[float, Range(0, 10)] = 1e-4
    clip: Annotated[float, Range(POSITIVE, 1e9)] = 1.0  # the gradient's largest norm
    ema: Beta = 0.999  # decay of the averaged weights, which are validated and exported; 0: no average
    precision: Precision = "auto"  # of the network; auto: bf16 where the hardware multiplies it natively


@dataclasses.dataclass(frozen=True)
class RunRecipe:
    """What has no part in what is learned, but for the seed and when to stop."""

    seed: Annotated[int, Range(0, 2**31 - 1)] = 0  # of the first weights and of the samples' order
    validate_every: Interval = 1000
    save_every: Interval = 1000
    log_every: Interval = 50
    patience: Interval = 10  # validations without improvement before the run ends
    min_delta: Annotated[float, Range(0, 1e6), FREE] = 1e-4  # a smaller improvement is none
    device: Annotated[DeviceName, FREE] = "auto"  # of the networks; the renderer draws where it can


class AnyRecipe(Protocol):
    """What every recipe has, whatever its network learns from."""

    @property
    def optim(self) -> OptimRecipe:
        """How it learns."""

    @property
    def run(self) -> RunRecipe:
        """How often it looks up."""

    def check(self, file: str) -> None:
        """InputError, naming the file, for values that are possible each, but not together."""


@dataclasses.dataclass(frozen=True)
class Recipe:
    """All of a training run of the residual or of direct-ft."""

    data: DataRecipe = DataRecipe()
    loss: LossRecipe = LossRecipe()
    optim: OptimRecipe = OptimRecipe()
    run: RunRecipe = RunRecipe()
    init: Path | None = None  # weights to start from

    def check(self, file: str) -> None:
        """InputError, naming the file, for values that are possible each, but not together."""
        low, high = self.data.disparity
        if low > high:
            raise InputError(f"{file}: data.disparity runs from {low:g} down to {high:g}; give the smaller one first")
        check_rates(self.optim, file)
        if self.loss.dilation % 2 == 0:
            raise InputError(f"{file}: loss.dilation {self.loss.dilation} is even; a square around a pixel is odd")
        if self.loss.features == "none":
            return
        if self.loss.features_file is None:
            fetched = "" if self.loss.features == "resnet50" else "loss.features=resnet50 takes what "
            raise InputError(
                f"{file}: loss.features_path is missing: it names the weights of {self.loss.features}; "
                f"{fetched}`spackle weights get features` brings{' them' if not fetched else ''}, "
                "loss.features=none does without"
            )
        if (self.loss.feature_size or CELL * self.data.cells) < LEAST_SIDE:
            raise InputError(
                f"{file}: crops of {self.data.cells} cells are too small for {self.loss.features} "
                f"({LEAST_SIDE} pixels): raise data.cells, or give loss.feature_size"
            )


R = TypeVar("R", bound=AnyRecipe)


def check_rates(optim: OptimRecipe, file: str) -> None:
    """InputError where the learning rate would rise."""
    if optim.min_lr > optim.lr:
        raise InputError(f"{file}: optim.min_lr {optim.min_lr:g} is above optim.lr {optim.lr:g}")


def plain(value: Any) -> Any:
    """A recipe as dictionaries, lists, numbers and strings."""
    if dataclasses.is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, (tuple, list)):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def differences(stored: Mapping[str, Any], recipe: Any, where: str = "") -> list[str]:
    """The keys in which a plain recipe and another one are different runs; `where` goes before each."""
    kinds = typing.get_type_hints(type(recipe), include_extras=True)
    found = [where + name for name, value in stored.items() if name not in kinds and value is not None]
    for name, kind in kinds.items():
        one, other = stored.get(name), getattr(recipe, name)
        if dataclasses.is_dataclass(other):
            found += differences(one or {}, other, f"{where}{name}.")
        elif FREE not in _bare(kind)[1] and one != plain(other):
            found.append(where + name)
    return sorted(found)


def load_recipe(kind: type[R], path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> R:
    """Read a recipe; what the file leaves out is as in `kind`.

    Args:
        kind: `Recipe`, or another dataclass of such values.
        path: a YAML file, or the name of a packaged one such as "cpu". Relative paths in it are relative to the
            working directory.
        overrides: `key=value` each, such as optim.steps=100 or data.rgbd.0.folder=kitchen; values are YAML.

    Raises:
        InputError: a missing or broken file, an unknown key, a value that cannot be.
    """
    names = sorted(file.stem for file in PACKAGED.glob("*.yaml"))
    if os.fspath(path) in names and not os.path.isfile(path):
        path = PACKAGED / f"{os.fspath(path)}.yaml"
    elif os.sep not in os.fspath(path) and not os.path.exists(path):
        raise InputError(f"{path}: no such recipe; there are {', '.join(names)}, or give a YAML file")
    if check_file(path, "recipe") > MAX_BYTES:
        raise InputError(f"{path}: too long for a recipe (at most {MAX_BYTES >> 10} KiB): is it the right file?")
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a recipe: {reason_in_a_line(error)}") from error
    raw = _parse(text, str(path)) or {}
    recipe: R = _build(kind, raw, "", str(path))
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or not key:
            raise InputError(f"{override!r}: neither an option nor key=value, such as optim.steps=100")
        _set(raw, key.split("."), _parse(value, override), override)
        recipe = _build(kind, raw, "", override)
    recipe.check(str(path))
    return recipe


def _parse(text: str, file: str) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise InputError("recipes are YAML, which needs a package: pip install 'spackle-nvs[train]'") from error
    try:
        depth = 0
        for token in yaml.scan(text):
            depth += type(token).__name__.endswith(("SequenceStartToken", "MappingStartToken"))
            depth -= type(token).__name__.endswith(("SequenceEndToken", "MappingEndToken", "BlockEndToken"))
            if isinstance(token, yaml.AliasToken) or depth > MAX_DEPTH:
                raise InputError(f"{file}: aliases (*) and values deeper than {MAX_DEPTH} are not read: write it out")
        return yaml.safe_load(text)
    except InputError:
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: a date that is none
        raise InputError(f"{file}: not YAML: {reason_in_a_line(error)}") from error


def _set(raw: Any, keys: Sequence[str], value: Any, override: str) -> None:
    """Put a value into nested dictionaries and lists."""
    for depth, key in enumerate(keys):
        last = depth == len(keys) - 1
        place: Any = key
        if isinstance(raw, list):
            if not (key.isdecimal() and int(key) < len(raw)):
                known = ".".join(keys[:depth])
                raise InputError(f"{override}: {known} has {len(raw)} entries, counted from 0; {key} is none of them")
            place = int(key)
        elif not last and not isinstance(raw.get(key), (dict, list)):
            raw[key] = {}
        if last:
            raw[place] = value
        raw = raw[place]
        if not last and not isinstance(raw, (dict, list)):
            raise InputError(f"{override}: {'.'.join(keys[: depth + 1])} has no parts")


def _bare(kind: Any) -> tuple[Any, tuple[Any, ...], bool]:
    """A type without its annotations and without null, the annotations, and whether null is allowed."""
    marks, optional = (), False
    while (origin := typing.get_origin(kind)) in (Annotated, Union, UnionType):
        if origin is Annotated:
            kind, *more = typing.get_args(kind)
            marks = (*marks, *more)
        else:
            (kind,) = (choice for choice in typing.get_args(kind) if choice is not NoneType)
            optional = True
    return kind, marks, optional


def _build(kind: Any, value: Any, key: str, file: str) -> Any:
    """A value of a type out of what YAML gave, or InputError with file, key and what is allowed."""
    inner, marks, optional = _bare(kind)
    if value is None and optional:
        return None
    if dataclasses.is_dataclass(inner):
        return _build_fields(inner, value, key, file)
    if typing.get_origin(inner) is tuple and isinstance(value, list):
        first, second = typing.get_args(inner)
        if second is ...:
            return tuple(_build(first, item, f"{key}.{place}", file) for place, item in enumerate(value))
        if len(value) == 2:
            return tuple(_build(first, item, key, file) for item in value)
    if typing.get_origin(inner) is Literal and value in typing.get_args(inner):
        return value
    if inner is Path and isinstance(value, str) and value and "\0" not in value:
        return Path(value)
    if inner in (int, float) and (number := _number(value, inner)) is not None:
        (span,) = (mark for mark in marks if isinstance(mark, Range))
        if span.low <= number <= span.high:
            return number
    raise _refused(key, value, _allowed(kind), file)


def _build_fields(kind: Any, value: Any, key: str, file: str) -> Any:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    value = {} if value is None else value  # a section whose keys are all commented out
    if not isinstance(value, dict):
        raise _refused(key, value, f"keys {', '.join(fields)}", file)
    here = f"{key}." if key else ""
    for name in value:
        if name not in fields:
            raise InputError(f"{file}: {here}{str(name)[:60]} is unknown; there are {', '.join(fields)}")
    for name, field in fields.items():
        if name not in value and field.default is dataclasses.MISSING:
            raise InputError(f"{file}: {here}{name} is missing; {key} needs it")
    types = typing.get_type_hints(kind, include_extras=True)
    return kind(**{name: _build(types[name], item, here + name, file) for name, item in value.items()})


def _number(value: Any, kind: type) -> float | int | None:
    """A finite number; YAML takes 1e-4 for text, which a person does not."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        number = float(value)
        if not math.isfinite(number):
            return None
        return number if kind is float else int(number) if number == int(number) else None
    except (ValueError, OverflowError):
        return None


def _allowed(kind: Any) -> str:
    """What a key takes, in words."""
    inner, marks, optional = _bare(kind)
    if typing.get_origin(inner) is tuple:
        first, second = typing.get_args(inner)
        return "a list" if second is ... else f"a list of two numbers, each {_bare(first)[1][0]}"
    if typing.get_origin(inner) is Literal:
        words = ", ".join(typing.get_args(inner))
    elif inner is Path:
        words = "a path"
    else:
        words = f"{'a whole number' if inner is int else 'a number'} {marks[0]}"
    return f"{words}, or null" if optional else words


def _refused(key: str, value: Any, allowed: str, file: str) -> InputError:
    return InputError(f"{file}: {key or 'the recipe'} cannot be {shown(value)}; it takes {allowed}")
