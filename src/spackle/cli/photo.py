"""The choices of `spackle predict`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from spackle.errors import InputError
from spackle.pipeline import Options, Pipeline
from spackle.video_frames import video_problem


@dataclasses.dataclass(frozen=True)
class PredictOptions:
    """The choices of `spackle predict`."""

    scene: Options
    lens: Mapping[str, float | None]  # `focal_px`, `focal_mm` and `fov`, as `load_photo` takes them
    render: bool = True  # write a video
    keep_base: bool = False  # write base.ply
    keep_frame: bool = False  # a uniform frame around a photo is part of it
    overwrite: bool = False  # of many photos, do again what is done already
    workers: int = 1  # processes that share the photos
    threads: int | None = None  # of each
    ray: str | None = None  # the cluster where they are; this machine where None

    def open(self) -> Pipeline:
        """What all photos share; InputError for an option that cannot be used, whatever the photo."""
        pipeline, path = Pipeline.open(self.scene), self.scene.path
        if not self.render:
            for option in ("format", "fps", "loop"):
                if (value := getattr(path.video, option)) is not None:
                    raise InputError(
                        f"--{option} {value}: is for the video, and --no-render writes none: leave one of them out"
                    )
        elif pipeline.given_views and (problem := video_problem(pipeline.given_views)):
            raise InputError(f"{path.cameras}: {problem}, so they make no video: add --no-render for pictures only")
        return pipeline
