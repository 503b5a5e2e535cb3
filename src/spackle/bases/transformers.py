"""The hf base: lift the depth that a model of the transformers library predicts.

`HfBase` is the base. `meaning_of` says what a model's output means, by its config.json; models
whose output has no known meaning are refused. Optional: pip install 'spackle-nvs[hf]'.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

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

# Weights for finer features at the coarsest level, which has none: no model publishes them.
_NEVER_USED_WEIGHTS = re.compile(r".*fusion_stage\.layers\.0\.residual_layer1\..*")

# Canonical disparity is focal length / width / metres.
Meaning = Literal["metres", "relative disparity", "canonical disparity"]
# By `model_type` of config.json; depth_anything may also be metric (see `meaning_of`).
OUTPUT_MEANINGS: dict[str, Meaning] = {
    "depth_anything": "relative disparity",
    "depth_pro": "canonical disparity",
    "dpt": "relative disparity",
    "glpn": "metres",
    "zoedepth": "metres",
}
MIN_DISPARITY_PER_M = 1e-4  # 1/m, and the next one: Depth Pro's own limits of its output
MAX_DISPARITY_PER_M = 1e4
# Relative disparity has no known unit and no known zero. A disparity of zero is put at FARTHEST_M,
# the greatest at 1.5 m: the ratio of 20 gives a clear parallax, and noise far away makes no depth
# edges. The smallest disparity is not stretched to FARTHEST_M, because a wall seen from the front
# would become a valley.
FARTHEST_M = 30.0
MIN_RELATIVE_SPREAD = 1e-5  # with less between the least and greatest value, all count as equal
MAX_INPUT_SIDE = 4096  # pixels of a network's input; a damaged file may ask for more
MEMORY_ADVICE = "give a smaller model"


class PhotoWindow(NamedTuple):
    """Where a photo lies in a padded picture, as shares of the picture's height and width."""

    top: float
    bottom: float
    left: float
    right: float


WHOLE_PICTURE = PhotoWindow(top=0.0, bottom=1.0, left=0.0, right=1.0)
# Makes a network's input [1, 3, h, w] of a photo [H, W, 3], sRGB in 0..1, and says where in the
# input the photo is.
Preprocessing = Callable[[Tensor], tuple[Tensor, PhotoWindow]]


