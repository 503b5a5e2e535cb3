"""The hf base: what depth models of transformers say, in metres, at the right place, or in one line why not."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import hashlib
import json
import logging
import math
import os
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from scenes import box_before_wall
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases import hf
from spackle.bases.depth_map import DepthMap
from spackle.bases.hf import DepthModel, HfBase
from spackle.bases.hf_models import FARTHEST_M, MEANINGS, UNFIT, Window, crop, meaning_of, to_depth_map
from spackle.bases.protocol import NEAREST_M
from spackle.color import srgb_to_linear
from spackle.errors import InputError
from spackle.image import DEFAULT_FOCAL_MM, Photo

transformers = pytest.importorskip("transformers", reason="depth models need transformers: pip install -e '.[dev]'")

IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
VIT = {"num_hidden_layers": 4, "num_attention_heads": 2, "intermediate_size": 32}
NARROW = {"neck_hidden_sizes": [8, 8, 16, 16], "fusion_hidden_size": 8}
DEPTH_PRO_INPUT = {
    "image_processor_type": "DepthProImageProcessorFast",
    "size": {"height": 64, "width": 64},
    "resample": 2,
    "do_resize": True,
    "do_rescale": True,
    "rescale_factor": 1 / 255,
    "do_normalize": True,
    "image_mean": [0.5, 0.4, 0.3],
    "image_std": [0.5, 0.6, 0.7],
}


# The preprocessor_config.json of the published DPT-Large and GLPN are of before image processors had that name.
OLD_DPT_INPUT = {"feature_extractor_type": "DPTFeatureExtractor", "size": 64, "resample": 2, "keep_aspect_ratio": False}
OLD_GLPN_INPUT = {"feature_extractor_type": "GLPNFeatureExtractor", "resample": 2, "size_divisor": 32}
DINOV2_INPUT = {"image_processor_type": "DPTImageProcessor", "do_resize": False, "do_rescale": False, "do_pad": True}
DINOV2_INPUT |= {"size_divisor": 14, "image_mean": [123.675, 116.28, 103.53], "image_std": [58.395, 57.12, 57.375]}
ANYTHING_INPUT = {"image_processor_type": "DPTImageProcessor", "do_pad": False, "size": {"height": 70, "width": 70}}
ANYTHING_INPUT |= {"keep_aspect_ratio": True, "ensure_multiple_of": 14, "resample": 3, **IMAGENET}
ZOE_INPUT = {"image_processor_type": "ZoeDepthImageProcessor", "do_pad": True, "size": {"height": 64, "width": 96}}
ZOE_INPUT |= {"keep_aspect_ratio": True, "ensure_multiple_of": 32}

STAGES = {"out_indices": [1, 2, 3, 4], "reshape_hidden_states": False, **VIT}
ANYTHING = {"reassemble_hidden_size": 24, "head_hidden_size": 4, **NARROW}
ANYTHING["backbone_config"] = {"model_type": "dinov2", "hidden_size": 24, "image_size": 70, "patch_size": 14, **STAGES}
BEIT = {"model_type": "beit", "hidden_size": 16, "image_size": 64, "patch_size": 16, **STAGES}
BEIT["use_relative_position_bias"] = True
ZOE = {"bottleneck_features": 8, "num_relative_features": 8, "bin_embedding_dim": 8, "num_attractors": [4, 2, 2, 1]}
DPT = {"hidden_size": 16, "image_size": 64, "patch_size": 16, "backbone_out_indices": [0, 1, 2, 3], "is_hybrid": False}
DINO = {"model_type": "dinov2", "hidden_size": 16, "image_size": 70, "patch_size": 14, **STAGES}
TIPS = {"model_type": "tipsv2_vision_model", "hidden_size": 16, "image_size": 28, "patch_size": 14, **STAGES}
GLPN = {
    "hidden_sizes": [8, 8, 16, 16],
    "depths": [1] * 4,
    "num_attention_heads": [1, 1, 2, 2],
    "decoder_hidden_size": 8,
}
SMALL = {"model_type": "dinov2", "hidden_size": 16, "image_size": 32, "patch_size": 8, **VIT, "num_hidden_layers": 2}
DEPTH_PRO = {"patch_size": 32, "fusion_hidden_size": 16, "intermediate_hook_ids": [1, 0], "merge_padding_value": 1}
DEPTH_PRO |= {"intermediate_feature_dims": [8, 8], "scaled_images_ratios": [0.5, 1.0], "use_fov_model": True}
DEPTH_PRO |= {"scaled_images_overlap_ratios": [0.0, 0.25], "scaled_images_feature_dims": [8, 8]}
DEPTH_PRO |= {"num_fov_head_layers": 1, **{f"{part}_model_config": SMALL for part in ("image", "patch", "fov")}}
TIPS_INPUT = {"image_processor_type": "Tipsv2DptImageProcessor", "size": {"height": 42, "width": 56}}
# By name: transformers' class, its settings, and those of its image processor.
MODELS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "relative": ("DepthAnything", {**ANYTHING, "depth_estimation_type": "relative", "max_depth": 1}, ANYTHING_INPUT),
    "metric": ("DepthAnything", {**ANYTHING, "depth_estimation_type": "metric", "max_depth": 20}, ANYTHING_INPUT),
    "dpt": ("DPT", {**DPT, **VIT, **NARROW}, OLD_DPT_INPUT | {"image_mean": [0.5] * 3, "image_std": [0.5] * 3}),
    "dinov2": ("DPT", {"backbone_config": DINO, "is_hybrid": False, **NARROW}, DINOV2_INPUT),
    "glpn": ("GLPN", GLPN, OLD_GLPN_INPUT),
    "zoedepth": ("ZoeDepth", {**ZOE, "backbone_config": BEIT, **NARROW}, ZOE_INPUT),
    "tips": ("Tipsv2Dpt", {"backbone_config": TIPS, "num_depth_bins": 8, **NARROW}, TIPS_INPUT),
    "depth_pro": ("DepthPro", DEPTH_PRO, DEPTH_PRO_INPUT),
}
METRIC = ("metric", "dinov2", "glpn", "zoedepth")
RELATIVE = ("relative", "dpt")


def randomise(network: nn.Module) -> None:
    """Weights large enough that the output depends on the picture."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in network.parameters():
            noise = torch.randn(parameter.shape, generator=generator)
            fan = parameter[0].numel() if parameter.ndim > 1 else 100
            parameter.copy_(noise / math.sqrt(fan) + (0.3 if parameter.ndim == 1 else 0.0))


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Tiny models of the real classes with random weights, saved as published ones are."""
    root, found = tmp_path_factory.mktemp("models"), {}
    for name, (kind, settings, preparation) in MODELS.items():
        found[name] = root / name
        config = getattr(transformers, f"{kind}Config")(**copy.deepcopy(settings))
        network = getattr(transformers, f"{kind}ForDepthEstimation")(config)
        randomise(network)
        if name == "depth_pro":
            with torch.no_grad():
                network.fov_model.head.layers[-1].weight.mul_(0.1)
                network.fov_model.head.layers[-1].bias.fill_(55.0)  # degrees
        network.save_pretrained(found[name])
        (found[name] / "preprocessor_config.json").write_text(json.dumps(preparation))
    return found


def photo_of(width: int = 96, height: int = 64, focal: float = 80.0, source: str = "EXIF") -> Photo:
    return Photo(box_before_wall(width=width, height=height).rgb, focal, source, Path("photo.png"))


@functools.cache
def load(folder: Path, precision: Any = "fp32") -> HfBase:
    return HfBase.load(str(folder), device="cpu", precision=precision)


def image_of(photo: Photo) -> Image.Image:
    return Image.fromarray((photo.rgb * 255).round().to(torch.uint8).numpy())


def by_hand(folder: Path, photo: Photo) -> tuple[Any, Any]:
    """The model's output and its image processor, by transformers alone."""
    network = transformers.AutoModelForDepthEstimation.from_pretrained(folder).eval()
    processor = transformers.AutoImageProcessor.from_pretrained(folder, backend="pil")
    with torch.no_grad():
        return network(**processor(images=image_of(photo), return_tensors="pt")), processor


