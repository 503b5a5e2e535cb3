"""The hf base: models of transformers give depth in metres; bad models are refused."""

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

import pytest
import torch
from helpers import DATA
from helpers.scenes import box_before_wall
from PIL import Image
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases import transformers as hf
from spackle.bases.depth import lift_rgbd
from spackle.bases.transformers import FARTHEST_M, HfBase, meaning_of
from spackle.core.focal_length import FocalSource
from spackle.core.photo import Photo
from spackle.depth.depth_map import DepthMap
from spackle.depth.units import RELATIVE_NEAR_M
from spackle.runtime.errors import InputError

transformers = pytest.importorskip(
    "transformers", reason="depth models need transformers: pip install -e '.[dev]'"
)

CONFIG, INPUT, WEIGHTS = "config.json", "preprocessor_config.json", "model.safetensors"
MODELS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    name: (entry["class"], entry["settings"], entry["input"])
    for name, entry in json.loads((DATA / "depth_models.json").read_text()).items()
}  # tiny models of the published kinds: class, settings, and the image processor's settings
RELATIVE = ("relative", "dpt")
Folders = dict[str, Path]  # by the names in `MODELS`


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Folders:
    """Tiny models of the real classes with random weights, saved like published models."""
    root = tmp_path_factory.mktemp("models")
    for name, (kind, settings, preparation) in MODELS.items():
        generator = torch.Generator().manual_seed(1)
        config = getattr(transformers, f"{kind}Config")(**copy.deepcopy(settings))
        network = getattr(transformers, f"{kind}ForDepthEstimation")(config)
        for parameter in network.requires_grad_(
            False
        ).parameters():  # large enough that the picture decides the output
            fan = parameter[0].numel() if parameter.ndim > 1 else 100
            noise = torch.randn(parameter.shape, generator=generator) / math.sqrt(fan)
            parameter.copy_(noise + (0.3 if parameter.ndim == 1 else 0.0))
        if name == "depth_pro":
            network.fov_model.head.layers[-1].weight.mul_(0.1)
            network.fov_model.head.layers[-1].bias.fill_(55.0)  # degrees
        network.save_pretrained(root / name)
        (root / name / INPUT).write_text(json.dumps(preparation))
    return {name: root / name for name in MODELS}


def photo_of(
    width: int = 96,
    height: int = 64,
    focal: float = 80.0,
    source: FocalSource = FocalSource.EXIF,
) -> Photo:
    return Photo(box_before_wall(width=width, height=height).rgb, focal, source, Path("photo.png"))


@functools.cache
def load(folder: Path, precision: Any = "fp32") -> HfBase:
    return HfBase.load(str(folder), device="cpu", precision=precision)


def image_of(photo: Photo) -> Image.Image:
    return Image.fromarray((photo.rgb * 255).round().to(torch.uint8).numpy())


@pytest.fixture
def maps(monkeypatch: pytest.MonkeyPatch) -> list[DepthMap]:
    seen: list[DepthMap] = []
    monkeypatch.setattr(
        "spackle.bases.depth.lift_rgbd",
        lambda *given, **named: (seen.append(given[1]), lift_rgbd(*given, **named))[1],
    )
    return seen


@pytest.mark.parametrize("name", ["metric", "glpn", *RELATIVE])
@pytest.mark.parametrize(("width", "height"), [(96, 64), (61, 83)])
def test_the_map_is_the_models_output_as_transformers_gives_it(
    name: str, width: int, height: int, folders: Folders, maps: list[DepthMap]
) -> None:
    photo = photo_of(width, height)
    network = transformers.AutoModelForDepthEstimation.from_pretrained(folders[name]).eval()
    processor = transformers.AutoImageProcessor.from_pretrained(folders[name], backend="pil")
    with torch.no_grad():
        output = network(**processor(images=image_of(photo), return_tensors="pt"))
    expected = processor.post_process_depth_estimation(output)[0]["predicted_depth"]
    prediction = load(folders[name]).predict(photo)
    (found,) = maps
    said = "relative, scaled to 1.5–30 m" if name in RELATIVE else "metric, by the model"
    assert (prediction.notes["depth_scale"], prediction.notes["precision"]) == (said, "fp32")
    assert (prediction.camera.focal, prediction.lens_source) == ((80.0, 80.0), "")
    assert bool(found.valid.all())
    assert (found.K, found.quantum, found.path) == (None, None, photo.path)
    if name in RELATIVE:
        share = (1 / found.depth - 1 / FARTHEST_M) / (1 / RELATIVE_NEAR_M - 1 / FARTHEST_M)
        near = float(expected.flatten().kthvalue(1 + round(0.999 * (expected.numel() - 1))).values)
        torch.testing.assert_close(share, (expected / near).clamp(0, 1), rtol=1e-4, atol=1e-5)
    else:
        torch.testing.assert_close(found.depth, expected, rtol=1e-5, atol=0)


