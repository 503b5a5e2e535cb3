"""What a prediction works with: set up once for all photos, and the base for each."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

from spackle.bases.depth_maps import load_depth
from spackle.bases.protocol import Base
from spackle.bases.rgbd import RgbdBase
from spackle.bases.sharp import SharpBase
from spackle.camera import Camera
from spackle.downloads import check_recorded
from spackle.errors import InputError
from spackle.formats import load_cameras
from spackle.image import Photo
from spackle.jobs.inputs import find_depth
from spackle.jobs.options import PredictOptions, check_options, video_problem
from spackle.jobs.request import shared_digest
from spackle.render import Renderer, get_renderer
from spackle.residual import ResidualNet
from spackle.residual.weights import load_residual


class BaseError(InputError):
    """The base of all photos cannot be used, so there is no point in trying the next photo."""


@dataclasses.dataclass(frozen=True)
class Tools:
    """What is set up once for all photos."""

    renderer: Renderer
    base: Callable[[], Base] | None  # loads one that needs nothing beside the photo, the first time it is asked for
    network: ResidualNet | None
    residual: str  # for the report: "shipped", a path, "seeds" or "none"
    views: list[Camera] | None  # of --cameras
    digest: str  # of the options, and of the files that all photos share


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
    # SHARP takes seconds to load: not before a photo is known to need it.
    base = functools.cache(lambda: _load_sharp(options, digest)) if options.base == "sharp" else None
    return Tools(get_renderer(options.device), base, network, options.residual_weights, views, digest)


def _load_sharp(options: PredictOptions, digest: str) -> SharpBase:
    """SHARP with the weights that were given or downloaded; a download is held to its record first."""
    path = options.base_weights
    device = None if options.device == "auto" else options.device
    try:
        if path is None:  # there were some when the options were checked
            raise InputError("SHARP's weights have gone while this was running: start again")
        check_recorded(path)  # where there is a record
        base = SharpBase.load(path, precision=options.precision, low_memory=options.low_memory, device=device)
        if shared_digest(options) != digest:
            raise InputError(f"{path}: changed while this was running: start again")
    except InputError as error:
        raise BaseError(str(error)) from error
    return base


def make_base(photo: Photo, options: PredictOptions, tools: Tools) -> Base:
    """The base for one photo, given at its full size.

    Raises:
        BaseError: no photo can be worked on.
        InputError: a depth map that cannot be used, or none for this photo.
    """
    if tools.base is not None:
        return tools.base()
    assert options.depth is not None  # set_up has refused it
    path = find_depth(options.depth, photo.path)
    depth = load_depth(path, calib=options.calib)
    depth.check_shape(photo.height, photo.width, photo.path)
    if options.gives_focal and depth.K is not None:  # a person's word beats the calibration's
        scale = depth.depth.shape[1] / photo.width
        depth = load_depth(path, calib=options.calib, focal_px=photo.focal_px * scale)
    return RgbdBase(depth)
