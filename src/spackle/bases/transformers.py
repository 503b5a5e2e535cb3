"""The hf base: lift the depth that a model of the transformers library predicts.

Optional: pip install 'spackle-nvs[hf]'.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from PIL import Image
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases import BasePrediction, is_plausible_focal
from spackle.bases.depth import lift_predicted_depth
from spackle.core.camera import Camera
from spackle.core.photo import Photo, resize_photo
from spackle.depth.depth_map import DepthMap, is_valid_depth
from spackle.depth.units import RELATIVE_NEAR_M, near_inverse_depth
from spackle.runtime.device import (
    Precision,
    pick_device,
    pick_dtype,
    report_memory_shortage,
    without_autocast_or_tf32,
)
from spackle.runtime.errors import InputError, as_input_error, reason_in_a_line
from spackle.runtime.progress import Progress

_NEVER_USED = re.compile(
    r".*fusion_stage\.layers\.0\.residual_layer1\..*"
)  # for finer features; never published

Meaning = Literal[
    "metres", "relative disparity", "canonical disparity"
]  # the last: focal length / width / metres
Window = tuple[
    float, ...
]  # the photo in a padded picture: top, bottom, left, right, as shares of the picture's sides
Prepare = Callable[
    [Tensor], tuple[Tensor, Window]
]  # [H, W, 3] sRGB in 0..1 to pixel values [1, 3, h, w]
WHOLE_PICTURE: Window = (0.0, 1.0, 0.0, 1.0)
OUTPUT_MEANINGS: dict[
    str, Meaning
] = {  # by `model_type` of config.json; depth_anything may also be metric: see `meaning_of`
    "depth_anything": "relative disparity",
    "depth_pro": "canonical disparity",
    "dpt": "relative disparity",
    "glpn": "metres",
    "zoedepth": "metres",
}
# Relative disparity has no known unit and no known zero. A disparity of zero is put at FARTHEST_M, the greatest at
# NEAREST_M: the ratio of 20 gives a clear parallax, and noise far away makes no depth edges. The smallest disparity is
# not stretched to FARTHEST_M, because a wall seen from the front would become a valley.
FARTHEST_M = 30.0
MIN_RELATIVE_SPREAD = 1e-5  # relative spread below which all pixels count as equal


class HfBase:
    """Any depth model that transformers runs and whose output has a known meaning (see `meaning_of`), frozen."""

    def __init__(
        self, name: str, network: nn.Module, prepare: Prepare, meaning: Meaning, precision: str
    ) -> None:
        """Use a loaded network; `precision` is its name in the report."""
        self.name, self.network, self.prepare, self.meaning = name, network, prepare, meaning
        self.precision = precision

    @staticmethod
    def load(model: str, *, device: str | None = None, precision: Precision = "auto") -> HfBase:
        """Read a model from a folder, or by owner/name from the hub's cache or the hub; no code of the model runs.

        At the precision auto, matrix products are bf16 if the hardware multiplies it natively. InputError for a device,
        package, model or file that is missing, broken or unknown, and for too little memory.
        """
        target = pick_device(device)
        dtype, name, source = (
            pick_dtype(precision, target),
            f"hf:{model}",
            os.path.expanduser(model),
        )
        transformers = _transformers()
        problem = "cannot be loaded ({reason}): check name and network, or give a folder with all the model's files"
        with as_input_error(name, problem), report_memory_shortage("give a smaller model"):
            try:
                network, prepare, meaning = _read(transformers, source, name, from_hub=False)
            except OSError:  # the hub's cache lacks a file
                if os.path.isdir(source):
                    raise
                import huggingface_hub  # comes with transformers, which would ask six times: half a minute offline

                huggingface_hub.get_hf_file_metadata(
                    huggingface_hub.hf_hub_url(source, "config.json")
                )
                network, prepare, meaning = _read(transformers, source, name, from_hub=True)
            _lower_linear(network, dtype)
            network.to(target)
        return HfBase(name, network, prepare, meaning, "bf16" if dtype.itemsize == 2 else "fp32")

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the pixels of the photo at its working size, as `lift_rgbd` makes them.

        If the focal length is unknown, the model's estimate is used. InputError if the model fails on this photo, its
        output is no depth, or memory is short.
        """
        photo = resize_photo(photo)
        problem = f"{self.name} fails ({{reason}}): give another photo or model"
        with as_input_error(photo.path, problem), report_memory_shortage("give a smaller model"):
            raw, fov = self._ask(photo.rgb)
        camera, lens_source = photo.camera, ""
        if fov is not None and 0 < fov < 180 and photo.focal_source.is_assumed:
            focal = 0.5 * photo.width / math.tan(math.radians(fov) / 2)
            if is_plausible_focal(focal, photo.width, photo.height):
                camera, lens_source = (
                    Camera.from_focal(focal, photo.width, photo.height),
                    "Depth Pro",
                )
        depth = to_depth_map(
            raw, self.meaning, camera.focal[0] / photo.width, self.name, photo.path
        )
        prediction = lift_predicted_depth(photo, depth, camera)
        relative = self.meaning == "relative disparity"
        scale = (
            f"relative, scaled to {RELATIVE_NEAR_M:g}–{FARTHEST_M:g} m"
            if relative
            else "metric, by the model"
        )
        notes = {**prediction.notes, "precision": self.precision, "depth_scale": scale}
        return dataclasses.replace(prediction, notes=notes, lens_source=lens_source)

    @torch.no_grad()
    def _ask(self, rgb: Tensor) -> tuple[Tensor, float | None]:
        """The network's output [h, w] float32 on the CPU, and the horizontal field of view if it predicts one."""
        pixels, window = self.prepare(rgb)
        device = next(self.network.parameters()).device
        with without_autocast_or_tf32(device):
            output = self.network(pixel_values=pixels.to(device))
        raw, fov = output.predicted_depth.float().cpu(), getattr(output, "field_of_view", None)
        sides = (raw.shape[1], raw.shape[1], raw.shape[2], raw.shape[2])
        top, bottom, left, right = (
            round(share * side) for share, side in zip(window, sides, strict=True)
        )
        return raw[0, top:bottom, left:right], None if fov is None else float(fov)


