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
from spackle.bases.model_limits import check_settings, check_weight_size
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
# Depth Pro's own limits of the inverse depth that it predicts, in 1/m.
MIN_INVERSE_DEPTH_PER_M = 1e-4
MAX_INVERSE_DEPTH_PER_M = 1e4
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
        """Use a loaded network.

        Args:
            name: the base's name in messages and reports, "hf:" and the model.
            network: predicts depth or disparity.
            preprocess: makes the network's input of a photo.
            meaning: what the numbers of the network's output are.
            precision: number type of the linear layers, for the report: fp32 or bf16.
        """
        self.name = name
        self.network = network
        self.preprocess = preprocess
        self.meaning = meaning
        self.precision = precision

    @staticmethod
    def load(model: str, *, device: str | None = None, precision: Precision = "auto") -> HfBase:
        """Load a depth model of the transformers library. No code of the model runs.

        Args:
            model: a folder, or owner/name of a model on the Hugging Face hub, which is downloaded
                unless the hub's cache on this machine holds it.
            device: cpu or a CUDA device; None: CUDA if available.
            precision: number type of matrix products; auto is bf16 if the hardware multiplies it
                natively.

        Raises:
            InputError: a device, package, model or file is missing, broken or unknown, or memory is
                short.
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
            # The hub is asked only for what is missing: a cached model loads without a network.
            try:
                loaded = _load_model(transformers, source, name, from_hub=False)
            except OSError:  # the folder, or the hub's cache, lacks a file
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
        """Gaussians of the photo's pixels, on the surfaces that it shows.

        The photo is first resized to its working size (the long side is at most 1536 pixels). If
        its focal length is unknown, the model's estimate is used, if it makes one. InputError if
        the model fails on this photo, its output is no depth, or memory is short.
        """
        photo = resize_photo(photo)
        problem = f"{self.name} fails ({{reason}}): give another photo or model"
        with as_input_error(photo.path, problem), report_memory_shortage(MEMORY_ADVICE):
            output, fov_degrees = self._run_network(photo.rgb)

        camera = photo.camera
        lens_source = ""  # the report then names the source of the photo's focal length
        if fov_degrees is not None and photo.focal_source.is_assumed:
            predicted_camera = _camera_of_fov(fov_degrees, photo)
            if predicted_camera is not None:
                camera = predicted_camera
                lens_source = "Depth Pro"  # the only model that predicts a field of view
        # Needed for a model that predicts canonical disparity, focal length / width / depth.
        focal_per_width = camera.focal[0] / photo.width
        depth = to_depth_map(output, self.meaning, focal_per_width, self.name, photo.path)
        prediction = lift_predicted_depth(photo, depth, camera)

        scale = "metric, by the model"
        if self.meaning == "relative disparity":
            scale = f"relative, scaled to {RELATIVE_NEAR_M:g}–{FARTHEST_M:g} m"
        notes = {**prediction.notes, "precision": self.precision, "depth_scale": scale}
        return dataclasses.replace(prediction, notes=notes, lens_source=lens_source)

    @torch.no_grad()
    def _run_network(self, rgb: Tensor) -> tuple[Tensor, float | None]:
        """The network's output for a photo [H, W, 3], sRGB in 0..1.

        Returns:
            The output [h, w] for the photo without padding, float32 on the CPU, and the horizontal
            field of view in degrees, or None if the network predicts none.
        """
        pixels, window = self.preprocess(rgb)
        device = next(self.network.parameters()).device
        with without_autocast_or_tf32(device):
            output = self.network(pixel_values=pixels.to(device))

        # Preprocessing may pad the photo: only the window that shows the photo is kept.
        depth = output.predicted_depth.float().cpu()  # [1, h, w]
        height, width = depth.shape[1:]
        rows = slice(round(window.top * height), round(window.bottom * height))
        columns = slice(round(window.left * width), round(window.right * width))
        # Only Depth Pro's output has a field of view.
        fov_degrees = getattr(output, "field_of_view", None)
        if fov_degrees is not None:
            fov_degrees = float(fov_degrees)
        return depth[0, rows, columns], fov_degrees


def _camera_of_fov(fov_degrees: float, photo: Photo) -> Camera | None:
    """The photo's camera, if `fov_degrees` is its horizontal field of view; None if implausible."""
    if not 0 < fov_degrees < 180:
        return None
    # tan(fov / 2) = (width / 2) / focal length
    focal_px = 0.5 * photo.width / math.tan(math.radians(fov_degrees) / 2)
    if not is_plausible_focal(focal_px, photo.width, photo.height):
        return None
    return Camera.from_focal(focal_px, photo.width, photo.height)