class HfBase:
    """Any depth model that transformers runs and whose output has a known meaning, frozen."""

    def __init__(
        self,
        name: str,
        network: nn.Module,
        preprocess: Preprocessing,
        meaning: Meaning,
        precision: str,
    ) -> None:
        """Use a loaded network; `precision` is its name in the report."""
        self.name = name
        self.network = network
        self.preprocess = preprocess
        self.meaning = meaning
        self.precision = precision

    @staticmethod
    def load(model: str, *, device: str | None = None, precision: Precision = "auto") -> HfBase:
        """Read a model from a folder, or by owner/name from the hub's cache or the hub.

        No code of the model runs. At the precision auto, matrix products are bf16 if the hardware
        multiplies it natively. `device` is cpu or a CUDA device; None: CUDA if available.
        InputError for a device, package, model or file that is missing, broken or unknown, and for
        too little memory.
        """
        target = pick_device(device)
        dtype = pick_dtype(precision, target)
        name = f"hf:{model}"
        source = os.path.expanduser(model)
        transformers = _import_transformers()
        problem = (
            "cannot be loaded ({reason}): check name and network, "
            "or give a folder with all the model's files"
        )
        with as_input_error(name, problem), report_memory_shortage(MEMORY_ADVICE):
            try:
                loaded = _load_model(transformers, source, name, from_hub=False)
            except OSError:  # the hub's cache lacks a file
                if os.path.isdir(source):
                    raise
                _check_hub(source)
                loaded = _load_model(transformers, source, name, from_hub=True)
            network, preprocess, meaning = loaded
            _lower_linear_layers(network, dtype)
            network.to(target)
        precision_name = "bf16" if dtype == torch.bfloat16 else "fp32"
        return HfBase(name, network, preprocess, meaning, precision_name)

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the photo's pixels at its working size, on the surfaces that it shows.

        If the focal length is unknown, the model's estimate is used. InputError if the model fails
        on this photo, its output is no depth, or memory is short.
        """
        photo = resize_photo(photo)
        problem = f"{self.name} fails ({{reason}}): give another photo or model"
        with as_input_error(photo.path, problem), report_memory_shortage(MEMORY_ADVICE):
            output, fov_degrees = self._run_network(photo.rgb)

        camera = photo.camera
        lens_source = ""
        if fov_degrees is not None and photo.focal_source.is_assumed:
            predicted_camera = _camera_of_fov(fov_degrees, photo)
            if predicted_camera is not None:
                camera = predicted_camera
                lens_source = "Depth Pro"  # the only model that predicts a field of view
        focal_per_width = camera.focal[0] / photo.width
        # Canonical disparity needs the focal length: a true one makes the metres true.
        depth = to_depth_map(output, self.meaning, focal_per_width, self.name, photo.path)
        prediction = lift_predicted_depth(photo, depth, camera)

        scale = "metric, by the model"
        if self.meaning == "relative disparity":
            scale = f"relative, scaled to {RELATIVE_NEAR_M:g}–{FARTHEST_M:g} m"
        notes = {**prediction.notes, "precision": self.precision, "depth_scale": scale}
        return dataclasses.replace(prediction, notes=notes, lens_source=lens_source)

    @torch.no_grad()
    def _run_network(self, rgb: Tensor) -> tuple[Tensor, float | None]:
        """The network's output [h, w] for a photo [H, W, 3], sRGB in 0..1, without padding.

        It is float32 on the CPU. The second value is the horizontal field of view in degrees, if
        the network predicts one.
        """
        pixels, window = self.preprocess(rgb)
        device = next(self.network.parameters()).device
        with without_autocast_or_tf32(device):
            output = self.network(pixel_values=pixels.to(device))

        # Only the photo's part of a padded picture is wanted.
        depth = output.predicted_depth.float().cpu()  # [1, h, w]
        height, width = depth.shape[1:]
        rows = slice(round(window.top * height), round(window.bottom * height))
        columns = slice(round(window.left * width), round(window.right * width))
        fov_degrees = getattr(output, "field_of_view", None)
        return depth[0, rows, columns], None if fov_degrees is None else float(fov_degrees)


def _camera_of_fov(fov_degrees: float, photo: Photo) -> Camera | None:
    """The camera with a horizontal field of view; None if that is no plausible one."""
    if not 0 < fov_degrees < 180:
        return None
    # tan(fov / 2) = (width / 2) / focal length
    focal_px = 0.5 * photo.width / math.tan(math.radians(fov_degrees) / 2)
    if not is_plausible_focal(focal_px, photo.width, photo.height):
        return None
    return Camera.from_focal(focal_px, photo.width, photo.height)


def meaning_of(settings: Mapping[str, Any], name: str) -> Meaning:
    """The meaning of a model's output by its config.json.

    InputError, which names the model, if it is unknown: a guess may be wrong.
    """
    # The file is untrusted: its values may have any type.
    kind = str(settings.get("model_type"))
    stated = str(settings.get("depth_estimation_type", "relative"))
    backbone = settings.get("backbone_config")
    has_dinov2 = isinstance(backbone, dict) and backbone.get("model_type") == "dinov2"
    # A dpt with DINOv2 is not MiDaS, and may predict anything.
    is_other_dpt = kind == "dpt" and has_dinov2
    if kind not in OUTPUT_MEANINGS or is_other_dpt or stated not in ("relative", "metric"):
        known = ", ".join(OUTPUT_MEANINGS)
        raise InputError(
            f"{name}: the output of {kind[:40]!a} has no known meaning: "
            f"give a model of type {known}"
        )
    if kind == "depth_anything" and stated == "metric":
        return "metres"
    return OUTPUT_MEANINGS[kind]


def to_depth_map(
    output: Tensor, meaning: Meaning, focal_per_width: float, name: str, photo: Path
) -> DepthMap:
    """Convert a model's output [h, w] float32 to metres.

    Pixels without a positive finite depth are not valid. Canonical disparity depends on
    `focal_per_width`, the photo's focal length over its width. InputError, which names the model
    and the photo, if the output has no positive number or is constant.
    """
    known = torch.isfinite(output)
    greatest = _check_contrast(output[known], name, photo)
    if meaning == "metres":
        depth = output
    elif meaning == "relative disparity":
        near_disparity = float(near_inverse_depth(output[known]))
        if not near_disparity > 0:  # nearly all values are negative
            near_disparity = greatest
        # 0 at FARTHEST_M, 1 at the nearest surface.
        nearness = (output / near_disparity).clamp(0, 1)
        depth = 1 / ((1 - nearness) / FARTHEST_M + nearness / RELATIVE_NEAR_M)
    else:
        disparity_per_m = output / focal_per_width
        depth = 1 / disparity_per_m.clamp(MIN_DISPARITY_PER_M, MAX_DISPARITY_PER_M)

    # A metric model may predict 0 or less for the sky.
    valid = known & is_valid_depth(depth)
    return DepthMap(
        depth.where(valid, 0.0),
        valid,
        K=None,
        quantum=None,
        quantity="depth" if meaning == "metres" else "disparity",
        path=photo,
    )


def _check_contrast(values: Tensor, name: str, photo: Path) -> float:
    """The greatest of a model's finite outputs [N].

    InputError, which names the model and the photo, if there are none, none is positive, or all are
    nearly equal.
    """
    found = "no finite number"
    if len(values):
        least, greatest = (float(extreme) for extreme in values.aminmax())
        min_spread = MIN_RELATIVE_SPREAD * max(abs(least), abs(greatest))
        if greatest > 0 and greatest > least + min_spread:
            return greatest
        found = f"{least:g} to {greatest:g}"
    raise InputError(
        f"{photo}: {name} predicts {found}, which cannot be depth: "
        "its weights are broken or need `precision` fp32, or the photo is empty"
    )


def _import_transformers() -> Any:
    """The module transformers, silenced; InputError that says what to install if it is missing."""
    # Otherwise it asks the hub to convert models of other formats.
    os.environ.setdefault("DISABLE_SAFETENSORS_CONVERSION", "1")
    try:
        import transformers
        import transformers.utils.logging as logs
    except Exception as error:  # a torchvision of another build raises RuntimeError
        reason = reason_in_a_line(error)
        raise InputError(
            f"depth models need transformers ({reason}): pip install 'spackle-nvs[hf]'"
        ) from error
    logs.set_verbosity(logs.CRITICAL)  # problems that matter are raised
    logs.disable_progress_bar()
    return transformers


def _check_hub(model: str) -> None:
    """Ask the hub once whether it has a model (owner/name); an exception if not.

    transformers itself would ask six times, which takes half a minute without a network.
    """
    import huggingface_hub  # comes with transformers

    huggingface_hub.get_hf_file_metadata(huggingface_hub.hf_hub_url(model, "config.json"))


def _load_model(
    transformers: Any, source: str, name: str, *, from_hub: bool
) -> tuple[nn.Module, Preprocessing, Meaning]:
    """A float32 network from safetensors, its preprocessing, and its output's meaning.

    `source` is a folder or owner/name; only `from_hub` may use the internet. OSError for a missing
    file; InputError, which calls the model `name`, for weights that do not fit.
    """
    # A model's folder may hold Python code, which must not run.
    files = {"local_files_only": not from_hub, "trust_remote_code": False}
    settings, _ = transformers.PretrainedConfig.get_config_dict(source, **files)
    meaning = meaning_of(settings, name)  # before gigabytes of weights are loaded
    kind = str(settings["model_type"])
    if kind == "depth_pro":  # its image processor needs torchvision
        mixin = transformers.ImageProcessingMixin
        processor_settings, _ = mixin.get_image_processor_dict(source, **files)
        preprocess = _stretch_to_input(processor_settings)
    else:
        # Always Pillow's: torchvision's results differ in the last digits, and torchvision does not
        # fit every torch.
        processor = transformers.AutoImageProcessor.from_pretrained(source, backend="pil", **files)
        preprocess = _run_processor(processor, is_zoedepth=kind == "zoedepth")

    network, info = transformers.AutoModelForDepthEstimation.from_pretrained(
        source,
        dtype=torch.float32,  # half precision is widened: only matrix products gain by it
        use_safetensors=True,
        weights_only=True,
        ignore_mismatched_sizes=True,  # they are reported below
        output_loading_info=True,
        **files,
    )
    _check_loading_info(info, name)
    return network.eval().requires_grad_(False), preprocess, meaning


def _check_loading_info(info: Mapping[str, Any], name: str) -> None:
    """InputError if weights were missing or of another shape when transformers loaded a model.

    `info` is what transformers says about it.
    """
    # transformers fills what is missing with random numbers, and goes on.
    problems = [f"have another shape for {key}" for key, *_ in sorted(info["mismatched_keys"])]
    problems += [
        f"lack {key}"
        for key in sorted(info["missing_keys"])
        if not _NEVER_USED_WEIGHTS.fullmatch(key)
    ]
    if problems:
        raise InputError(
            f"{name}: its weights {problems[0]}: give the weights that belong to its config.json"
        )


def _lower_linear_layers(network: nn.Module, dtype: torch.dtype) -> None:
    """Let the linear layers, which take most of the time, multiply in `dtype`.

    Their inputs and outputs stay float32. The last layers are convolutions and stay float32: the
    eight bits of bfloat16 would turn slanted surfaces into stairs.
    """
    if dtype == torch.float32:
        return

    def lower_inputs(layer: nn.Module, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        return tuple(x.to(dtype) for x in inputs)

    def widen_output(layer: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
        return output.float()

    for module in network.modules():
        if type(module) is nn.Linear:
            module.to(dtype)
            module.register_forward_pre_hook(lower_inputs)
            module.register_forward_hook(widen_output)


def _run_processor(processor: Any, is_zoedepth: bool) -> Preprocessing:
    """Preprocessing by an image processor of transformers.

    ZoeDepth's pads the photo with its mirror image, and resizes both together.
    """
    is_padded = is_zoedepth and processor.do_pad

    def preprocess(rgb: Tensor) -> tuple[Tensor, PhotoWindow]:
        image = Image.fromarray((rgb * 255).round().to(torch.uint8).numpy())
        inputs = processor(images=image, return_tensors="pt")
        pixels = torch.as_tensor(inputs["pixel_values"])
        height, width = rgb.shape[:2]
        return pixels, _zoedepth_window(height, width) if is_padded else WHOLE_PICTURE

    return preprocess


def _zoedepth_window(height: int, width: int) -> PhotoWindow:
    """Where a photo of this size in pixels lies in the picture that ZoeDepth's processor pads.

    The margin is 3 · sqrt(side / 2) pixels on each side.
    """
    margin_y = int(math.sqrt(height / 2) * 3)
    margin_x = int(math.sqrt(width / 2) * 3)
    padded_height = height + 2 * margin_y
    padded_width = width + 2 * margin_x
    return PhotoWindow(
        top=margin_y / padded_height,
        bottom=(margin_y + height) / padded_height,
        left=margin_x / padded_width,
        right=(margin_x + width) / padded_width,
    )


def _stretch_to_input(settings: Mapping[str, Any]) -> Preprocessing:
    """Preprocessing by preprocessor_config.json: normalise a photo, and stretch it to one size.

    ValueError for a size that is impossible, or another filter than the bilinear one.
    """
    height = int(settings["size"]["height"])
    width = int(settings["size"]["width"])
    # What Depth Pro's own processor does, and nothing else, is done here without torchvision.
    filter_number = settings.get("resample", Image.Resampling.BILINEAR)
    is_possible = 1 <= min(height, width) <= max(height, width) <= MAX_INPUT_SIDE
    if filter_number != Image.Resampling.BILINEAR or not is_possible:
        raise ValueError(f"an input of {width}×{height}, or resized otherwise than bilinear")
    mean = torch.tensor(settings["image_mean"]).float()  # [3]
    std = torch.tensor(settings["image_std"]).float()

    def preprocess(rgb: Tensor) -> tuple[Tensor, PhotoWindow]:
        normalised = ((rgb - mean) / std).permute(2, 0, 1)[None]  # [1, 3, H, W]
        pixels = interpolate(normalised, size=(height, width), mode="bilinear")
        return pixels, WHOLE_PICTURE

    return preprocess
