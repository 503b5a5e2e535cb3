"""The Python interface: a photo from a file, bytes, an array or a tensor becomes a completed scene."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from spackle.bases import Base
from spackle.bases.open import open_base, wrap_loaded_base
from spackle.bases.settings import AUTO, BaseSettings
from spackle.core.photo import Photo, load_photo, photo_from_picture
from spackle.core.trajectories import TrajectoryKind
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import load_depth
from spackle.depth.units import DepthKind, depth_from_array
from spackle.pipeline import FillOptions, FillTexture, Pipeline, PipelineOptions
from spackle.render import Renderer, get_renderer
from spackle.residual.network import ResidualNet
from spackle.runtime.errors import InputError, short_repr, shorten_input_errors
from spackle.runtime.progress import LogReporter
from spackle.scene import Scene
from spackle.views import PathOptions

Pixels = NDArray[Any] | Tensor
PhotoSource = str | os.PathLike[str] | bytes | BinaryIO | Image.Image | Pixels | Photo
DepthSource = str | os.PathLike[str] | bytes | BinaryIO | Pixels | DepthMap
Residual = str | os.PathLike[str] | ResidualNet | None


class Spackle:
    """Completes many photos; a network is loaded once, at the first photo that needs it."""

    @shorten_input_errors()
    def __init__(
        self,
        base: str | Base = AUTO,
        *,
        residual: Residual = None,
        fill: FillTexture = "auto",
        device: str = "auto",
        renderer: Renderer | None = None,
    ) -> None:
        """Choose base, fill and device.

        Args:
            base: a name as for `--base`, or a loaded base, such as `SharpBase.load(weights)`. "auto" takes the best
                base for each photo: a depth map, SHARP or MoGe if their weights have been downloaded, or else
                "lite", which is rough. The choice is logged to the logger "spackle".
            residual: a weight file, a loaded network, "seeds" to fill without a network, or "none" to keep the holes;
                None takes the weights that come with Spackle.
            fill: source of the texture in the holes, see `spackle.pipeline.open_texture`; "none" keeps the holes.
            device: "auto", "cpu" or "cuda", for base and renderer.
            renderer: by default the renderer of the device.

        Raises:
            InputError: an unknown name, or weights that cannot be used.
        """
        name = base if isinstance(base, str) else AUTO
        network = residual if isinstance(residual, ResidualNet) else None
        if residual is None or isinstance(residual, ResidualNet):
            weights = None
        else:
            weights = os.fspath(residual)
        chosen = FillOptions(residual=weights, fill=fill)
        options = PipelineOptions(base=BaseSettings(name=name, device=device), fill=chosen)
        options.base.check()
        opened = open_base(options.base) if isinstance(base, str) else wrap_loaded_base(base)
        self._given = not isinstance(base, str) or base not in (AUTO, "rgbd")
        self._pipeline = Pipeline(
            options, opened, network or chosen.load(), renderer or get_renderer(device)
        )

    @shorten_input_errors()
    def predict(
        self,
        photo: PhotoSource,
        depth: DepthSource | None = None,
        *,
        trajectory: TrajectoryKind = "rotate-forward",
        disparity: float | None = None,
        depth_kind: DepthKind = "auto",
        keep_frame: bool = False,
        focal_px: float | None = None,
        focal_mm: float | None = None,
        fov: float | None = None,
        progress: bool = False,
    ) -> Scene:
        """Turn a photo into a scene without holes along a camera path; see `spackle.predict`."""
        if depth is not None and self._given:
            raise InputError(
                'a depth map and a base are given: leave one of them out, or give base="rgbd"'
            )
        lens = {"focal_px": focal_px, "focal_mm": focal_mm, "fov": fov}
        if isinstance(photo, Photo) and lens != dict.fromkeys(lens):
            raise InputError(
                "a loaded photo has a focal length already: give focal_px, focal_mm or fov to load_photo"
            )
        pipeline, options = self._pipeline, self._pipeline.options
        options = dataclasses.replace(
            options, path=PathOptions(trajectory=trajectory, disparity=disparity)
        )
        options.path.check()
        with contextlib.ExitStack() as stack:
            if depth is not None:
                source = stack.enter_context(_depth(depth, depth_kind))
                options = dataclasses.replace(
                    options,
                    base=dataclasses.replace(options.base, depth=source, depth_kind=depth_kind),
                )
                pipeline = dataclasses.replace(pipeline, base=open_base(options.base))
            keep = keep_frame or options.give_geometry
            loaded = stack.enter_context(_photo(photo, keep_frame=keep, **lens))
            return (
                dataclasses.replace(pipeline, options=options)
                .complete(loaded, LogReporter(progress))
                .scene
            )


def predict(
    photo: PhotoSource,
    depth: DepthSource | None = None,
    *,
    base: str | Base = AUTO,
    trajectory: TrajectoryKind = "rotate-forward",
    disparity: float | None = None,
    depth_kind: DepthKind = "auto",
    residual: Residual = None,
    fill: FillTexture = "auto",
    device: str = "auto",
    renderer: Renderer | None = None,
    keep_frame: bool = False,
    focal_px: float | None = None,
    focal_mm: float | None = None,
    fov: float | None = None,
    progress: bool = False,
) -> Scene:
    """Turn a photo into a scene without holes along a camera path; for many photos keep a `Spackle`.

    Args:
        photo: a path, the bytes of a file, an open file, a PIL picture, a loaded photo, or an array or tensor
            [H, W, 3] or [3, H, W] of sRGB as uint8 or as floats in 0..1.
        depth: the photo's depth as a path, bytes or an open file in a format of `load_depth`, an array or tensor [H, W]
            in metres (0, NaN or inf: unknown), or a loaded depth map.
        base, residual, fill, device, renderer: see `Spackle`.
        trajectory: the path for which the scene is completed, in addition to the leftmost and rightmost views.
        disparity: size of the camera's movement, see `spackle.core.trajectories.disparity_to_offset`; None lets `choose_disparity` decide,
            with a limit of 0.15 for lite and 0.3 for other bases.
        depth_kind: the meaning of a depth map's numbers, see `spackle.load_depth`.
        keep_frame: keep a uniform frame around a picture. Otherwise the frame is cropped, unless depth or a focal
            length is given.
        focal_px, focal_mm, fov: the focal length, see `load_photo`.
        progress: draw a bar on the standard error.

    Raises:
        InputError: a photo, a depth map, a name or weights that cannot be used; `base` together with `depth`, or a
            focal length for a loaded photo.
    """
    return Spackle(base, residual=residual, fill=fill, device=device, renderer=renderer).predict(
        photo,
        depth,
        trajectory=trajectory,
        disparity=disparity,
        depth_kind=depth_kind,
        keep_frame=keep_frame,
        focal_px=focal_px,
        focal_mm=focal_mm,
        fov=fov,
        progress=progress,
    )


@contextlib.contextmanager
def _photo(source: PhotoSource, **options: Any) -> Iterator[Photo]:
    """Load the photo; during the block, bytes lie in a temporary file, from which a base can read the photo's depth."""
    if isinstance(source, Photo):
        yield source
    elif isinstance(source, Image.Image | np.ndarray | Tensor):
        yield photo_from_picture(source, **options)
    else:
        with _as_file(source, "photo") as path:
            yield load_photo(path, **options)


