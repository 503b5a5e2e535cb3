"""The files that `spackle predict --outputs` writes for each photo, told by their names."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import cast, get_args

from spackle.depth.writers import DEPTH_ENCODERS
from spackle.formats.scene_files import SCENE_ENCODERS
from spackle.results.photo_folder import PAGE_NAME, REPORT_NAME, VIEWS_NAME
from spackle.runtime.declared_options import VideoFormatName
from spackle.runtime.errors import InputError, unknown_name

SCENE_NAMES = tuple(f"scene{suffix}" for suffix in SCENE_ENCODERS)
BASE_NAMES = tuple(f"base{suffix}" for suffix in SCENE_ENCODERS)
VIDEO_NAMES = tuple(f"video.{name}" for name in get_args(VideoFormatName))
DEPTH_NAMES = tuple(f"depth{suffix}" for suffix in DEPTH_ENCODERS)
OUTPUT_NAMES = (
    *SCENE_NAMES,
    PAGE_NAME,
    *BASE_NAMES,
    *VIDEO_NAMES,
    *DEPTH_NAMES,
    VIEWS_NAME,
    REPORT_NAME,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outputs:
    """Which files are written for each photo; report.json always is, as the last one."""

    gaussian_files: tuple[str, ...]  # such as scene.spz, base.ply and scene.html
    video_format: VideoFormatName | None  # None: no video
    depth: str | None  # name of the photo's depth; None: no depth
    views: bool  # pictures of given views

    @property
    def needs_fill(self) -> bool:
        """Whether a file shows what completion adds; depth and Gaussians of the base do not."""
        has_scene = any(name.startswith("scene.") for name in self.gaussian_files)
        return has_scene or self.video_format is not None or self.views


def parse_outputs(text: str) -> Outputs:
    """The files that a list of names asks for, such as "scene.spz,report.json".

    InputError for a name that is none of `OUTPUT_NAMES`, or two videos or depth maps.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise InputError(f"`outputs`: names no file: there are {', '.join(OUTPUT_NAMES)}")
    for name in names:
        if name not in OUTPUT_NAMES:
            raise InputError(f"`outputs` {name} is {unknown_name(name, OUTPUT_NAMES)}")
    video = _only_one(names, VIDEO_NAMES)
    gaussian_names = (*SCENE_NAMES, PAGE_NAME, *BASE_NAMES)
    return Outputs(
        gaussian_files=tuple(name for name in gaussian_names if name in names),
        video_format=(
            None if video is None else cast(VideoFormatName, video.removeprefix("video."))
        ),
        depth=_only_one(names, DEPTH_NAMES),
        views=VIEWS_NAME in names,
    )


def _only_one(names: Sequence[str], kinds: Sequence[str]) -> str | None:
    """The one name of a kind; None if there is none, InputError if there are two."""
    found = [name for name in kinds if name in names]
    if len(found) > 1:
        raise InputError(f"`outputs` {', '.join(found)}: give one of them")
    return found[0] if found else None