def meaning_of(settings: Mapping[str, Any], name: str) -> Meaning:
    """What the numbers of a model's output are, according to its config.json (`settings`).

    InputError, which calls the model `name`, if config.json does not tell: a guess may be wrong.
    """
    # The file is untrusted, and its values may have any type; hence `str`.
    kind = str(settings.get("model_type"))
    depth_type = str(settings.get("depth_estimation_type", "relative"))
    backbone = settings.get("backbone_config")
    has_dinov2 = isinstance(backbone, dict) and backbone.get("model_type") == "dinov2"
    # Models of type dpt are MiDaS models, with a known output. With DINOv2 as the backbone, such
    # a model is no MiDaS, and may predict anything.
    is_other_dpt = kind == "dpt" and has_dinov2
    if kind not in OUTPUT_MEANINGS or is_other_dpt or depth_type not in ("relative", "metric"):
        known = ", ".join(OUTPUT_MEANINGS)
        raise InputError(
            # At most 40 characters of the untrusted type, escaped to ASCII (!a).
            f"{name}: the output of {kind[:40]!a} has no known meaning: "
            f"give a model of type {known}"
        )
    if kind == "depth_anything" and depth_type == "metric":
        return "metres"
    return OUTPUT_MEANINGS[kind]


def to_depth_map(
    output: Tensor, meaning: Meaning, focal_per_width: float, name: str, photo: Path
) -> DepthMap:
    """Convert a model's output [h, w] float32 to a depth map in metres.

    Args:
        output: metres; or relative disparity, which is inverse depth with unknown unit and zero; or
            canonical disparity, which is focal length / width / metres.
        meaning: which of these it is.
        focal_per_width: the photo's focal length over its width.
        name: the model, for messages.
        photo: the photo's path, for messages.

    Returns:
        The map, in which only pixels with a positive finite depth are valid.

    Raises:
        InputError: the output has no positive number, or is constant.
    """
    known = torch.isfinite(output)
    greatest = _greatest_with_contrast(output[known], name, photo)
    if meaning == "metres":
        depth = output
    elif meaning == "relative disparity":
        # A high quantile instead of the maximum, because the nearest pixels are often specks.
        near_disparity = float(near_inverse_depth(output[known]))
        if not near_disparity > 0:  # nearly all values are negative
            near_disparity = greatest
        # 1 at the nearest surface, which is put at RELATIVE_NEAR_M; 0 is put at FARTHEST_M.
        nearness = (output / near_disparity).clamp(0, 1)
        depth = 1 / ((1 - nearness) / FARTHEST_M + nearness / RELATIVE_NEAR_M)
    else:
        inverse_depth = output / focal_per_width  # 1/m
        depth = 1 / inverse_depth.clamp(MIN_INVERSE_DEPTH_PER_M, MAX_INVERSE_DEPTH_PER_M)

    # A metric model may predict 0 or less for the sky: there is no depth then.
    valid = known & is_valid_depth(depth)
    # The map needs no intrinsics (K), because the camera is passed separately, and has no
    # quantisation step (quantum), because nothing was rounded.
    return DepthMap(
        depth.where(valid, 0.0),
        valid,
        K=None,
        quantum=None,
        quantity="depth" if meaning == "metres" else "disparity",
        path=photo,
    )


def _greatest_with_contrast(values: Tensor, name: str, photo: Path) -> float:
    """The greatest of the finite `values` [N] that the model `name` predicts for a photo.

    InputError, which names the model and the photo, if there are no values, none is positive, or
    all are nearly equal.
    """
    predicted_range = "no finite number"
    if len(values):
        least, greatest = (float(extreme) for extreme in values.aminmax())
        min_spread = MIN_RELATIVE_SPREAD * max(abs(least), abs(greatest))
        if greatest > 0 and greatest > least + min_spread:
            return greatest
        predicted_range = f"{least:g} to {greatest:g}"
    raise InputError(
        f"{photo}: {name} predicts {predicted_range}, which cannot be depth: "
        "its weights are broken or need `precision` fp32, or the photo is empty"
    )


