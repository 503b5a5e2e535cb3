"""What a prediction works with: set up once for all photos, and the base for each."""

from __future__ import annotations

import dataclasses
from typing import cast

from spackle.bases.open import OpenedBase, open_base
from spackle.bases.protocol import Base
from spackle.camera import Camera
from spackle.camera_path import KeyframePath
from spackle.choose import Load
from spackle.errors import InputError
from spackle.formats import load_cameras, load_path
from spackle.image import Photo
from spackle.jobs.options import PredictOptions, check_options, video_problem
from spackle.jobs.request import shared_digest
from spackle.render import Renderer, get_renderer
from spackle.residual import ResidualNet
from spackle.residual.network import load_residual


@dataclasses.dataclass(frozen=True)
class Tools:
    """What is set up once for all photos."""

    renderer: Renderer
    opened: OpenedBase
    network: ResidualNet | None
    residual: str  # for the report: "shipped", a path, "seeds" or "none"
    views: list[Camera] | None  # of --cameras
    digest: str  # of the options, and of the files that all photos share
    path: KeyframePath | None = None  # of --path

    @property
    def base(self) -> Load | None:
        """The network, for callers that have not moved to `opened` yet."""
        return None if self.opened.takes_depth else lambda: self.opened.load(cast(Photo, None)).load()


def set_up(options: PredictOptions) -> Tools:
    """Check the options that do not depend on a photo, and load what all photos share.

    Raises:
        InputError: an option that cannot be used.
    """
    check_options(options)
    file = options.residual_file
    network = None if file is None else load_residual(file)
    views = load_cameras(options.cameras) if options.cameras else None
    if views and options.render and (problem := video_problem(views)):
        raise InputError(f"{options.cameras}: {problem}, so they make no video: add --no-render for pictures only")
    digest = shared_digest(options)
    opened = open_base(options.settings)
    path = load_path(options.path) if options.path else None
    return Tools(get_renderer(options.device), opened, network, options.residual_weights, views, digest, path)


def make_base(photo: Photo, options: PredictOptions, tools: Tools) -> Base:
    """The base that is named, for one photo, given at its full size."""
    return tools.opened.load(photo, options.depth).load()