def meaning_of(settings: Mapping[str, Any], name: str) -> Meaning:
    """The meaning of a model's output by its config.json; InputError if it is unknown, because a guess may be wrong."""
    kind, stated = (
        str(settings.get("model_type")),
        str(settings.get("depth_estimation_type", "relative")),
    )
    backbone = settings.get("backbone_config")
    dinov2 = (
        kind == "dpt" and isinstance(backbone, dict) and backbone.get("model_type") == "dinov2"
    )  # no MiDaS
    if kind not in OUTPUT_MEANINGS or dinov2 or stated not in ("relative", "metric"):
        known = ", ".join(OUTPUT_MEANINGS)
        raise InputError(
            f"{name}: the output of {kind[:40]!a} has no known meaning: give a model of type {known}"
        )
    return "metres" if kind == "depth_anything" and stated == "metric" else OUTPUT_MEANINGS[kind]


def to_depth_map(raw: Tensor, meaning: Meaning, focal: float, name: str, photo: Path) -> DepthMap:
    """Convert a model's output [h, w] float32 to metres; pixels without a positive finite depth are not valid.

    Canonical disparity depends on `focal`, the photo's focal length over its width. InputError, which names `name` and
    `photo`, if the output has no positive number or is constant.
    """
    known = torch.isfinite(raw)
    low, high = (
        (float(extreme) for extreme in raw[known].aminmax())
        if known.any()
        else (math.nan, math.nan)
    )
    if not high > max(0, low + MIN_RELATIVE_SPREAD * max(abs(low), abs(high))):
        why = "its weights are broken or need --precision fp32, or the photo is empty"
        raise InputError(
            f"{photo}: {name} predicts {low:g} to {high:g}, which cannot be depth: {why}"
        )
    if meaning == "metres":
        depth = raw
    elif meaning == "relative disparity":
        near = float(near_inverse_depth(raw[known]))
        share = (raw / (near if near > 0 else high)).clamp(0, 1)
        depth = 1 / ((1 - share) / FARTHEST_M + share / RELATIVE_NEAR_M)
    else:
        depth = 1 / (raw / focal).clamp(1e-4, 1e4)  # in 1/m: Depth Pro's own limits
    valid = known & is_valid_depth(depth)
    return DepthMap(
        depth.where(valid, 0.0),
        valid,
        None,
        None,
        "depth" if meaning == "metres" else "disparity",
        photo,
    )