def _import_transformers() -> Any:
    """Import the library transformers, and switch off its messages.

    InputError, which says what to install, if it is missing.
    """
    # Without this setting it would ask the hub to convert models of other formats.
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

    `source` is a folder or owner/name of a model on the hub. Files are downloaded only with
    `from_hub`. OSError for a missing file; InputError, which calls the model `name`, for weights
    that do not fit.
    """
    # A model's folder may hold Python code, which must not run.
    file_options = {"local_files_only": not from_hub, "trust_remote_code": False}
    settings, _ = transformers.PretrainedConfig.get_config_dict(source, **file_options)
    meaning = meaning_of(settings, name)  # before gigabytes of weights are loaded
    check_settings(settings)
    if os.path.isdir(source):
        config = transformers.AutoConfig.from_pretrained(source, **file_options)
        with torch.device("meta"):
            empty_network = transformers.AutoModelForDepthEstimation.from_config(config)
        check_weight_size(empty_network, Path(source))
    kind = str(settings["model_type"])
    # Only Depth Pro's image processor needs torchvision: Spackle does its work instead.
    if kind == "depth_pro":
        mixin = transformers.ImageProcessingMixin
        processor_settings, _ = mixin.get_image_processor_dict(source, **file_options)
        preprocess = _stretch_to_input(processor_settings)
    else:
        # Pictures are resized by Pillow ("pil") on every machine. torchvision's results differ in
        # the last digits, and each version of it needs a certain version of torch.
        processor = transformers.AutoImageProcessor.from_pretrained(
            source, backend="pil", **file_options
        )
        preprocess = _run_processor(processor, is_zoedepth=kind == "zoedepth")

    network, info = transformers.AutoModelForDepthEstimation.from_pretrained(
        source,
        dtype=torch.float32,  # also if the file has half precision
        use_safetensors=True,
        weights_only=True,
        ignore_mismatched_sizes=True,  # `_check_loading_info` reports them
        output_loading_info=True,
        **file_options,
    )
    _check_loading_info(info, name)
    return network.eval().requires_grad_(False), preprocess, meaning


def _check_loading_info(info: Mapping[str, Any], name: str) -> None:
    """InputError if weights were missing or of another shape when transformers loaded a model.

    `info` is the "loading info" that transformers returns; `name` is the model, for the message.
    """
    # transformers gives such weights random values, and goes on.
    mismatched_names = [key for key, *_ in sorted(info["mismatched_keys"])]  # without both shapes
    problems = [f"have another shape for {key}" for key in mismatched_names]
    # Some models have layers that they never use, and that no file holds.
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
        if type(module) is nn.Linear:  # no subclass, which may use its weights in another way
            module.to(dtype)
            module.register_forward_pre_hook(lower_inputs)
            module.register_forward_hook(widen_output)


def _run_processor(processor: Any, is_zoedepth: bool) -> Preprocessing:
    """Make the preprocessing of a model by its image processor, which transformers loaded.

    ZoeDepth's processor first pads the photo with its own mirror image, unless its `do_pad` is off.
    Then the result also says where in the padded picture the photo lies.
    """
    is_padded = is_zoedepth and processor.do_pad

    def preprocess(rgb: Tensor) -> tuple[Tensor, PhotoWindow]:
        """The network's input for a photo [H, W, 3], and where the photo lies in it."""
        # Image processors are made for pictures of 8 bits.
        image = Image.fromarray((rgb * 255).round().to(torch.uint8).numpy())
        inputs = processor(images=image, return_tensors="pt")
        pixels = torch.as_tensor(inputs["pixel_values"])
        height, width = rgb.shape[:2]
        # Only ZoeDepth's processor pads; the others resize the photo alone.
        window = _zoedepth_window(height, width) if is_padded else WHOLE_PICTURE
        return pixels, window

    return preprocess


def _zoedepth_window(height: int, width: int) -> PhotoWindow:
    """Where a photo of this size in pixels lies in the picture that ZoeDepth's processor pads.

    The processor's margin is 3 · sqrt(height / 2) pixels above and below, and 3 · sqrt(width / 2)
    pixels on the left and right.
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
    """Make Depth Pro's preprocessing: normalise a photo, and stretch it to the input's size.

    `settings` are the values of the model's preprocessor_config.json. ValueError if they ask for an
    impossible size, or for another filter than the bilinear one.
    """
    height = int(settings["size"]["height"])
    width = int(settings["size"]["width"])
    is_possible = 1 <= min(height, width) <= max(height, width) <= MAX_INPUT_SIDE
    # Depth Pro's own processor can use other filters; here there is only the bilinear one.
    filter_number = settings.get("resample", Image.Resampling.BILINEAR)
    if filter_number != Image.Resampling.BILINEAR or not is_possible:
        raise ValueError(f"an input of {width}×{height}, or resized otherwise than bilinear")
    mean = torch.tensor(settings["image_mean"]).float()  # [3]
    std = torch.tensor(settings["image_std"]).float()

    def preprocess(rgb: Tensor) -> tuple[Tensor, PhotoWindow]:
        """The network's input for a photo [H, W, 3]; the photo fills the whole of it."""
        normalised = ((rgb - mean) / std).permute(2, 0, 1)[None]  # [1, 3, H, W]
        pixels = interpolate(normalised, size=(height, width), mode="bilinear")
        return pixels, WHOLE_PICTURE

    return preprocess
