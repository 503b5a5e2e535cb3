"""Recipes out of YAML files, and `key=value` on top of them; every mistake is one line."""

from __future__ import annotations

import dataclasses
import math
import os
import typing
from collections.abc import Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union

from spackle.camera_path import MAX_DISPARITY
from spackle.errors import InputError, reason_in_a_line
from spackle.image import check_file
from spackle.residual.hole_features import CELL
from spackle.training.depth.recipe import LITE_RANGES, LiteRecipe, check_lite
from spackle.training.recipe import OptimRecipe, Recipe

R = TypeVar("R", Recipe, LiteRecipe)

POSITIVE = 1e-12
LEAST_SIDE = 36  # pixels that the feature networks need
# The least and the greatest that a number may be; elements of lists likewise.
RANGES: dict[str, tuple[float, float]] = {
    "data.rgbd.focal_px": (1, 1e6),
    "data.rgbd.unit_m": (POSITIVE, 1e3),
    **{f"data.shares.{name}": (0, 1e6) for name in ("composites", "rgbd", "stereo", "pairs", "pseudo")},
    "data.disparity": (0, MAX_DISPARITY),
    "data.views": (1, 1e6),  # six digits name a sample's file
    "data.crops": (1, 100),
    "data.cells": (16, 768),
    "data.validation_views": (1, 1e6),
    "data.seed": (0, 2**31 - 2),
    **{f"loss.{name}": (0, 1e6) for name in ("color", "alpha", "perceptual", "preserve")},
    "loss.feature_size": (64, 4096),
    "loss.dilation": (1, 1001),
    "optim.lr": (POSITIVE, 1),
    "optim.min_lr": (0, 1),
    "optim.warmup": (0, 1e9),
    "optim.steps": (1, 1e9),
    "optim.batch": (1, 1e5),
    "optim.betas": (0, 0.999999),
    "optim.weight_decay": (0, 10),
    "optim.clip": (POSITIVE, 1e9),
    "optim.ema": (0, 0.999999),
    "run.seed": (0, 2**31 - 1),
    **{f"run.{name}": (1, 1e9) for name in ("validate_every", "save_every", "log_every", "patience")},
    "run.min_delta": (0, 1e6),
    **LITE_RANGES,
}


