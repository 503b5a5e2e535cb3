"""The report is a well-formed page without addresses, escapes names, contains all cells, and has
reproducible bytes."""

from __future__ import annotations

import base64
import importlib.util
import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest
from helpers import evaluation_data
from helpers.command import refuses, run
from PIL import Image

from spackle.paper.evaluation.folder import image_file
from spackle.paper.evaluation.measurements import Run as Results
from spackle.paper.evaluation.plots import plots_of_run
from spackle.paper.evaluation.report import make_report, overview_table
from spackle.paper.evaluation.tables import make_tables

pytest.importorskip("matplotlib")
EVIL = "<script>alert('1')</script>&\"$x_{$"
METHODS = ("base", "inpaint2d", "initial", "spackle")


class Page(HTMLParser):
    """Parses a page; AssertionError unless end tags match start tags."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[tuple[tuple[str, ...], str]] = []  # the tags around a text, the text
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.open += [] if tag in ("br", "hr", "img", "input", "meta") else [tag]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append((tuple(self.open), data))

    def named(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag == name]

    def text(self, around: str) -> str:
        return "".join(data for tags, data in self.words if around in tags)


def results(near: bool) -> Results:
    def numbers(method: str, scene: int) -> dict[str, float | None]:
        before = 0.05 + 0.01 * scene
        rank = METHODS.index(method)
        found: dict[str, float | None] = {
            "har_before": before,
            "har": before if method == "base" else 0.0,
        }
        if near:
            found |= {
                "psnr": 20.0 + rank,
                "psnr_hole": 8.0 + rank + 0.2 * scene,
                "ssim_outside": None,
            }
            found |= {"ssim_hole": 0.3 + 0.1 * rank, "distance": 4.0 - rank}
        return found

    name = f"{EVIL}{{}}".replace("{$", "{{$")
    return evaluation_data.results(
        EVIL, near, lambda k: {m: numbers(m, k) for m in METHODS}, 11, name
    )


def test_a_page_is_well_formed_and_contains_everything(tmp_path: Path) -> None:
    runs = results(near=True), results(near=False)
    for index in range(len(runs[0].measured_images)):
        for method in (*METHODS, "truth"):
            file = image_file(tmp_path, index, runs[0].images[index], f".{method}.webp")
            file.parent.mkdir(exist_ok=True)
            Image.new("RGB", (48, 32)).save(file)
    sources = [(one, tmp_path) for one in runs]
    text = make_report(sources)
    assert text == make_report(sources)
    page = Page(text)
    tables = make_tables(runs)
    plots = (str(image["src"]) for image in page.named("img") if image.get("class") == "plot")
    drawings = [ElementTree.fromstring(base64.b64decode(plot.partition(",")[2])) for plot in plots]
    assert len(drawings) == 3  # near views: PSNR, distance; large views: holes
    # A plot that is copied from the page says what it shows.
    for drawing in drawings:
        assert "base rgbd" in "".join(drawing.itertext())
    sections = [part["id"] for part in page.named("section")]
    assert sections == ["summary", "pictures", "plots", "tables", "setup"]
    assert not re.search(r"://|@import|url\(|\*\*", text)
    assert text.count("<script") == 1
    assert "<b>damaged" not in text
    assert f"{EVIL}9 worst" in page.text("h4")
    (policy,) = (meta["content"] for meta in page.named("meta") if "http-equiv" in meta)
    assert str(policy).startswith("default-src 'none'")
    assert all(
        str(attributes.get("src", "data:image/")).startswith("data:image/")
        for _, attributes in page.tags
    )
    assert all(image["alt"] for image in page.named("img"))
    written = [word for around, word in page.words if {"td", "th"} & set(around)]
    rows = [(table, cells) for table in tables for body in table.bodies for cells in body]
    cells = [cell.strip("*") for table, line in rows for cell in line[table.word_columns - 1 :]]
    assert all(written.count(cell) >= cells.count(cell) for cell in set(cells) - {""})
    for table in tables:
        assert table.caption in page.text("figcaption")
        assert all(note in page.text("li") for note in table.notes)
    assert page.text("strong")  # the best of a column


def test_the_legend_of_a_plot_with_one_scene_is_below_its_axes() -> None:
    measured = {"psnr_hole": 12.0, "distance": 3.0}
    methods = ("base", "paper-initial", "paper", "spackle", "dense")
    run = evaluation_data.results("One scene", True, lambda k: dict.fromkeys(methods, measured), 1)
    plots = plots_of_run(run)
    assert len(plots) == 2
    for plot in plots:
        assert plot.note == ""  # one scene has no order
        drawing = ElementTree.fromstring(base64.b64decode(plot.address.partition(",")[2]))
        parts = {part.get("id"): part for part in drawing.iter()}
        corners = re.findall(r"[ML] \S+ (\S+)", str(parts["patch_2"][0].get("d")))
        legend = [float(str(text.get("y"))) for text in parts["legend_1"].iter() if text.get("y")]
        assert len(legend) == 2 * len(methods)  # markers and titles
        numbers = 20  # units of the image below the axes, for the numbers along them
        assert min(legend) > max(map(float, corners)) + numbers


def test_a_table_without_a_column_says_only_how_to_get_its_metrics(tmp_path: Path) -> None:
    run = evaluation_data.results("Scenes", False, lambda k: {"base": {"har": 0.1}}, 1)
    run.about["metrics"].update(dict.fromkeys(("clipiqa", "niqe", "musiq"), "not run: no pyiqa"))
    (table,) = [table for table in make_tables([run]) if table.label == "tab:large_view_nr_iqa"]
    assert table.notes == ["CLIPIQA, NIQE, MUSIQ not run: no pyiqa."]
    # The overview, which leaves these columns out, says it, too.
    assert table.notes[0] in overview_table([run]).notes


def test_evaluate_and_tables_write_the_report(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    words = ("--dataset", "middlebury", "--base", "rgbd", "--protocol", "near-view")
    choices = (
        "evaluate",
        scenes,
        *words,
        "-o",
        out,
        *("--methods", "base,initial"),
        *("--metrics", "psnr"),
        *("--limit", 2),
    )
    assert run(*choices, "--html").code == 0
    text = (out / "report.html").read_text(encoding="utf-8")
    assert sum(image.get("class") != "plot" for image in Page(text).named("img")) == 2 * 3
    assert str(tmp_path) not in text
    assert run("tables", out, "-o", tmp_path / "again", "--html").code == 0
    whole = (tmp_path / "again" / "report.html").read_text(encoding="utf-8")
    assert whole.partition('id="tables"')[0] == text.partition('id="tables"')[0]
    # A table of the paper without our rows.
    assert "Efficiency and Gaussian overhead" in Page(whole).text("figcaption")
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name)
    )
    for command in (choices, ("tables", out, "-o", tmp_path / "none")):
        refuses(run(*command, "--html"), "spackle-nvs[eval]")
