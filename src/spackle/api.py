"""The Python interface: a photo from a file, bytes, an array or a tensor becomes a scene.

`predict` completes one photo; a `Spackle` keeps its networks and completes many.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Protocol, TypeGuard

from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from spackle.bases import Base
from spackle.bases.open import open_base, wrap_loaded_base
from spackle.bases.settings import AUTO, RGBD, BaseSettings
from spackle.core.array_values import is_array_like
from spackle.core.photo import Photo, load_photo, photo_from_picture
from spackle.core.trajectories import TrajectoryKind
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import DepthValue
from spackle.depth.units import DepthKind
from spackle.pipeline import FillMode, FillOptions, Pipeline, PipelineOptions
from spackle.render import Renderer, get_renderer
from spackle.residual.network import ResidualNet
from spackle.runtime.errors import InputError, short_repr, shorten_input_errors
from spackle.runtime.progress import Cancel, LogReporter, ProgressListener
from spackle.scene import Scene
from spackle.views import PathOptions


class ArrayLike(Protocol):
    """An array of another package, such as xarray, JAX or CuPy."""

    def __array__(self) -> NDArray[Any]:
        """The same numbers as a NumPy array."""


Pixels = NDArray[Any] | Tensor | Image.Image | ArrayLike
FileSource = str | os.PathLike[str] | bytes | bytearray | memoryview | BinaryIO
PhotoSource = FileSource | Pixels | Photo
DepthSource = FileSource | Pixels | DepthMap
Residual = str | os.PathLike[str] | ResidualNet | None


class Spackle:
    """Completes many photos; a network is loaded once, at the first photo that needs it."""

    @shorten_input_errors()
    def __init__(
        self,
        base: str | Base = AUTO,
        *,
        residual: Residual = None,
        fill: str = "auto",
        mode: FillMode = "scene",
        device: str = "auto",
        renderer: Renderer | None = None,
    ) -> None:
        """Choose base, fill and device.

        Args:
            base: the network that turns a photo into Gaussians: a name as for `spackle predict
                --base`, or a loaded base, such as `SharpBase.load(weights)`. "auto" takes the best
                for each photo: a depth map, SHARP or MoGe if their weights have been downloaded,
                or else "lite", which is rough. The choice is logged to the logger "spackle".
            residual: the network that fills holes: a weight file, a loaded network, "initial" to
                fill without a network, or "none" to keep the holes; None takes the weights that
                come with Spackle.
            fill: source of the texture in the holes, see `spackle.pipeline.open_texture`; "none"
                keeps the holes; `package.module:Class` is an inpainter of another package.
            mode: "scene" fills the holes of all views by one set of Gaussians; "view" fills each
                view by a set of its own; "paper" does so by the paper's method alone (eqs. 2 to
                9): one pass, no occlusion guard, no texture. Sets of single views are in the
                scene's `by_view`.
            device: "auto", "cpu" or "cuda", for base and renderer.
            renderer: by default the renderer of the device.

        Raises:
            InputError: an unknown name, weights that cannot be used, or a texture together with
                the mode "paper".
        """
        # A loaded network needs no file, so it is not part of the options.
        if isinstance(residual, ResidualNet):
            fill_options = FillOptions(fill=fill, mode=mode)
            network: ResidualNet | None = residual
        else:
            weights = None if residual is None else os.fspath(residual)
            fill_options = FillOptions(residual=weights, fill=fill, mode=mode)
            network = fill_options.load_network()
        fill_options.check()

        if isinstance(base, str):
            base_settings = BaseSettings(name=base, device=device)
            opened_base = open_base(base_settings)
            # A depth map does not contradict these two: "auto" prefers a depth map to all networks,
            # and "rgbd" is the base that lifts a photo by its depth map.
            self._accepts_depth = base in (AUTO, RGBD)
        else:
            base_settings = BaseSettings(device=device)
            opened_base = wrap_loaded_base(base)
            # A loaded base makes the Gaussians itself, so a depth map would have no effect.
            self._accepts_depth = False

        self._pipeline = Pipeline(
            options=PipelineOptions(base=base_settings, fill=fill_options),
            base=opened_base,
            network=network,
            renderer=renderer or get_renderer(device),
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
        depth_unit: str | float | None = None,
        keep_frame: bool = False,
        focal_px: float | None = None,
        focal_mm: float | None = None,
        fov: float | None = None,
        progress: bool | ProgressListener = False,
        cancel: Cancel | None = None,
    ) -> Scene:
        """Turn a photo into a scene without holes along a camera path.

        Arguments and errors are those of `spackle.predict`.
        """
        if depth is not None and not self._accepts_depth:
            raise InputError(
                'a depth map and a base are given: leave one of them out, or give base="rgbd"'
            )
        has_lens = focal_px is not None or focal_mm is not None or fov is not None
        if isinstance(photo, Photo) and has_lens:
            raise InputError(
                "a loaded photo has a focal length already: "
                "give focal_px, focal_mm or fov to load_photo"
            )

        # The session's base, network and renderer, with the path of this call.
        path = PathOptions(trajectory=trajectory, disparity=disparity)
        path.check()
        options = dataclasses.replace(self._pipeline.options, path=path)
        pipeline = dataclasses.replace(self._pipeline, options=options)

        # Temporary files of photo and depth have to exist until the scene is complete, because the
        # base reads them late.
        # A uniform frame around the picture is cropped, unless the user wants it, or gives depth or
        # cameras: these belong to the whole picture, frame included.
        with contextlib.ExitStack() as open_files:
            if depth is not None:
                depth_source = open_files.enter_context(_open_depth(depth))
                pipeline = _with_depth(pipeline, depth_source, depth_kind, depth_unit)
            loaded_photo = open_files.enter_context(
                _open_photo(
                    photo,
                    keep_frame=keep_frame or pipeline.options.has_given_geometry,
                    focal_px=focal_px,
                    focal_mm=focal_mm,
                    fov=fov,
                )
            )
            return pipeline.complete(loaded_photo, LogReporter(progress, cancel)).scene


def predict(
    photo: PhotoSource,
    depth: DepthSource | None = None,
    *,
    base: str | Base = AUTO,
    trajectory: TrajectoryKind = "rotate-forward",
    disparity: float | None = None,
    depth_kind: DepthKind = "auto",
    depth_unit: str | float | None = None,
    residual: Residual = None,
    fill: str = "auto",
    mode: FillMode = "scene",
    device: str = "auto",
    renderer: Renderer | None = None,
    keep_frame: bool = False,
    focal_px: float | None = None,
    focal_mm: float | None = None,
    fov: float | None = None,
    progress: bool | ProgressListener = False,
    cancel: Cancel | None = None,
) -> Scene:
    """Turn a photo into a scene without holes along a camera path.

    For many photos keep a `Spackle`, which loads its networks once. The scene's `report`, a
    `SceneReport`, says how it was made: its holes, base, focal length, warnings and times.

    Args:
        photo: a path, the bytes of a file, an open file, a PIL picture, a loaded photo, or an
            array or tensor of sRGB as for `photo_from_picture`, such as [H, W, 3] of uint8.
        depth: the photo's depth as a path, bytes or an open file in a format of `load_depth`, a
            loaded depth map, or a PIL picture, array or tensor [H, W]: floats in metres, in which
            0, NaN and inf are unknown, and so are the masked numbers of a masked array.
        base: what turns the photo into Gaussians, see `Spackle`.
        trajectory: the path for which the scene is completed, in addition to the leftmost and
            rightmost views.
        disparity: size of the camera's movement, see
            `spackle.core.trajectories.disparity_to_offset`; None chooses it for the photo, with a
            limit of 0.1 for lite and 0.3 for other bases.
        depth_kind: the meaning of a depth map's numbers, see `spackle.load_depth`.
        depth_unit: the unit of metric depth, such as "mm", "1/256" or 0.001.
        residual: the network that fills holes, see `Spackle`.
        fill: source of the texture in the holes, see `Spackle`.
        mode: one set of Gaussians for all views, or one for each view, see `Spackle`.
        device: "auto", "cpu" or "cuda", for base and renderer.
        renderer: by default the renderer of the device.
        keep_frame: keep a uniform frame around a picture. Otherwise the frame is cropped, unless
            depth or a focal length is given.
        focal_px: focal length in pixels of the photo.
        focal_mm: focal length in millimetres, as a 35 mm equivalent.
        fov: horizontal field of view in degrees.
        progress: True draws a bar on the standard error; a function gets a `StageProgress` at the
            start of each stage and after each of its steps, such as the views of the fill.
        cancel: a `threading.Event`, or a function that returns bool, which is asked between two
            steps; once it is set or true, the work ends.

    Raises:
        InputError: a photo, a depth map, a name or weights that cannot be used; `base` together
            with `depth`, or a focal length for a loaded photo.
        Cancelled: `cancel` has asked for the end.
    """
    # A session for this one photo; what it loads is freed with it.
    session = Spackle(
        base, residual=residual, fill=fill, mode=mode, device=device, renderer=renderer
    )
    return session.predict(
        photo,
        depth,
        trajectory=trajectory,
        disparity=disparity,
        depth_kind=depth_kind,
        depth_unit=depth_unit,
        keep_frame=keep_frame,
        focal_px=focal_px,
        focal_mm=focal_mm,
        fov=fov,
        progress=progress,
        cancel=cancel,
    )


def _with_depth(
    pipeline: Pipeline,
    depth: Path | DepthMap | DepthValue,
    depth_kind: DepthKind,
    depth_unit: str | float | None,
) -> Pipeline:
    """The same pipeline, with a base that lifts a photo by this depth."""
    # The fill's network and the renderer stay open; only the base is opened anew, for this photo.
    base_settings = dataclasses.replace(
        pipeline.options.base, depth=depth, depth_kind=depth_kind, depth_unit=depth_unit
    )
    return dataclasses.replace(
        pipeline,
        options=dataclasses.replace(pipeline.options, base=base_settings),
        base=open_base(base_settings),
    )


@contextlib.contextmanager
def _open_photo(
    source: PhotoSource,
    *,
    keep_frame: bool,
    focal_px: float | None,
    focal_mm: float | None,
    fov: float | None,
) -> Iterator[Photo]:
    """Give the loaded photo, during the block.

    Bytes lie in a temporary file until the block ends, because a base may read the depth that
    phones store inside a photo's file. The options are those of `load_photo`.
    """
    # The focal length of a loaded photo is known; the caller has refused another one.
    if isinstance(source, Photo):
        yield source
    elif _is_pixels(source):
        yield photo_from_picture(
            source, keep_frame=keep_frame, focal_px=focal_px, focal_mm=focal_mm, fov=fov
        )
    else:
        with _as_file(source, "photo") as path:
            yield load_photo(
                path, keep_frame=keep_frame, focal_px=focal_px, focal_mm=focal_mm, fov=fov
            )


@contextlib.contextmanager
def _open_depth(source: DepthSource) -> Iterator[Path | DepthMap | DepthValue]:
    """Give a depth map in a form that a base takes, during the block.

    A file's content lies in a temporary file until the block ends. The base reads it, because only
    the base knows the photo, which shows whether the numbers can be metres.
    """
    if isinstance(source, DepthMap):
        yield source
    elif isinstance(source, str | os.PathLike):
        # The base also looks for the calibration beside the file.
        yield Path(source)
    elif _is_pixels(source):
        yield DepthValue(source)
    else:
        with _as_file(source, "depth") as path:
            yield path


def _is_pixels(source: object) -> TypeGuard[Pixels]:
    """Whether a photo or depth map is a value with pixels, and not a file or its content."""
    # An open file or a path is never one, whatever methods its class adds.
    is_file = isinstance(source, str | bytes | os.PathLike) or hasattr(source, "read")
    return not is_file and is_array_like(source)


@contextlib.contextmanager
def _as_file(source: Any, name: str) -> Iterator[Path]:
    """Give the path of a file that holds the source's bytes, during the block.

    A path is given as it is; bytes, and the content of an open file, go into a temporary file.

    Args:
        source: a path, the bytes of a file, or a file opened in binary mode.
        name: what an error message calls a source without a path; also the temporary file's name.

    Raises:
        InputError: the source is something else; or the block raised one, which then says `name`
            where it said the temporary file's path.
    """
    if isinstance(source, str | os.PathLike):
        yield Path(source)
        return

    # An open file is read from its current position, so a photo may lie inside a larger file.
    content = source.read() if hasattr(source, "read") else source
    if isinstance(content, bytearray | memoryview):
        content = bytes(content)
    # A file opened as text gives a str.
    if not isinstance(content, bytes):
        raise InputError(
            f"{name}: {type(source).__name__} {short_repr(source)} is not accepted: "
            "give a path, bytes, a file opened in binary mode, or an array"
        )

    # The readers of photos and depth maps take files, because some formats need to seek in them.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        try:
            yield path
        except InputError as error:
            raise InputError(str(error).replace(str(path), name)) from error
