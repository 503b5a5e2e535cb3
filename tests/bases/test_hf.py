"""The hf base: what depth models of transformers say, in metres, at the right place, or in one line why not."""

from __future__ import annotations

import contextlib
import copy
import functools
import json
import math
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from scenes import box_before_wall
from stand_in import publish
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases import hf
from spackle.bases.depth_map import DepthMap
from spackle.bases.hf import FARTHEST_M, HfBase, meaning_of, to_depth_map
from spackle.bases.lift import lift
from spackle.bases.open import open_base
from spackle.bases.protocol import NEAREST_M
from spackle.bases.settings import BaseSettings
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


# What comes out.


@pytest.fixture
def pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each pixel has a Gaussian of its own."""
    monkeypatch.setattr(hf, "lift", functools.partial(lift, levels=0))


@pytest.mark.usefixtures("pixels")
@pytest.mark.parametrize("name", MODELS)
def test_each_kind_of_model_gives_gaussians_with_the_photos_colours(name: str, folders: dict[str, Path]) -> None:
    photo, base = photo_of(), load(folders[name])
    prediction = base.predict(photo)
    assert base.name == f"hf:{folders[name]}"
    front = photo.width * photo.height
    colors = srgb_to_linear(photo.rgb).reshape(-1, 3)
    assert float((prediction.gaussians.colors[:front] - colors).abs().mean()) < 0.006
    assert all(bool(torch.isfinite(tensor).all()) for tensor in prediction.gaussians.tensors)
    uv, z = prediction.camera.project(prediction.gaussians.means[:front])
    torch.testing.assert_close(uv, prediction.camera.pixel_centers().reshape(-1, 2), rtol=0, atol=1e-2)
    assert float(z.max() / z.min()) > 1.01
    said = "relative, scaled to 1.5–30 m" if name in RELATIVE else "metric, by the model"
    assert prediction.notes["depth_scale"] == said
    assert prediction.notes["precision"] == "fp32"
    assert "depth_invalid_pixels" not in prediction.notes
    assert (prediction.camera.focal, prediction.lens_source) == ((80.0, 80.0), "")
    assert all(isinstance(value, str | int | float) for value in prediction.notes.values())


@pytest.mark.parametrize("name", ["metric", "glpn", *RELATIVE])
@pytest.mark.parametrize(("width", "height"), [(96, 64), (61, 83)])
def test_the_map_is_the_models_output_as_transformers_gives_it(
    name: str, width: int, height: int, folders: dict[str, Path], maps: list[DepthMap]
) -> None:
    photo = photo_of(width, height)
    output, processor = by_hand(folders[name], photo)
    expected = processor.post_process_depth_estimation(output)[0]["predicted_depth"]
    load(folders[name]).predict(photo)
    (found,) = maps
    assert bool(found.valid.all())
    assert (found.K, found.quantum, found.path) == (None, None, photo.path)
    if name in RELATIVE:
        share = (1 / found.depth - 1 / FARTHEST_M) / (1 / NEAREST_M - 1 / FARTHEST_M)
        near = float(expected.flatten().kthvalue(1 + round(0.999 * (expected.numel() - 1))).values)
        torch.testing.assert_close(share, (expected / near).clamp(0, 1), rtol=1e-4, atol=1e-5)
    else:
        torch.testing.assert_close(found.depth, expected, rtol=1e-5, atol=0)


def test_a_photo_larger_than_the_working_size_is_looked_at_and_lifted_at_that_size(folders: dict[str, Path]) -> None:
    big = Photo(torch.rand(40, 1600, 3, generator=torch.Generator().manual_seed(0)), 1600.0, "EXIF", Path("photo.png"))
    prediction = load(folders["metric"]).predict(big)
    assert (prediction.camera.width, prediction.camera.height) == (1536, 38)
    assert prediction.camera.focal[0] == pytest.approx(1536)


# What a model sees.


def test_tips_sees_the_photo_stretched_as_pillow_does_it(folders: dict[str, Path]) -> None:
    photo = photo_of(192, 128)
    pixels, _ = load(folders["tips"]).prepare(photo.rgb)
    resized = torch.from_numpy(np.array(image_of(photo).resize((56, 42), Image.Resampling.BILINEAR)))
    torch.testing.assert_close(pixels[0], resized.permute(2, 0, 1) / 255, rtol=0, atol=1.5 / 255)


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
    prepare = load(folders[name]).prepare
    base = HfBase("hf:x", Brightness(mean, std), prepare, "metres", "fp32")
    base.predict(Photo(rgb, 300.0, "EXIF", Path("photo.png")))
    near = maps[0].depth < 4
    # ZoeDepth's processor puts corner pixels on corners, its post-processing, followed here, edges on edges.
    within = 0.9 if name == "zoedepth" else 0.6
    for axis, sides in ((1, (height, height // 4, height // 2)), (0, (width, width // 3, 3 * width // 4))):
        seen = near.any(dim=axis)
        pixel = sides[0] / len(seen)
        first, last = (int(seen.nonzero().flatten()[end]) for end in (0, -1))
        assert pixel * first == pytest.approx(sides[1], abs=within * pixel)
        assert pixel * (last + 1) == pytest.approx(sides[2], abs=within * pixel)


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


def depth_pro_by_hand(folder: Path, photo: Photo) -> tuple[Tensor, float]:
    """Inverse canonical depth and field of view in degrees."""
    settings = json.loads((folder / "preprocessor_config.json").read_text())
    network = transformers.DepthProForDepthEstimation.from_pretrained(folder).eval()
    mean, std = (torch.tensor(settings[key]) for key in ("image_mean", "image_std"))
    pixels = interpolate(((photo.rgb - mean) / std).permute(2, 0, 1)[None], (64, 64), mode="bilinear")
    with torch.no_grad():
        output = network(pixel_values=pixels)
    return output.predicted_depth[0], float(output.field_of_view)


def test_depth_pro_gives_the_lens_where_nobody_knows_it_and_else_scales_its_depth_to_it(
    folders: dict[str, Path], maps: list[DepthMap]
) -> None:
    base, unknown = load(folders["depth_pro"]), photo_of(focal=90.0, source=f"default {DEFAULT_FOCAL_MM:g} mm")
    canonical, fov = depth_pro_by_hand(folders["depth_pro"], unknown)
    assert 20 < fov < 90
    seen = 0.5 * unknown.width / math.tan(math.radians(fov) / 2)
    photos = [
        unknown,
        *(photo_of(focal=focal, source=source) for focal, source in ((48.0, "EXIF"), (192.0, "--focal-px"))),
    ]
    for photo, focal, source in zip(photos, (seen, 48.0, 192.0), ("Depth Pro", "", ""), strict=True):
        prediction = base.predict(photo)
        assert prediction.camera.focal == pytest.approx((focal, focal), rel=1e-4)
        assert prediction.lens_source == source
        # The formula of its image processor, which exists for torchvision alone.
        expected = 1 / (canonical * photo.width / focal).clamp(1e-4, 1e4)
        torch.testing.assert_close(maps[-1].depth, expected, rtol=1e-3, atol=0)


# What the numbers mean.


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, "no kind of depth model that is known here: give one of depth_anything, depth_pro"),
        ({"model_type": ["dpt"]}, "no kind of depth model"),
        ({"model_type": "chmv2"}, "'chmv2' is no kind"),  # it measures how high trees stand
        ({"model_type": "depth_anything", "depth_estimation_type": ["metric"]}, "neither relative nor metric"),
    ],
)
def test_an_output_that_nobody_can_read_is_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        meaning_of(settings, "hf:x")
    for kind in ({"model_type": "depth_anything"}, {"model_type": "dpt", "backbone_config": {"model_type": "beit"}}):
        assert meaning_of(kind, "hf:x") == "relative disparity"  # the default, and MiDaS


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
    def prepare(rgb: Tensor) -> tuple[Tensor, hf.Window]:
        return rgb.permute(2, 0, 1)[None], hf.WHOLE

    return HfBase("hf:a/b", Says(depth, fov).eval(), prepare, meaning, "fp32")


SLOPE = torch.linspace(2, 5, 96).expand(1, 64, 96).contiguous()


@pytest.mark.parametrize(
    ("depth", "meaning", "words"),
    [
        (torch.zeros(1, 64, 96), "metres", "predicts 0 to 0, which is no depth"),
        (torch.full((1, 64, 96), 3.0), "relative disparity", "predicts 3 to 3"),
        (torch.full((1, 64, 96), math.nan), "metres", "predicts nan to nan"),
        (-SLOPE, "metres", "predicts -5 to -2"),
        (-SLOPE, "canonical disparity", "predicts -5 to -2"),
        (SLOPE[0], "metres", r"fails \(an output of shape \(64, 96\)\)"),
    ],
)
def test_an_output_that_is_no_depth_is_one_line_with_photo_and_model(depth: Tensor, meaning: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        saying(depth, meaning).predict(photo_of())
    assert str(caught.value).startswith("photo.png: hf:a/b ")
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("pixels")
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


@pytest.mark.parametrize("fov", [0.0, 179.999, math.nan])
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
    monkeypatch.setattr(base.network, "forward", lambda **_: (_ for _ in ()).throw(RuntimeError(words)))
    with pytest.raises(InputError, match=r"not enough memory .*: give a smaller model"):
        base.predict(photo_of())


# Precision.


def test_bf16_is_close_to_fp32_without_stairs_and_repeats(folders: dict[str, Path], maps: list[DepthMap]) -> None:
    photo = photo_of()
    exact, low = load(folders["metric"]), load(folders["metric"], "bf16")
    assert (exact.precision, low.precision) == ("fp32", "bf16")
    for base in (exact, low, low):
        assert base.predict(photo).notes["precision"] == base.precision
    with torch.autocast("cpu", torch.bfloat16):  # the caller's changes nothing
        exact.predict(photo)
    one, other, again, within = (found.depth for found in maps)
    assert torch.equal(one, within)
    assert not torch.equal(one, other)
    torch.testing.assert_close(other, one, rtol=0.02, atol=0)
    assert torch.equal(other, again)
    assert len(other.unique()) > 0.9 * len(one.unique())  # bfloat16 has 128 numbers between 8 and 16 m


def test_weights_of_half_precision_are_widened(folders: dict[str, Path], tmp_path: Path, maps: list[DepthMap]) -> None:
    folder = shutil.copytree(folders["metric"], tmp_path / "half")
    tensors = {key: value.half() for key, value in load_file(folder / "model.safetensors").items()}
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    settings = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(settings | {"dtype": "float16"}))
    base = load(folder)
    assert {parameter.dtype for parameter in base.network.parameters()} == {torch.float32}
    base.predict(photo_of())
    load(folders["metric"]).predict(photo_of())
    torch.testing.assert_close(maps[0].depth, maps[1].depth, rtol=0.02, atol=0)


# Folders that are no model.


def without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def writing(name: str, content: str | bytes) -> Callable[[Path], None]:
    data = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / name).write_bytes(data) and None


def cut(folder: Path) -> None:
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1000])


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


INPUT = "preprocessor_config.json"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (without("config.json"), "'None' is no kind of depth model"),
        (writing("config.json", "{"), "cannot be loaded .*config.json"),
        (writing("config.json", "[]"), "cannot be loaded"),
        (writing("config.json", '{"model_type": "bert"}'), "'bert' is no kind of depth model"),
        (with_setting("config.json", neck_hidden_sizes="many"), "cannot be loaded"),
        (with_setting("config.json", reassemble_hidden_size=48), "its weights have another shape for"),
        (without(INPUT), "cannot be loaded .*image processor"),
        (writing(INPUT, '{"image_processor_type": "Crystal"}'), "cannot be loaded|fails"),
        (pickled, "model.safetensors"),
        (cut, "cannot be loaded"),
        (lacking("head"), "its weights lack .*: give the weights that belong to its config.json"),
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
    [{"size": {"height": 1 << 20, "width": 64}}, {"size": 64}, {"resample": 3}],
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
    load(folder).predict(photo_of())
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


def test_a_missing_package_is_named(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(InputError, match=r"pip install 'spackle-nvs\[hf\]'"):
        HfBase.load(str(folders["metric"]))


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


# The hub, of which only the cache can be had here.


@pytest.fixture
def cached(folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of owner/name in the hub's cache, on a machine without network."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    commit = "0123456789abcdef0123456789abcdef01234567"
    model = tmp_path / "hub" / "models--owner--name"
    (model / "refs").mkdir(parents=True)
    (model / "refs" / "main").write_text(commit)
    return shutil.copytree(folders["metric"], model / "snapshots" / commit)


def test_a_model_in_the_hubs_cache_needs_no_network(cached: Path, folders: dict[str, Path]) -> None:
    base = HfBase.load("owner/name", device="cpu", precision="fp32")
    assert base.name == "hf:owner/name"
    means = load(folders["metric"]).predict(photo_of()).gaussians.means
    assert torch.equal(base.predict(photo_of()).gaussians.means, means)


@pytest.mark.parametrize("missing", ["config.json", INPUT, "model.safetensors"])
def test_what_neither_cache_nor_hub_give_is_one_line(cached: Path, missing: str) -> None:
    (cached / missing).unlink()
    for name in ("owner/name", "owner/absent"):
        with pytest.raises(InputError, match=f"^hf:{name}: cannot be loaded ") as caught:
            HfBase.load(name)
        assert "\n" not in str(caught.value)


def test_auto_takes_depth_anything_before_lite(
    folders: dict[str, Path], shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo = photo_of()
    assert open_base(BaseSettings()).predict(photo)[1].base == "lite"
    with pytest.raises(InputError, match="--base depth: not on this machine: `spackle weights get depth`"):
        open_base(BaseSettings("depth"))
    content = (folders["relative"] / "model.safetensors").read_bytes()
    entry = publish(monkeypatch, "depth", content)
    file = tmp_path / "weights" / entry.file
    shutil.copytree(folders["relative"], file.parent)
    expected = load(folders["relative"]).predict(photo).gaussians
    for name in ("auto", "depth"):
        prediction, choice = open_base(BaseSettings(name, precision="fp32", device="cpu")).predict(photo)
        assert choice.base == "depth"
        assert torch.equal(prediction.gaussians.means, expected.means)
    file.write_bytes(content[::-1])
    choice = open_base(BaseSettings()).predict(photo)[1]
    assert (choice.base, "SHA-256 is not the published one" in choice.failures[0]) == ("lite", True)