def load_recipe(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> Recipe:
    """Read a recipe of the residual or of direct-ft; what the file leaves out is as `Recipe` has it.

    Args:
        path: a YAML file. Relative paths in it are relative to the working directory.
        overrides: `key=value` each, such as optim.steps=100 or data.rgbd.0.folder=kitchen; values are YAML.

    Raises:
        InputError: a missing or broken file, an unknown key, a value that cannot be.
    """
    recipe = _load(Recipe, path, overrides)
    _check_together(recipe, str(path))
    return recipe


def load_lite_recipe(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> LiteRecipe:
    """Read a recipe of the lite base likewise; what the file leaves out is as `LiteRecipe` has it."""
    recipe = _load(LiteRecipe, path, overrides)
    _check_rates(recipe.optim, str(path))
    check_lite(recipe, str(path))
    return recipe


def _load(kind: type[R], path: str | os.PathLike[str], overrides: Sequence[str]) -> R:
    check_file(path, "recipe")
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
    return recipe


def _parse(text: str, file: str) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise InputError("recipes are YAML, which needs a package: pip install 'spackle-nvs[train]'") from error
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: a date that is none
        raise InputError(f"{file}: not YAML: {reason_in_a_line(error)}") from error


def _set(raw: Any, keys: Sequence[str], value: Any, override: str) -> None:
    """Put a value into nested dictionaries and lists."""
    for depth, key in enumerate(keys):
        last = depth == len(keys) - 1
        if isinstance(raw, list):
            if not (key.isdecimal() and int(key) < len(raw)):
                known = ".".join(keys[:depth])
                raise InputError(f"{override}: {known} has {len(raw)} entries, counted from 0; {key} is none of them")
            place: Any = int(key)
        else:
            place = key
            if not last and not isinstance(raw.get(key), (dict, list)):
                raw[key] = {}
        if last:
            raw[place] = value
        raw = raw[place]
        if not last and not isinstance(raw, (dict, list)):
            raise InputError(f"{override}: {'.'.join(keys[: depth + 1])} has no parts")


def _build(kind: Any, value: Any, key: str, file: str) -> Any:
    """A value of a type out of what YAML gave, or InputError with file, key and what is allowed."""
    choices = typing.get_args(kind) if typing.get_origin(kind) in (Union, UnionType) else ()
    if NoneType in choices:
        if value is None:
            return None
        (kind,) = (choice for choice in choices if choice is not NoneType)
    if dataclasses.is_dataclass(kind):
        return _build_fields(kind, value, key, file)
    if typing.get_origin(kind) is tuple:
        return _build_tuple(kind, value, key, file)
    if typing.get_origin(kind) is Literal and value in typing.get_args(kind):
        return value
    if kind is Path and isinstance(value, str) and value and "\0" not in value:
        return Path(value)
    if kind in (int, float) and (number := _number(value, kind)) is not None:
        low, high = RANGES[_ranged(key)]
        if low <= number <= high:
            return number
    raise _refused(key, value, _allowed(kind, key, bool(choices)), file)


def _build_fields(kind: Any, value: Any, key: str, file: str) -> Any:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    value = {} if value is None else value  # a section whose keys are all commented out
    if not isinstance(value, dict):
        raise _refused(key, value, f"keys {', '.join(fields)}", file)
    here = f"{key}." if key else ""
    for name in value:
        if name not in fields:
            raise InputError(f"{file}: {here}{name} is unknown; there are {', '.join(fields)}")
    for name, field in fields.items():
        if name not in value and field.default is dataclasses.MISSING:
            raise InputError(f"{file}: {here}{name} is missing; {key} needs it")
    types = typing.get_type_hints(kind)
    return kind(**{name: _build(types[name], item, here + name, file) for name, item in value.items()})


def _build_tuple(kind: Any, value: Any, key: str, file: str) -> Any:
    first, second = typing.get_args(kind)
    if not isinstance(value, list):
        raise _refused(key, value, _allowed(kind, key, False), file)
    if second is ...:
        return tuple(_build(first, item, f"{key}.{place}", file) for place, item in enumerate(value))
    if len(value) != 2:
        raise _refused(key, value, _allowed(kind, key, False), file)
    return tuple(_build(first, item, key, file) for item in value)


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


def _ranged(key: str) -> str:
    """A key without its places in lists."""
    return ".".join(part for part in key.split(".") if not part.isdecimal())


def _allowed(kind: Any, key: str, optional: bool) -> str:
    """What a key takes, in words."""
    if typing.get_origin(kind) is tuple:
        many = typing.get_args(kind)[1] is ...
        return "a list" if many else f"a list of two numbers, each {_span(key)}"
    if typing.get_origin(kind) is Literal:
        words = ", ".join(typing.get_args(kind))
    elif kind is Path:
        words = "a path"
    else:
        words = f"{'a whole number' if kind is int else 'a number'} {_span(key)}"
    return f"{words}, or null" if optional else words


def _span(key: str) -> str:
    low, high = RANGES[_ranged(key)]
    return f"from {low:g} to {high:g}" if low != POSITIVE else f"above 0, up to {high:g}"


def _refused(key: str, value: Any, allowed: str, file: str) -> InputError:
    return InputError(f"{file}: {key or 'the recipe'} cannot be {str(value)[:60]!r}; it takes {allowed}")


def _check_rates(optim: OptimRecipe, file: str) -> None:
    if optim.min_lr > optim.lr:
        raise InputError(f"{file}: optim.min_lr {optim.min_lr:g} is above optim.lr {optim.lr:g}")


def _check_together(recipe: Recipe, file: str) -> None:
    """InputError for values that are possible each, but not together."""
    low, high = recipe.data.disparity
    if low > high:
        raise InputError(f"{file}: data.disparity runs from {low:g} down to {high:g}; give the smaller number first")
    _check_rates(recipe.optim, file)
    if recipe.loss.dilation % 2 == 0:
        raise InputError(f"{file}: loss.dilation {recipe.loss.dilation} is even; a square around a pixel is odd")
    if recipe.loss.features == "none":
        return
    if recipe.loss.features_path is None:
        raise InputError(
            f"{file}: loss.features_path is missing: it names the weights of {recipe.loss.features}; "
            "loss.features=none does without"
        )
    if (recipe.loss.feature_size or CELL * recipe.data.cells) < LEAST_SIDE:
        raise InputError(
            f"{file}: crops of {recipe.data.cells} cells are too small for {recipe.loss.features} "
            f"({LEAST_SIDE} pixels): raise data.cells, or give loss.feature_size"
        )
