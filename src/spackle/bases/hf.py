"""The hf base: a depth model of transformers looks at the photo, and its depth is lifted as a measured one is.

Optional: pip install 'spackle-nvs[hf]'.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import math
import os
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from spackle.bases.hf_models import (
    SCALE_NOTES,
    SQUARE_ANTIALIAS,
    Meaning,
    Prepare,
    Window,
    by_processor,
    by_settings,
    crop,
    meaning_of,
    to_depth_map,
)
from spackle.bases.lift import lift
from spackle.bases.protocol import BasePrediction, Progress
from spackle.camera import Camera
from spackle.device import MemoryShort, Precision, memory_is_short, own_arithmetic, pick_device, pick_dtype
from spackle.errors import InputError, reason_in_a_line
from spackle.image import LENSES, Photo, resize_photo

SETTINGS = ["config.json", "preprocessor_config.json", "processor_config.json"]
WEIGHTS = ["model.safetensors", "model-*.safetensors", "model.safetensors.index.json"]
NOT_INSTALLED = "depth models need a package: pip install 'spackle-nvs[hf]'"
FIT = "give the weights that belong to its config.json"
_HUB_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*", re.ASCII)


@dataclasses.dataclass(frozen=True)
class DepthModel:
    """A depth network in evaluation mode, with all that is needed to ask it."""

    network: nn.Module
    prepare: Prepare
    meaning: Meaning

    @torch.no_grad()
    def __call__(self, rgb: Tensor) -> tuple[Tensor, float | None, Window]:
        """Ask for the depth of a photo, [H, W, 3] sRGB in 0..1.

        Returns:
            the network's numbers [h, w] float32 on the processor, the horizontal field of view in degrees where it
            gives one, and the part of the numbers that is the photo.
        """
        pixels, window = self.prepare(rgb)
        with quiet():
            output = self.network(pixel_values=pixels.to(next(self.network.parameters()).device))
        raw, fov = output.predicted_depth.float().cpu(), getattr(output, "field_of_view", None)
        if raw.ndim != 3 or len(raw) != 1:
            raise ValueError(f"an output of shape {tuple(raw.shape)}")
        return raw[0], None if fov is None else float(fov), window


class HfBase:
    """Any depth model that transformers runs and whose output has a known meaning (see `hf_models`), frozen."""

    def __init__(self, name: str, model: DepthModel, precision: str) -> None:
        """Use a model that is loaded already; `precision` is what the report says."""
        self.name = name
        self.model = model
        self.precision = precision

    @classmethod
    def load(
        cls, model: str, *, device: str | None = None, precision: Precision = "auto", name: str | None = None
    ) -> HfBase:
        """Read a model's settings and weights.

        Args:
            model: a folder, or owner/name on the hub. What the hub's cache holds is taken from there, without
                network; the rest is copied into it.
            device: cpu or a CUDA device; where None, CUDA if it is there.
            precision: of the products of matrices; auto is bf16 where the hardware multiplies it natively.
            name: of the base; hf:MODEL where None.

        Raises:
            InputError: a device, package, model or file that is not there, a model that is broken, that is not a depth
                model or whose output has no known meaning, or too little memory. Nothing in the files is executed.
            ValueError: an unknown precision.
        """
        target = pick_device(device)
        dtype = pick_dtype(precision, target)
        name = name or f"hf:{model}"
        return cls(name, _load_model(model, name, target, dtype), "bf16" if dtype.itemsize == 2 else "fp32")

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the pixels of the photo at its working size, as `lift` makes them.

        A model that sees the lens gives it where neither the photo's file nor a person does.

        Args:
            photo: at its full size; the model looks at it at its working size.
            progress: called when the depth is there, and when it is lifted.

        Raises:
            InputError: the model cannot work on this photo, or what it says is no depth; or too little memory.
        """
        photo = resize_photo(photo)
        device = next(self.model.network.parameters()).device
        with _one_line(f"{photo.path}: {self.name}", "fails", "give another photo or model"), own_arithmetic(device):
            raw, fov, window = self.model(photo.rgb)
        camera, lens_source = photo.camera, ""
        if fov is not None and photo.focal_source.startswith("default"):
            camera, lens_source = self._camera(photo, fov), "Depth Pro"  # the only kind that gives a lens
        focal = camera.focal[0] / photo.width
        depth = to_depth_map(crop(raw, window), self.model.meaning, focal, self.name, photo.path)
        if progress:
            progress(1, 2)
        prediction = lift(photo.rgb, depth, camera)
        if progress:
            progress(2, 2)
        notes = {**prediction.notes, "precision": self.precision, "depth_scale": SCALE_NOTES[self.model.meaning]}
        if invalid := int((~depth.valid).sum()):
            notes["depth_invalid_pixels"] = invalid
        return dataclasses.replace(prediction, notes=notes, lens_source=lens_source)

    def _camera(self, photo: Photo, fov: float) -> Camera:
        """The photo's camera with a horizontal field of view in degrees."""
        focal = 0.5 * photo.width / math.tan(math.radians(fov) / 2) if 0 < fov < 180 else math.nan
        shortest, longest = (lens * max(photo.width, photo.height) for lens in LENSES)
        if not shortest <= focal <= longest:
            raise InputError(
                f"{photo.path}: {self.name} sees a field of view of {fov:g}°, which no lens has: "
                "give the focal length with --focal-mm"
            )
        return Camera.from_focal(focal, photo.width, photo.height)


