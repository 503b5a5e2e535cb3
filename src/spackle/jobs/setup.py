"""What a prediction works with: set up once for all photos, and the base for each."""

from __future__ import annotations

import dataclasses
import functools

from spackle.bases.depth_maps import load_depth
from spackle.bases.hf import HfBase
from spackle.bases.lite.base import LiteBase
from spackle.bases.protocol import Base
from spackle.bases.rgbd import RgbdBase
from spackle.camera import Camera
from spackle.choose import Auto, BaseError, Load, Say, Search, Way, by_own_depth, load_sharp
from spackle.errors import InputError
from spackle.formats import load_cameras, load_path
from spackle.image import Photo
from spackle.jobs.bases import AUTO, HF, NETWORKS, kind_of
from spackle.jobs.inputs import find_depth
from spackle.jobs.options import PredictOptions, check_options, video_problem
from spackle.jobs.request import shared_digest
from spackle.keyframes import KeyframePath
from spackle.render import Renderer, get_renderer
from spackle.residual import ResidualNet
from spackle.residual.network import load_residual


@dataclasses.dataclass(frozen=True)
class Tools:
    """What is set up once for all photos."""

    renderer: Renderer
    base: Load | None  # of a network, which is loaded the first time it is asked for
    auto: Auto | None  # finds a base for each photo, where none is named
    network: ResidualNet | None
    residual: str  # for the report: "shipped", a path, "seeds" or "none"
    views: list[Camera] | None  # of --cameras
    digest: str  # of the options, and of the files that all photos share
    path: KeyframePath | None = None  # of --path


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
    base, auto = _bases(options, digest)
    path = load_path(options.path) if options.path else None
    return Tools(get_renderer(options.device), base, auto, network, options.residual_weights, views, digest, path)


def _bases(options: PredictOptions, digest: str) -> tuple[Load | None, Auto | None]:
    """A network, or the search for a base, or neither; nothing is loaded yet, for that takes seconds."""
    name = options.named
    if name == AUTO:
        there = "checkpoint" in options.base_files
        sharp, lite = (functools.partial(_load, kind, options, digest) for kind in ("sharp", "lite"))
        return None, Auto(sharp if there else None, lite)
    if not kind_of(name).network:
        return None, None
    return functools.cache(functools.partial(_load_for_all, options, digest)), None


def _load_for_all(options: PredictOptions, digest: str) -> Base:
    """The network that --base names; BaseError where it cannot be loaded."""
    try:
        return _load(options.named, options, digest)
    except InputError as error:
        raise BaseError(str(error)) from error


def _load(name: str, options: PredictOptions, digest: str) -> Base:
    """A network, by files that have not changed since the options were checked.

    Raises:
        InputError: it cannot be loaded.
        BaseError: its files are others now.
    """
    base = _network(name, options)
    if shared_digest(options) != digest:
        files = ", ".join(str(file) for file in options.base_files.values())
        raise BaseError(f"{files}: changed while this was running: start again")
    return base


def _network(name: str, options: PredictOptions) -> Base:
    device = None if options.device == "auto" else options.device
    if name == "lite":
        return LiteBase.load(options.checkpoint if options.named == name else None, device=device)
    if name.startswith(HF):
        return HfBase.load(name.removeprefix(HF), device=device, precision=options.precision)
    path = options.base_files.get("checkpoint")
    if path is None:  # there were some when the options were checked
        raise InputError("SHARP's weights have gone while this was running: start again")
    return load_sharp(
        path,
        precision=options.precision,
        low_memory=options.low_memory,
        windows=options.windows,
        compiled=options.compiled,
        device=device,
    )


def make_base(photo: Photo, options: PredictOptions, tools: Tools) -> Base:
    """The base that is named, for one photo, given at its full size.

    Raises:
        BaseError: no photo can be worked on.
        InputError: a depth map that cannot be used, or none for this photo.
    """
    if tools.base is not None:
        return tools.base()
    if options.depth is None:
        return _by_own_depth(photo)
    path = find_depth(options.depth, photo.path)
    depth = load_depth(path, calib=options.calib)
    depth.check_shape(photo.height, photo.width, photo.path)
    if options.gives_focal and depth.K is not None:  # a person's word beats the calibration's
        scale = depth.depth.shape[1] / photo.width
        depth = load_depth(path, calib=options.calib, focal_px=photo.focal_px * scale)
    return RgbdBase(depth)


def search_base(photo: Photo, options: PredictOptions, tools: Tools, say: Say) -> Search:
    """The base for one photo, named or not; `say` is told what is passed over."""
    if tools.auto is not None:
        return tools.auto.search(photo, say)
    named = options.base != AUTO
    why = "--depth" if options.depth is not None else f"--base {options.base}" if named else "-c"
    return Search(photo, [Way(why, lambda photo: make_base(photo, options, tools))], say)


def _by_own_depth(photo: Photo) -> RgbdBase:
    """By the depth in the photo's file; InputError where there is none."""
    base = by_own_depth(photo)
    if base is None:
        raise InputError(
            f"{photo.path}: --base rgbd needs depth, and there is none in the photo: give --depth FILE, or --depth "
            f"FOLDER for many photos; {', '.join(NETWORKS)} need none"
        )
    return base