@pytest.fixture
def maps(monkeypatch: pytest.MonkeyPatch) -> list[DepthMap]:
    """The depth maps that are handed over to be lifted."""
    seen: list[DepthMap] = []
    original = hf.lift

    def lift(rgb: Tensor, depth: DepthMap, camera: Any) -> Any:
        seen.append(depth)
        return original(rgb, depth, camera)

    monkeypatch.setattr(hf, "lift", lift)
    return seen


def front_depth(base: HfBase, photo: Photo) -> Tensor:
    """[H, W]: where the pixels' own Gaussians stand."""
    prediction = base.predict(photo)
    return prediction.gaussians.means[: photo.width * photo.height, 2].reshape(photo.height, photo.width)


# What comes out.


@pytest.mark.parametrize("name", MODELS)
def test_each_kind_of_model_gives_gaussians_with_the_photos_colours(name: str, folders: dict[str, Path]) -> None:
    photo, steps = photo_of(), []
    base = load(folders[name])
    prediction = base.predict(photo, lambda done, of: steps.append((done, of)))
    assert base.name == f"hf:{folders[name]}"
    front = photo.width * photo.height
    torch.testing.assert_close(prediction.gaussians.colors[:front], srgb_to_linear(photo.rgb).reshape(-1, 3))
    assert all(bool(torch.isfinite(tensor).all()) for tensor in prediction.gaussians.tensors)
    uv, z = prediction.camera.project(prediction.gaussians.means[:front])
    torch.testing.assert_close(uv, prediction.camera.pixel_centers().reshape(-1, 2), rtol=0, atol=1e-2)
    assert float(z.max() / z.min()) > 1.01
    assert steps == [(1, 2), (2, 2)]
    said = "relative, scaled to 1.5–30 m" if name in RELATIVE else "metric, by the model"
    assert prediction.notes["depth_scale"] == said
    assert prediction.notes["precision"] == "fp32"
    assert "depth_invalid_pixels" not in prediction.notes
    assert (prediction.camera.focal, prediction.lens_source) == ((80.0, 80.0), "")
    assert all(isinstance(value, str | int | float) for value in prediction.notes.values())


