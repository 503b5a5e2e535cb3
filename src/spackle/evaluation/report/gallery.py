"""Which images a report pictures: few of them, from the worst to the best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from spackle.evaluation.report.cases import case_html
from spackle.evaluation.report.markup import Html, joined, tag
from spackle.evaluation.report.pictures import SIDE, chosen, fitting
from spackle.evaluation.report.source import Source
from spackle.evaluation.report.svg import spread
from spackle.evaluation.results import Record
from spackle.evaluation.sheets import Ranking, rank

MOST = 8  # images of a page
LEAST = 2  # of each evaluation, however many there are
Case = tuple[Record, str, Mapping[str, bytes]]  # an image, which of how many it is, its pictures


def gallery(sources: Sequence[Source]) -> Html:
    """The sliders of every evaluation; all pictures of the page have to fit together."""
    count = max(LEAST, MOST // len(sources))
    picked = [(rank(source.run), _pick(source, count)) for source in sources]
    fits = iter(fitting([pictures for _, cases in picked for _, _, pictures in cases]))
    parts: list[Html] = []
    for source, (ranking, cases) in zip(sources, picked, strict=True):
        about = _said(source, ranking, len(cases)) if cases else "No pictures are left."
        parts += [tag("h3", source.name), tag("p", about)]
        parts += [case_html(source.run, record, place, next(fits)) for record, place, _ in cases]
    return joined(parts)


def _pick(source: Source, count: int) -> list[Case]:
    """Images from the worst to the best, evenly between them; those without pictures are passed over."""
    ranking = rank(source.run)
    names = ranking.names[::-1] if ranking else [record.name for record in source.run.measured]
    index = {record.name: number for number, record in enumerate(source.run.records)}
    cases: list[Case] = []
    for place in spread(len(names), count):
        pictures = chosen(source.pictures(index[names[place]]))
        if pictures:
            said = _place(place, len(names)) if ranking else ""
            cases.append((source.run.records[index[names[place]]], said, pictures))
    return cases


def _place(place: int, count: int) -> str:
    """ "worst", "best", or which of how many."""
    if count < 2:
        return ""
    return {0: "worst", count - 1: "best"}.get(place, f"{place + 1} of {count}")


def _said(source: Source, ranking: Ranking | None, count: int) -> str:
    """What is pictured, and what is not."""
    run = source.run
    order = f", from the worst to the best by {ranking.says}" if ranking and count > 1 else ""
    terms = f" Pictures of {run.title}: {run.config['terms']}." if run.config.get("terms") else ""
    images = "image" if len(run.measured) == 1 else "images"
    return (
        f"{count} of {len(run.measured)} {images}{order}; of each the view with the largest hole. Press and drag on a "
        f"picture, or use the arrow keys. A page pictures up to {MOST} images, or {LEAST} of each evaluation where "
        f"there are more than {MOST // LEAST}, up to {SIDE} pixels wide or high, smaller where they are many.{terms}"
    )
