"""The pipeline from a photo to a completed scene: base, camera path, fill. Begin with `Pipeline.complete`."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

from torch import Tensor

from spackle.bases import BasePrediction
from spackle.bases.open import OpenedBase, ResolvedBase, open_base
from spackle.bases.settings import BaseSettings
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo, check_photo_size
from spackle.core.trajectories import KeyframePath
from spackle.inpaint import InpainterOptions, get_inpainter
from spackle.render import Renderer, get_renderer
from spackle.residual.architectures import SHIPPED, load_residual, shipped_network
from spackle.residual.network import ResidualNet
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Progress, Reporter
from spackle.scene import Scene
from spackle.scene_fill.fill import FillContext, fill_scene, fill_view
from spackle.scene_fill.texture import Texture, exemplar_texture, painted_texture
from spackle.views import PathOptions, PlannedViews, choose_disparity, plan_views
from spackle.weights import installed_weights

# Where the texture in the holes comes from.
FillTexture = Literal["auto", "network", "exemplar", "lama", "none"]
# One set of aux Gaussians for all views, or one set for each view.
FillMode = Literal["scene", "view"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class FillOptions:
    """Options of the fill."""

    residual: str | None = (
        None  # a file of weights, "seeds", "none", or None for the shipped weights if there are any
    )
    fill: FillTexture = "auto"
    mode: FillMode = "scene"

    @property
    def texture(self) -> FillTexture:
        """The fill, with "auto" resolved; "none" if `residual` is "none".

        In view mode "auto" means "exemplar", because inpainting would take seconds for each view.
        """
        if self.residual == "none":
            return "none"
        return "exemplar" if self.mode == "view" and self.fill == "auto" else resolved(self.fill)

    @property
    def weights(self) -> str:
        """The weights' name in reports: "shipped", a file, "seeds" or "none"."""
        return (
            "none"
            if self.texture == "none"
            else self.residual or ("shipped" if SHIPPED.is_file() else "seeds")
        )

    @property
    def file(self) -> Path | None:
        """The file of the weights; None without a network."""
        if self.weights in ("seeds", "none"):
            return None
        return SHIPPED if self.weights == "shipped" else Path(self.weights)

    def load(self) -> ResidualNet | None:
        """The network, if any; InputError for a file that cannot be used."""
        return None if self.file is None else load_residual(self.file)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PipelineOptions:
    """All options for a photo: base, camera path and fill."""

    base: BaseSettings = dataclasses.field(default_factory=BaseSettings)
    path: PathOptions = dataclasses.field(default_factory=PathOptions)
    fill: FillOptions = dataclasses.field(default_factory=FillOptions)

    @property
    def give_geometry(self) -> bool:
        """Whether a depth map or cameras are given; both belong to the whole photo, so its border is kept."""
        return self.base.depth is not None or self.path.cameras is not None


@dataclasses.dataclass(frozen=True)
class CompletedPhoto:
    """A photo's scene, and the results from which it was made."""

    photo: Photo  # at its full size
    prediction: BasePrediction
    choice: ResolvedBase
    views: PlannedViews
    scene: Scene  # its disparity is None for given views and keyframes
    pictures: Mapping[
        int, Tensor
    ]  # [H, W, 3] uint8, by index: the completed views that completion has rendered
    saved_view: str | None = None  # in view mode: the view that `scene.aux` belongs to


