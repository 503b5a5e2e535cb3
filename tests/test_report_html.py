"""The report: well-formed, in need of nothing else, all strings escaped, all cells there, the same bytes twice."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import re
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from command import run
from evaluation_data import write_boxes
from PIL import Image

from spackle.evaluation.report import Source, make_report
from spackle.evaluation.report.axes import linear, percent_decades
from spackle.evaluation.report.gallery import MOST
from spackle.evaluation.report.markup import VOID, Html, tag
from spackle.evaluation.report.pictures import BUDGET, encode, fitting, size_of
from spackle.evaluation.report.plots import DOTS, FORMS, SCENES
from spackle.evaluation.report.svg import SHAPES, spread
from spackle.evaluation.results import Record, Row
from spackle.evaluation.results import Run as Results
from spackle.evaluation.table import BEST, Table
from spackle.evaluation.tables import make_tables

EVIL = "<script>alert('1')</script>&\"\x01\ud800"
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
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, tag
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append((tuple(self.open), data))

    def named(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag == name]

    def text(self, around: str) -> str:
        return "".join(data for tags, data in self.words if around in tags)


def figures(near: bool, method: str, scene: int) -> dict[str, float | None]:
    """Plausible numbers."""
    before, rank = 0.05 + 0.01 * scene, METHODS.index(method)
    found: dict[str, float | None] = {"har_before": before, "har": before if method == "base" else 0.0}
    if method not in ("inpaint2d",):
        aux = 0 if method == "base" else 1000 + 10 * scene
        found |= {"aux": aux, "aux_share": aux / 50000, "merged": 50000 + aux}
    if near:
        found |= {"psnr": 20.0 + rank, "psnr_hole": 8.0 + rank + 0.2 * scene, "psnr_outside": 30.0}
        found |= {"ssim": 0.8, "ssim_hole": 0.3 + 0.1 * rank, "ssim_outside": None, "distance": 4.0 - rank}
    return found


def results(near: bool, count: int = 11, title: str = "Middlebury", name: str = "scene_{}") -> Results:
    """A run of some images, the last of which has none."""
    settings = ["near"] if near else ["0.3", "0.4", "0.5"]
    facts = {"base_gaussians": 50000, "shown": {"setting": settings[-1], "view": "right"}}
    records = [
        Record(
            name.format(scene),
            facts,
            tuple(Row(s, v, m, figures(near, m, scene)) for s in settings for m in METHODS for v in ("left", "right")),
        )
        for scene in range(count)
    ]
    config: dict[str, Any] = {
        "title": title,
        "terms": f"cite {title}",
        "protocol": "near-view" if near else "large-view",
        "methods": list(METHODS),
        "base": {"title": "rgbd", "says": "the dataset's own depth", "weights": None},
        "disparities": None if near else [0.3, 0.4, 0.5],
        "residual": {"weights": "shipped", "sha256": "0123456789", "precision": "bfloat16"},
        "metrics": {"niqe": "not run: pyiqa is not installed"},
    }
    return Results(config, (*records, Record("gone", problem="gone.png: <b>damaged</b>", remarks=())))


def picture(index: int, size: tuple[int, int] = (48, 32)) -> Mapping[str, bytes]:
    return {n: encode(Image.new("RGB", size, (20 * index % 256, 9 * k, 90))) for k, n in enumerate((*METHODS, "truth"))}


def report(*runs: Results, **more: Any) -> str:
    sources = [Source(one, picture, {"spackle": "9.9"}, {"cpu": EVIL}) for one in runs]
    return make_report(sources, make_tables(runs), **more)


@pytest.fixture(scope="module")
def both() -> str:
    return report(results(near=True), results(near=False))


def test_a_page_is_well_formed_and_its_plots_are_xml(both: str) -> None:
    page = Page(both)
    drawings = re.findall(r"<svg.*?</svg>", both, re.DOTALL)
    plots = [ElementTree.fromstring(drawing) for drawing in drawings if 'class="plot"' in drawing]
    assert len(plots) == 5  # near views: overhead, PSNR, distance; large views: holes, overhead
    for drawing in drawings:
        ElementTree.fromstring(drawing)
    width = 360.0
    for plot in plots:
        assert plot.get("aria-label")
        height = float(str(plot.get("viewBox")).split()[3])
        for mark in plot.iter("path"):
            place = re.match(r"translate\((\S+) (\S+)\)", mark.get("transform", ""))
            if place:
                assert 0 <= float(place[1]) <= width
                assert 0 <= float(place[2]) <= height
    assert [part["id"] for part in page.named("section")] == ["summary", "plots", "pictures", "tables", "setup"]
    links = [str(link["href"])[1:] for link in page.named("a")]
    assert links == [part["id"] for part in page.named("section")]


def test_a_page_needs_nothing_else(both: str) -> None:
    page = Page(both)
    assert "://" not in both
    assert not page.named("link")
    assert not page.named("iframe")
    for _, attributes in page.tags:
        assert str(attributes.get("src", "data:")).startswith("data:image/webp;base64,") or "src" not in attributes
    assert all("src" not in script for script in page.named("script"))
    assert not re.search(r"@import|url\(", both)
    (policy,) = (meta["content"] for meta in page.named("meta") if "http-equiv" in meta)
    assert str(policy).startswith("default-src 'none'")
    for image in page.named("img"):
        data = base64.b64decode(str(image["src"]).partition(",")[2])
        with Image.open(io.BytesIO(data)) as opened:
            assert opened.format == "WEBP"
        assert image["alt"]


def test_every_string_from_outside_is_escaped() -> None:
    text = report(results(near=True, title=EVIL, name=f"{EVIL}{{}}"), bench={EVIL: [EVIL, {EVIL: 1}]})
    page = Page(text)
    assert text.count("<script") == 1
    assert "<b>damaged" not in text
    assert "\x01" not in text
    text.encode("utf-8")
    assert f"{EVIL[:-2]}\ufffd\ufffd3" in page.text("h4")
    for drawing in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        ElementTree.fromstring(drawing)
    assert tag("p", "<&>", Html("<i></i>"), title='"') == '<p title="&quot;">&lt;&amp;&gt;<i></i></p>'


def test_the_same_results_give_the_same_bytes(both: str) -> None:
    assert both == report(results(near=True), results(near=False))


def test_all_cells_of_the_tables_are_there(both: str) -> None:
    runs = [results(near=True), results(near=False)]
    body = both[both.index('id="tables"') :]
    for table, found in zip(make_tables(runs), re.findall(r"<table>.*?</table>", body), strict=True):
        assert rows_of(found) == expected(table)
    page = Page(both)
    captions = page.text("figcaption")
    for table in make_tables(runs):
        assert table.caption in captions
        assert all(note in page.text("li") for note in table.notes)
    assert "0.0566" in body  # the paper's
    assert "not run: pyiqa is not installed" in body
    assert "<strong>" in body


def rows_of(table: str) -> list[list[str]]:
    """The cells of an HTML table, row by row."""
    rows = re.findall(r"<tr.*?</tr>", table)
    return [[Page(cell).words[0][1] if Page(cell).words else "" for cell in cells(row)] for row in rows]


def cells(row: str) -> list[str]:
    return re.findall(r"<t[hd].*?</t[hd]>", row)


def expected(table: Table) -> list[list[str]]:
    """The same from the values; a dataset's name has a row of its own."""
    drop = table.words - 1
    rows = [[name for name, _ in table.groups]] if any(name for name, _ in table.groups) else []
    rows.append(list(table.columns[drop:]))
    for number, line in enumerate(table.lines):
        if drop and (line.rule or number == 0):
            rows.append([line.cells[0]])
        rows.append([cell.removeprefix(BEST).removesuffix(BEST) for cell in line.cells[drop:]])
    return rows


