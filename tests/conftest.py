"""Fixtures, and hypothesis profiles: HYPOTHESIS_PROFILE=explore looks for new examples."""

from __future__ import annotations

import functools
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# Before torch is imported: idle threads that spin slow down tests in parallel processes.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Tests must not use downloaded weights.
os.environ["SPACKLE_WEIGHTS"] = str(Path(__file__).with_name("no weights"))

# Files and folders whose tests walk commands, processes, a browser or a training, or compute for
# many seconds: `make test-fast` leaves them out. Those that take longest come first, here and in a
# run, so that no process is left alone with a long one at the end.
JOURNEYS = (
    "test_quick_start.py",
    "web",
    "cli",
    "fuzz",
    "paper/dataset/test_dataset_build.py",
    "paper/training/test_whole_views.py",
    "paper/training/test_training.py",
    "test_extensions.py",
    "paper/evaluation/test_bench.py",
    "test_examples.py",
    "scene_fill/test_fill_scene.py",
    "posed",
    "paper/evaluation/test_mode_paper.py",
    "paper/evaluation/test_evaluate.py",
    "paper/training/test_direct_ft.py",
    "test_api.py",
    "test_documented_lines.py",
    "test_progress.py",
    "test_suggestions.py",
    "bases/test_sharp.py",
    "bases/test_moge.py",
    "bases/test_lite.py",
    "render/test_kernels.py",
    "test_rendered_scenes.py",
    "paper/evaluation/test_figures.py",
    "paper/evaluation/test_pairs.py",
    "paper/evaluation/test_report_html.py",
    "runtime/test_workers.py",
    "formats/test_export.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of `JOURNEYS`, and run them first, in their order."""
    journeys = [Path(__file__).parent / name for name in JOURNEYS]

    @functools.cache
    def place(file: Path) -> int:
        """The place of a file in `JOURNEYS`; their number, if it is in none."""
        for index, journey in enumerate(journeys):
            if file == journey or journey in file.parents:
                return index
        return len(journeys)

    places = {item: place(item.path) for item in items}
    for item in items:
        if places[item] < len(journeys):
            item.add_marker("journey")
    items.sort(key=places.__getitem__)


settings.register_profile("repeat", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeat"))


@pytest.fixture(scope="module")
def short_paths() -> Iterator[None]:
    """A path along which nobody says how long it is has 3 frames in place of 120."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("spackle.views.DEFAULT_VIDEO_SECONDS", 0.1)
        yield


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """A small photo and its depth map."""
    from helpers.photos import write_pair

    return write_pair(tmp_path)


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Random weights of SHARP and lite."""
    from helpers.sharp_weights import write_tiny
    from helpers.stand_in import SHARP_FILE, write_lite

    folder = tmp_path_factory.mktemp("weights")
    return {
        "sharp": write_tiny(folder / SHARP_FILE),
        "lite": write_lite(folder / "lite.safetensors"),
    }


@pytest.fixture
def shipped(tmp_path: Path, made: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Random weights of lite in place of the shipped ones; SHARP is not installed."""
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path / "weights"))
    lite = Path(shutil.copy(made["lite"], tmp_path / "lite.safetensors"))
    monkeypatch.setattr("spackle.bases.lite.SHIPPED_WEIGHTS", lite)
    return lite