@dataclasses.dataclass(frozen=True)
class Pipeline:
    """A base, a residual network and a renderer, opened once for many photos."""

    options: PipelineOptions
    base: OpenedBase
    network: ResidualNet | None
    renderer: Renderer
    given_views: list[Camera] | None = None  # from --cameras; they replace a path
    keyframes: KeyframePath | None = None  # from --path

    @staticmethod
    def open(options: PipelineOptions) -> Pipeline:
        """Check the options, and load the files that they name; InputError for an option that no photo can use."""
        options.base.check()
        options.path.check()
        network = options.fill.load()
        open_texture(options.fill.texture)  # fails before long work
        given_views, keyframes = options.path.load()
        renderer = get_renderer(options.base.device)
        return Pipeline(options, open_base(options.base), network, renderer, given_views, keyframes)

    def complete(self, photo: Photo, reporter: Reporter) -> CompletedPhoto:
        """Complete the scene of a photo at its full size; InputError if the photo or its depth map cannot be used."""
        fill, precision = self.options.fill, self.options.base.precision
        prediction, choice = self.predict(photo, reporter)
        views = plan_views(
            prediction, self.options.path, photo.path, self.given_views, self.keyframes
        )
        base, camera, texture = prediction.gaussians, prediction.camera, open_texture(fill.texture)
        context = FillContext(
            base, camera, self.renderer, self.network, texture, precision=precision
        )
        saved_view, by_view, pictures = None, None, dict[int, Tensor]()
        with reporter.stage("complete") as step:
            if fill.mode == "scene" or fill.texture == "none":
                chosen = [] if fill.texture == "none" else views.views_to_fill
                filled = fill_scene(
                    context,
                    [views.cameras[k] for k in chosen],
                    self.given_views is not None,
                    step,
                    always_filled=[n for n, k in enumerate(chosen) if k in views.always_filled],
                )
                aux = filled.aux
                if views.frame_maker.is_plain:
                    pictures = {chosen[k]: picture for k, picture in filled.pictures.items()}
            else:
                by_view = tuple(_fill_each(context, views.cameras, step))
                eye = camera.position.double()
                far = {
                    name: (views.cameras[k].position.double() - eye).norm()
                    for name, k in views.measured.items()
                }
                saved_view = max(
                    far, key=lambda name: float(far[name])
                )  # a file holds one set of aux Gaussians
                aux = by_view[views.measured[saved_view]]
        if not aux.finite:
            source = self.options.path.cameras or photo.path
            raise InputError(f"{source}: views too extreme to complete: check their K")
        scene = Scene(base, aux, camera, by_view, self._disparity(prediction))
        return CompletedPhoto(photo, prediction, choice, views, scene, pictures, saved_view)

    def predict(self, photo: Photo, reporter: Reporter) -> tuple[BasePrediction, ResolvedBase]:
        """Predict the photo's Gaussians, and choose the size of the camera's movement; also return the chosen base."""
        check_photo_size(photo.width, photo.height, photo.path)
        name = photo.path.name
        if photo.frame is not None:
            reporter.log(f"{name}: {photo.frame.note}; --keep-frame keeps it")
        prediction, choice = self.base.predict(photo, log=reporter.warn, stage=reporter.stage)
        if choice.note:
            reporter.log(f"{name}: {choice.note}")
        chosen = self._disparity(prediction) is not None and self.options.path.disparity is None
        if chosen:
            with reporter.stage("move"):
                prediction = choose_disparity(prediction, self.renderer, photo.path)
        reporter.log(
            f"{name}: {len(prediction.gaussians):,} Gaussians from {choice.name}, "
            f"focal length {prediction.camera.focal[0]:.0f} px ({prediction.lens_source or photo.focal_source.value})"
        )
        if chosen:
            reporter.log(f"{name}: {move_in_words(prediction)}")
        if depth_range := prediction.notes.get("depth_range"):
            reporter.log(f"{name}: its depth is {depth_range}")
        if missing := float(prediction.notes.get("depth_filled", 0)):
            reporter.log(f"{name}: {missing:.1%} of the depth was missing and has been filled")
        if self.options.base.depth is not None and (
            size := prediction.notes.get("depth_resampled_from")
        ):
            reporter.log(f"{name}: the depth map is {size}, and was resampled to the photo's size")
        return prediction, choice

    def _disparity(self, prediction: BasePrediction) -> float | None:
        """The path's disparity; None if views or keyframes are given."""
        given = self.given_views is not None or self.keyframes is not None
        return None if given else self.options.path.disparity_or(prediction.max_disparity)


def move_in_words(prediction: BasePrediction) -> str:
    """A line for the log about the disparity that `choose_disparity` has chosen."""
    reach, usual, invented = (
        prediction.max_disparity,
        prediction.notes["usual_disparity"],
        prediction.notes["uncovered"],
    )
    of, more = (
        (f" of {usual:g}", f"; `--disparity {usual:g}` moves farther")
        if reach != usual
        else ("", "")
    )
    return f"camera moves by disparity {reach:g}{of}: {invented:.1%} of the widest view is invented{more}"


def _fill_each(
    context: FillContext, cameras: Sequence[Camera], step: Progress
) -> Iterator[Gaussians]:
    guards = [context.photo_guard()]
    for index, camera in enumerate(cameras):
        yield fill_view(context, camera, guards).aux
        step(index + 1, len(cameras))


def complete(
    prediction: BasePrediction,
    cameras: Sequence[Camera],
    *,
    exact: bool = False,
    network: ResidualNet | Literal["shipped"] | None = "shipped",
    fill: FillTexture = "auto",
    renderer: Renderer | None = None,
    progress: Progress | None = None,
) -> Scene:
    """Fill the holes of all views by one set of aux Gaussians, see `fill_scene`.

    Args:
        prediction: a base's result.
        cameras: the views.
        exact: whether only these views will be rendered, and no views between them.
        network: the residual network, by default Spackle's; None fills the holes by the seeds alone.
        fill: see `open_texture`; "none" keeps the holes.
        renderer: by default the best of this machine, on its GPU if it has one.
        progress: called with (views done, all views).
    """
    chosen = shipped_network() if network == "shipped" else network
    base, camera = prediction.gaussians, prediction.camera
    context = FillContext(base, camera, renderer or get_renderer(), chosen, open_texture(fill))
    return Scene(
        base, fill_scene(context, cameras if fill != "none" else (), exact, progress).aux, camera
    )


def resolved(fill: FillTexture) -> FillTexture:
    """Replace "auto" by "lama" if LaMa's weights have been downloaded, else by "exemplar"."""
    if fill != "auto":
        return fill
    return "lama" if installed_weights("lama") else "exemplar"


def open_texture(fill: FillTexture) -> Texture | None:
    """The texture function of a fill: "lama" inpaints the widest views, "exemplar" takes patches of each view.

    "auto" is one of the two, see `resolved`; "network" and "none" give None. InputError for "lama" without its weights.
    """
    chosen = resolved(fill)
    return _lama() if chosen == "lama" else exemplar_texture if chosen == "exemplar" else None


@functools.cache
def _lama() -> Texture:
    return functools.partial(painted_texture, get_inpainter("lama", InpainterOptions()))