class Stub(nn.Module):
    """A network whose output is a function of its input."""

    def __init__(self, depth_of: Callable[[Tensor], Tensor], fov: float | None = None) -> None:
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))
        self.depth_of, self.fov = depth_of, None if fov is None else torch.tensor([fov])

    def forward(self, pixel_values: Tensor) -> Any:
        return SimpleNamespace(predicted_depth=self.depth_of(pixel_values), field_of_view=self.fov)


def test_depth_pro_gives_an_unknown_focal_length_and_scales_its_depth_to_a_known_one(
    folders: Folders, maps: list[DepthMap]
) -> None:
    base, unknown = (
        load(folders["depth_pro"]),
        photo_of(focal=90.0, source=FocalSource.ASSUMED),
    )
    settings = MODELS["depth_pro"][2]
    network = transformers.DepthProForDepthEstimation.from_pretrained(folders["depth_pro"]).eval()
    mean, std = (torch.tensor(settings[key]) for key in ("image_mean", "image_std"))
    pixels = interpolate(
        ((unknown.rgb - mean) / std).permute(2, 0, 1)[None], (64, 64), mode="bilinear"
    )
    with torch.no_grad():
        output = network(pixel_values=pixels)
    fov = float(output.field_of_view)
    assert 20 < fov < 90
    seen = 0.5 * unknown.width / math.tan(math.radians(fov) / 2)
    known = [
        photo_of(focal=focal, source=source)
        for focal, source in ((48.0, FocalSource.EXIF), (192.0, FocalSource.FOCAL_PX))
    ]
    for photo, focal, source in zip(
        [unknown, *known], (seen, 48.0, 192.0), ("Depth Pro", "", ""), strict=True
    ):
        prediction = base.predict(photo)
        assert prediction.camera.focal == pytest.approx((focal, focal), rel=1e-4)
        assert prediction.lens_source == source
        expected = 1 / (output.predicted_depth[0] * photo.width / focal).clamp(1e-4, 1e4)
        torch.testing.assert_close(maps[-1].depth, expected, rtol=1e-3, atol=0)


def test_models_whose_output_has_no_known_meaning_are_refused() -> None:
    unread: list[dict[str, Any]] = [
        {},
        {"model_type": ["dpt"]},
        {"model_type": "chmv2"},  # measures the height of trees
        {"model_type": "depth_anything", "depth_estimation_type": ["metric"]},
        {"model_type": "dpt", "backbone_config": {"model_type": "dinov2"}},
    ]
    for settings in unread:
        with pytest.raises(
            InputError, match="has no known meaning: give a model of type depth_anything, depth_pro"
        ):
            meaning_of(settings, "hf:x")
    for kind in (
        {"model_type": "depth_anything"},
        {"model_type": "dpt", "backbone_config": {"model_type": "beit"}},
    ):
        assert meaning_of(kind, "hf:x") == "relative disparity"


def predicting(depth: Tensor, meaning: Any = "metres", fov: float | None = None) -> HfBase:
    network = Stub(lambda _: depth, fov)
    return HfBase(
        "hf:a/b",
        network,
        lambda rgb: (rgb.permute(2, 0, 1)[None], hf.WHOLE_PICTURE),
        meaning,
        "fp32",
    )


SLOPE = torch.linspace(2, 5, 96).expand(1, 64, 96).contiguous()


