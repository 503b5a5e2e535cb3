"""The paper's six tables and one more: titles, captions, columns and notes.

The caption and notes explain a table's terms to its reader. tables.py fills the tables with
numbers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal

# Which results a table shows: those of large camera moves, those at the viewpoints of second
# photos, or counts of Gaussians and times.
Source = Literal["large", "near", "cost"]

PAPER_IMAGES_NOTE = "n: number of images, of those in the paper."
BEST_NOTE = "Bold: best of a run's rows."
LICENCE_NOTE = (
    "pyiqa: PolyForm Noncommercial licence 1.0.0; several of the networks that it fetches are for "
    "research only."
)


@dataclasses.dataclass(frozen=True)
class ColumnLayout:
    """A column of a table: a metric, its head, and how its numbers are written."""

    title: str
    metric: str
    number_format: str | None = None  # a key of `NUMBER_FORMATS`; None: that of the image metric
    group: str = ""  # a head above this and neighbouring columns


@dataclasses.dataclass(frozen=True, kw_only=True)
class TableLayout:
    """What a table shows; its rows are methods, that is, ways to render new views of a photo."""

    label: str  # in the paper's LaTeX source
    source: Source
    title: str
    caption: str
    columns: tuple[ColumnLayout, ...]
    time_columns: tuple[ColumnLayout, ...] = ()  # shown as rows of medians below the table
    marks_best: bool = False  # whether the best number of a column is bold
    # For each method that has a row the row's title, "" for the method's own; None: all methods.
    row_titles: Mapping[str, str] | None = None
    # If `row_titles` is None: only methods that have this metric get a row, and the base does not.
    needed_metric: str | None = None
    word_columns: int = 2  # the number of columns on the left with words instead of numbers
    notes: tuple[str, ...] = ()


LARGE_VIEW_QUALITY = TableLayout(
    label="tab:large_view_nr_iqa",
    source="large",
    title="Quality of large views, without a truth",
    caption="No-reference quality under controlled large views.",
    columns=(
        ColumnLayout("CLIPIQA ↑", "clipiqa"),
        ColumnLayout("NIQE ↓", "niqe"),
        ColumnLayout("MUSIQ ↑", "musiq"),
    ),
    marks_best=True,
    notes=(PAPER_IMAGES_NOTE, BEST_NOTE, LICENCE_NOTE),
)

HOLE_AREA = TableLayout(
    label="tab:controlled_disocclusion",
    source="large",
    title="Hole Area Ratio before and after",
    caption=(
        "Large-view hole coverage. Hole Area Ratio (HAR, eq. 11): share of pixels whose opacity is "
        "below 0.95. Reduction: of the mean HAR."
    ),
    columns=(
        ColumnLayout("base HAR ↓", "har_before", "ratio"),
        ColumnLayout("HAR ↓", "har", "ratio"),
        ColumnLayout("Reduction ↑", "reduction", "percent"),
    ),
    needed_metric="har",
    notes=(PAPER_IMAGES_NOTE,),
)

OVERHEAD = TableLayout(
    label="tab:efficiency_gaussian_overhead",
    source="cost",
    title="Efficiency and Gaussian overhead",
    caption=(
        "Efficiency and Gaussian overhead under controlled large views. Counts: means over views. "
        "Times: medians over datasets."
    ),
    columns=(
        ColumnLayout("Added GS", "aux", "count"),
        ColumnLayout("Added GS (%)", "aux_share", "share"),
    ),
    time_columns=(
        ColumnLayout("Median base time (ms)", "base_ms", "tenths"),
        ColumnLayout("Median Spackle time (ms)", "spackle_ms", "tenths"),
        ColumnLayout("Median time overhead", "overhead", "overhead"),
    ),
    row_titles={"paper": "", "spackle": ""},
    notes=("Average: mean of the datasets' means, over the datasets that were measured.",),
)

NEAR_VIEW_QUALITY = TableLayout(
    label="tab:near_view",
    source="near",
    title="Distance from true second photos",
    caption=(
        "The base, the naive decoupled framework (direct FT) and Spackle against true second "
        "photos."
    ),
    columns=(
        ColumnLayout("distance ↓", "distance"),
        ColumnLayout("PSNR ↑", "psnr"),
        ColumnLayout("PSNR in the hole ↑", "psnr_hole"),
        ColumnLayout("DISTS ↓", "dists"),
        ColumnLayout("LPIPS ↓", "lpips"),
    ),
    word_columns=1,
    notes=(LICENCE_NOTE,),
)

DENSE_AGAINST_MASKED = TableLayout(
    label="tab:mask_guided_init",
    source="near",
    title="Dense grid against mask guided",
    caption=(
        "Mask-guided initialisation against a dense grid. Reduction: of the mean count. The last "
        "column relates the mean count to the masked cells of 2×2 pixels."
    ),
    columns=(
        ColumnLayout("Base GS", "base_gaussians", "count"),
        ColumnLayout("Aux. GS ↓", "aux", "hundredths"),
        ColumnLayout("Reduction ↑", "aux_reduction", "percent"),
        ColumnLayout("distance ↓", "distance"),
        ColumnLayout("PSNR ↑", "psnr"),
        ColumnLayout("DISTS ↓", "dists"),
        ColumnLayout("LPIPS ↓", "lpips"),
        ColumnLayout("Aux. GS / (HAR × grid)", "aux_per_cell", "rate"),
    ),
    row_titles={
        "dense": "Dense grid init",
        "paper": "Mask guided init",
        "paper-initial": "",
        "spackle": "Spackle",
    },
    notes=(PAPER_IMAGES_NOTE, LICENCE_NOTE),
)

EXPANDED_OVERHEAD = TableLayout(
    label="tab:expanded_efficiency_gaussian_overhead",
    source="cost",
    title="Gaussians added and merged, and times",
    caption=(
        "Expanded efficiency and Gaussian overhead under controlled large views. Counts: means "
        "over views. Times and rates: medians over views, from the photo to the view."
    ),
    columns=(
        ColumnLayout("Added GS", "aux", "count"),
        ColumnLayout("Added GS (%)", "aux_share", "share"),
        ColumnLayout("Merged GS", "merged", "count"),
        ColumnLayout("base time (ms)", "base_ms", "tenths"),
        ColumnLayout("Spackle time (ms)", "spackle_ms", "tenths"),
        ColumnLayout("Time overhead", "overhead", "overhead"),
        ColumnLayout("base FPS", "base_fps", "rate"),
        ColumnLayout("Spackle FPS", "spackle_fps", "rate"),
    ),
    row_titles={"paper": "", "spackle": ""},
    word_columns=3,
    notes=(
        PAPER_IMAGES_NOTE,
        "The paper's row for Middlebury at S1 contradicts itself: 0.671 FPS is 1,490 ms and not "
        "6,410.3, and neither number gives −3.3 %.",
    ),
)

NEAR_VIEW_HOLES = TableLayout(
    label="tab:near_view_holes",
    source="near",
    title="Against true second photos, in the hole and outside",
    caption=(
        "Against true second photos, in the hole (base opacity below 0.95) and outside; the paper "
        "has no such table."
    ),
    columns=(
        ColumnLayout("base HAR", "har_before", "ratio"),
        ColumnLayout("in the hole", "distance", group="distance ↓"),
        ColumnLayout("image", "psnr", group="PSNR ↑"),
        ColumnLayout("in the hole", "psnr_hole", group="PSNR ↑"),
        ColumnLayout("outside", "psnr_outside", group="PSNR ↑"),
        ColumnLayout("image", "ssim", group="SSIM ↑"),
        ColumnLayout("in the hole", "ssim_hole", group="SSIM ↑"),
        ColumnLayout("outside", "ssim_outside", group="SSIM ↑"),
    ),
    marks_best=True,
    notes=(PAPER_IMAGES_NOTE, BEST_NOTE),
)

# In the order in which tables.md and tables.tex have them.
TABLE_LAYOUTS = (
    LARGE_VIEW_QUALITY,
    HOLE_AREA,
    OVERHEAD,
    NEAR_VIEW_QUALITY,
    DENSE_AGAINST_MASKED,
    EXPANDED_OVERHEAD,
    NEAR_VIEW_HOLES,
)
