"""The Python interface."""

from __future__ import annotations

import html
import io
from pathlib import Path
from types import ModuleType
from typing import Any

import av
import numpy as np
import pytest
import torch
from helpers import portraits
from helpers.photos import HEIGHT, WIDTH, box, metres, write_pair, write_photo
from helpers.scenes import psnr, same_bits
from PIL import Image

import spackle
from spackle.bases.depth import RgbdBase
from spackle.bases.settings import BaseSettings
from spackle.pipeline import Pipeline, PipelineOptions
from spackle.runtime.progress import LogReporter

pytestmark = pytest.mark.usefixtures("short_paths")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> spackle.Scene:
    photo, depth = write_pair(tmp_path_factory.mktemp("pair"))
    return spackle.predict(photo, depth)


def test_every_public_name_is_there_and_no_other() -> None:
    for name in [
        *spackle.__all__,
        *spackle.__all__,
    ]:  # twice, because an import could replace a name by a module
        assert not isinstance(getattr(spackle, name), ModuleType)
    assert {"predict", "Scene", "__version__"} <= set(dir(spackle))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        spackle.nonsense  # noqa: B018


def test_paths_and_loaded_values_give_the_same_scene(
    scene: spackle.Scene, pair: tuple[Path, Path]
) -> None:
    photo, depth = pair
    loaded = spackle.load_photo(photo), spackle.load_depth(depth)
    assert same_bits(spackle.predict(*loaded).gaussians, scene.gaussians)
    assert same_bits(spackle.predict(str(photo), str(depth)).gaussians, scene.gaussians)
    whole = Pipeline.open(PipelineOptions(base=BaseSettings(depth=depth))).complete(
        loaded[0], LogReporter()
    )
    assert same_bits(whole.scene.gaussians, scene.gaussians)
    alone = RgbdBase(loaded[1]).predict(loaded[0])
    assert same_bits(scene.base, alone.gaussians)
    assert len(scene.gaussians) == len(scene.base) + len(scene.aux) > len(scene.base)
    assert same_bits(scene.gaussians.select(torch.arange(len(scene.base))), scene.base)


def test_a_scene_says_how_it_was_made(scene: spackle.Scene, pair: tuple[Path, Path]) -> None:
    report = scene.report
    assert report is not None
    assert [view.view for view in report.holes] == ["-0.07", "+0.07"]
    for view in report.holes:
        assert 0.1 < view.before < 0.13
        assert view.after < 0.01 * view.before
    befores, afters = zip(*((view.before, view.after) for view in report.holes), strict=True)
    assert report.hole_ratio_before == pytest.approx(sum(befores) / 2)
    assert report.hole_ratio_after == pytest.approx(sum(afters) / 2)
    assert (report.base, report.base_reason) == ("rgbd", "a depth map is given")
    assert report.focal_px == scene.camera.focal[0]
    assert (report.focal_source, report.warnings) == ("default 30 mm", ())
    assert set(report.seconds) == {"prepare", "base", "move", "complete", "measure"}
    assert all(seconds >= 0 for seconds in report.seconds.values())

    # What is missing, guessed or replaced is a warning.
    depth = np.where(box(640, 480), np.nan, 3).astype(np.float32)
    mended = spackle.predict(pair[0], depth, fov=60, residual="initial").report
    assert mended is not None
    assert mended.focal_source == "fov"
    missing, resampled = mended.warnings
    assert missing.endswith("of the depth was missing and has been filled")
    assert resampled.endswith("the depth map is 640×480, and was resampled to the photo's size")


def test_a_photo_and_its_depth_in_every_form(pair: tuple[Path, Path], tmp_path: Path) -> None:
    photo, depth = pair
    pixels, metres_of = np.asarray(Image.open(photo).convert("RGB")), spackle.load_depth(depth)
    depths = [
        depth.read_bytes(),
        io.BytesIO(depth.read_bytes()),
        metres_of.depth.numpy(),
        metres_of.depth.double(),
    ]
    photos = [photo.read_bytes(), io.BytesIO(photo.read_bytes()), Image.open(photo), pixels]
    photos += [(tensor := torch.from_numpy(pixels / 255)), tensor.movedim(2, 0)]
    session = spackle.Spackle(residual="initial")
    expected = session.predict(photo, depth)
    for form in photos:
        assert same_bits(session.predict(form, depth).gaussians, expected.gaussians)
    for form in depths:  # the rounding steps of an array's depth are unknown
        made = session.predict(photo, form, trajectory="swipe").base
        assert len(made) == len(expected.base)
        torch.testing.assert_close(made.means, expected.base.means, rtol=2e-3, atol=2e-3)
    portrait = portraits.write(tmp_path / "portrait.jpg", portraits.PORTRAIT)
    assert same_bits(session.predict(portraits.PORTRAIT).base, session.predict(portrait).base)