def _load_model(model: str, name: str, device: torch.device, dtype: torch.dtype) -> DepthModel:
    """Read a depth model from safetensors; only its linear layers compute in `dtype`. No code of its own runs."""
    meaning_of(_read_settings(_find(model, SETTINGS), "config.json", name), name)  # before the weights come
    folder = _find(model, [*SETTINGS, *WEIGHTS])
    settings = _read_settings(folder, "config.json", name)
    meaning, kind = meaning_of(settings, name), str(settings["model_type"])
    transformers = _transformers()
    with _one_line(name, "cannot be loaded", "give its files again, or another model"), quiet():
        prepare = _prepare(transformers, folder, kind, name)
        # Anything but float32 on disk is widened: what is not a product of matrices is cheap, and coarse in 16 bits.
        network, info = transformers.AutoModelForDepthEstimation.from_pretrained(
            folder,
            dtype=torch.float32,
            use_safetensors=True,
            weights_only=True,
            trust_remote_code=False,
            local_files_only=True,
            ignore_mismatched_sizes=True,  # only so that they can be named
            output_loading_info=True,
        )
        found = DepthModel(network.eval().requires_grad_(False), prepare, meaning)
        if info["mismatched_keys"]:
            key = min(info["mismatched_keys"])[0]
            raise InputError(f"{name}: its weights have another shape than its config.json says, {key} for one: {FIT}")
        missing = sorted(info["missing_keys"])
        if missing and _matters(found, missing):
            lacks = missing[0] if len(missing) == 1 else f"{missing[0]} and {len(missing) - 1} more"
            raise InputError(f"{name}: its weights lack {lacks}: {FIT}")
        _lower_linear(network, dtype)
        network.to(device)
    return found


def _transformers() -> Any:
    try:
        with quiet():
            import transformers
            import transformers.utils.logging
    except Exception as error:  # a torchvision of another build raises RuntimeError
        if isinstance(error, ModuleNotFoundError) and error.name in ("transformers", "huggingface_hub"):
            raise InputError(NOT_INSTALLED) from error
        raise InputError(f"transformers cannot be imported ({reason_in_a_line(error)}): install it again") from error
    return transformers


def _prepare(transformers: Any, folder: Path, kind: str, name: str) -> Prepare:
    if kind in SQUARE_ANTIALIAS:
        settings, _ = transformers.ImageProcessingMixin.get_image_processor_dict(str(folder), local_files_only=True)
        return by_settings(settings, SQUARE_ANTIALIAS[kind])
    # Pillow's, everywhere: torchvision's differ from it in the last digits, and cannot be had beside every torch.
    try:
        processor = transformers.AutoImageProcessor.from_pretrained(
            folder, backend="pil", trust_remote_code=False, local_files_only=True
        )
    except (ImportError, ValueError) as error:
        if "torchvision" not in str(error):
            raise
        raise InputError(
            f"{name}: its image processor needs torchvision: install the one that was built for torch "
            f"{torch.__version__}, or give another model"
        ) from error
    return by_processor(processor, kind)


def _matters(model: DepthModel, missing: list[str]) -> bool:
    """Whether the output depends on tensors that the file lacks: DPT has some that it never uses.

    They have random numbers now. With NaN in their place the answer is NaN if one of them is used.
    """
    tensors = model.network.state_dict()
    for key in missing:
        if key in tensors and tensors[key].is_floating_point():
            tensors[key].fill_(torch.nan)
    raw, fov, _ = model(torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0)))
    return not bool(torch.isfinite(raw).all()) or (fov is not None and fov != fov)


def _lower_linear(network: nn.Module, dtype: torch.dtype) -> None:
    """Let the linear layers, where a transformer spends its time, multiply in `dtype`; they take and give float32.

    The last layers of all these models are convolutions and stay float32: eight bits would turn slanted surfaces into
    stairs.
    """
    if dtype == torch.float32:
        return
    for module in network.modules():
        if type(module) is nn.Linear:
            module.to(dtype)
            module.register_forward_pre_hook(lambda _, args: tuple(x.to(dtype) for x in args))
            module.register_forward_hook(lambda _module, _args, output: output.float())


