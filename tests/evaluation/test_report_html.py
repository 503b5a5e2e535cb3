"""The report: well-formed, in need of nothing else, all strings escaped, all cells there, the same bytes twice."""

from __future__ import annotations

import base64
import importlib.util
import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import evaluation_data
import pytest
from command import refuses, run
from PIL import Image

from spackle.evaluation.folder import image_file
from spackle.evaluation.methods import METHODS as FACTS
from spackle.evaluation.pictures import evenly
from spackle.evaluation.report import make_report, scenes_plot
from spackle.evaluation.rows import Run as Results
from spackle.evaluation.tables import make_tables

pytest.importorskip("matplotlib")
EVIL = "<script>alert('1')</script>&\"$x_{$"
METHODS = ("base", "inpaint2d", "seeds", "spackle")


class Page(HTMLParser):
    """Walks over a page: every tag is closed by its own, in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[tuple[tuple[str, ...], str]] = []  # the tags around it, text
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        assert len(dict(attrs)) == len(attrs), attrs
        self.open += [] if tag in ("br", "hr", "img", "input", "meta") else [tag]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append((tuple(self.open), data))

    def named(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag == name]

    def text(self, around: str) -> str:
        return "".join(data for tags, data in self.words if around in tags)

    def drawings(self) -> list[ElementTree.Element]:
        """The plots, which have to be XML."""
        plots = (str(image["src"]) for image in self.named("img") if image.get("class") == "plot")
        return [ElementTree.fromstring(base64.b64decode(plot.partition(",")[2])) for plot in plots]


def figures(near: bool, method: str, scene: int) -> dict[str, float | None]:
    """Plausible numbers."""
    before, rank = 0.05 + 0.01 * scene, METHODS.index(method)
    found: dict[str, float | None] = {"har_before": before, "har": before if method == "base" else 0.0}
    if method != "inpaint2d":
        aux = 0 if method == "base" else 1000 + 10 * scene
        found |= {"aux": aux, "aux_share": aux / 50000, "merged": 50000 + aux}
    if near:
        found |= {"psnr": 20.0 + rank, "psnr_hole": 8.0 + rank + 0.2 * scene, "psnr_outside": 30.0}
        found |= {"ssim": 0.8, "ssim_hole": 0.3 + 0.1 * rank, "ssim_outside": None, "distance": 4.0 - rank}
    return found


def results(near: bool, count: int = 11, title: str = "Middlebury", name: str = "scene_{}") -> Results:
    """A run of some images, the last of which has none."""
    return evaluation_data.results(title, near, lambda k: {m: figures(near, m, k) for m in METHODS}, count, name)


def report(folder: Path, *runs: Results, size: tuple[int, int] = (48, 32)) -> str:
    """A page of these runs, with the same pictures for each."""
    for index in range(len(runs[0].measured)):
        for k, method in enumerate((*METHODS, "truth")):
            file = image_file(folder, index, runs[0].images[index], f".{method}.webp")
            file.parent.mkdir(exist_ok=True)
            Image.new("RGB", size, (20 * index % 256, 9 * k, 90)).save(file)
    return make_report([(one, folder) for one in runs])


def test_a_page_is_well_formed_and_needs_nothing_else(tmp_path: Path) -> None:
    runs = results(near=True), results(near=False)
    text = report(tmp_path, *runs)
    page, tables = Page(text), make_tables(runs)
    assert text == report(tmp_path, *runs)
    assert len(page.drawings()) == 3  # near views: PSNR, distance; large views: holes
    sections = [part["id"] for part in page.named("section")]
    assert sections == ["summary", "plots", "pictures", "tables", "setup"]
    assert not re.search(r"://|@import|url\(|\*\*", text)
    assert all("src" not in script for script in page.named("script"))
    (policy,) = (meta["content"] for meta in page.named("meta") if "http-equiv" in meta)
    assert str(policy).startswith("default-src 'none'")
    assert all(str(attributes.get("src", "data:image/")).startswith("data:image/") for _, attributes in page.tags)
    assert all(image["alt"] for image in page.named("img"))
    written = [word for around, word in page.words if {"td", "th"} & set(around)]
    rows = [(table, cells) for table in tables for body in table.bodies for cells in body]
    cells = [cell.strip("*") for table, line in rows for cell in line[table.words - 1 :]]
    assert all(written.count(cell) >= cells.count(cell) for cell in set(cells) - {""})
    for table in tables:
        assert table.caption in page.text("figcaption")
        assert all(note in page.text("li") for note in table.notes)
    assert page.text("strong")  # the best of a column


def test_every_string_from_outside_is_escaped(tmp_path: Path) -> None:
    text = report(tmp_path, results(near=True, title=EVIL, name=f"{EVIL}{{}}".replace("{$", "{{$")))
    page = Page(text)
    assert text.count("<script") == 1
    assert "<b>damaged" not in text
    assert f"{EVIL}3" in page.text("h4")
    assert page.drawings()


def test_plots_show_each_value_once_in_a_form_of_its_method() -> None:
    assert len({facts.color for facts in FACTS.values()}) == len({facts.form for facts in FACTS.values()}) == len(FACTS)
    assert [evenly(11, 4), evenly(3, 8), evenly(5, 1)] == [[0, 3, 7, 10], [0, 1, 2], [0]]
    plot = scenes_plot(results(near=True, count=3), "distance")
    assert plot is not None
    drawn = [part.get("style", "") for part in ElementTree.fromstring(plot.svg).iter() if part.tag.endswith("}use")]
    for method in ("seeds", "spackle"):  # a dot for each image, and one in the legend
        assert sum(f"fill: {FACTS[method].color}" in style for style in drawn) == 3 + 1


def test_the_command_writes_it_and_tables_write_the_same(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, words = tmp_path / "out", ("--dataset", "middlebury", "--base", "rgbd", "--protocol", "near-view")
    choices = ("evaluate", scenes, *words, "-o", out, "--methods", "base,seeds", "--metrics", "psnr", "--limit", 2)
    assert run(*choices).code == 0
    assert run(*choices, "--html").code == 0  # nothing is measured again
    text = (out / "report.html").read_text(encoding="utf-8")
    assert sum(image.get("class") != "plot" for image in Page(text).named("img")) == 2 * 3
    assert str(tmp_path) not in text
    assert run("tables", out, "-o", tmp_path / "again", "--html").code == 0
    whole = (tmp_path / "again" / "report.html").read_text(encoding="utf-8")
    assert whole.partition('id="tables"')[0] == text.partition('id="tables"')[0]
    assert "Efficiency and Gaussian overhead" in Page(whole).text("figcaption")  # a table of the paper's, yet empty
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name))
    for command in (choices, ("tables", out, "-o", tmp_path / "none")):
        refuses(run(*command, "--html"), "spackle-nvs[eval]")
