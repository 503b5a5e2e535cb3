"""SHARP's network against the original's results, and in other precisions and batches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import DATA
from helpers.scenes import psnr
from helpers.sharp_weights import (
    MICRO_SIZE,
    gaussians_of,
    micro_network,
    tiny_weights,
    waves,
    write_tiny,
)
from torch import Tensor, nn

import spackle
from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.base import (
    UNUSED_PREFIXES,
    expected_shapes,
    load_network,
    to_metric,
)
from spackle.bases.sharp.encoder import (
    FULL_SIZE,
    TINY_SIZE,
    WINDOW_COUNT,
    SharpConfig,
    set_precision,
)
from spackle.bases.sharp.network import (
    GroupNorm,
    SharpNetwork,
    apply_deltas,
    make_initial_gaussians,
)
from spackle.bases.sharp.stretch import stretch_gaussians
from spackle.core.focal_length import FocalSource
from spackle.core.photo import Photo
from spackle.render import CpuRenderer
from spackle.runtime.device import (
    has_native_bf16,
    pick_device,
    pick_dtype,
    report_memory_shortage,
    without_autocast_or_tf32,
)
from spackle.runtime.errors import InputError

CPU = torch.device("cpu")
GOLDEN = dict(np.load(DATA / "sharp_tiny_golden.npz"))
STRETCH = (1600 / (2 * 1200), 1200 / (2 * 1200), 1.0)  # of the golden numbers' photo


def run_small(config: SharpConfig, dtype: torch.dtype) -> tuple[Tensor, spackle.Gaussians]:
    """The output of the depth head [2, side, side], and the Gaussians in normalised space."""
    network = SharpNetwork(config).eval()
    weights = tiny_weights(config)
    network.load_state_dict({name: weights[name] for name in network.state_dict()})
    set_precision(network, dtype)
    heard: list[Tensor] = []
    network.monodepth_model.monodepth_predictor.head.register_forward_hook(
        lambda head, x, out: heard.append(out[0])
    )
    with torch.inference_mode():
        output = network(waves(config.side), 0.8, windows_per_batch=5)
        return heard[0], apply_deltas(output.initial, output.deltas)


def off(found: Tensor, golden: np.ndarray) -> float:
    """The largest difference, relative to the largest golden number."""
    return float(np.abs(found.numpy() - golden).max() / np.abs(golden).max())


def test_the_network_has_the_tensors_of_the_published_checkpoint_that_are_used() -> None:
    lines = (DATA / "sharp_tensors.txt").read_text().splitlines()
    published = {
        name: tuple(int(n) for n in shape.split(",")) for name, shape in map(str.split, lines)
    }
    assert (len(published), sum(int(np.prod(shape)) for shape in published.values())) == (
        1038,
        702_305_169,
    )
    assert expected_shapes(FULL_SIZE) == {
        name: shape for name, shape in published.items() if not name.startswith(UNUSED_PREFIXES)
    }
    assert gaussians_of(FULL_SIZE) == 1_179_648


def test_the_tiny_network_gives_the_originals_depth_and_gaussians() -> None:
    disparity, gaussians = run_small(TINY_SIZE, torch.float32)
    assert off(disparity[:, ::48, ::48], GOLDEN["disparity"]) < 1e-5
    index = torch.from_numpy(GOLDEN["index"].astype(np.int64))
    columns = [
        gaussians.means,
        gaussians.scales,
        gaussians.quats,
        gaussians.colors,
        gaussians.opacities[:, None],
    ]
    found = torch.cat(columns, dim=1)[index].split([3, 3, 4, 3, 1], dim=1)
    golden = np.split(GOLDEN["gaussians_ndc"], [3, 6, 10, 13], axis=1)
    assert all(off(one, other) < 1e-5 for one, other in zip(found, golden, strict=True))
    world = stretch_gaussians(gaussians, STRETCH).select(index)
    assert off(world.means, GOLDEN["means_world"]) < 1e-5
    error = np.abs(world.covariances().numpy() - GOLDEN["covariances_world"]).max((1, 2))
    assert float((error / np.abs(GOLDEN["covariances_world"]).max((1, 2))).max()) < 1e-4


def test_bf16_renders_the_same_picture_to_45_db() -> None:
    camera = spackle.Camera.from_focal(300, 400, 300)
    sets = [run_small(MICRO_SIZE, dtype)[1] for dtype in (torch.float32, torch.bfloat16)]
    views = [
        CpuRenderer().render(stretch_gaussians(gaussians, STRETCH), camera).rgb
        for gaussians in sets
    ]
    assert psnr(*views) > 45
    assert not torch.equal(*views)


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
        assert apply_deltas(
            make_initial_gaussians(waves(8), torch.full((1, 2, 8, 8), extreme)),
            torch.zeros(14, 2, 4, 4),
        ).finite


def test_depth_goes_with_focal_length_over_width() -> None:
    base = SharpBase(micro_network())
    rgb = torch.rand(20, 30, 3)
    near, far = (
        base.predict(Photo(rgb, f, FocalSource.EXIF, Path("a.jpg"))).gaussians.means
        for f in (30.0, 60.0)
    )
    torch.testing.assert_close(far[:, 2], 2 * near[:, 2], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(far[:, :2], near[:, :2], rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_pt_and_safetensors_give_the_same_network(
    tmp_path: Path, suffix: str, dtype: torch.dtype
) -> None:
    weights, path = tiny_weights(), write_tiny(tmp_path / f"weights{suffix}")
    network = load_network(path, dtype)
    path.write_bytes(bytes(path.stat().st_size))  # must not change the network
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor.float(), weights[name].to(tensor.dtype).float()), name
    heavy = network.feature_model.fusion.out_conv.weight
    assert (heavy.dtype, heavy.requires_grad, network.training) == (dtype, False, False)
    assert heavy.is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize(
    ("flag", "native"), [("amx_bf16", True), ("avx512_bf16", True), ("avx512_f", False)]
)
def test_auto_is_bf16_if_the_hardware_multiplies_it(
    monkeypatch: pytest.MonkeyPatch, flag: str, native: bool
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {flag: True})
    assert has_native_bf16(CPU) is native
    assert pick_dtype("auto", CPU) == (torch.bfloat16 if native else torch.float32)
    assert (pick_dtype("fp32", CPU), pick_dtype("bf16", CPU)) == (torch.float32, torch.bfloat16)
    with pytest.raises(InputError, match="`precision` fp16 is unknown"):
        pick_dtype("fp16", CPU)  # type: ignore[arg-type]
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (8 if native else 7, 0))
    assert has_native_bf16(torch.device("cuda")) is native  # from Ampere on


def test_unknown_devices_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spackle.bases.sharp.base.load_network", lambda *args: pytest.fail("read"))
    for count, names in ((0, ["cuda", "ban\x1b[31mana\n", "meta", ""]), (2, ["cuda:2"])):
        monkeypatch.setattr(torch.cuda, "is_available", lambda count=count: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda count=count: count)
        for name in names:
            with pytest.raises(spackle.InputError, match=r"give cpu|give at most cuda:1") as caught:
                SharpBase.load(tmp_path / "any.pt", device=name)
            assert str(caught.value).isprintable()
    assert (pick_device(None), pick_device("cpu")) == (torch.device("cuda"), CPU)
    assert pick_device("cuda:1") == torch.device("cuda:1")


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError(
            "[enforce fail] DefaultCPUAllocator: can't allocate memory: "
            "you tried to allocate 9 bytes."
        ),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
        MemoryError(),
    ],
)
def test_too_little_memory_is_one_line(error: Exception) -> None:
    words = r"^not enough memory .*: try this, or close other programs$"
    with pytest.raises(spackle.InputError, match=words), report_memory_shortage("try this"):
        raise error
    with pytest.raises(RuntimeError, match="shapes"), report_memory_shortage():
        raise RuntimeError("shapes do not fit")


def test_the_callers_autocast_has_no_effect() -> None:
    base, photo = (
        SharpBase(micro_network()),
        Photo(torch.rand(20, 30, 3), 40.0, FocalSource.EXIF, Path("a.jpg")),
    )
    expected = to_metric(base.infer(photo), photo)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = to_metric(base.infer(photo), photo)
        assert torch.is_autocast_enabled("cpu")
    assert all(map(torch.equal, found.tensors, expected.tensors))


def test_tf32_is_off_during_own_arithmetic_on_a_gpu() -> None:
    switches = (
        torch.backends.cuda.matmul,
        torch.backends.cudnn.conv,
    )  # they exist without a GPU, too
    before = [switch.fp32_precision for switch in switches]
    try:
        switches[0].fp32_precision = "tf32"
        with without_autocast_or_tf32(CPU):
            assert switches[0].fp32_precision == "tf32"
        with without_autocast_or_tf32(torch.device("cuda")):
            assert [switch.fp32_precision for switch in switches] == ["ieee", "ieee"]
        assert switches[0].fp32_precision == "tf32"
    finally:
        for switch, value in zip(switches, before, strict=True):
            switch.fp32_precision = value


PHOTO = Photo(
    torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(0)),
    40.0,
    FocalSource.EXIF,
    Path("a.jpg"),
)


@pytest.mark.parametrize(
    ("options", "calls"),
    [({}, 7), ({"windows_per_batch": 9}, 4), ({"windows_per_batch": 1}, WINDOW_COUNT)],
)
def test_the_number_of_windows_at_once_changes_nothing(options: dict[str, Any], calls: int) -> None:
    seen: list[int] = []
    found = SharpBase(micro_network(), **options).infer(
        PHOTO, lambda done, total: seen.append(done)
    )
    assert len(seen) == calls
    assert seen[-1] == WINDOW_COUNT
    expected = SharpBase(micro_network(), windows_per_batch=35).infer(PHOTO)
    torch.testing.assert_close(
        found.initial.disparity_map, expected.initial.disparity_map, rtol=1e-5, atol=1e-6
    )
    torch.testing.assert_close(found.deltas, expected.deltas, rtol=1e-4, atol=1e-4)
