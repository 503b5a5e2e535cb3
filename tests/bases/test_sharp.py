"""SHARP's network against numbers that the original computed, and against itself in other precisions and batches."""

from __future__ import annotations

import functools
from pathlib import Path

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
from spackle.bases.sharp.base import PARAMETERS, UNUSED, expected_shapes, load_network, to_metric
from spackle.bases.sharp.encoder import FULL, FULL_WINDOWS, HALF_WINDOWS, TINY, SharpConfig, cut, merge, set_precision
from spackle.bases.sharp.network import GroupNorm, SharpNetwork, compose, make_start
from spackle.bases.sharp.unproject import stretch_gaussians
from spackle.device import enough_memory, multiplies_bf16, own_arithmetic, pick_device, pick_dtype
from spackle.image import Photo, load_photo
from spackle.render import CpuRenderer

CPU = torch.device("cpu")
GOLDEN = dict(np.load(DATA / "sharp_tiny_golden.npz"))
STRETCH = (1600 / (2 * 1200), 1200 / (2 * 1200), 1.0)  # of the golden numbers' photo


def run_small(config: SharpConfig, dtype: torch.dtype) -> tuple[Tensor, spackle.Gaussians]:
    """What the depth head says, [2, side, side], and the Gaussians in normalised space."""
    network = SharpNetwork(config).eval()
    weights = tiny_weights(config)
    network.load_state_dict({name: weights[name] for name in network.state_dict()})
    set_precision(network, dtype)
    heard: list[Tensor] = []
    network.monodepth_model.monodepth_predictor.head.register_forward_hook(lambda head, x, out: heard.append(out[0]))
    with torch.inference_mode():
        output = network(waves(config.side), 0.8, batch=5)
        return heard[0], compose(output.start, output.deltas)


def off(found: Tensor, golden: np.ndarray) -> float:
    """The largest difference, relative to the largest golden number."""
    return float(np.abs(found.numpy() - golden).max() / np.abs(golden).max())


def test_the_network_has_the_tensors_of_the_published_checkpoint_that_are_used() -> None:
    lines = (DATA / "sharp_tensors.txt").read_text().splitlines()
    published = {name: tuple(int(n) for n in shape.split(",")) for name, shape in map(str.split, lines)}
    assert (len(published), sum(int(np.prod(shape)) for shape in published.values())) == (1038, PARAMETERS)
    assert expected_shapes(FULL) == {name: shape for name, shape in published.items() if not name.startswith(UNUSED)}
    assert gaussians_of(FULL) == 1_179_648


def test_the_tiny_network_gives_the_originals_depth_and_gaussians() -> None:
    disparity, gaussians = run_small(TINY, torch.float32)
    assert off(disparity[:, ::48, ::48], GOLDEN["disparity"]) < 1e-5
    index = torch.from_numpy(GOLDEN["index"].astype(np.int64))
    columns = [gaussians.means, gaussians.scales, gaussians.quats, gaussians.colors, gaussians.opacities[:, None]]
    found = torch.cat(columns, dim=1)[index].split([3, 3, 4, 3, 1], dim=1)
    golden = np.split(GOLDEN["gaussians_ndc"], [3, 6, 10, 13], axis=1)
    assert all(off(one, other) < 1e-5 for one, other in zip(found, golden, strict=True))
    world = stretch_gaussians(gaussians, STRETCH).select(index)
    assert off(world.means, GOLDEN["means_world"]) < 1e-5
    error = np.abs(world.covariances().numpy() - GOLDEN["covariances_world"]).max((1, 2))
    assert float((error / np.abs(GOLDEN["covariances_world"]).max((1, 2))).max()) < 1e-4


def test_bf16_draws_the_same_picture_to_45_db() -> None:
    camera = spackle.Camera.from_focal(300, 400, 300)
    sets = [run_small(MICRO, dtype)[1] for dtype in (torch.float32, torch.bfloat16)]
    views = [CpuRenderer().render(stretch_gaussians(gaussians, STRETCH), camera).rgb for gaussians in sets]
    assert psnr(*views) > 45
    assert not torch.equal(*views)


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


def test_extreme_depths_make_finite_gaussians() -> None:
    for extreme in (1e-8, 1e9):
        assert compose(make_start(waves(8), torch.full((1, 2, 8, 8), extreme)), torch.zeros(14, 2, 4, 4)).finite


@pytest.mark.parametrize(("name", "size"), [("one.png", (1, 1)), ("long.png", (10_000, 10)), ("deep.png", (64, 48))])
def test_odd_photos_become_gaussians_in_front_of_their_camera(tmp_path: Path, name: str, size: tuple[int, int]) -> None:
    image = Image.fromarray(picture()).resize(size)
    if name == "deep.png":
        image = Image.fromarray(np.asarray(image.convert("L")).astype(np.uint16) * 257)
    image.save(tmp_path / name)
    seen: list[tuple[int, int]] = []
    base = SharpBase(micro_network(), weights="w.pt")
    prediction = base.predict(load_photo(tmp_path / name), lambda done, total: seen.append((done, total)))
    assert prediction.notes == {"precision": "fp32", "weights": "w.pt"}
    camera, gaussians = prediction.camera, prediction.gaussians
    assert (camera.width, camera.height) == ((1536, 2) if name == "long.png" else image.size)
    assert len(gaussians) == gaussians_of(MICRO)
    assert seen[-1] == (35, 35)
    uv, z = camera.project(gaussians.means)
    assert gaussians.finite
    assert bool((z > 0).all())
    inside = (uv >= -1) & (uv <= torch.tensor([camera.width + 1, camera.height + 1]))
    assert bool(inside.all())  # each cell's Gaussian lies in its cell, give or take a delta
    assert float(CpuRenderer().render(gaussians, camera).alpha.mean()) > 0.5


