"""Options of `spackle predict`, and what they mean for the pipeline."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from spackle.errors import InputError
from spackle.formats.depth import check_depth_name
from spackle.pipeline import Options, Pipeline
from spackle.video_frames import video_problem


@dataclasses.dataclass(frozen=True)
class PredictOptions:
    """Options of `spackle predict`, and what they mean for the pipeline."""

    scene: Options
    lens: Mapping[str, float | None]  # `focal_px`, `focal_mm` and `fov`, as `load_photo` takes them
    render: bool = True  # write a video
    keep_base: bool = False  # write base.ply
    depth_out: str | None = None  # write the photo's depth, under this name
    keep_frame: bool = False  # keep a uniform frame around a photo
    overwrite: bool = False  # of several photos, redo those that are done
    workers: int = 1  # processes that share the photos
    threads: int | None = None  # of each worker

    def open(self) -> Pipeline:
        """Open the pipeline for all photos; InputError for an option that cannot be used with any photo."""
        if self.depth_out is not None:
            check_depth_name(self.depth_out)
            if Path(self.depth_out).name != self.depth_out:
                raise InputError(f"--depth-out {self.depth_out}: is put beside scene.ply: give a name without a folder")
        pipeline, path = Pipeline.open(self.scene), self.scene.path
        if not self.render:
            for option in ("format", "fps", "loop"):
                if (value := getattr(path.video, option)) is not None:
                    raise InputError(
                        f"--{option} {value}: applies to the video, and --no-render writes none: leave one of them out"
                    )
        elif pipeline.given_views and (problem := video_problem(pipeline.given_views)):
            raise InputError(f"{path.cameras}: {problem}, so they make no video: add --no-render for pictures only")
        return pipeline
