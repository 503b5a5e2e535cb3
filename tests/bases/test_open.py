"""`open_base`: a photo's base and the reason for it, the source of the focal length, and errors."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import portraits
from helpers.photos import HEIGHT, WIDTH, metres, picture, write_depth, write_photo
from helpers.scenes import random_gaussians, same_bits
from helpers.sharp_weights import gaussians_of, write_tiny
from helpers.stand_in import SHARP_FILE, StandIn, write_model

import spackle
from spackle.bases import BasePrediction
from spackle.bases.lite import INPUT_SCALES, LiteBase
from spackle.bases.open import BaseError, ResolvedBase, open_base, wrap_loaded_base
from spackle.bases.settings import BaseSettings
from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.encoder import MICRO_SIZE
from spackle.bases.transformers import HfBase
from spackle.core.focal_length import FocalSource
from spackle.core.photo import Photo, load_photo, photo_from_picture
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import load_depth
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Progress

pytestmark = pytest.mark.usefixtures("shipped")
NO_DEPTH, NO_SHARP = "no depth in the photo", "no SHARP weights here, no MoGe weights here"


@pytest.fixture(autouse=True)
def _lite_uses_one_input_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spackle.bases.lite.INPUT_SCALES", INPUT_SCALES[:1])


@pytest.fixture
def sharp(tmp_path: Path, made: dict[str, Path]) -> Path:
    """Weights of SHARP in the folder of downloads."""
    (tmp_path / "weights").mkdir()
    return Path(shutil.copy(made["sharp"], tmp_path / "weights"))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Stand-ins for SHARP and models of the hub, which read no files.

    The list holds the arguments of each load.
    """
    asked: list[dict[str, Any]] = []

    def load(path: Path | str, **options: Any) -> StandIn:
        asked.append({"path": path, **options})
        return StandIn("sharp" if isinstance(path, Path) else f"hf:{path}")

    monkeypatch.setattr(SharpBase, "load", load)
    monkeypatch.setattr(HfBase, "load", load)
    return asked


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    return write_photo(tmp_path / "photo.png")


@pytest.fixture
def portrait(tmp_path: Path) -> Path:
    return portraits.write(tmp_path / "portrait.jpg", portraits.PORTRAIT)


def pick(
    path: Path, log: list[str] | None = None, /, **settings: Any
) -> tuple[BasePrediction, ResolvedBase]:
    log = [] if log is None else log
    return open_base(BaseSettings(**settings)).predict(load_photo(path), log=log.append)


def test_auto_uses_the_photos_depth_then_sharp_then_lite(
    tmp_path: Path, photo: Path, portrait: Path, sharp: Path
) -> None:
    prediction, choice = pick(photo)
    assert (choice.name, choice.reason, len(prediction.gaussians)) == (
        "sharp",
        NO_DEPTH,
        gaussians_of(MICRO_SIZE),
    )
    assert prediction.notes["weights"] == SHARP_FILE
    sharp.unlink()
    choice = pick(photo)[1]
    assert (choice.name, choice.reason, choice.failures) == ("lite", f"{NO_DEPTH}, {NO_SHARP}", ())
    assert "`spackle weights get depth` (140.6 MB, MIT)" in choice.note
    prediction, choice = pick(portrait)
    assert (choice.name, choice.reason) == ("rgbd", "the depth in the photo")
    assert str(prediction.notes["depth"]).startswith("portrait depth of the photo")
    named, choice = pick(portrait, name="rgbd")
    assert (choice.reason, choice.note) == ("chosen by name", "")
    assert same_bits(named.gaussians, prediction.gaussians)
    given, choice = pick(portrait, depth=write_depth(tmp_path / "depth.npy"))
    assert (choice.name, choice.reason, choice.note) == ("rgbd", "a depth map is given", "")
    assert float(given.gaussians.means[0, 2]) == pytest.approx(metres()[0, 0], rel=1e-5)