def test_each_pictured_image_has_a_slider(both: str) -> None:
    page = Page(both)
    sliders = [grip for grip in page.named("input") if grip["type"] == "range"]
    assert len(sliders) == MOST
    assert len(page.named("article")) == MOST
    assert len(page.named("img")) == MOST * (len(METHODS) + 1)
    assert len(page.named("select")) == 2 * MOST
    layers = [str(figure["class"]).split() for figure in page.named("figure") if "layer" in str(figure.get("class"))]
    assert sum("left" in layer for layer in layers) == sum("right" in layer for layer in layers) == MOST
    assert page.text("span").count("worst") == page.text("span").count("best") == 2
    assert "4 of 11 images, from the worst to the best by distance" in page.text("p")
    chosen = [option for option in page.named("option") if "selected" in option]
    assert len(chosen) == 2 * MOST


def test_many_evaluations_still_fit() -> None:
    titles = ("Middlebury", "Booster", "WildRGBD", "Tanks", "ETH3D", "LLFF")
    page = Page(report(*(results(near, 3, title) for title in titles for near in (True, False))))
    assert len(page.named("article")) == 2 * 12
    noise = Image.effect_noise((960, 720), 90).convert("RGB")
    fits = fitting([{"base": encode(noise), "spackle": encode(noise)}] * 12)
    assert sum(len(data) * 4 / 3 for case in fits for data in case.values()) <= BUDGET
    width, height = size_of(fits[0]["base"])
    assert width < 960
    assert abs(width / height - 4 / 3) < 0.02
    whole = [{"base": encode(Image.new("RGB", (960, 720)))}]
    assert fitting(whole) == whole


