"""What a Python program hears of long work, and how it ends it."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path

import pytest
import torch
from helpers.photos import write_pair
from helpers.posed_captures import write_record3d

import spackle
from spackle.bases.depth import RgbdBase
from spackle.runtime.errors import as_input_error
from spackle.web.jobs import Job
from spackle.web.work import SceneWork

pytestmark = pytest.mark.usefixtures("short_paths")
STAGES = ["prepare", "base", "move", "complete", "measure"]


@pytest.fixture(scope="module")
def session() -> spackle.Spackle:
    return spackle.Spackle(residual="initial")


@pytest.fixture(scope="module")
def scene(session: spackle.Spackle, tmp_path_factory: pytest.TempPathFactory) -> spackle.Scene:
    return session.predict(*write_pair(tmp_path_factory.mktemp("pair")), disparity=0.1)


def test_a_program_hears_of_each_stage_and_each_step(
    session: spackle.Spackle, pair: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    heard: list[spackle.StageProgress] = []
    made = session.predict(*pair, progress=heard.append)
    assert list(dict.fromkeys(update.stage for update in heard)) == STAGES
    assert made.report is not None
    assert set(made.report.seconds) == set(STAGES)
    # At the start of a stage nobody knows how many steps there are.
    assert (heard[0].done, heard[0].total, heard[0].share) == (0, 0, None)
    shares = [update.share for update in heard if update.stage == "complete"]
    assert shares[0] is None
    known = [share for share in shares if share is not None]
    assert known == sorted(known)
    assert known[-1] == 1
    assert capsys.readouterr().err == ""  # no bar
    with pytest.raises(AttributeError):
        heard[0].done = 1  # type: ignore[misc]


@pytest.mark.parametrize("stage", STAGES)
def test_an_event_ends_the_work_in_every_stage(
    session: spackle.Spackle,
    pair: tuple[Path, Path],
    stage: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A folder of the test's own: other programs of the machine have temporary files, too.
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    event = threading.Event()
    stages: list[str] = []

    def set_event(update: spackle.StageProgress) -> None:
        stages.append(update.stage)
        if update.stage == stage:
            event.set()

    photo, depth = (path.read_bytes() for path in pair)  # bytes lie in temporary files
    with pytest.raises(spackle.Cancelled, match="`cancel`"):
        session.predict(photo, depth, progress=set_event, cancel=event)
    assert stages[-1] == stage
    assert list(temporary.iterdir()) == []
    # The session is as good as before.
    event.clear()
    assert len(session.predict(*pair, cancel=event).aux) > 0


def test_a_function_ends_the_work_after_a_step(pair: tuple[Path, Path]) -> None:
    heard: list[spackle.StageProgress] = []
    with pytest.raises(spackle.Cancelled):
        spackle.predict(
            *pair,
            residual="initial",
            progress=heard.append,
            cancel=lambda: bool(heard) and heard[-1].stage == "complete" and heard[-1].done == 1,
        )
    assert (heard[-1].stage, heard[-1].done) == ("complete", 1)
    assert heard[-1].total > 1


def test_each_function_of_one_stage_ends_between_views(
    scene: spackle.Scene, pair: tuple[Path, Path], tmp_path: Path
) -> None:
    cameras = scene.path("swipe", disparity=0.3, frames=4)
    prediction = RgbdBase(spackle.load_depth(pair[1])).predict(spackle.load_photo(pair[0]))
    marked = torch.arange(len(scene.base)) % 5 == 0
    done: list[tuple[int, int]] = []

    def note(steps: int, total: int) -> None:
        done.append((steps, total))

    works = [
        lambda cancel: spackle.complete(
            prediction, cameras, network=None, progress=note, cancel=cancel
        ),
        lambda cancel: spackle.fill(
            scene.base, cameras, network=None, progress=note, cancel=cancel
        ),
        lambda cancel: spackle.remove(
            scene.base, marked, cameras, network=None, progress=note, cancel=cancel
        ),
        lambda cancel: scene.save_video(
            tmp_path / "video.mp4", "swipe", frames=4, progress=note, cancel=cancel
        ),
    ]
    for work in works:
        done.clear()
        with pytest.raises(spackle.Cancelled):
            work(lambda: len(done) > 0 and done[-1][0] == 2)
        assert done[-1] == (2, 4)
        set_event = threading.Event()
        set_event.set()
        done.clear()
        with pytest.raises(spackle.Cancelled):
            work(set_event)
        assert done == []
    assert list(tmp_path.glob("video*")) == []
    # A video that stood there before stays.
    (tmp_path / "video.mp4").write_bytes(b"former")
    with pytest.raises(spackle.Cancelled):
        works[-1](lambda: len(done) > 1)
    assert [path.read_bytes() for path in tmp_path.glob("*video*")] == [b"former"]


def test_a_cancel_is_never_taken_for_bad_input() -> None:
    with pytest.raises(spackle.Cancelled), as_input_error("photo.jpg", "cannot be read: {reason}"):
        raise spackle.Cancelled


def test_the_server_hears_the_same_as_a_program(pair: tuple[Path, Path], tmp_path: Path) -> None:
    photo, depth = pair
    job = Job(id="1", name=photo.name, source=str(photo), depth=str(depth), folder=tmp_path)
    job.results.mkdir()
    job = job.model_copy(update={"options": {"files": [], "frames": 3}})
    events: list[dict[str, object]] = []
    SceneWork()((job, None), lambda event: events.append(dict(event)))
    stages = dict.fromkeys(event["stage"] for event in events if "stage" in event)
    assert [stage for stage in stages if stage in STAGES] == STAGES
    heard: list[spackle.StageProgress] = []
    spackle.predict(*pair, progress=heard.append)
    of_fill = [(update.done, update.total) for update in heard if update.stage == "complete"]
    assert of_fill == [
        (event["done"], event["total"]) for event in events if event.get("stage") == "complete"
    ]


def test_photos_with_known_cameras_say_how_far_they_are_and_can_be_ended(tmp_path: Path) -> None:
    folder = write_record3d(tmp_path)
    stages: list[str] = []

    def note(update: spackle.StageProgress) -> None:
        stages.append(update.stage)

    with pytest.raises(spackle.Cancelled):
        spackle.predict_posed(folder, progress=note, cancel=lambda: stages[-1:] == ["merge"])
    assert stages[0] == "photos"
    assert stages[-1] == "merge"