@pytest.mark.parametrize("name", [*METRIC, *RELATIVE])
@pytest.mark.parametrize(("width", "height"), [(96, 64), (61, 83)])
def test_the_map_is_the_models_output_as_transformers_gives_it(
    name: str, width: int, height: int, folders: dict[str, Path], maps: list[DepthMap]
) -> None:
    photo = photo_of(width, height)
    output, processor = by_hand(folders[name], photo)
    raw, expected = output.predicted_depth[0], None
    if name == "zoedepth":  # as its own post-processing, in the sizes that it names, without torchvision
        pads = [int(math.sqrt(side / 2) * 3) for side in (height, width)]
        whole = interpolate(raw[None, None], (height + 2 * pads[0], width + 2 * pads[1]), mode="bicubic")[0, 0]
        expected = whole[pads[0] : -pads[0], pads[1] : -pads[1]]
    elif name == "dinov2":  # the photo stands in the middle of what was padded to multiples of 14
        tall, wide = (-(-side // 14) * 14 for side in (height, width))
        top, left = (tall - height) // 2, (wide - width) // 2
        whole = interpolate(raw[None, None], (tall, wide), mode="bilinear", antialias=True)[0, 0]
        expected = whole[top : top + height, left : left + width]
    else:
        expected = processor.post_process_depth_estimation(output)[0]["predicted_depth"]
    load(folders[name]).predict(photo)
    (found,) = maps
    depth = found.depth
    assert bool(found.valid.all())
    assert (found.K, found.quantum, found.path) == (None, None, photo.path)
    if name in RELATIVE:
        share = (1 / depth - 1 / FARTHEST_M) / (1 / NEAREST_M - 1 / FARTHEST_M)
        near = float(expected.flatten().kthvalue(1 + round(0.999 * (expected.numel() - 1))).values)
        torch.testing.assert_close(share, (expected / near).clamp(0, 1), rtol=1e-4, atol=1e-5)
    elif name in ("zoedepth", "dinov2"):
        resized = interpolate(expected[None, None], depth.shape, mode="bilinear", antialias=True)[0, 0]
        assert float((depth / resized - 1).abs().mean()) < 0.01
    else:
        torch.testing.assert_close(depth, expected, rtol=1e-5, atol=0)


def test_a_photo_larger_than_the_working_size_is_looked_at_and_lifted_at_that_size(folders: dict[str, Path]) -> None:
    big = Photo(torch.rand(40, 1600, 3, generator=torch.Generator().manual_seed(0)), 1600.0, "EXIF", Path("photo.png"))
    prediction = load(folders["metric"]).predict(big)
    assert (prediction.camera.width, prediction.camera.height) == (1536, 38)
    assert prediction.camera.focal[0] == pytest.approx(1536)


# What a model sees.


def test_depth_pro_sees_the_photo_normalised_and_stretched_without_smoothing(folders: dict[str, Path]) -> None:
    photo = photo_of(
        192, 128
    )  # every pixel of the network's 64×64 is the mean of 2 of the 3 that it stands for, or of 4
    pixels, window = load(folders["depth_pro"]).model.prepare(photo.rgb)
    expected = torch.empty(3, 64, 64)
    for channel, (mean, std) in enumerate(zip((0.5, 0.4, 0.3), (0.5, 0.6, 0.7), strict=True)):
        values = (photo.rgb[..., channel] - mean) / std
        rows = (values[0::2] + values[1::2]) / 2
        expected[channel] = rows[:, 1::3]
    torch.testing.assert_close(pixels[0], expected)
    assert window == Window()


def test_tips_sees_the_photo_stretched_as_pillow_does_it(folders: dict[str, Path]) -> None:
    photo = photo_of(192, 128)
    pixels, window = load(folders["tips"]).model.prepare(photo.rgb)
    resized = torch.from_numpy(np.array(image_of(photo).resize((56, 42), Image.Resampling.BILINEAR)))
    expected = resized.permute(2, 0, 1) / 255
    torch.testing.assert_close(pixels[0], expected, rtol=0, atol=1.5 / 255)
    assert window == Window()


class Brightness(nn.Module):
    """A network whose depth is what it sees: 2 m where the photo is bright, 6 m where it is dark."""

    def __init__(self, mean: float, std: float) -> None:
        super().__init__()
        self.mean, self.std = mean, std
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, pixel_values: Tensor) -> Any:
        bright = pixel_values[:, 0] * self.std + self.mean
        return SimpleNamespace(predicted_depth=torch.where(bright > 0.5, 2.0, 6.0))


@pytest.mark.parametrize("name", ["metric", "dinov2", "glpn", "zoedepth"])
@pytest.mark.parametrize(("width", "height"), [(288, 192), (181, 240)])
def test_depth_lies_where_the_photo_shows_it_whatever_is_resized_and_padded(
    name: str, width: int, height: int, folders: dict[str, Path], maps: list[DepthMap]
) -> None:
    rgb = torch.zeros(height, width, 3)
    box = (slice(height // 4, height // 2), slice(width // 3, 3 * width // 4))
    rgb[box] = 1.0
    mean, std = {"metric": (0.485, 0.229), "dinov2": (123.675 / 255, 58.395 / 255)}.get(name, (0.5, 0.5))
    mean, std = (0.0, 1.0) if name == "glpn" else (mean, std)
    model = dataclasses.replace(load(folders[name]).model, network=Brightness(mean, std))
    HfBase("hf:x", model, "fp32").predict(Photo(rgb, 300.0, "EXIF", Path("photo.png")))
    near = maps[0].depth < 4
    # ZoeDepth's processor puts corner pixels on corners, its post-processing, followed here, edges on edges.
    within = 0.9 if name == "zoedepth" else 0.6
    for axis, sides in ((1, (height, height // 4, height // 2)), (0, (width, width // 3, 3 * width // 4))):
        seen = near.any(dim=axis)
        pixel = sides[0] / len(seen)
        first, last = (int(seen.nonzero().flatten()[end]) for end in (0, -1))
        assert pixel * first == pytest.approx(sides[1], abs=within * pixel)
        assert pixel * (last + 1) == pytest.approx(sides[2], abs=within * pixel)


def test_the_window_of_a_ramp_is_the_same_ramp() -> None:
    ys, xs = torch.meshgrid(torch.arange(40.0) + 0.5, torch.arange(60.0) + 0.5, indexing="ij")
    window = Window(left=0.11, top=0.07, width=0.78, height=0.86)
    found = crop(3 * xs + 5 * ys, window)
    assert found.shape == (34, 47)
    v, u = torch.meshgrid((torch.arange(34) + 0.5) / 34, (torch.arange(47) + 0.5) / 47, indexing="ij")
    expected = 3 * 60 * (0.11 + 0.78 * u) + 5 * 40 * (0.07 + 0.86 * v)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-2)
    whole = torch.rand(5, 7)
    assert crop(whole, Window()) is whole


# Scale.


def test_relative_disparity_runs_from_its_zero_at_30_m_to_its_greatest_at_1_5_m() -> None:
    raw = torch.linspace(0, 7, 101).expand(50, 101).contiguous()
    found = to_depth_map(raw, "relative disparity", 1.0, "hf:x", Path("photo.png"))
    assert (float(found.depth.min()), float(found.depth.max())) == pytest.approx((1.5, 30.0))
    assert found.quantity == "disparity"
    inverse = 1 / found.depth[0]
    torch.testing.assert_close(
        inverse.diff(), inverse.diff().mean().expand(100), rtol=1e-3, atol=0
    )  # planes stay planes
    same = to_depth_map(1000 * raw, "relative disparity", 1.0, "hf:x", Path("photo.png"))
    torch.testing.assert_close(same.depth, found.depth)
    wall = 5 + 0.05 * torch.rand(40, 50, generator=torch.Generator().manual_seed(0))  # seen from the front
    depth = to_depth_map(wall, "relative disparity", 1.0, "hf:x", Path("photo.png")).depth
    assert 1.5 <= float(depth.min()) < float(depth.max()) < 1.6
    raw = torch.tensor([[0.5, 1.0, 2.0, 0.0, 1e9]])  # Depth Pro's scale goes by the focal length in photo widths
    found = to_depth_map(raw, "canonical disparity", 0.8, "hf:x", Path("photo.png"))
    torch.testing.assert_close(found.depth, torch.tensor([[1.6, 0.8, 0.4, 1e4, 1e-4]]))  # its limits: 10 km, 0.1 mm


def test_a_few_specks_do_not_push_the_rest_of_a_relative_scene_away() -> None:
    raw = torch.linspace(0, 1, 100).expand(100, 100).contiguous()
    clean = to_depth_map(raw, "relative disparity", 1.0, "hf:x", Path("photo.png")).depth
    specked = raw.clone()
    specked[3, :5], specked[4, 7] = 50.0, -3.0
    found = to_depth_map(specked, "relative disparity", 1.0, "hf:x", Path("photo.png")).depth
    same = specked == raw
    torch.testing.assert_close(found[same], clean[same], rtol=0.02, atol=0)
    assert float(found[3, 0]) == pytest.approx(1.5)
    assert float(found[4, 7]) == pytest.approx(30.0)


def depth_pro_by_hand(folder: Path, photo: Photo) -> tuple[Tensor, float]:
    """Inverse canonical depth and field of view in degrees."""
    settings = json.loads((folder / "preprocessor_config.json").read_text())
    network = transformers.DepthProForDepthEstimation.from_pretrained(folder).eval()
    mean, std = (torch.tensor(settings[key]) for key in ("image_mean", "image_std"))
    pixels = interpolate(((photo.rgb - mean) / std).permute(2, 0, 1)[None], (64, 64), mode="bilinear")
    with torch.no_grad():
        output = network(pixel_values=pixels)
    return output.predicted_depth[0], float(output.field_of_view)


def test_depth_pro_gives_the_lens_where_nobody_knows_it(folders: dict[str, Path], maps: list[DepthMap]) -> None:
    photo = photo_of(focal=90.0, source=f"default {DEFAULT_FOCAL_MM:g} mm")
    canonical, fov = depth_pro_by_hand(folders["depth_pro"], photo)
    assert 20 < fov < 90
    prediction = load(folders["depth_pro"]).predict(photo)
    focal = 0.5 * photo.width / math.tan(math.radians(fov) / 2)
    assert prediction.camera.focal == pytest.approx((focal, focal), rel=1e-4)
    assert prediction.lens_source == "Depth Pro"
    # The formula of its image processor, which exists for torchvision alone.
    expected = 1 / (canonical * photo.width / focal).clamp(1e-4, 1e4)
    torch.testing.assert_close(maps[0].depth, expected, rtol=1e-3, atol=0)


@pytest.mark.parametrize("source", ["EXIF", "--focal-px"])
def test_depth_pro_believes_a_known_lens_and_scales_its_depth_to_it(
    source: str, folders: dict[str, Path], maps: list[DepthMap]
) -> None:
    canonical, _ = depth_pro_by_hand(folders["depth_pro"], photo_of())
    for focal in (48.0, 96.0, 192.0):
        prediction = load(folders["depth_pro"]).predict(photo_of(focal=focal, source=source))
        assert prediction.camera.focal == (focal, focal)
        assert prediction.lens_source == ""
    for found, focal in zip(maps, (48.0, 96.0, 192.0), strict=True):
        torch.testing.assert_close(found.depth, 1 / (canonical * 96 / focal).clamp(1e-4, 1e4), rtol=1e-3, atol=0)


# What the numbers mean.


def test_every_depth_model_of_the_installed_transformers_has_a_known_meaning_or_a_reason() -> None:
    from transformers.models.auto.modeling_auto import MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES

    assert set(MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES) == set(MEANINGS) | set(UNFIT)


@pytest.mark.parametrize(
    ("settings", "meaning"),
    [
        ({"model_type": "depth_anything"}, "relative disparity"),
        ({"model_type": "depth_anything", "depth_estimation_type": "relative"}, "relative disparity"),
        ({"model_type": "depth_anything", "depth_estimation_type": "metric"}, "metres"),
        ({"model_type": "dpt"}, "relative disparity"),
        ({"model_type": "dpt", "backbone_config": None}, "relative disparity"),
        ({"model_type": "dpt", "backbone_config": {"model_type": "beit"}}, "relative disparity"),
        ({"model_type": "dpt", "backbone_config": {"model_type": "dinov2"}}, "metres"),
        ({"model_type": "glpn"}, "metres"),
        ({"model_type": "zoedepth"}, "metres"),
        ({"model_type": "tipsv2_dpt"}, "metres"),
        ({"model_type": "depth_pro"}, "canonical disparity"),
    ],
)
def test_the_meaning_of_the_output_follows_from_the_settings(settings: dict[str, Any], meaning: str) -> None:
    assert meaning_of(settings, "hf:x") == meaning


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, "its config.json names no kind of depth model that is known here: give one of depth_anything, depth_pro"),
        ({"model_type": "bert"}, "'bert' is no kind of depth model that is known here"),
        ({"model_type": ["dpt"]}, "no kind of depth model"),
        ({"model_type": "chmv2"}, "how high trees stand"),
        ({"model_type": "prompt_depth_anything"}, "measured depth map"),
        ({"model_type": "depth_anything", "depth_estimation_type": "ordinal"}, "neither relative nor metric"),
        ({"model_type": "depth_anything", "depth_estimation_type": ["metric"]}, "neither relative nor metric"),
    ],
)
def test_an_output_that_nobody_can_read_is_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        meaning_of(settings, "hf:x")


# Bad outputs.


class Says(nn.Module):
    """A network that answers the same to every picture."""

    def __init__(self, depth: Tensor, fov: float | None = None) -> None:
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))
        self.depth, self.fov = depth, fov

    def forward(self, pixel_values: Tensor) -> Any:
        fov = None if self.fov is None else torch.tensor([self.fov])
        return SimpleNamespace(predicted_depth=self.depth, field_of_view=fov)


