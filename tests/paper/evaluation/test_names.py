"""What tables, figures and reports call a base: SHARP is the network with the published weights."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import pytest
from helpers.command import refuses, run
from helpers.evaluation_data import results, write_boxes
from helpers.photos import write_photo
from helpers.sharp_weights import MICRO_SIZE, write_tiny

from spackle.paper.evaluation.folder import load_run
from spackle.paper.evaluation.measurements import Run as Results
from spackle.paper.evaluation.table import to_markdown
from spackle.paper.evaluation.tables import make_tables
from spackle.weights import PUBLISHED_WEIGHTS


def with_base(name: str, digest: str | None) -> Results:
    """An evaluation with a base of this name, whose weights have this digest."""
    one = results("Middlebury", False, lambda image: {"base": {"har": 0.2, "har_before": 0.2}})
    # A folder of an earlier version may hold a title of its own.
    base = {"name": name, "title": "SHARP", "says": "a network", "weights": digest}
    return dataclasses.replace(one, config={**one.config, "base": base})


@pytest.mark.parametrize(
    ("name", "weights", "title"), [("sharp", "sharp", "SHARP"), ("moge", "depth", "moge")]
)
def test_only_published_weights_have_the_name_of_the_published_network(
    name: str, weights: str, title: str
) -> None:
    published = with_base(name, PUBLISHED_WEIGHTS[weights].sha256)
    other = with_base(name, "0123456789abcdef")
    assert published.base_title == title
    assert other.base_title == f"{title} stand-in"
    assert "(01234567)" in other.base_description
    assert with_base(name, None).base_title == f"{title} stand-in"
    assert with_base("lite", "0123456789abcdef").base_title == "lite"


def plain_sharp(text: str) -> list[str]:
    """The lines that name SHARP without being the paper's, or calling it a stand-in."""
    known = r"SHARP stand-in|(not|like|on) SHARP|SHARP \(paper\)"
    return [line for line in text.splitlines() if "SHARP" in re.sub(known, "", line)]


def test_a_stand_in_is_named_so_in_every_file(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    write_boxes(tmp_path / "data" / "Ball_1", 0)
    tiny = write_tiny(tmp_path / "sharp.safetensors", MICRO_SIZE)
    sharp = ("--base", "sharp", "-c", tiny, "--precision", "fp32", "--metrics", "none")
    choices = ("--methods", "base,direct-ft", "--direct-ft", tiny, "--disparity", "0.6")
    out = tmp_path / "out"
    words = ("evaluate", tmp_path / "data", "--dataset", "middlebury", *sharp, *choices, "-o", out)
    done = run(*words, "--html")
    assert done.code == 0, done.err
    assert run("figures", out, "-o", tmp_path / "figures").code == 0
    files = ("out/tables.md", "out/tables.tex", "out/report.html", "figures/figures.tex")
    texts = {name: (tmp_path / name).read_text("utf-8") for name in files}
    assert [line for text in texts.values() for line in plain_sharp(text)] == []
    assert all("SHARP stand-in" in text for text in texts.values())
    tables = "".join(map(to_markdown, make_tables([load_run(out)])))
    assert "direct FT (SHARP stand-in)" in tables
    assert "Base of our rows: SHARP stand-in (Middlebury)." in tables
    assert "Spackle on SHARP (paper)" in tables


def test_scenes_in_a_datasets_layout_keep_their_own_name(tmp_path: Path) -> None:
    root = tmp_path / "data"
    write_boxes(root / "Ball", 0)
    about = {"title": "Boxes", "about": "drawn boxes in Middlebury's layout, not Middlebury's"}
    (root / "Ball" / "about.json").write_text(json.dumps(about))
    words = ("--dataset", "middlebury", "--base", "rgbd", "--metrics", "none")
    choices = ("--methods", "base,paper-initial", "--disparity", "0.6")
    out = tmp_path / "out"
    done = run("evaluate", root, *words, *choices, "-o", out)
    assert done.code == 0, done.err
    (table,) = [one for one in make_tables([load_run(out)]) if "disocclusion" in one.label]
    rows = {texts[0] for rows in table.bodies for texts in rows if texts[0]}
    assert "Boxes" in rows
    assert f"Boxes: {about['about']}." in table.notes
    (ours,) = [rows for rows in table.bodies if rows[0][0] == "Boxes"]
    assert [texts[1] for texts in ours] == ["Initial Gaussians, eqs. 2 to 9 (rgbd)"]
    # The counts are those of scenes, not of Middlebury's 23.
    assert ours[0][2] == "1"
    assert "Boxes" in (out / "tables.tex").read_text()

    # A name of the paper's, and scenes of different names, are refused.
    again = ("evaluate", root, *words, *choices, "-o", tmp_path / "none")
    (root / "Ball" / "about.json").write_text(json.dumps(about | {"title": "Tanks"}))
    refuses(run(*again), "about.json", "Tanks is a dataset of the paper")
    write_boxes(root / "Chair", 1)
    (root / "Ball" / "about.json").write_text(json.dumps(about))
    refuses(run(*again), "Chair", "evaluate each by itself")


def test_photos_need_nothing_but_the_photo(tmp_path: Path) -> None:
    root = tmp_path / "holiday"
    write_photo(root / "beach.JPG", 64, 48)
    words = ("evaluate", root, "--dataset", "photos", "--metrics", "none", "--disparity", "0.6")
    out = tmp_path / "out"
    done = run(*words, "--base", "lite", "--methods", "base,paper-initial", "-o", out)
    assert done.code == 0, done.err
    found = load_run(out)
    assert (found.title, found.measured_images) == ("Photos", ["holiday/beach"])
    done = run(*words, "--base", "rgbd", "-o", tmp_path / "none")
    assert done.code == 2
    assert "neither a depth map nor points" in done.err