@contextlib.contextmanager
def _one_line(who: str, what: str, advice: str) -> Iterator[None]:
    """Turn whatever transformers and torch raise over a stranger's files into one line (or MemoryShort)."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = reason_in_a_line(error)
        if memory_is_short(error):
            raise MemoryShort(f"{who}: not enough memory: give a smaller model, or close other programs") from error
        raise InputError(f"{who} {what} ({reason}): {advice}") from error


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep the packages from printing warnings, logs and progress bars; what matters is raised."""
    from huggingface_hub import utils

    own = getattr(sys.modules.get("transformers"), "utils", None)  # transformers has progress bars beside the hub's
    with contextlib.ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
        for logger in (logging.getLogger(name) for name in ("transformers", "huggingface_hub", "httpx")):
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
        if not utils.are_progress_bars_disabled():
            stack.callback(utils.enable_progress_bars)
            utils.disable_progress_bars()
        if own is not None and own.logging.is_progress_bar_enabled():
            stack.callback(own.logging.enable_progress_bar)
            own.logging.disable_progress_bar()
        yield


def _read_settings(folder: Path, file: str, name: str) -> dict[str, Any]:
    """The JSON object in a file of the model `name`."""
    try:
        settings = json.loads((folder / file).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{name}: {file} cannot be read ({reason_in_a_line(error)}): give the model's files again"
        ) from error
    if not isinstance(settings, dict):
        raise InputError(f"{name}: {file} is no JSON object: give the model's files again")
    return settings


def _find(model: str, files: list[str]) -> Path:
    """The folder with these files of a model; what is in the cache is taken from there without asking the hub."""
    if os.path.isdir(model) or model.startswith(("./", "../", "/", "~")):
        folder = Path(model).expanduser()
        if not folder.is_dir():
            raise InputError(f"hf:{model}: no such folder: check the name")
    elif _HUB_NAME.fullmatch(model):
        snapshot_download = _hub().snapshot_download
        cached = None
        with contextlib.suppress(OSError), quiet():  # what huggingface_hub says of what is not in the cache is one
            cached = Path(snapshot_download(model, allow_patterns=files, local_files_only=True))
        folder = cached if cached is not None and not _lacks(cached, files) else _from_hub(model, files)
    else:
        raise InputError(f"hf:{model}: neither a folder nor a model of the hub: give a folder, or owner/name")
    if problem := _lacks(folder, files):
        raise InputError(f"hf:{model}: {problem}")
    return folder


def _lacks(folder: Path, files: list[str]) -> str:
    """What a folder lacks of a model's settings, and of its weights where they are among the files; "" for nothing."""
    if not (folder / "config.json").is_file():
        return "has no config.json, so it is no model of transformers: give another"
    if not any((folder / name).is_file() for name in SETTINGS[1:]):
        return f"has no {SETTINGS[1]}, which says how to prepare a photo: give it, or another model"
    index = folder / WEIGHTS[-1]
    if WEIGHTS[0] in files and index.is_file():
        parts = _read_settings(folder, index.name, str(folder)).get("weight_map")
        names = {str(name) for name in parts.values()} if isinstance(parts, dict) else set()
        absent = sorted(name for name in names if not os.path.isfile(folder / name))  # nor one too long
        if absent or not names:
            return f"{index.name} names weights that are not there ({', '.join(absent)[:80]}): give its files again"
    elif WEIGHTS[0] in files and not (folder / WEIGHTS[0]).is_file():
        return f"has no {WEIGHTS[0]}, the only kind of weights that runs no code when it is read: give another model"
    return ""


def fetch_revision(model: str, revision: str, files: Sequence[str], folder: Path) -> None:
    """Bring files of one commit of a hub's model into a folder; goes on where an earlier call broke off.

    InputError where huggingface_hub is not installed, or the hub does not give the files.
    """
    _from_hub(model, list(files), revision=revision, local_dir=folder)
    if absent := [name for name in files if not (folder / name).is_file()]:
        raise InputError(f"hf:{model}: revision {revision} has no {', '.join(absent)}: try again")


def _hub() -> Any:
    """The package huggingface_hub; InputError where it is not installed."""
    try:
        import huggingface_hub.errors
    except ImportError as error:
        raise InputError(NOT_INSTALLED) from error
    return huggingface_hub


def _from_hub(model: str, files: list[str], **options: Any) -> Path:
    """The model's folder in the cache, or in `local_dir`, after what is not in it has been copied there."""
    hub = _hub()
    try:
        with quiet():
            return Path(hub.snapshot_download(model, allow_patterns=files, **options))
    except Exception as error:  # of three libraries, one of them about the network
        if isinstance(error, hub.errors.LocalEntryNotFoundError):
            problem = "not on this machine yet, and the hub cannot be reached: connect, or give a folder"
        elif isinstance(error, hub.errors.GatedRepoError):
            problem = "its owner asks for consent: give it on the model's page, then log in with hf auth login"
        elif isinstance(error, hub.errors.RepositoryNotFoundError):
            problem = "the hub has no such model, or only for its owner: check the name, or log in with hf auth login"
        else:
            problem = f"cannot be fetched from the hub ({reason_in_a_line(error)}): try again, or give a folder"
        raise InputError(f"hf:{model}: {problem}") from error