def saying(depth: Tensor, meaning: Any = "metres", fov: float | None = None) -> HfBase:
    def prepare(rgb: Tensor) -> tuple[Tensor, Window]:
        return rgb.permute(2, 0, 1)[None], Window()

    return HfBase("hf:a/b", DepthModel(Says(depth, fov).eval(), prepare, meaning), "fp32")


SLOPE = torch.linspace(2, 5, 96).expand(1, 64, 96).contiguous()


@pytest.mark.parametrize(
    ("depth", "meaning", "words"),
    [
        (torch.zeros(1, 64, 96), "metres", "predicts 0 for every pixel"),
        (torch.zeros(1, 64, 96), "relative disparity", "predicts 0 for every pixel"),
        (torch.zeros(1, 64, 96), "canonical disparity", "predicts 0 for every pixel"),
        (torch.full((1, 64, 96), 3.0), "metres", "predicts 3 for every pixel"),
        (torch.full((1, 64, 96), math.nan), "metres", "no finite number"),
        (torch.full((1, 64, 96), math.inf), "relative disparity", "no finite number"),
        (-SLOPE, "metres", "no depth above zero"),
        (-SLOPE, "relative disparity", "no disparity above zero"),
        (SLOPE[0], "metres", r"fails \(an output of shape \(64, 96\)\)"),
        (SLOPE[None], "metres", "fails"),
    ],
)
def test_an_output_that_is_no_depth_is_one_line_with_photo_and_model(depth: Tensor, meaning: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        saying(depth, meaning).predict(photo_of())
    assert str(caught.value).startswith("photo.png: hf:a/b ")
    assert "\n" not in str(caught.value)


def test_a_few_bad_pixels_are_filled_and_counted(maps: list[DepthMap]) -> None:
    broken = SLOPE.clone()
    broken[0, 10, 20:24] = torch.tensor([math.nan, math.inf, 0.0, -1.0])
    prediction = saying(broken).predict(photo_of())
    assert int((~maps[0].valid).sum()) == 4
    assert bool((maps[0].depth[~maps[0].valid] == 0).all())
    assert prediction.notes["depth_invalid_pixels"] == 4
    assert prediction.notes["depth_filled"] == pytest.approx(4 / (64 * 96), abs=1e-4)
    z = prediction.gaussians.means[: 64 * 96, 2].reshape(64, 96)
    torch.testing.assert_close(z[10, 20:24], SLOPE[0, 10, 20:24], rtol=0.1, atol=0)
    relative = SLOPE.clone()
    relative[0, 5, 5] = math.nan
    assert saying(relative, "relative disparity").predict(photo_of()).notes["depth_invalid_pixels"] == 1


@pytest.mark.parametrize("fov", [0.0, -3.0, 180.0, 179.999, math.nan, math.inf])
def test_a_field_of_view_that_no_lens_has_is_refused_unless_the_lens_is_known(fov: float) -> None:
    base = saying(SLOPE, "canonical disparity", fov)
    with pytest.raises(InputError, match="which no lens has: give the focal length with --focal-mm"):
        base.predict(photo_of(source="default 30 mm"))
    assert base.predict(photo_of()).camera.focal[0] == 80


def test_a_photo_that_a_model_cannot_work_on_is_one_line(folders: dict[str, Path]) -> None:
    speck = Photo(torch.rand(3, 5, 3), 5.0, "EXIF", Path("speck.png"))
    with pytest.raises(InputError, match=r"^speck.png: hf:.*glpn fails \(.*\): give another photo or model$"):
        load(folders["glpn"]).predict(speck)


def test_a_shortage_of_memory_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    base = saying(SLOPE)
    words = "[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory: you tried to allocate 1 byte"
    monkeypatch.setattr(base.model.network, "forward", lambda **_: (_ for _ in ()).throw(RuntimeError(words)))
    with pytest.raises(InputError, match="not enough memory: give a smaller model"):
        base.predict(photo_of())


# Precision.


def test_bf16_is_close_to_fp32_without_stairs_and_repeats(folders: dict[str, Path], maps: list[DepthMap]) -> None:
    photo = photo_of()
    exact, low = load(folders["metric"]), load(folders["metric"], "bf16")
    assert (exact.precision, low.precision) == ("fp32", "bf16")
    for base in (exact, low, low):
        assert base.predict(photo).notes["precision"] == base.precision
    one, other, again = (found.depth for found in maps)
    assert not torch.equal(one, other)
    torch.testing.assert_close(other, one, rtol=0.02, atol=0)
    assert torch.equal(other, again)
    assert len(other.unique()) > 0.9 * len(one.unique())  # bfloat16 has 128 numbers between 8 and 16 m


@pytest.mark.parametrize("name", MODELS)
def test_every_kind_of_model_runs_in_bf16(name: str, folders: dict[str, Path]) -> None:
    photo = photo_of()
    exact, low = (load(folders[name], precision).model(photo.rgb) for precision in ("fp32", "bf16"))
    assert low[0].dtype == torch.float32
    assert float((low[0] - exact[0]).abs().mean()) < 0.02 * float(exact[0].abs().mean())
    assert not torch.equal(low[0], exact[0])
    assert low[1] == (None if exact[1] is None else pytest.approx(exact[1], rel=0.02))


def test_weights_of_half_precision_are_widened(folders: dict[str, Path], tmp_path: Path, maps: list[DepthMap]) -> None:
    folder = shutil.copytree(folders["metric"], tmp_path / "half")
    tensors = {key: value.half() for key, value in load_file(folder / "model.safetensors").items()}
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    settings = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(settings | {"dtype": "float16"}))
    base = load(folder)
    assert {parameter.dtype for parameter in base.model.network.parameters()} == {torch.float32}
    base.predict(photo_of())
    load(folders["metric"]).predict(photo_of())
    torch.testing.assert_close(maps[0].depth, maps[1].depth, rtol=0.02, atol=0)