def test_many_images_make_no_large_page() -> None:
    run = results(near=True, count=400)
    text = make_report([Source(run, lambda index: {})], make_tables([run]))
    assert len(text) < 1_000_000
    assert f"{SCENES} of 400 scenes, spread evenly." in text
    assert re.search(r"\d+ of 1,600 images and views", text)
    assert text.count('class="mark') < DOTS + 4 * 2 * SCENES + 20
    assert "No pictures are left." in text


def test_axes_hold_their_values() -> None:
    for values in ([0.3, 0.4, 0.5], [0.0, 0.0], [7.3, 7.3], [1e-7, 3e-7], [12, 48000]):
        for origin in (True, False):
            axis = linear("m", values, origin)
            assert axis.low <= min(values) <= max(values) <= axis.high
            assert 2 <= len(axis.ticks) <= 8
            assert len({text for _, text in axis.ticks}) == len(axis.ticks)
            assert all(0 <= axis.at(value) <= 1 for value in values)
    decades = percent_decades("HAR", [0.25, 0.0, 2e-5])
    assert [text for _, text in decades.ticks] == ["0", "0.001 %", "0.01 %", "0.1 %", "1 %", "10 %", "100 %"]
    assert decades.at(0.0) == 0
    assert 0 < decades.at(2e-5) < decades.at(0.25) < 1
    assert len(percent_decades("HAR", [0.0]).ticks) == 3
    assert percent_decades("HAR", [1.0, 1.0]).at(1.0) in (0, 1)


def test_forms_tell_methods_apart() -> None:
    assert len(set(FORMS.values())) == len(FORMS)
    assert set(FORMS.values()) <= set(SHAPES)
    assert [spread(11, 4), spread(3, 8), spread(400, 2), spread(5, 1)] == [[0, 3, 7, 10], [0, 1, 2], [0, 399], [0]]


def test_the_command_writes_it_and_tables_write_the_same(tmp_path: Path) -> None:
    root = tmp_path / "data"
    for seed, name in enumerate(("<script>alert(1)<", "Door")):
        write_boxes(root / name, seed)
    out = tmp_path / "out"
    words = ("--dataset", "middlebury", "--root", root, "--base", "rgbd", "--protocol", "near-view", "-o", out)
    choices = (*words, "--methods", "base,seeds", "--metrics", "psnr")
    done = run("evaluate", *choices)
    assert done.code == 0, done.err
    assert not (out / "report.html").exists()
    assert run("evaluate", *choices, "--html").code == 0  # nothing is measured again
    text = (out / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert text.count("<script") == 1
    assert "<script>alert(1)<" in page.text("h4")
    assert len(page.named("img")) == 2 * 3
    assert str(tmp_path) not in text
    assert run("tables", out, "-o", tmp_path / "again", "--html").code == 0
    assert (tmp_path / "again" / "report.html").read_text(encoding="utf-8") == text
    for file in (out / "images").glob("*.webp"):
        file.unlink()  # as an older run left it: the strips of thumbnails are cut
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench" / "bench.json").write_text(json.dumps({"stages": [{"name": "<predict>", "seconds": 1.5}]}))
    assert run("tables", out, tmp_path / "bench", "-o", tmp_path / "old", "--html").code == 0
    old = Page((tmp_path / "old" / "report.html").read_text(encoding="utf-8"))
    assert len(old.named("img")) == 2 * 3
    assert "<predict>" in old.text("dd")
    assert run("tables", out, tmp_path / "bench", "-o", tmp_path / "old").code == 2  # without a page, what for?


def test_a_report_of_methods_without_figures() -> None:
    run = results(near=False, count=1)
    bare = [dataclasses.replace(r, rows=tuple(dataclasses.replace(x, figures={}) for x in r.rows)) for r in run.records]
    text = report(dataclasses.replace(run, records=tuple(bare)))
    assert Page(text).named("article")
    assert text.count('class="plot"') == 1  # the paper's HAR alone