def test_depth_goes_with_focal_length_over_width() -> None:
    """As the paper has it; sideways positions do not."""
    base = SharpBase(micro_network())
    rgb = torch.rand(20, 30, 3)
    near, far = (base.predict(Photo(rgb, f, "EXIF", Path("a.jpg"))).gaussians.means for f in (30.0, 60.0))
    torch.testing.assert_close(far[:, 2], 2 * near[:, 2], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(far[:, :2], near[:, :2], rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_both_kinds_of_file_give_the_same_network(tmp_path: Path, suffix: str, dtype: torch.dtype) -> None:
    weights, path = tiny_weights(), write_tiny(tmp_path / f"weights{suffix}")
    network = load_network(path, dtype)
    path.write_bytes(bytes(path.stat().st_size))  # what was read from it stays
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor.float(), weights[name].to(tensor.dtype).float()), name
    heavy = network.feature_model.fusion.out_conv.weight
    assert (heavy.dtype, heavy.requires_grad, network.training) == (dtype, False, False)
    assert heavy.is_contiguous(memory_format=torch.channels_last)


def test_too_little_memory_to_load_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_tiny(tmp_path / "w.pt")
    for kind, method, advice in ((Tensor, "float", "try --precision bf16, or close"), (torch, "empty", "close")):
        with monkeypatch.context() as patch:
            # What the allocator really says when a computer has no such memory.
            patch.setattr(kind, method, lambda *arguments, **options: torch.zeros(2**60, dtype=torch.uint8))
            with pytest.raises(spackle.InputError, match=f"not enough memory for the network: {advice}"):
                SharpBase.load(path, precision="fp32", device="cpu")


@pytest.mark.parametrize(("flag", "native"), [("amx_bf16", True), ("avx512_bf16", True), ("avx512_f", False)])
def test_auto_is_bf16_where_the_hardware_multiplies_it(
    monkeypatch: pytest.MonkeyPatch, flag: str, native: bool
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {flag: True})
    assert multiplies_bf16(CPU) is native
    assert pick_dtype("auto", CPU) == (torch.bfloat16 if native else torch.float32)
    assert (pick_dtype("fp32", CPU), pick_dtype("bf16", CPU)) == (torch.float32, torch.bfloat16)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (8 if native else 7, 0))
    assert multiplies_bf16(torch.device("cuda")) is native  # from Ampere on


def test_a_device_is_taken_where_it_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spackle.bases.sharp.base.load_network", lambda *args: pytest.fail("read"))
    for count, names in ((0, ["cuda", "ban\x1b[31mana\n", "meta", ""]), (2, ["cuda:2"])):
        monkeypatch.setattr(torch.cuda, "is_available", lambda count=count: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda count=count: count)
        for name in names:
            with pytest.raises(spackle.InputError, match=r"give cpu|the last CUDA device is cuda:1") as caught:
                SharpBase.load(tmp_path / "any.pt", device=name)
            assert str(caught.value).isprintable()
    assert (pick_device(None), pick_device("cpu")) == (torch.device("cuda"), CPU)
    assert pick_device("cuda:1") == torch.device("cuda:1")


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes."),
        RuntimeError("[enforce fail] not enough memory: you tried to allocate 9 bytes."),  # Windows
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
        RuntimeError("unable to mmap 9 bytes from file <w.pt>: Cannot allocate memory (12)"),
        MemoryError(),
    ],
)
def test_too_little_memory_is_one_line(error: Exception) -> None:
    words = r"^not enough memory .*: try this, or close other programs$"
    with pytest.raises(spackle.InputError, match=words), enough_memory("try this"):
        raise error
    with pytest.raises(RuntimeError, match="shapes"), enough_memory():
        raise RuntimeError("shapes do not fit")


def test_the_callers_autocast_stays_outside() -> None:
    base, photo = SharpBase(micro_network()), Photo(torch.rand(20, 30, 3), 40.0, "EXIF", Path("a.jpg"))
    expected = to_metric(base.infer(photo), photo)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = to_metric(base.infer(photo), photo)
        assert torch.is_autocast_enabled("cpu")
    assert all(map(torch.equal, found.tensors, expected.tensors))


@pytest.mark.parametrize(
    ("switch", "value"),
    [("cuda.matmul.allow_tf32", True), ("cuda.matmul.fp32_precision", "tf32"), ("fp32_precision", "tf32")],
)
def test_tf32_is_off_on_a_gpu_and_then_as_the_caller_had_it(switch: str, value: object) -> None:
    """The switches exist without a GPU too."""

    def switches() -> list[str]:
        return [torch.backends.cuda.matmul.fp32_precision, torch.backends.cudnn.conv.fp32_precision]

    matmul, conv = switches()
    *path, name = switch.split(".")
    try:
        setattr(functools.reduce(getattr, path, torch.backends), name, value)
        before = switches()
        assert "tf32" in before
        with own_arithmetic(CPU):
            assert switches() == before
        with own_arithmetic(torch.device("cuda")):
            assert switches() == ["ieee", "ieee"]
        with pytest.raises(RuntimeError), own_arithmetic(torch.device("cuda")):
            torch.zeros(2) + torch.zeros(3)
        assert switches() == before
    finally:
        torch.set_float32_matmul_precision("highest")
        torch.backends.cudnn.allow_tf32 = True
        torch.backends.fp32_precision = "none"
        torch.backends.cuda.matmul.fp32_precision, torch.backends.cudnn.conv.fp32_precision = matmul, conv