def test_switches_of_the_caller_change_nothing(folders: dict[str, Path], maps: list[DepthMap]) -> None:
    base = load(folders["metric"])
    base.predict(photo_of())
    with torch.autocast("cpu", torch.bfloat16):
        base.predict(photo_of())
    assert torch.equal(maps[0].depth, maps[1].depth)


# Folders that are no model.


def without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def writing(name: str, content: str | bytes) -> Callable[[Path], None]:
    data = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / name).write_bytes(data) and None


def cut(folder: Path) -> None:
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1000])


def of_another_model(folder: Path) -> None:
    save_file({"linear.weight": torch.zeros(3, 3)}, folder / "model.safetensors", metadata={"format": "pt"})


def lacking(prefix: str) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        file = folder / "model.safetensors"
        tensors = {key: value for key, value in load_file(file).items() if not key.startswith(prefix)}
        save_file(tensors, file, metadata={"format": "pt"})

    return damage


def with_setting(file: str, **changes: Any) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        settings = json.loads((folder / file).read_text())
        (folder / file).write_text(json.dumps(settings | changes))

    return damage


def pickled(folder: Path) -> None:
    torch.save(load_file(folder / "model.safetensors"), folder / "pytorch_model.bin")
    (folder / "model.safetensors").unlink()


