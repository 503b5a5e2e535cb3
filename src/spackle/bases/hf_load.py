"""Depth models by way of transformers (optional: pip install 'spackle-nvs[hf]')."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from spackle.bases.device import MemoryShort, memory_is_short
from spackle.bases.hf_hub import NOT_INSTALLED, quiet, read_settings, settings_folder, weights_folder
from spackle.bases.hf_input import SQUARE_ANTIALIAS, Prepare, Window, by_processor, by_settings
from spackle.bases.hf_kinds import Meaning, meaning_of
from spackle.errors import InputError, reason_in_a_line

FIT = "give the weights that belong to its config.json"
_PROBE = (64, 64)  # height and width of a picture that only has to reach every weight


@dataclasses.dataclass(frozen=True)
class DepthModel:
    """A depth network in evaluation mode, with all that is needed to ask it."""

    network: nn.Module
    prepare: Prepare
    meaning: Meaning

    @torch.no_grad()
    def __call__(self, rgb: Tensor) -> tuple[Tensor, float | None, Window]:
        """What the network says about a photo, [H, W, 3] sRGB in 0..1.

        Returns:
            its numbers [h, w] float32 on the processor, the horizontal field of view in degrees where it gives one,
            and the part of them that is the photo.
        """
        pixels, window = self.prepare(rgb)
        with quiet():
            output = self.network(pixel_values=pixels.to(next(self.network.parameters()).device))
        raw, fov = output.predicted_depth.float().cpu(), getattr(output, "field_of_view", None)
        if raw.ndim != 3 or len(raw) != 1:
            raise ValueError(f"an output of shape {tuple(raw.shape)}")
        return raw[0], None if fov is None else float(fov), window


def load_model(model: str, name: str, device: torch.device, dtype: torch.dtype) -> DepthModel:
    """Read a depth model from safetensors; nothing of its own code is run.

    Args:
        model: a folder, or owner/name on the hub.
        name: what messages call it.
        device: where it runs.
        dtype: of the products of matrices, which are most of the work; all else stays in float32.

    Raises:
        InputError: a package or file is missing, or the model is broken, not a depth model, or too large.
    """
    meaning_of(read_settings(settings_folder(model), "config.json", name), name)  # before the weights come
    folder = weights_folder(model)
    settings = read_settings(folder, "config.json", name)
    meaning, kind = meaning_of(settings, name), str(settings["model_type"])
    transformers = _transformers()
    with one_line(name, "cannot be loaded", "give its files again, or another model"), _silent(transformers):
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
        lower(network, dtype)
        network.to(device)
    return found


@contextmanager
def one_line(who: str, what: str, advice: str) -> Iterator[None]:
    """Turn whatever transformers and torch raise over a stranger's files into one line.

    Raises:
        InputError: `who`, `what` went wrong, why, and the advice.
        MemoryShort: memory was short.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = reason_in_a_line(error)
        if memory_is_short(error):
            raise MemoryShort(f"{who}: not enough memory: give a smaller model, or close other programs") from error
        raise InputError(f"{who} {what} ({reason}): {advice}") from error


def lower(network: nn.Module, dtype: torch.dtype) -> None:
    """Let the linear layers, where a transformer spends its time, multiply in `dtype`, in place.

    What they take and give stays float32. The last layers of all these models are convolutions, which stay
    float32 too: eight bits would turn slanted surfaces into stairs.
    """
    if dtype == torch.float32:
        return
    for module in network.modules():
        if type(module) is nn.Linear:
            module.to(dtype)
            module.register_forward_pre_hook(lambda _, args: tuple(x.to(dtype) for x in args))
            module.register_forward_hook(lambda _module, _args, output: output.float())


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
    """Whether the output depends on tensors that the file lacks: DPT has some, in its code, that are never used.

    They have random numbers now. With NaN in their place the answer is NaN if one of them is used.
    """
    tensors = model.network.state_dict()
    for key in missing:
        if key in tensors and tensors[key].is_floating_point():
            tensors[key].fill_(torch.nan)
    raw, fov, _ = model(torch.rand(*_PROBE, 3, generator=torch.Generator().manual_seed(0)))
    return not bool(torch.isfinite(raw).all()) or (fov is not None and fov != fov)


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


@contextmanager
def _silent(transformers: Any) -> Iterator[None]:
    """`quiet`, and transformers' own progress bars with it."""
    bars = transformers.utils.logging
    enabled = bars.is_progress_bar_enabled()
    try:
        with quiet():
            bars.disable_progress_bar()
            yield
    finally:
        if enabled:
            bars.enable_progress_bar()
