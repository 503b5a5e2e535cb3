"""A wrong word is answered with the word that was probably meant: command, Python and HTTP."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.command import run
from starlette.exceptions import HTTPException

import spackle
from spackle.runtime.suggestions import closest_suffix
from spackle.web.uploads import FillRequest, _edit_options, read_options

PHOTO = np.zeros((48, 64, 3))
DEPTH = np.ones((48, 64))


def scene() -> spackle.Scene:
    nothing = spackle.Gaussians.empty()
    return spackle.Scene(nothing, nothing, spackle.Camera.from_focal(50, 64, 48))


COMMANDS = [
    ("predict photo.jpg --base shrp", "--base shrp is unknown: did you mean sharp?"),
    ("predict photo.jpg --trajectory swip", "--trajectory swip is unknown: did you mean swipe?"),
    ("predict photo.jpg --fill exemplr", "--fill exemplr is unknown: did you mean exemplar?"),
    ("predict photo.jpg --mode veiw", "--mode veiw is unknown: did you mean view?"),
    ("predict photo.jpg --device cdua", "--device cdua is unknown: did you mean cuda?"),
    (
        "predict photo.jpg --depth-kind metrc",
        "--depth-kind metrc is unknown: did you mean metric? There are auto, metric, disparity",
    ),
    ("predict photo.jpg --format mp5", "--format mp5 is unknown: did you mean mp4?"),
    ("predict photo.jpg --format tiff", "--format tiff is unknown: did you mean gif?"),
    ("predict photo.jpg --trajectry swipe", "No such option: --trajectry: did you mean --traj"),
    ("predict photo.jpg --depth-out a.pgn", "a.pgn: not a name for a depth map: did you mean .png"),
    ("export scene.ply -o a.plyy", "a.plyy: which format: did you mean .ply?"),
    ("render scene.ply -o a.avi", "a.avi: not a kind of video that can be written: end the name"),
    ("fill scene.ply --background kep -o b.ply", "--background kep is unknown: did you mean keep?"),
    ("exprt scene.ply", "No such command 'exprt'. Did you mean 'export'?"),
]
PYTHON: list[tuple[Callable[[], object], str]] = [
    (lambda: spackle.predict(PHOTO, base="shrp"), "`base` shrp is unknown: did you mean sharp?"),
    (
        lambda: spackle.predict(PHOTO, trajectory="swip"),  # type: ignore[arg-type]
        "`trajectory` swip is unknown: did you mean swipe?",
    ),
    (
        lambda: spackle.predict(PHOTO, fill="exemplr"),
        "`fill` exemplr is unknown: did you mean exemplar?",
    ),
    (
        lambda: spackle.predict(PHOTO, mode="veiw"),  # type: ignore[arg-type]
        "`mode` veiw is unknown: did you mean view?",
    ),
    (
        lambda: spackle.predict(PHOTO, DEPTH, depth_kind="metrc"),  # type: ignore[arg-type]
        "`depth_kind` metrc is unknown: did you mean metric?",
    ),
    (
        lambda: spackle.get_renderer("cdua"),
        "`device` cdua is unknown: did you mean cuda?",
    ),
    (
        lambda: spackle.fill(scene().base, [scene().camera], background="kep"),  # type: ignore[arg-type]
        "`background` kep is unknown: did you mean keep?",
    ),
    (lambda: scene().export("a.gbl"), "a.gbl: which format: did you mean .glb? Else end the name"),
    (lambda: scene().export(io.BytesIO(), "spx"), "scene.spx: which format: did you mean .spz?"),
    (lambda: scene().save_video("a.mpeg"), "a.mpeg: not a name for a video: did you mean .mp4?"),
]
HTTP = [
    ('{"base": "lit"}', "base lit on this server: unknown: did you mean lite? There are auto"),
    ('{"trajectry": "swipe"}', "options: trajectry: there is no such key: did you mean trajectory"),
    ('{"keepframe": true}', "options: keepframe: there is no such key: did you mean keep_frame?"),
    ('{"path": 1}', "options: path: there is no such key: there are base, depth_kind"),
    ('{"trajectory": "swip"}', "not 'swip': did you mean swipe?"),
    ('{"fill": "exemplr"}', "not 'exemplr': did you mean exemplar?"),
    ('{"files": ["scene.gbl"]}', "not 'scene.gbl': did you mean scene.glb?"),
]


@pytest.mark.parametrize(("words", "message"), COMMANDS, ids=lambda value: value[:40])
def test_a_command_suggests(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photo.jpg").touch()
    scene().save(tmp_path / "scene.ply")
    done = run(*words.split())
    assert (done.code, message in done.err) == (2, True), done.err


@pytest.mark.parametrize(("call", "message"), PYTHON, ids=[message[:40] for _, message in PYTHON])
def test_python_suggests(call: Callable[[], object], message: str) -> None:
    with pytest.raises(spackle.InputError) as caught:
        call()
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(("options", "message"), HTTP)
def test_http_suggests(options: str, message: str) -> None:
    with pytest.raises(HTTPException) as caught:
        read_options(options, ["auto", "lite"])
    assert (caught.value.status_code, message in caught.value.detail) == (422, True), caught.value


def test_an_edit_over_http_suggests() -> None:
    with pytest.raises(HTTPException) as caught:
        _edit_options({"options": '{"camras": []}'}, FillRequest)  # type: ignore[arg-type]
    assert "camras: there is no such key: did you mean cameras?" in caught.value.detail


def test_the_plain_kind_of_file_is_suggested_and_no_far_fetched_one() -> None:
    known = [".compressed.ply", ".ply", ".v4.spz", ".spz", ".splat", ".sog", ".glb", ".html"]
    assert closest_suffix("a.plyy", known) == ".ply"
    assert closest_suffix("a.SPX", known) == ".spz"
    assert closest_suffix("a.htm", known) == ".html"
    for name in ("a.obj", "ply", "a.", "a.jpg"):
        assert closest_suffix(name, known) is None