@pytest.mark.parametrize(
    ("depth", "meaning", "words"),
    [
        (torch.zeros(1, 64, 96), "metres", "predicts 0 to 0, which cannot be depth"),
        (torch.full((1, 64, 96), 3.0), "relative disparity", "predicts 3 to 3"),
        (
            torch.full((1, 64, 96), math.nan),
            "metres",
            "predicts no finite number, which cannot be depth",
        ),
        (-SLOPE, "metres", "predicts -5 to -2"),
        (SLOPE[0], "metres", r"fails \(.*\): give another photo or model"),
    ],
)
def test_an_output_that_is_no_depth_is_refused(depth: Tensor, meaning: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        predicting(depth, meaning).predict(photo_of())
    assert str(caught.value).startswith("photo.png: hf:a/b ")


def change(folder: Path, file: str, settings: dict[str, Any]) -> None:
    (folder / file).write_text(json.dumps(json.loads((folder / file).read_text()) | settings))


def change_weights(folder: Path, edit: Callable[[dict[str, Tensor]], dict[str, Tensor]]) -> None:
    save_file(edit(load_file(folder / WEIGHTS)), folder / WEIGHTS, metadata={"format": "pt"})


def lacking(folder: Path, prefix: str) -> None:
    change_weights(
        folder, lambda tensors: {key: t for key, t in tensors.items() if not key.startswith(prefix)}
    )


def pickled(folder: Path) -> None:
    torch.save(load_file(folder / WEIGHTS), folder / "pytorch_model.bin")
    (folder / WEIGHTS).unlink()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda folder: (folder / CONFIG).unlink(), "'None' has no known meaning"),
        (lambda folder: (folder / CONFIG).write_text("{"), "cannot be loaded .*config.json"),
        (
            lambda folder: change(folder, CONFIG, {"reassemble_hidden_size": 48}),
            "its weights have another shape for",
        ),
        (lambda folder: (folder / INPUT).unlink(), "cannot be loaded .*image processor"),
        (pickled, WEIGHTS),
        (
            lambda folder: (folder / WEIGHTS).write_bytes((folder / WEIGHTS).read_bytes()[:-1000]),
            "cannot be loaded",
        ),
        (
            lambda folder: lacking(folder, "head"),
            "its weights lack .*: give the weights that belong to its config",
        ),
    ],
)
def test_a_broken_folder_is_refused_in_one_line(
    damage: Callable[[Path], None],
    words: str,
    folders: Folders,
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
    ("model", "settings", "words"),
    [
        ("metric", {"backbone_config": None, "backbone": "a/b"}, "names another model, 'a/b'"),
        ("metric", {"backbone_config": {"backbone": "resnet50"}}, "another model, 'resnet50'"),
        ("metric", {"backbone_config": {"num_hidden_layers": 10**7}}, "10000000 for 'num_hidden"),
        ("metric", {"num_hidden_layers": 60_000}, r"60,0\d\d layers, at most 1,000"),
        ("glpn", {"depths": [10**7]}, "the value 10000000 for 'depths'"),
        ("glpn", {"depths": [1] * 100_000}, "100,000 values for 'depths'"),
        ("metric", {"fusion_hidden_size": 30_000}, "bytes of weights, and its files have"),
    ],
)
def test_a_configuration_asks_for_no_other_model_and_no_more_than_its_files_hold(
    model: str,
    settings: dict[str, Any],
    words: str,
    folders: Folders,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = shutil.copytree(folders[model], tmp_path / "model")
    change(folder, CONFIG, settings)

    def ask_hub(*arguments: object, **options: object) -> None:
        raise AssertionError("the hub was asked")

    monkeypatch.setattr("huggingface_hub.HfApi.repo_exists", ask_hub)
    monkeypatch.setattr("huggingface_hub.hf_hub_download", ask_hub)
    with pytest.raises(InputError, match=words):
        load(folder)


def test_weights_that_a_model_never_uses_may_be_missing(
    folders: Folders, tmp_path: Path, maps: list[DepthMap]
) -> None:
    folder = shutil.copytree(folders["dpt"], tmp_path / "dpt")
    lacking(folder, "neck.fusion_stage.layers.0.residual_layer1")
    for one in (folder, folders["dpt"]):
        load(one).predict(photo_of())
    assert torch.equal(maps[0].depth, maps[1].depth)


def test_code_in_a_models_folder_is_not_run(folders: Folders, tmp_path: Path) -> None:
    folder, flag = shutil.copytree(folders["metric"], tmp_path / "model"), tmp_path / "run"
    (folder / "own.py").write_text(f"open({str(flag)!r}, 'w')")
    change(
        folder,
        CONFIG,
        {"auto_map": {"AutoModelForDepthEstimation": "own.Model", "AutoConfig": "own.Config"}},
    )
    change(folder, INPUT, {"auto_map": {"AutoImageProcessor": "own.Processor"}})
    with contextlib.suppress(InputError):
        load(folder)
    assert not flag.exists()


def test_a_missing_package_is_refused_in_one_line(
    folders: Folders, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(
        InputError, match=r"need transformers \(.*\): pip install 'spackle-nvs\[hf\]'"
    ):
        HfBase.load(str(folders["metric"]))


def test_a_model_in_the_hubs_cache_needs_no_network(
    folders: Folders, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    commit, model = (
        "0123456789abcdef0123456789abcdef01234567",
        tmp_path / "hub" / "models--owner--name",
    )
    (model / "refs").mkdir(parents=True)
    (model / "refs" / "main").write_text(commit)
    cached = shutil.copytree(folders["metric"], model / "snapshots" / commit)
    base = HfBase.load("owner/name", device="cpu", precision="fp32")
    assert base.name == "hf:owner/name"
    means = load(folders["metric"]).predict(photo_of()).gaussians.means
    assert torch.equal(base.predict(photo_of()).gaussians.means, means)
    (cached / WEIGHTS).unlink()
    for name in ("owner/name", "owner/absent", "./absent", "a b/c", ""):
        with pytest.raises(InputError, match=f"^hf:{name}: cannot be loaded .+$"):
            HfBase.load(name)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr("huggingface_hub.hf_hub_url", lambda model, file: "http://127.0.0.1:9")
    monkeypatch.setattr("time.sleep", lambda _: pytest.fail("it waits and tries again"))
    with pytest.raises(InputError, match=r"refused.*: check name and network"):
        HfBase.load("owner/absent")
