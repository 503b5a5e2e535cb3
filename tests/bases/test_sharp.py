"""SHARP's network against numbers that the original computed, and against itself in other precisions and batches."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from photos import picture
from PIL import Image
from scenes import psnr
from sharp_weights import DATA, MICRO, gaussians_of, micro_network, tiny_weights, waves, write_tiny
from torch import Tensor, nn

import spackle
from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.base import to_metric
from spackle.bases.sharp.checkpoint import expected_shapes
from spackle.bases.sharp.layers import (
    FULL,
    FULL_WINDOWS,
    HALF_WINDOWS,
    TINY,
    GroupNorm,
    cut,
    merge,
    set_precision,
)
from spackle.bases.sharp.network import SharpNetwork, compose, make_start
from spackle.bases.sharp.unproject import stretch_gaussians
from spackle.device import enough_memory, multiplies_bf16, own_arithmetic, pick_device, pick_dtype
from spackle.image import Photo, load_photo
from spackle.render import CpuRenderer

CPU = torch.device("cpu")
GOLDEN = dict(np.load(DATA / "sharp_tiny_golden.npz"))
COLUMNS = {"means": slice(0, 3), "scales": slice(3, 6), "quats": slice(6, 10), "colors": slice(10, 13), "alpha": 13}
STRETCH = (1600 / (2 * 1200), 1200 / (2 * 1200), 1.0)  # of the golden numbers' photo


@functools.cache
def run_tiny(dtype: torch.dtype) -> tuple[Tensor, spackle.Gaussians]:
    """What the depth head says, [2, side, side], and the Gaussians in normalised space."""
    network = SharpNetwork(TINY).eval()
    weights = tiny_weights()
    network.load_state_dict({name: weights[name] for name in network.state_dict()})
    set_precision(network, dtype)
    heard: list[Tensor] = []
    network.monodepth_model.monodepth_predictor.head.register_forward_hook(lambda head, x, out: heard.append(out[0]))
    with torch.inference_mode():
        output = network(waves(), 0.8, batch=5)
        return heard[0], compose(output.start, output.deltas)


def off(found: Tensor, golden: np.ndarray) -> float:
    """The largest difference, relative to the largest golden number."""
    return float(np.abs(found.numpy() - golden).max() / np.abs(golden).max())


def test_the_published_checkpoint_has_exactly_these_tensors() -> None:
    lines = (DATA / "sharp_tensors.txt").read_text().splitlines()
    published = {name: tuple(int(n) for n in shape.split(",")) for name, shape in map(str.split, lines)}
    assert expected_shapes(FULL) == published
    assert (len(published), sum(int(np.prod(shape)) for shape in published.values())) == (1038, 702_305_169)
    assert gaussians_of(FULL) == 1_179_648


@pytest.mark.parametrize("attribute", COLUMNS)
def test_the_tiny_network_gives_the_originals_depth_and_gaussians(attribute: str) -> None:
    disparity, gaussians = run_tiny(torch.float32)
    assert off(disparity[:, ::48, ::48], GOLDEN["disparity"]) < 1e-5
    index = torch.from_numpy(GOLDEN["index"].astype(np.int64))
    columns = [gaussians.means, gaussians.scales, gaussians.quats, gaussians.colors, gaussians.opacities[:, None]]
    found = torch.cat(columns, dim=1)[index]
    assert off(found[:, COLUMNS[attribute]], GOLDEN["gaussians_ndc"][:, COLUMNS[attribute]]) < 1e-5


def test_the_tiny_network_gives_the_originals_gaussians_in_metres() -> None:
    _, gaussians = run_tiny(torch.float32)
    world = stretch_gaussians(gaussians, STRETCH).select(torch.from_numpy(GOLDEN["index"].astype(np.int64)))
    assert off(world.means, GOLDEN["means_world"]) < 1e-5
    error = np.abs(world.covariances().numpy() - GOLDEN["covariances_world"]).max((1, 2))
    assert float((error / np.abs(GOLDEN["covariances_world"]).max((1, 2))).max()) < 1e-4


def test_bf16_draws_the_same_picture_to_45_db() -> None:
    views = []
    for dtype in (torch.float32, torch.bfloat16):
        _, gaussians = run_tiny(dtype)
        camera = spackle.Camera.from_focal(300, 400, 300)
        views.append(CpuRenderer().render(stretch_gaussians(gaussians, STRETCH), camera).rgb)
    assert psnr(*views) > 45
    assert not torch.equal(*views)


@pytest.mark.parametrize("batch", [4, 35])
def test_the_number_of_windows_at_once_changes_nothing(batch: int) -> None:
    network = micro_network()
    with torch.inference_mode():
        expected = network(waves(MICRO.side), 0.8, batch=5)
        found = network(waves(MICRO.side), 0.8, batch)
    torch.testing.assert_close(found.start.disparity_map, expected.start.disparity_map, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(found.deltas, expected.deltas, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("side", "count"), [(1536, FULL_WINDOWS), (768, HALF_WINDOWS)])
def test_windows_are_cut_and_merged_without_a_seam(side: int, count: int) -> None:
    image = waves(side)
    windows = cut(image, 384, count)
    assert windows.shape == (count**2, 3, 384, 384)
    assert torch.equal(windows[1, :, :, 0], image[0, :, :384, (side - 384) // (count - 1)])  # the second goes right
    overlap = 384 - (side - 384) // (count - 1)
    assert torch.equal(merge(windows, overlap // 2), image)


@pytest.mark.parametrize("channels_last", [False, True])
def test_group_norm_is_exact_over_half_a_million_pixels(channels_last: bool) -> None:
    torch.manual_seed(0)
    x = torch.randn(1, 16, 700, 700) * 0.5 + 3
    norm = GroupNorm(8, 16)
    nn.init.normal_(norm.weight), nn.init.normal_(norm.bias)
    expected = nn.functional.group_norm(x.double(), 8, norm.weight.double(), norm.bias.double())
    found = norm(x.to(memory_format=torch.channels_last) if channels_last else x)
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1e-5)
    assert found.shape == x.shape


@pytest.mark.parametrize("extreme", [1e-8, 1e9])
def test_extreme_depths_make_finite_gaussians(extreme: float) -> None:
    odd = compose(make_start(waves(8), torch.full((1, 2, 8, 8), extreme)), torch.zeros(14, 2, 4, 4))
    assert all(bool(torch.isfinite(t).all()) for t in odd.tensors)


def odd_photos() -> dict[str, Image.Image]:
    color = Image.fromarray(picture())
    grey = np.asarray(color.convert("L"))
    return {
        "one.png": color.resize((1, 1)),
        "long.png": color.resize((10_000, 10)),
        "deep.png": Image.fromarray(grey.astype(np.uint16) * 257),
    }


@pytest.mark.parametrize("name", odd_photos())
def test_odd_photos_become_gaussians_in_front_of_their_camera(tmp_path: Path, name: str) -> None:
    image = odd_photos()[name]
    image.save(tmp_path / name)
    seen: list[tuple[int, int]] = []
    photo = load_photo(tmp_path / name)
    base = SharpBase(micro_network(), weights="w.pt")
    prediction = base.predict(photo, lambda done, total: seen.append((done, total)))
    assert prediction.notes == {"precision": "fp32", "weights": "w.pt"}
    camera, gaussians = prediction.camera, prediction.gaussians
    assert (camera.width, camera.height) == ((1536, 2) if name == "long.png" else image.size)
    assert len(gaussians) == gaussians_of(MICRO)
    assert seen[-1] == (35, 35)
    uv, z = camera.project(gaussians.means)
    assert all(bool(torch.isfinite(t).all()) for t in gaussians.tensors)
    assert bool((z > 0).all())
    inside = (uv >= -1).all(-1) & (uv <= torch.tensor([camera.width + 1, camera.height + 1])).all(-1)
    assert bool(inside.all())  # each cell's Gaussian lies in its cell, give or take a delta
    assert float(CpuRenderer().render(gaussians, camera).alpha.mean()) > 0.5


def test_a_wider_lens_sees_the_same_depth_factor_as_the_paper_has_it() -> None:
    """Depth goes with focal length over width, and sideways positions do not."""
    base = SharpBase(micro_network())
    rgb = torch.rand(20, 30, 3)
    near, far = (base.predict(Photo(rgb, f, "EXIF", Path("a.jpg"))).gaussians.means for f in (30.0, 60.0))
    torch.testing.assert_close(far[:, 2], 2 * near[:, 2], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(far[:, :2], near[:, :2], rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize(("flag", "native"), [("amx_bf16", True), ("avx512_bf16", True), ("avx512_f", False)])
def test_auto_is_bf16_where_the_hardware_multiplies_it(
    monkeypatch: pytest.MonkeyPatch, flag: str, native: bool
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {flag: True}, raising=False)
    assert multiplies_bf16(CPU) is native
    assert pick_dtype("auto", CPU) == (torch.bfloat16 if native else torch.float32)
    assert (pick_dtype("fp32", CPU), pick_dtype("bf16", CPU)) == (torch.float32, torch.bfloat16)
    monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert pick_dtype("auto", CPU) == torch.float32  # an older torch cannot tell
    for capability, ampere in (((7, 5), False), ((8, 0), True)):
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device, found=capability: found)
        assert multiplies_bf16(torch.device("cuda")) is ampere


@pytest.mark.parametrize("device", ["cuda", "ban\x1b[31mana\n", "meta", ""])
def test_a_device_that_is_not_there_is_one_line_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr("spackle.bases.sharp.base.load_network", lambda *args: pytest.fail("read"))
    with pytest.raises(spackle.InputError, match="give cpu") as caught:
        SharpBase.load(tmp_path / "any.pt", device=device)
    assert str(caught.value).isprintable()


def test_a_device_that_is_there_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert (pick_device(None), pick_device("cpu")) == (torch.device("cuda"), CPU)
    assert pick_device("cuda:1") == torch.device("cuda:1")
    with pytest.raises(spackle.InputError, match="the last CUDA device is cuda:1"):
        pick_device("cuda:2")


SHORTAGES = {
    "processor": RuntimeError(
        "[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes."
    ),
    "Windows": RuntimeError("[enforce fail] not enough memory: you tried to allocate 9 bytes."),
    "GPU": torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
    "cuBLAS": RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
    "mapping": RuntimeError("unable to mmap 9 bytes from file <w.pt>: Cannot allocate memory (12)"),
    "Python": MemoryError(),
}


@pytest.mark.parametrize("kind", SHORTAGES)
def test_too_little_memory_is_one_line(kind: str) -> None:
    with pytest.raises(spackle.InputError, match=r"^not enough memory .*: try this, or close other programs$"):  # noqa: SIM117
        with enough_memory("try this"):
            raise SHORTAGES[kind]
    with pytest.raises(RuntimeError, match="shapes"), enough_memory():
        raise RuntimeError("shapes do not fit")


def too_much(*arguments: object, **options: object) -> Tensor:
    """What the allocator really says when a computer has no such memory."""
    return torch.empty(2**60, dtype=torch.uint8)


@pytest.mark.parametrize(
    ("kind", "method", "advice"),
    [
        (Tensor, "float", "try --precision bf16, or close"),
        (torch, "load", "close"),  # to map the file
    ],
)
def test_too_little_memory_to_load_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: Any, method: str, advice: str
) -> None:
    path = write_tiny(tmp_path / "w.pt")
    monkeypatch.setattr(kind, method, too_much)
    with pytest.raises(spackle.InputError, match=f"not enough memory for the network: {advice}"):
        SharpBase.load(path, precision="fp32", device="cpu")


def test_the_callers_autocast_stays_outside() -> None:
    base, photo = SharpBase(micro_network()), Photo(torch.rand(20, 30, 3), 40.0, "EXIF", Path("a.jpg"))
    expected = base.look(photo)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = base.look(photo)
        metric = to_metric(found, photo)
        assert torch.is_autocast_enabled("cpu")
    assert torch.equal(found.deltas, expected.deltas)
    assert torch.equal(found.start.disparity_map, expected.start.disparity_map)
    assert all(map(torch.equal, metric.tensors, to_metric(expected, photo).tensors))


def tf32_switches() -> list[str]:
    return [torch.backends.cuda.matmul.fp32_precision, torch.backends.cudnn.conv.fp32_precision]


@pytest.fixture
def _own_tf32_switches() -> Iterator[None]:
    matmul, conv = tf32_switches()
    yield
    torch.set_float32_matmul_precision("highest")
    torch.backends.cudnn.allow_tf32 = True
    torch.backends.fp32_precision = "none"
    torch.backends.cuda.matmul.fp32_precision, torch.backends.cudnn.conv.fp32_precision = matmul, conv


@pytest.mark.usefixtures("_own_tf32_switches")
@pytest.mark.parametrize(
    ("switch", "value"),
    [("cuda.matmul.allow_tf32", True), ("cuda.matmul.fp32_precision", "tf32"), ("fp32_precision", "tf32")],
)
def test_tf32_is_off_on_a_gpu_and_then_as_the_caller_had_it(switch: str, value: object) -> None:
    """The switches exist without a GPU too."""
    *path, name = switch.split(".")
    setattr(functools.reduce(getattr, path, torch.backends), name, value)
    before = tf32_switches()
    assert "tf32" in before
    with own_arithmetic(CPU):
        assert tf32_switches() == before
    with own_arithmetic(torch.device("cuda")):
        assert tf32_switches() == ["ieee", "ieee"]
    assert tf32_switches() == before
    with pytest.raises(RuntimeError), own_arithmetic(torch.device("cuda")):
        torch.zeros(2) + torch.zeros(3)
    assert tf32_switches() == before
    if name == "allow_tf32":
        assert torch.backends.cuda.matmul.allow_tf32  # it refuses to be read where the two disagree