@contextlib.contextmanager
def _depth(source: DepthSource, kind: DepthKind) -> Iterator[Path | DepthMap]:
    if isinstance(source, np.ndarray | Tensor):
        array = source.detach().cpu().numpy() if isinstance(source, Tensor) else source
        yield depth_from_array(array, Path("depth"), kind)
    elif isinstance(source, DepthMap | str | os.PathLike):
        yield source if isinstance(source, DepthMap) else Path(source)
    else:
        with _as_file(source, "depth") as path:
            yield load_depth(path, kind=kind)


@contextlib.contextmanager
def _as_file(source: str | os.PathLike[str] | bytes | BinaryIO, kind: str) -> Iterator[Path]:
    """A path to the source's bytes; messages contain `kind` instead of the name of a temporary file."""
    if isinstance(source, str | os.PathLike):
        yield Path(source)
        return
    content = source.read() if hasattr(source, "read") else source
    if not isinstance(content, bytes):
        accepted = "a path, bytes, a file opened in binary mode, or an array"
        raise InputError(
            f"{kind}: {type(source).__name__} {short_repr(source)} is not accepted: give {accepted}"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / kind
        path.write_bytes(content)
        try:
            yield path
        except InputError as error:
            raise InputError(str(error).replace(str(path), kind)) from error