@pytest.mark.parametrize(
    ("photo", "options", "words"),
    [
        (b"\xff\xd8" + bytes(100_000), {}, "photo: not an image"),
        ("x" * 100_000, {}, "xxx"),
        (io.StringIO("x" * 100_000), {}, "binary mode"),
        (np.zeros((48, 64, 5)), {}, "[H, W, 3]"),
        (np.zeros((3, 64, 3)), {}, "64×3 is too small"),
        (np.full((48, 64, 3), 200.0), {}, "from 200 to 200"),
        (object(), {}, "a path, bytes"),
        (np.zeros((48, 64, 3)), {"depth": np.zeros((48, 64), complex)}, "integers or floats"),
        (np.zeros((48, 64, 3)), {"depth": np.zeros((48, 64))}, "all-invalid"),
        (
            np.zeros((48, 64, 3)),
            {"base": "lite", "depth": np.ones((48, 64))},
            "leave one of them out",
        ),
        (np.zeros((48, 64, 3)), {"base": "sharpest"}, "sharp"),
        (np.zeros((48, 64, 3)), {"fov": "60"}, "`fov` must be a positive number, got '60'"),
        (np.zeros((48, 64, 3)), {"residual": "no" * 9000}, "no such weight file"),
    ],
    ids=lambda value: value if isinstance(value, str) and len(value) < 30 else type(value).__name__,
)
def test_bad_input_is_refused_in_a_short_message(photo: Any, options: Any, words: str) -> None:
    with pytest.raises(spackle.InputError) as caught:
        spackle.predict(photo, **options)
    assert words in str(caught.value)
    assert len(str(caught.value)) <= 300


def test_scenes_are_written_to_open_files(scene: spackle.Scene, tmp_path: Path) -> None:
    scene.save(tmp_path / "scene.ply")
    saved, exported, video = io.BytesIO(), io.BytesIO(), io.BytesIO()
    scene.save(saved)
    scene.export(exported, "spz")
    scene.save_video(video, "swipe", seconds=0.1, size="80x40", stereo="sbs")
    assert saved.getvalue() == (tmp_path / "scene.ply").read_bytes() == scene.to_bytes("ply")
    assert exported.getvalue() == scene.to_bytes("spz")
    with av.open(io.BytesIO(video.getvalue())) as container:
        assert [(frame.width, frame.height) for frame in container.decode(video=0)] == [
            (160, 40)
        ] * 3
    for bad in ({"stereo": "both"}, {"fit": "fill"}, {"show": "light"}, {"format": "avi"}):
        with pytest.raises(spackle.InputError, match=r"^(`\w+` \w+ is unknown|video\.avi: not)"):
            scene.save_video(io.BytesIO(), **bad)  # type: ignore[arg-type]
    off = (scene.depth_map() / torch.from_numpy(metres()) - 1).abs()
    assert float((off < 0.05).float().mean()) > 0.9  # except at outlines
    with pytest.raises(spackle.InputError, match="which format"):
        scene.export(io.BytesIO())


def test_a_scene_is_loaded_exported_and_shown(scene: spackle.Scene, tmp_path: Path) -> None:
    counts = f"{len(scene.base):,} base + {len(scene.aux):,} aux Gaussians, {WIDTH}×{HEIGHT}"
    assert repr(scene) == f"Scene({counts}, cpu)"
    assert repr(scene.base) == f"Gaussians({len(scene.base):,}, cpu)"
    for name in ("scene.ply", "scene.spz", "scene.html"):
        scene.export(tmp_path / name)
    loaded = spackle.Scene.load(tmp_path / "scene.ply")
    assert loaded.report is None
    assert repr(loaded) == repr(scene)
    assert (loaded.disparity, torch.equal(loaded.base.means, scene.base.means)) == (
        scene.disparity,
        True,
    )
    assert scene.disparity is not None
    wide = spackle.Scene.load(tmp_path / "scene.ply", fov=90)
    assert wide.camera.focal[0] == pytest.approx(WIDTH / 2)
    frame = scene.show(300)._repr_html_()
    page = html.unescape(frame.partition('srcdoc="')[2].rpartition('"')[0])
    assert page == (tmp_path / "scene.html").read_text(encoding="utf-8")
    assert len(repr(scene.show())) < 80
    for wrong in ("scene.obj", "nowhere/scene.ply"):
        with pytest.raises(spackle.InputError, match=wrong):
            scene.export(tmp_path / wrong)


def test_predict_takes_a_focal_length_and_draws_its_progress(
    pair: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    photo, depth = pair
    made = spackle.predict(photo, depth, fov=90, disparity=0.1, residual="initial", progress=True)
    assert [frame.rgb.shape for frame in made.frames(made.path("swipe", frames=2))] == [
        (HEIGHT, WIDTH, 3)
    ] * 2
    assert made.camera.focal[0] == pytest.approx(WIDTH / 2)
    assert "complete" in capsys.readouterr().err
    with pytest.raises(ValueError, match="load_photo"):
        spackle.predict(spackle.load_photo(photo), depth, fov=90)
    narrow = write_photo(photo.with_name("narrow.png"), 290, 36)
    with pytest.raises(
        spackle.InputError, match=r"narrow\.png: 290×36 is too small or too narrow: give"
    ):
        spackle.predict(narrow)


def test_complete_fills_the_given_views(scene: spackle.Scene, tmp_path: Path) -> None:
    photo, depth = write_pair(tmp_path)
    prediction = RgbdBase(spackle.load_depth(depth)).predict(spackle.load_photo(photo))
    seen: list[tuple[int, int]] = []
    cameras = scene.path("swipe", disparity=0.4, frames=4)
    made = spackle.complete(
        prediction, cameras, exact=True, progress=lambda done, total: seen.append((done, total))
    )
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert all(spackle.hole_area_ratio(made.render(camera).alpha) < 2e-3 for camera in cameras)
    assert made.report is not None
    assert (made.report.focal_px, made.report.base) == (prediction.camera.focal[0], None)
    assert (made.report.hole_ratio_before, list(made.report.seconds)) == (None, ["complete"])
    unlearned = spackle.complete(prediction, cameras, exact=True, network=None)
    assert (
        10 < psnr(made.render(cameras[0]).rgb, unlearned.render(cameras[0]).rgb) < 60
    )  # the weights change the picture