def test_weights_and_options_reach_sharp(
    tmp_path: Path, photo: Path, portrait: Path, sharp: Path, quick: list[dict[str, Any]]
) -> None:
    given = write_tiny(tmp_path / "mine.pt")
    choice = pick(photo, checkpoint=given)[1]
    assert (choice.name, choice.reason, quick.pop()["path"]) == (
        "sharp",
        "a checkpoint is given",
        given,
    )
    words: dict[str, Any] = {"precision": "fp32", "windows_per_batch": 9}
    assert pick(photo, **words)[1].name == "sharp"
    assert quick == [{"path": sharp, "device": None, **words}]
    assert pick(portrait, **words)[1].name == "rgbd"
    sharp.unlink()
    assert pick(photo, **words)[1].name == "lite"
    assert len(quick) == 1


def test_a_base_is_loaded_once_and_only_if_a_photo_needs_it(
    photo: Path,
    portrait: Path,
    sharp: Path,
    quick: list[dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(LiteBase, "load", lambda *args, **options: pytest.fail("loaded"))
    base = open_base(BaseSettings())
    base.predict(load_photo(portrait))
    assert not quick
    news = [base.predict(load_photo(photo))[1].note for _ in range(2)]
    assert ([bool(line) for line in news], len(quick)) == ([True, False], 1)
    model = open_base(BaseSettings(name="hf:me/small", precision="fp32", device="cpu"))
    assert [model.predict(load_photo(photo))[1].name for _ in range(2)] == ["hf:me/small"] * 2
    assert quick[1:] == [{"path": "me/small", "precision": "fp32", "device": "cpu"}]


def test_the_chosen_base_predicts_all_frames_of_a_clip(photo: Path, portrait: Path) -> None:
    base = open_base(BaseSettings())
    prediction, choice = base.predict(load_photo(photo))
    kept, again = base.only_chosen(choice).predict(load_photo(portrait))
    assert (choice.name, again.name) == ("lite", "lite")
    assert kept.notes == prediction.notes


def test_the_focal_length_comes_from_the_user_then_the_map_then_the_photo(
    tmp_path: Path, photo: Path
) -> None:
    disparity, ours_px = tmp_path / "disp0.npy", load_photo(photo, focal_px=60)
    np.save(disparity, (80 * 0.2 / metres() - 1.5).astype(np.float32))
    lens = f"[80 0 {WIDTH / 2}; 0 80 {HEIGHT / 2}; 0 0 1]"
    facts = f"cam0={lens}\ncam1={lens}\ndoffs=1.5\nbaseline=200\nwidth={WIDTH}\nheight={HEIGHT}\n"
    (tmp_path / "calib.txt").write_text(facts)
    loaded, front = load_depth(disparity), slice(0, WIDTH * HEIGHT)
    for depth in (disparity, loaded):
        prediction, _ = pick(photo, depth=depth)
        assert (prediction.camera.focal[0], prediction.lens_source) == (80, "calibration")
        ours, _ = open_base(BaseSettings(depth=depth)).predict(ours_px)
        assert (ours.camera.focal[0], ours.lens_source) == (60, "")
        # depth = baseline · focal / (disparity + doffs)
        torch.testing.assert_close(
            ours.gaussians.means[front, 2], 0.75 * prediction.gaussians.means[front, 2]
        )
        scene = spackle.predict(ours_px, depth=depth, residual="none")
        assert scene.camera.focal[0] == 60
        assert same_bits(scene.base, ours.gaussians)
    of_the_file = dataclasses.replace(ours_px, focal_source=FocalSource.EXIF)
    assert open_base(BaseSettings(depth=loaded)).predict(of_the_file)[0].camera.focal[0] == 80


def test_auto_goes_on_if_the_depth_in_the_photo_is_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = list[str]()
    photo = portraits.write(tmp_path / "photo.jpg", portraits.PORTRAITS["bad: GDepth, broken map"])
    choice = pick(photo, log)[1]
    assert (choice.name, choice.reason) == (
        "lite",
        f"the depth in the photo cannot be used, {NO_SHARP}",
    )
    assert choice.failures[0].startswith(f"the depth in the photo: {photo}: ")
    assert [
        line.startswith(f"photo.jpg: going on without the depth in the photo: {photo}: ")
        for line in log
    ] == [True]
    with pytest.raises(InputError, match=r"photo\.jpg"):
        pick(photo, name="rgbd")
    depth = torch.full((WIDTH, HEIGHT), 2.0)
    wrong = DepthMap(depth, depth > 0, None, None, "depth", photo)
    monkeypatch.setattr("spackle.bases.open.load_photo_depth", lambda path: wrong)
    assert f"{HEIGHT}×{WIDTH} but photo {photo} is {WIDTH}×{HEIGHT}" in pick(photo)[1].failures[0]


def test_damaged_weights_fail_once_for_all_photos(photo: Path, sharp: Path) -> None:
    content = bytearray(sharp.read_bytes())
    content[len(content) // 2] ^= 1
    sharp.write_bytes(content)
    said, log, base = "not a file of weights, or damaged", list[str](), open_base(BaseSettings())
    choices = [base.predict(load_photo(photo), log=log.append)[1] for _ in range(2)]
    assert [choice.reason for choice in choices] == [
        f"{NO_DEPTH}, SHARP cannot be used, no MoGe weights here"
    ] * 2
    assert (len(log), said in log[0], said in choices[0].failures[0]) == (1, True, True)
    for settings in ({"name": "sharp"}, {"checkpoint": sharp}):
        with pytest.raises(BaseError, match=said):
            pick(photo, **settings)


def test_a_base_that_fails_for_one_photo_is_tried_for_the_next(
    tmp_path: Path, sharp: Path, quick: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    predict_box = StandIn.predict

    def picky(self: StandIn, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        found = predict_box(self, photo, progress)
        if photo.path.stem == "b":
            raise InputError(f"{photo.path}: not this one")
        means = found.gaussians.means * (torch.inf if photo.path.stem == "c" else 1)
        return dataclasses.replace(
            found, gaussians=dataclasses.replace(found.gaussians, means=means)
        )

    monkeypatch.setattr(StandIn, "predict", picky)
    log, base = list[str](), open_base(BaseSettings())
    paths = [write_photo(tmp_path / f"{name}.png") for name in "abcd"]
    names = [base.predict(load_photo(path), log=log.append)[1].name for path in paths]
    assert names == ["sharp", "lite", "lite", "sharp"]
    assert ("not this one" in log[0], "range of float32" in log[1], len(quick)) == (True, True, 1)
    for path in paths[1:3]:
        with pytest.raises(InputError, match=path.name) as caught:
            pick(path, name="sharp")
        assert not isinstance(caught.value, BaseError)


def test_given_depth_has_no_fallback(tmp_path: Path, photo: Path, portrait: Path) -> None:
    np.save(tmp_path / "bad.npy", np.zeros((HEIGHT, WIDTH), np.float32))
    (tmp_path / "depths").mkdir()
    for depth, named in (
        (tmp_path / "bad.npy", "bad.npy"),
        (tmp_path / "depths", "no depth map in"),
    ):
        with pytest.raises(InputError, match=named):
            pick(portrait, depth=depth)
    with pytest.raises(InputError, match="the photo has none inside") as caught:
        pick(photo, name="rgbd")
    assert not isinstance(caught.value, BaseError)
    ours = load_depth(write_depth(tmp_path / "depths" / "photo.npy"))
    by_call, _ = open_base(BaseSettings(name="rgbd")).predict(load_photo(photo), depth=ours)
    assert same_bits(by_call.gaussians, pick(photo, depth=tmp_path / "depths")[0].gaussians)


@pytest.mark.parametrize(
    ("settings", "option"),
    [
        ({"name": "lite", "depth": Path("d.npy")}, "`depth` d.npy: the lite base"),
        ({"name": "hf:a/b", "checkpoint": Path("x.pt")}, "`checkpoint` x.pt: the hf base"),
        ({"name": "hf:a/b", "windows_per_batch": 1}, "`windows_per_batch` 1: the hf base"),
        ({"name": "hf:"}, "names no model"),
        ({"name": "shrap"}, r"did you mean sharp\?"),
        ({"name": "sharp"}, "spackle weights get sharp.*`checkpoint` FILE"),
        ({"name": "rgbd", "checkpoint": Path("x.pt")}, "`checkpoint` x.pt: the rgbd base"),
        ({"calib": Path("c.txt")}, "`calib` c.txt: there is no depth map to read"),
        ({"depth_kind": "near-white"}, "`depth_kind` near-white: there is no depth map to read"),
        (
            {"depth": Path("d.npy"), "far": 9.0},
            "`far` 9.0: only for relative maps: add `depth_kind` near-white",
        ),
        ({"depth": Path("d.npy"), "windows_per_batch": 1}, "`windows_per_batch` 1: the rgbd base"),
        ({"precision": "fp8"}, "fp8"),
        ({"windows_per_batch": 36}, "`windows_per_batch` must be between 1 and 35, got 36"),
    ],
    ids=str,
)
def test_options_that_a_base_does_not_take_are_refused(
    settings: dict[str, Any], option: str
) -> None:
    with pytest.raises(InputError, match=option):
        open_base(BaseSettings(**settings))


def test_the_files_and_the_public_name_of_a_models_folder(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "one" / "small")
    settings = BaseSettings(name=f"hf:{folder}")
    assert set(settings.model_files) == {"config.json", "model.safetensors"}
    assert (settings.public_name, BaseSettings(name="hf:me/small").public_name) == (
        "hf:small",
        "hf:me/small",
    )


PLUGIN = """
from helpers.stand_in import StandIn

class Box(StandIn):
    def __init__(self):
        super().__init__("box")
"""


def test_a_base_of_another_package_is_named_by_its_module_and_class(
    tmp_path: Path, photo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "box_base.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)
    prediction, choice = pick(photo, name="box_base:Box")
    assert (choice.name, choice.reason) == ("box_base:Box", "chosen by name")
    assert len(prediction.gaussians) > 0
    # Results depend on the code, as on weights.
    files = BaseSettings(name="box_base:Box").model_files
    assert files == {"box_base:Box": tmp_path / "box_base.py"}
    for name, problem in (("box_base:Sphere", "has no Sphere"), ("nowhere:Box", "cannot import")):
        with pytest.raises(InputError, match=problem):
            pick(photo, name=name)
    with pytest.raises(InputError, match=r"`precision` fp32: the package\.module:Class base"):
        pick(photo, name="box_base:Box", precision="fp32")


class ForeignBase:
    """A base of another package, which returns a small scene without the photo."""

    name = "foreign"

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        camera = photo.camera.resized(32, 24)
        return BasePrediction(random_gaussians(5), camera, {})


@pytest.mark.usefixtures("sharp")
@pytest.mark.parametrize("name", ["lite", "sharp", "rgbd", "foreign"])
def test_a_prediction_has_the_photo_at_its_cameras_size(
    name: str, tmp_path: Path, photo: Path
) -> None:
    # SHARP alone is quick enough for a photo above the working size, 1536 pixels.
    width, height = (1600, 800) if name == "sharp" else (WIDTH, HEIGHT)
    loaded = photo_from_picture(picture(width, height))
    if name == "foreign":
        base = wrap_loaded_base(ForeignBase())
    else:
        depth = write_depth(tmp_path / "depth.npy") if name == "rgbd" else None
        base = open_base(BaseSettings(name=name, depth=depth))
    prediction, _ = base.predict(loaded)
    camera = prediction.camera
    assert prediction.photo is not None
    assert prediction.photo.shape == (camera.height, camera.width, 3)
    assert camera.width == {"sharp": 1536, "foreign": 32}.get(name, WIDTH)
    if name in ("lite", "rgbd"):
        assert torch.equal(prediction.photo, loaded.rgb)  # its border is not replaced
    means = [rgb.mean((0, 1)) for rgb in (prediction.photo, loaded.rgb)]
    assert float((means[0] - means[1]).abs().max()) < 0.01