INDEX = "model.safetensors.index.json"


INPUT = "preprocessor_config.json"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (without("config.json"), "has no config.json, so it is no model of transformers"),
        (writing("config.json", "{"), "config.json cannot be read"),
        (writing("config.json", b"\xff\xfe"), "config.json cannot be read"),
        (writing("config.json", "[]"), "config.json is no JSON object"),
        (writing("config.json", '{"model_type": "bert"}'), "'bert' is no kind of depth model"),
        (writing("config.json", '{"architectures": []}'), "its config.json names no kind of depth model"),
        (with_setting("config.json", neck_hidden_sizes="many"), "cannot be loaded"),
        (with_setting("config.json", reassemble_hidden_size=48), "its weights have another shape than its config.json"),
        (without(INPUT), "has no preprocessor_config.json"),
        (writing(INPUT, "{"), "cannot be loaded"),
        (writing(INPUT, '{"image_processor_type": "Crystal"}'), "cannot be loaded|fails"),
        pytest.param(
            with_setting(INPUT, image_processor_type="Sam2ImageProcessor"),
            "needs torchvision: install the one",
            marks=pytest.mark.skipif(find_spec("torchvision") is not None, reason="torchvision is installed"),
        ),
        (without("model.safetensors"), "has no model.safetensors, the only kind of weights that runs no code"),
        (pickled, "has no model.safetensors, the only kind of weights that runs no code"),
        (writing("model.safetensors", b""), "cannot be loaded"),
        (writing("model.safetensors", b"PK\x03\x04" * 100), "cannot be loaded"),
        (cut, "cannot be loaded"),
        (of_another_model, "its weights lack .* and .* more: give the weights that belong to its config.json"),
        (lacking("head.conv3.bias"), "its weights lack head.conv3.bias: give"),
        (
            writing(INDEX, '{"weight_map": {"a": "model-00001-of-00002.safetensors"}}'),
            "not there .model-00001-of-00002.s",
        ),
        (writing(INDEX, '{"weight_map": {"a": ["b"]}}'), "names weights that are not there"),
        (writing(INDEX, '{"weight_map": []}'), "names weights that are not there"),
        (writing(INDEX, "{"), "model.safetensors.index.json cannot be read"),
    ],
)
def test_a_folder_that_is_no_model_is_one_line(
    damage: Callable[[Path], None],
    words: str,
    folders: dict[str, Path],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    folder = shutil.copytree(folders["metric"], tmp_path / "model")
    damage(folder)
    with pytest.raises(InputError, match=words) as caught:
        load(folder)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)
    assert len(str(caught.value)) < 450 + len(str(folder))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "changes",
    [{"size": {"height": 0, "width": 64}}, {"size": {"height": 1 << 20, "width": 64}}, {"size": 64}, {"resample": 3}],
)
def test_an_input_for_depth_pro_that_is_not_known_here_is_one_line(
    changes: dict[str, Any], folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = shutil.copytree(folders["depth_pro"], tmp_path / "model")
    with_setting(INPUT, **changes)(folder)
    with pytest.raises(InputError, match="cannot be loaded"):
        load(folder)


def test_weights_that_a_model_never_uses_may_be_missing(
    folders: dict[str, Path], tmp_path: Path, maps: list[DepthMap]
) -> None:
    """DPT-Large as published lacks them: the first stage of the neck has nothing to add to."""
    folder = shutil.copytree(folders["dpt"], tmp_path / "dpt")
    lacking("neck.fusion_stage.layers.0.residual_layer1")(folder)
    warned: list[logging.LogRecord] = []
    listener = logging.Handler()
    listener.emit = warned.append  # type: ignore[method-assign]
    logging.getLogger("transformers").addHandler(listener)
    try:
        load(folder).predict(photo_of())
    finally:
        logging.getLogger("transformers").removeHandler(listener)
    assert not warned
    load(folders["dpt"]).predict(photo_of())
    assert torch.equal(maps[0].depth, maps[1].depth)


def test_code_in_a_models_folder_is_not_run(folders: dict[str, Path], tmp_path: Path) -> None:
    folder = shutil.copytree(folders["metric"], tmp_path / "model")
    flag = tmp_path / "run"
    (folder / "own.py").write_text(f"open({str(flag)!r}, 'w')")
    with_setting("config.json", auto_map={"AutoModelForDepthEstimation": "own.Model", "AutoConfig": "own.Config"})(
        folder
    )
    with_setting(INPUT, auto_map={"AutoImageProcessor": "own.Processor"})(folder)
    with contextlib.suppress(InputError):
        load(folder)
    assert not flag.exists()


def test_loading_and_predicting_say_nothing_and_leave_the_packages_settings_alone(
    folders: dict[str, Path], capfd: pytest.CaptureFixture[str]
) -> None:
    from huggingface_hub.utils import are_progress_bars_disabled

    said = transformers.utils.logging
    before = said.get_verbosity(), said.is_progress_bar_enabled(), are_progress_bars_disabled()
    capfd.readouterr()
    HfBase.load(str(folders["dpt"]), device="cpu").predict(photo_of())
    assert capfd.readouterr() == ("", "")
    assert before == (said.get_verbosity(), said.is_progress_bar_enabled(), are_progress_bars_disabled())


@pytest.mark.parametrize("package", ["transformers", "huggingface_hub"])
def test_a_missing_package_is_named(package: str, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=r"pip install 'spackle-nvs\[hf\]'"):
        HfBase.load(str(folders["metric"]))
    if package == "huggingface_hub":
        with pytest.raises(InputError, match=r"pip install 'spackle-nvs\[hf\]'"):
            HfBase.load("some/model")


def test_a_broken_package_is_one_line(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
            if name == "transformers":
                raise RuntimeError("operator torchvision::nms does not exist")

    monkeypatch.delitem(sys.modules, "transformers")
    monkeypatch.setattr(sys, "meta_path", [Broken(), *sys.meta_path])
    with pytest.raises(InputError, match=r"cannot be imported \(operator torchvision::nms does not exist\)"):
        HfBase.load(str(folders["metric"]))


# Names.


def test_folders_are_told_from_names_of_the_hub(
    folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("plain", "owner/name"):
        shutil.copytree(folders["metric"], tmp_path / name)
    for name in ("plain", "owner/name", "./plain", "~/plain", str(tmp_path / "plain")):
        assert HfBase.load(name, device="cpu").name == f"hf:{name}"
    for name in ("./absent", "../absent", "~/absent", str(tmp_path / "absent")):
        with pytest.raises(InputError, match=f"^hf:{name}: no such folder: check the name$"):
            HfBase.load(name)
    for name in ("absent", "a/b/c", "", "a//b", "a b/c", "other/", "https://huggingface.co/a/b"):
        with pytest.raises(InputError, match="neither a folder nor a model of the hub: give a folder, or owner/name"):
            HfBase.load(name)


# The hub, as a server on this machine.


class Hub(ThreadingHTTPServer):
    """Models as the hub serves them."""

    daemon_threads = False
    models: dict[str, Path]
    gated: set[str]
    requests: list[str]

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Answers(BaseHTTPRequestHandler):
    server: Hub
    sha = "0123456789abcdef0123456789abcdef01234567"

    def do_GET(self) -> None:
        path = self.path.partition("?")[0].strip("/")
        self.server.requests.append(f"{self.command} {path}")
        api = path.startswith("api/models/")
        owner, name, *rest = path.removeprefix("api/models/").split("/")
        folder = self.server.models.get(f"{owner}/{name}")
        if folder is None:
            return self.answer(401, b"{}", {"X-Error-Code": "RepoNotFound", "X-Error-Message": "Repository not found"})
        if f"{owner}/{name}" in self.server.gated and not (api and rest[:1] != ["tree"]):
            return self.answer(403, b"{}", {"X-Error-Code": "GatedRepo", "X-Error-Message": "Access is restricted"})
        if api and rest[:1] == ["tree"]:
            return self.answer(200, json.dumps([self.entry(file) for file in sorted(folder.iterdir())]).encode())
        if api:
            return self.answer(200, json.dumps({"id": f"{owner}/{name}", "sha": self.sha, "siblings": []}).encode())
        data = (folder / rest[-1]).read_bytes()
        tag = f'"{hashlib.sha1(data).hexdigest()}"'
        return self.answer(200, data, {"ETag": tag, "X-Repo-Commit": self.sha})

    do_HEAD = do_GET

    def entry(self, file: Path) -> dict[str, Any]:
        data = file.read_bytes()
        return {"type": "file", "path": file.name, "size": len(data), "oid": hashlib.sha1(data).hexdigest()}

    def answer(self, status: int, data: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(data)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(data)

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def hub(folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """A hub with one model that is to be had and one that asks for consent, and an empty cache."""
    import huggingface_hub

    server = Hub(("127.0.0.1", 0), Answers)
    server.models = {"owner/name": folders["metric"], "owner/gated": folders["metric"], "owner/text": tmp_path / "text"}
    server.gated, server.requests = {"owner/gated"}, []
    (tmp_path / "text").mkdir()
    for name, content in {"config.json": '{"model_type": "bert"}', INPUT: "{}", "model.safetensors": "x"}.items():
        (tmp_path / "text" / name).write_text(content)
    original = huggingface_hub.snapshot_download
    here = functools.partial(original, endpoint=server.url, cache_dir=tmp_path / "cache")
    monkeypatch.setattr(huggingface_hub, "snapshot_download", here)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_a_model_of_the_hub_is_fetched_once_and_then_needs_no_network(
    hub: Hub, folders: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    photo = photo_of()
    (folders["metric"] / "pytorch_model.bin").write_bytes(b"never asked for")
    try:
        first = HfBase.load("owner/name", device="cpu", precision="fp32")
    finally:
        os.remove(folders["metric"] / "pytorch_model.bin")
    assert first.name == "hf:owner/name"
    asked = [request for request in hub.requests if "/resolve/" in request]
    assert {request.rpartition("/")[2] for request in asked} == {"config.json", INPUT, "model.safetensors"}
    hub.requests.clear()
    again = HfBase.load("owner/name", device="cpu", precision="fp32")
    assert hub.requests == []
    depth = front_depth(first, photo)
    assert torch.equal(depth, front_depth(again, photo))
    assert torch.equal(depth, front_depth(load(folders["metric"]), photo))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("listed", [True, False])
def test_a_fetch_that_broke_off_is_finished(
    listed: bool, hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import huggingface_hub

    HfBase.load("owner/name", device="cpu")
    cache = tmp_path / "cache"
    if not listed:  # transformers itself fills the cache without a list of what belongs there
        ignored = shutil.ignore_patterns("trees")
        cache = shutil.copytree(cache, tmp_path / "other", symlinks=True, ignore=ignored)
        elsewhere = functools.partial(huggingface_hub.snapshot_download, cache_dir=cache)
        monkeypatch.setattr(huggingface_hub, "snapshot_download", elsewhere)
    (snapshot,) = cache.rglob("snapshots/*")
    os.remove(snapshot / "model.safetensors")
    hub.requests.clear()
    HfBase.load("owner/name", device="cpu")
    assert hub.requests


def test_what_the_hub_cannot_give_is_one_line(
    hub: Hub, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    import huggingface_hub

    for name, words in (
        ("owner/text", "'bert' is no kind of depth model"),
        ("owner/absent", "the hub has no such model, or only for its owner: check"),
        ("owner/gated", "its owner asks for consent: give it on the model's page"),
    ):
        with pytest.raises(InputError, match=f"^hf:{name}: {words}"):
            HfBase.load(name)
    assert not any("model.safetensors" in request for request in hub.requests)  # no weights of what is no depth model
    closed = functools.partial(huggingface_hub.snapshot_download, endpoint="http://127.0.0.1:9")
    monkeypatch.setattr(huggingface_hub, "snapshot_download", closed)
    with pytest.raises(InputError, match=r"^hf:owner/name: not on this machine yet, and the hub cannot be reached"):
        HfBase.load("owner/name")
    assert capfd.readouterr() == ("", "")
