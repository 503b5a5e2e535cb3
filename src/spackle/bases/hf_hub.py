"""Where a model's files are: in a folder, in the hub's cache on this machine, or on the hub, from where they are copied
into the cache (optional: pip install 'spackle-nvs[hf]')."""

from __future__ import annotations

import json
import logging
import os
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from spackle.errors import InputError, reason_in_a_line

NOT_INSTALLED = "depth models need a package: pip install 'spackle-nvs[hf]'"
SETTINGS = ["config.json", "preprocessor_config.json", "processor_config.json"]
WEIGHTS = ["model.safetensors", "model-*.safetensors", "model.safetensors.index.json"]
_HUB_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*", re.ASCII)


def settings_folder(model: str) -> Path:
    """The folder with a model's settings, for a look at them before gigabytes are copied.

    Raises:
        InputError: no such folder, no such model, the hub cannot be reached, or the settings are not there.
    """
    return _find(model, SETTINGS, _lacks_settings)


def weights_folder(model: str) -> Path:
    """The folder with a model's settings and weights; raises as `settings_folder` does."""
    return _find(model, [*SETTINGS, *WEIGHTS], lambda folder: _lacks_settings(folder) or _lacks_weights(folder))


def read_settings(folder: Path, file: str, name: str) -> dict[str, Any]:
    """What a JSON file of a model says.

    Raises:
        InputError: not a JSON object; `name` is the model's.
    """
    try:
        settings = json.loads((folder / file).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{name}: {file} cannot be read ({reason_in_a_line(error)}): give the model's files again"
        ) from error
    if not isinstance(settings, dict):
        raise InputError(f"{name}: {file} is no JSON object: give the model's files again")
    return settings


@contextmanager
def quiet() -> Iterator[None]:
    """Keep the packages from printing warnings, logs and progress bars; what matters is raised."""
    from huggingface_hub import utils

    loggers = [logging.getLogger(name) for name in ("transformers", "huggingface_hub", "httpx")]
    levels, bars = [logger.level for logger in loggers], not utils.are_progress_bars_disabled()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for logger in loggers:
                logger.setLevel(logging.CRITICAL)
            utils.disable_progress_bars()
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
        if bars:
            utils.enable_progress_bars()


def _find(model: str, files: list[str], lacks: Callable[[Path], str]) -> Path:
    """A folder that lacks nothing; what is in the cache is taken from there without asking the hub."""
    if os.path.isdir(model) or model.startswith(("./", "../", "/", "~")):
        folder = Path(model).expanduser()
        if not folder.is_dir():
            raise InputError(f"hf:{model}: no such folder: check the name")
    elif _HUB_NAME.fullmatch(model):
        cached = _from_cache(model, files)
        folder = cached if cached is not None and not lacks(cached) else _from_hub(model, files)
    else:
        raise InputError(f"hf:{model}: neither a folder nor a model of the hub: give a folder, or owner/name")
    if problem := lacks(folder):
        raise InputError(f"hf:{model}: {problem}")
    return folder


def _lacks_settings(folder: Path) -> str:
    if not (folder / "config.json").is_file():
        return "has no config.json, so it is no model of transformers: give another"
    if not any((folder / name).is_file() for name in SETTINGS[1:]):
        return f"has no {SETTINGS[1]}, which says how to prepare a photo: give it, or another model"
    return ""


def _lacks_weights(folder: Path) -> str:
    index = folder / WEIGHTS[-1]
    if index.is_file():
        parts = read_settings(folder, index.name, str(folder)).get("weight_map")
        names = {str(name) for name in parts.values()} if isinstance(parts, dict) else set()
        absent = sorted(name for name in names if not (folder / name).is_file())
        if absent or not names:
            return f"{index.name} names weights that are not there ({', '.join(absent)[:80]}): give its files again"
        return ""
    if not (folder / WEIGHTS[0]).is_file():
        return f"has no {WEIGHTS[0]}, the only kind of weights that runs no code when it is read: give another model"
    return ""


def _from_cache(model: str, files: list[str]) -> Path | None:
    """The model's folder in the cache, whatever of it is there; None where nothing is."""
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise InputError(NOT_INSTALLED) from error
    try:
        with quiet():
            return Path(snapshot_download(model, allow_patterns=files, local_files_only=True))
    except OSError:  # what huggingface_hub says of it is one
        return None


def _from_hub(model: str, files: list[str]) -> Path:
    """The model's folder in the cache, after what is not in it has been copied there."""
    from huggingface_hub import errors, snapshot_download

    try:
        with quiet():
            return Path(snapshot_download(model, allow_patterns=files))
    except Exception as error:  # of three libraries, one of them about the network
        if isinstance(error, errors.LocalEntryNotFoundError):
            problem = "not on this machine yet, and the hub cannot be reached: connect, or give a folder"
        elif isinstance(error, errors.GatedRepoError):
            problem = "its owner asks for consent: give it on the model's page, then log in with hf auth login"
        elif isinstance(error, errors.RepositoryNotFoundError):
            problem = "the hub has no such model, or only for its owner: check the name, or log in with hf auth login"
        else:
            problem = f"cannot be fetched from the hub ({reason_in_a_line(error)}): try again, or give a folder"
        raise InputError(f"hf:{model}: {problem}") from error