def _transformers() -> Any:
    os.environ.setdefault(
        "DISABLE_SAFETENSORS_CONVERSION", "1"
    )  # else it asks the hub to convert other formats
    try:
        import transformers
        import transformers.utils.logging as logs
    except Exception as error:  # a torchvision of another build raises RuntimeError
        problem = f"depth models need transformers ({reason_in_a_line(error)})"
        raise InputError(f"{problem}: pip install 'spackle-nvs[hf]'") from error
    logs.set_verbosity(logs.CRITICAL)  # problems that matter are raised
    logs.disable_progress_bar()
    return transformers


def _read(
    transformers: Any, source: str, name: str, *, from_hub: bool
) -> tuple[nn.Module, Prepare, Meaning]:
    """A float32 network from safetensors, its preprocessing, and its output's meaning; OSError for a missing file."""
    files = {"local_files_only": not from_hub, "trust_remote_code": False}
    settings, _ = transformers.PretrainedConfig.get_config_dict(source, **files)
    meaning, kind = (
        meaning_of(settings, name),
        str(settings["model_type"]),
    )  # before weights are loaded
    if kind == "depth_pro":  # its image processor needs torchvision
        prepare = _stretched(
            transformers.ImageProcessingMixin.get_image_processor_dict(source, **files)[0]
        )
    else:  # always Pillow's: torchvision's results differ in the last digits, and it does not fit every torch
        prepare = _processed(
            transformers.AutoImageProcessor.from_pretrained(source, backend="pil", **files), kind
        )
    # Half precision is widened, because only matrix products gain by it. Mismatched shapes are reported below.
    options = {"dtype": torch.float32, "use_safetensors": True, "ignore_mismatched_sizes": True}
    network, info = transformers.AutoModelForDepthEstimation.from_pretrained(
        source, weights_only=True, output_loading_info=True, **options, **files
    )
    wrong = [f"have another shape for {key}" for key, *_ in sorted(info["mismatched_keys"])]
    wrong += [
        f"lack {key}" for key in sorted(info["missing_keys"]) if not _NEVER_USED.fullmatch(key)
    ]
    if wrong:
        raise InputError(
            f"{name}: its weights {wrong[0]}: give the weights that belong to its config.json"
        )
    return network.eval().requires_grad_(False), prepare, meaning


def _lower_linear(network: nn.Module, dtype: torch.dtype) -> None:
    """Let the linear layers, which take most of the time, multiply in `dtype`; their inputs and outputs are float32."""
    # The last layers are convolutions and stay float32: eight bits would turn slanted surfaces into stairs.
    for module in network.modules():
        if type(module) is nn.Linear and dtype != torch.float32:
            module.to(dtype)
            module.register_forward_pre_hook(lambda _, args: tuple(x.to(dtype) for x in args))
            module.register_forward_hook(lambda _module, _args, output: output.float())


def _processed(processor: Any, kind: str) -> Prepare:
    def prepare(rgb: Tensor) -> tuple[Tensor, Window]:
        image = Image.fromarray((rgb * 255).round().to(torch.uint8).numpy())
        pixels = torch.as_tensor(processor(images=image, return_tensors="pt")["pixel_values"])
        window = WHOLE_PICTURE
        if (
            kind == "zoedepth" and processor.do_pad
        ):  # reflects the photo beyond its borders, then resizes both together
            window = ()
            for side in rgb.shape[:2]:
                margin = int(math.sqrt(side / 2) * 3)
                window += (margin / (side + 2 * margin), (margin + side) / (side + 2 * margin))
        return pixels, window

    return prepare


def _stretched(settings: Mapping[str, Any]) -> Prepare:
    """Preprocessing by preprocessor_config.json: stretch the photo bilinearly to one size, and normalise it."""
    size = int(settings["size"]["height"]), int(settings["size"]["width"])
    if settings.get("resample", 2) != Image.Resampling.BILINEAR or not (
        1 <= min(size) <= max(size) <= 4096
    ):
        raise ValueError(f"an input of {size[1]}×{size[0]}, or resized otherwise than bilinear")
    mean, std = (torch.tensor(settings[key]).float() for key in ("image_mean", "image_std"))

    def prepare(rgb: Tensor) -> tuple[Tensor, Window]:
        return interpolate(
            ((rgb - mean) / std).permute(2, 0, 1)[None], size=size, mode="bilinear"
        ), WHOLE_PICTURE

    return prepare
