"""The way of a photo to its completed scene. Begin with `Pipeline.complete`.

    photo --> base --> Gaussians --+
                                   +--> render --> holes --> fill --> aux --> merge
    camera path -------------------+

The base turns the photo into Gaussians. Seen from other places along a camera path, they show
holes. The fill adds "aux" Gaussians in these holes; base and aux Gaussians together are the scene.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal, get_args

import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.bases.open import OpenedBase, ResolvedBase, open_base
from spackle.bases.settings import BaseSettings
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo, check_photo_size
from spackle.core.trajectories import DepthRange
from spackle.depth.units import RELATIVE_KINDS, UNIT_ADVICE
from spackle.inpaint import InpainterOptions, get_inpainter
from spackle.render import Renderer, get_renderer
from spackle.residual import hole_area_ratio
from spackle.residual.architectures import (
    SHIPPED,
    load_residual,
    network_class,
    shipped_network,
)
from spackle.residual.network import ResidualNet
from spackle.runtime.declared_options import FillMode as FillMode
from spackle.runtime.declared_options import FillTexture as FillTexture
from spackle.runtime.errors import InputError, check_name
from spackle.runtime.plugins import check_name_or_plugin, is_plugin
from spackle.runtime.progress import (
    Cancel,
    Progress,
    Reporter,
    cancellable,
    raise_if_cancelled,
)
from spackle.scene import Scene, SceneReport, ViewHoles
from spackle.scene_fill.context import FillContext
from spackle.scene_fill.fill import fill_scene, fill_view
from spackle.scene_fill.fill_plan import Background, FillPlan, plan_fill
from spackle.scene_fill.removal import uncovered_pixels
from spackle.scene_fill.texture import Texture, exemplar_texture, painted_texture
from spackle.views import GivenPath, PathOptions, PlannedViews, choose_disparity, plan_views
from spackle.weights import installed_weights

FILL_TEXTURES: tuple[str, ...] = get_args(FillTexture)
# Given views stand anywhere, so that many of them must protect what they show.
MAX_GUARDED_VIEWS = 32


@dataclasses.dataclass(frozen=True, kw_only=True)
class FillOptions:
    """Options of the fill, which adds Gaussians in the holes of views."""

    # A file of weights for the network; "initial": no network; "none": no fill; None: the shipped
    # weights if there are any.
    residual: str | None = None
    # The network's class, `package.module:Class`, if the weights are of another package's network.
    residual_network: str | None = None
    fill: str = "auto"  # a `FillTexture`, or an inpainter `package.module:Class`
    mode: FillMode = "scene"

    @property
    def texture(self) -> str:
        """Where the texture comes from, with "auto" decided; "none" if nothing is to be filled."""
        if self.residual == "none":
            return "none"
        # LaMa takes seconds for a view. One set of Gaussians for all views needs it for the widest
        # views only; sets of their own would need it for each view, so "auto" does without it.
        if self.mode == "view" and self.fill == "auto":
            return "exemplar"
        # The paper's method adds no texture; `check` refuses to ask for one.
        if self.mode == "paper" and self.fill == "auto":
            return "network"
        return resolve_texture(self.fill)

    @property
    def weights_name(self) -> str:
        """The name of the network's weights in reports: "shipped", a file, "initial" or "none"."""
        if self.texture == "none":  # no hole is filled, so no weights are used
            return "none"
        if self.residual is not None:
            return self.residual
        # A package that was built without weights fills by the initial Gaussians alone.
        return "shipped" if SHIPPED.is_file() else "initial"

    @property
    def weights_file(self) -> Path | None:
        """The file of the network's weights; None if no network is used."""
        if self.weights_name in ("initial", "none"):
            return None
        return SHIPPED if self.weights_name == "shipped" else Path(self.weights_name)

    def check(self) -> None:
        """InputError if an option has an unknown value, or two options contradict each other."""
        check_name_or_plugin("fill", self.fill, FILL_TEXTURES)
        check_name("mode", self.mode, get_args(FillMode))
        if self.mode == "paper" and (self.fill in ("exemplar", "lama") or is_plugin(self.fill)):
            raise InputError(
                f"`fill` {self.fill}: the paper's method adds no texture: "
                "leave it out, or give `mode` view"
            )

    def load_network(self) -> ResidualNet | None:
        """Load the network, or None if none is used; InputError for a file that cannot be used."""
        # The user has named the class, so its module may be imported; the file alone may not ask
        # for this.
        if self.residual_network is not None:
            network_class(self.residual_network, "residual_network")
        return None if self.weights_file is None else load_residual(self.weights_file)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PipelineOptions:
    """All options for turning a photo into a scene: those of the base, the path and the fill."""

    base: BaseSettings = dataclasses.field(default_factory=BaseSettings)
    path: PathOptions = dataclasses.field(default_factory=PathOptions)
    fill: FillOptions = dataclasses.field(default_factory=FillOptions)

    @property
    def has_given_geometry(self) -> bool:
        """Whether a depth map or cameras are given.

        Both belong to the whole photo, so the photo's uniform frame must not be cropped.
        """
        return self.base.depth is not None or self.path.cameras is not None


@dataclasses.dataclass(frozen=True, kw_only=True)
class PredictedPhoto:
    """What the base made of a photo."""

    prediction: BasePrediction  # the Gaussians, the camera, and how far the camera may move
    base: ResolvedBase  # which base it was, and why
    warnings: tuple[str, ...]  # what the user should know about the photo, its depth and its base


@dataclasses.dataclass(frozen=True, kw_only=True)
class FilledHoles:
    """The aux Gaussians of all planned views."""

    aux: Gaussians  # for all views; in the modes view and paper, those of the view `saved_view`
    by_view: tuple[Gaussians, ...] | None = None  # in the modes view and paper: of each view
    # In the modes view and paper: the name, in the report, of the view whose aux Gaussians are
    # saved.
    saved_view: str | None = None
    # [H, W, 3] uint8 sRGB by the view's index: completed views that the fill has rendered already
    pictures: Mapping[int, Tensor] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompletedPhoto:
    """A photo's scene, and everything from which it was made."""

    photo: Photo  # at its full size
    predicted: PredictedPhoto
    views: PlannedViews
    filled: FilledHoles
    scene: Scene  # its disparity is None for given views and keyframes


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pipeline:
    """A base, a network for the fill and a renderer, opened once for many photos."""

    options: PipelineOptions
    base: OpenedBase
    network: ResidualNet | None  # None: holes are filled without a network
    renderer: Renderer
    # What the files `options.path.cameras` and `options.path.path` hold, if they are given.
    given_path: GivenPath = dataclasses.field(default_factory=GivenPath)

    @staticmethod
    def open(options: PipelineOptions) -> Pipeline:
        """Check the options, and load the files that they name.

        The base's network is loaded later, for the first photo. InputError for an option that no
        photo can use.
        """
        options.base.check()
        options.path.check()
        options.fill.check()
        network = options.fill.load_network()
        # Only to find missing weights of LaMa before long work; `_fill_holes` opens it again.
        open_texture(options.fill.texture)
        given_path = options.path.load()
        return Pipeline(
            options=options,
            base=open_base(options.base),
            network=network,
            renderer=get_renderer(options.base.device),
            given_path=given_path,
        )

    def complete(self, photo: Photo, reporter: Reporter) -> CompletedPhoto:
        """Turn a photo into its completed scene.

        Args:
            photo: the photo at its full size.
            reporter: gets messages and progress, and times the stages.

        Raises:
            InputError: the photo or its depth map cannot be used.
        """
        # A file of cameras may know the photo's lens, and where the photo stands among its views.
        photo = self.given_path.with_lens(photo)
        given = self.given_path.around_photo(photo.path.name)
        for line in given.notes:
            reporter.log(line)

        # photo --> base --> Gaussians
        predicted = self.predict(photo, reporter)
        prediction = predicted.prediction

        # camera path --> views
        views = plan_views(
            prediction,
            self.options.path,
            photo.path,
            self.renderer,
            given.views,
            given.keyframes,
        )

        # render --> holes --> fill --> aux
        with reporter.stage("complete") as progress:
            filled = self._fill_holes(prediction, views, progress)
        # Coordinates that are infinite or NaN come from views such as one with a tiny focal length.
        if not filled.aux.finite:
            source = self.options.path.cameras or photo.path
            raise InputError(f"{source}: views too extreme to complete: check their K")

        # merge
        scene = Scene(
            base=prediction.gaussians,
            aux=filled.aux,
            camera=prediction.camera,
            by_view=filled.by_view,
            disparity=self._path_disparity(prediction),
            is_metric=prediction.is_metric,
        )

        with reporter.stage("measure"):
            holes = measure_holes(scene, views, self.renderer)
        report = SceneReport(
            holes=holes,
            base=predicted.base.name,
            base_reason=predicted.base.reason,
            focal_px=prediction.camera.focal[0],
            focal_source=prediction.lens_source or photo.focal_source.value,
            warnings=predicted.warnings,
            seconds=dict(reporter.seconds),
        )
        return CompletedPhoto(
            photo=photo,
            predicted=predicted,
            views=views,
            filled=filled,
            scene=dataclasses.replace(scene, report=report),
        )

    def predict(self, photo: Photo, reporter: Reporter) -> PredictedPhoto:
        """Turn a photo into Gaussians by the base, and choose how far the camera moves.

        The base is a network or the photo's depth map. What the user should know is logged, and
        returned as warnings. InputError if the photo or its depth map cannot be used.
        """
        check_photo_size(photo.width, photo.height, photo.path)
        name = photo.path.name
        warnings: list[str] = []

        def warn(line: str) -> None:
            """Log what the user should know, and keep it for the scene's report."""
            warnings.append(line)
            reporter.log(line)

        def warn_of_base(line: str) -> None:
            """Keep why a better base could not be used; programs get this as a warning."""
            warnings.append(line)
            reporter.warn(line)

        for note in photo.notes:
            warn(f"{name}: {note}")
        if photo.frame is not None:
            warn(f"{name}: {photo.frame.note}; `keep_frame` keeps it")
        prediction, base = self.base.predict(photo, log=warn_of_base, stage=reporter.stage)
        if base.note:
            warn(f"{name}: {base.note}")

        # Views and keyframes that the user gives say themselves where the camera goes.
        follows_trajectory = not self.given_path.replaces_trajectory
        chooses_disparity = follows_trajectory and self.options.path.disparity is None
        if chooses_disparity:
            with reporter.stage("move"):  # the stage's published name in the report's times
                prediction = choose_disparity(prediction, self.renderer, photo.path)

        focal_source = prediction.lens_source or photo.focal_source.value
        reporter.log(
            f"{name}: {len(prediction.gaussians):,} Gaussians from {base.name}, "
            f"focal length {prediction.camera.focal[0]:.0f} px ({focal_source})"
        )
        if chooses_disparity:
            reporter.log(f"{name}: {describe_movement(prediction)}")
        if "depth_range" in prediction.notes:
            reporter.log(f"{name}: {describe_depth(prediction.notes)}")
        for line in self._depth_warnings(prediction):
            warn(f"{name}: {line}")
        if follows_trajectory:
            specks = describe_specks(prediction.gaussians)
            if specks:
                warn(f"{name}: {specks}")
        return PredictedPhoto(prediction=prediction, base=base, warnings=tuple(warnings))

    def _depth_warnings(self, prediction: BasePrediction) -> list[str]:
        """Lines about what had to be done to the photo's depth: parts filled, or resampled."""
        lines: list[str] = []
        missing_ratio = float(prediction.notes.get("depth_filled", 0))
        if missing_ratio:
            lines.append(f"{missing_ratio:.1%} of the depth was missing and has been filled")

        # Depth inside a photo's file is usually coarser than the photo, which is no news. A map
        # that the user gives should have the photo's size.
        map_size = prediction.notes.get("depth_resampled_from")
        stretch = float(prediction.notes.get("depth_stretched", 0))
        if stretch:
            lines.append(
                f"the depth map is {map_size}, as networks round sides, and was stretched by "
                f"{stretch:.1%} to the photo's shape"
            )
        elif map_size and self.options.base.depth is not None:
            lines.append(f"the depth map is {map_size}, and was resampled to the photo's size")
        return lines

    def _path_disparity(self, prediction: BasePrediction) -> float | None:
        """How far the camera moves along the trajectory; None for given views or keyframes."""
        if self.given_path.replaces_trajectory:
            return None
        return self.options.path.disparity_or(prediction.max_disparity)

    def _fill_holes(
        self, prediction: BasePrediction, views: PlannedViews, progress: Progress
    ) -> FilledHoles:
        """Add Gaussians in the holes of all planned views: one set for all, or one for each."""
        texture = self.options.fill.texture
        if texture == "none":
            return FilledHoles(aux=Gaussians.empty(prediction.gaussians.means.device))

        context = FillContext.of(
            prediction,
            self.renderer,
            self.network,
            texture=open_texture(texture),
            precision=self.options.base.precision,
        )
        mode = self.options.fill.mode
        if mode == "scene":
            return self._fill_together(context, views, progress)
        if mode == "paper":
            return _fill_each_view(context, views, context.complete_as_paper, progress)

        # A guard is a view whose surfaces the added Gaussians must not cover: here, the photo.
        guards = [context.photo_guard()]

        def aux_of_view(camera: Camera) -> Gaussians:
            """The Gaussians that Spackle adds for one view: two passes, behind what the photo
            shows, with texture.
            """
            return fill_view(context, camera, guards).aux

        return _fill_each_view(context, views, aux_of_view, progress)

    def _fill_together(
        self, context: FillContext, views: PlannedViews, progress: Progress
    ) -> FilledHoles:
        """Fill the holes of all views by one set of Gaussians.

        Args:
            context: the photo's Gaussians, and the settings of the fill.
            views: the planned views; of these the fill gets `views_to_fill`.
            progress: called with (views done, all views).
        """
        # The fill gets only some of the planned views, and names each by its position among them.
        cameras = [views.cameras[index] for index in views.views_to_fill]
        filled = fill_scene(
            context,
            cameras,
            # Between given views nothing will be rendered.
            exact=self.given_path.cameras is not None,
            progress=progress,
        )

        # Some views the fill has rendered after the last Gaussians that they needed. If a frame of
        # the video is just such a view, the video need not render it again.
        if not views.frame_maker.is_plain:
            return FilledHoles(aux=filled.aux)
        pictures = {}
        for position, picture in filled.pictures.items():
            index = views.views_to_fill[position]
            frame_index = views.frame_within.get(index, index)
            pictures[frame_index] = _without_margin(
                picture, views.cameras[index], views.cameras[frame_index]
            )
        return FilledHoles(aux=filled.aux, pictures=pictures)


def _without_margin(picture: Tensor, wide: Camera, frame: Camera) -> Tensor:
    """The part [H, W, 3] of a wide view's picture that a camera of H × W pixels shows.

    Both cameras look in the same direction with the same focal length, so that their principal
    points say how their pixels lie to each other.
    """
    left, top = (wide.K[:2, 2] - frame.K[:2, 2]).round().int().tolist()
    return picture[top : top + frame.height, left : left + frame.width]


def _fill_each_view(
    context: FillContext,
    views: PlannedViews,
    aux_of_view: Callable[[Camera], Gaussians],
    progress: Progress,
) -> FilledHoles:
    """Fill the holes of each view by Gaussians of its own.

    Args:
        context: the photo's Gaussians, and the settings of the fill.
        views: the planned views; those that are shown are filled.
        aux_of_view: makes the Gaussians that fill the holes of a camera's view.
        progress: called with (views done, all views).
    """
    shown_cameras = views.cameras[: views.shown_view_count]
    by_view: list[Gaussians] = []
    for camera in shown_cameras:
        by_view.append(aux_of_view(camera))
        progress(len(by_view), len(shown_cameras))

    # A file of a scene has room for one set of aux Gaussians. The reported view farthest from the
    # photo is chosen, because the holes grow with the distance.
    photo_eye = context.photo_camera.position.double()

    def distance_from_photo(name: str) -> float:
        """Distance of the reported view of this name, in units of the scene."""
        camera = views.cameras[views.reported_views[name]]
        return float((camera.position.double() - photo_eye).norm())

    saved_view = max(views.reported_views, key=distance_from_photo)
    return FilledHoles(
        aux=by_view[views.reported_views[saved_view]], by_view=tuple(by_view), saved_view=saved_view
    )


@torch.no_grad()
def measure_holes(scene: Scene, views: PlannedViews, renderer: Renderer) -> tuple[ViewHoles, ...]:
    """The share of holes (eq. 11) in each reported view, before and after completion."""
    holes: list[ViewHoles] = []
    for name, index in views.reported_views.items():
        camera = views.cameras[index]
        before = renderer.render([scene.base], camera)
        after = renderer.render(scene.of_view(index), camera)
        holes.append(
            ViewHoles(
                view=name,
                before=hole_area_ratio(before.alpha),
                after=hole_area_ratio(after.alpha),
            )
        )
    return tuple(holes)


def describe_depth(notes: Mapping[str, float | int | str]) -> str:
    """A line for the log about a depth map: how it was understood, near, median and far.

    `notes` are those of the base rgbd. If the meaning was guessed, the line says how to correct it.
    """
    if "depth_read_as" not in notes:
        return f"its depth: {notes['depth_range']}"
    line = f"depth read as {notes['depth_read_as']}: {notes['depth_range']}"
    if notes["depth_unit"] != "guessed":
        return line
    return (
        f"{line}; if that is wrong, give {UNIT_ADVICE}, or for relative depth "
        f"`depth_kind` {' or '.join(RELATIVE_KINDS)}"
    )


def describe_specks(gaussians: Gaussians) -> str:
    """A line about specks far before all surfaces, by which the camera moves; "" without specks."""
    depths = DepthRange.of_specks(gaussians)
    if depths is None:
        return ""
    near, percent = depths
    return (
        f"less than 1 % of the scene is as near as {near:.3g}, and the rest begins at "
        f"{percent:.3g}: the camera moves only as far as the nearest part allows; if that part is "
        "specks, clean the depth map"
    )


def describe_movement(prediction: BasePrediction) -> str:
    """A line for the log about the size of the camera's movement that was chosen for a photo."""
    # `choose_disparity` has replaced the base's usual disparity, and noted both facts.
    chosen = prediction.max_disparity
    usual = prediction.notes["usual_disparity"]
    hole_ratio = prediction.notes["uncovered"]
    if chosen == usual:
        return (
            f"camera moves by disparity {chosen:g}: {hole_ratio:.1%} of the widest view is invented"
        )
    return (
        f"camera moves by disparity {chosen:g} of {usual:g}: "
        f"{hole_ratio:.1%} of the widest view is invented; `disparity` {usual:g} moves farther"
    )


def complete(
    prediction: BasePrediction,
    cameras: Sequence[Camera],
    *,
    exact: bool = False,
    network: ResidualNet | Literal["shipped"] | None = "shipped",
    fill: str = "auto",
    renderer: Renderer | None = None,
    progress: Progress | None = None,
    cancel: Cancel | None = None,
) -> Scene:
    """Fill the holes of all views by one set of Gaussians, which are added to the base's.

    Args:
        prediction: a base's result.
        cameras: the views.
        exact: whether only these views will be rendered, and no views between them.
        network: the network that improves the added Gaussians, by default Spackle's; None adds
            them without a network.
        fill: where the texture comes from, see `open_texture`; "none" keeps the holes.
        renderer: by default the best of this machine, on its GPU if it has one.
        progress: called with (views done, all views).
        cancel: asks for the end of the work between two views, as for `predict`.

    Raises:
        Cancelled: `cancel` has asked for the end.
    """
    raise_if_cancelled(cancel)
    context = FillContext.of(
        prediction,
        renderer or get_renderer(),
        shipped_network() if network == "shipped" else network,
        texture=open_texture(fill),
    )
    views_to_fill = cameras if fill != "none" else ()
    start = time.perf_counter()
    filled = fill_scene(context, views_to_fill, exact=exact, progress=cancellable(progress, cancel))
    report = SceneReport(
        focal_px=prediction.camera.focal[0],
        focal_source=prediction.lens_source or None,
        seconds={"complete": round(time.perf_counter() - start, 3)},
    )
    return Scene(
        prediction.gaussians,
        filled.aux,
        prediction.camera,
        report=report,
        is_metric=prediction.is_metric,
    )


def fill(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    background: Background = "keep",
    fillable: Sequence[Tensor | None] | None = None,
    photo_camera: Camera | None = None,
    network: ResidualNet | Literal["shipped"] | None = "shipped",
    texture: str = "auto",
    renderer: Renderer | None = None,
    progress: Progress | None = None,
    cancel: Cancel | None = None,
) -> Gaussians:
    """A scene of any program with Gaussians added where its cameras see holes.

    The first Gaussians of the result are the given ones, bit for bit, with their harmonics; those
    that were added come after them. What a camera sees already is not hidden by them.

    Args:
        gaussians: the scene, in any frame.
        cameras: the views to fill, in the scene's frame (x right, y down, z forward at each
            camera).
        background: "keep": sky and empty space around the scene stay empty, and holes that
            surfaces enclose are filled; "fill": everything empty is filled. A photo's scene and a
            room have no background, so that both words give the same.
        fillable: for each camera the pixels [H, W] bool whose holes are filled, or None for all;
            other holes stay open, and are no source of colour. It replaces `background`.
        photo_camera: of the photo from which the scene was made; None: the camera that sees most
            stands for it.
        network: the network that improves the added Gaussians, by default Spackle's; None adds
            them without a network.
        texture: where the texture comes from, as `fill` of `complete`.
        renderer: by default the best of this machine, on its GPU if it has one.
        progress: called with (views done, all views).
        cancel: asks for the end of the work between two views, as for `predict`.

    Raises:
        ValueError: there are no cameras, `fillable` does not fit them, or `background` is unknown.
        Cancelled: `cancel` has asked for the end.
    """
    if not cameras:
        raise ValueError("`cameras` is empty: give the views to fill")
    check_name("background", background, get_args(Background))
    if fillable is not None:
        _check_fillable(fillable, cameras)
    raise_if_cancelled(cancel)
    renderer = renderer or get_renderer()
    plan = plan_fill(
        gaussians,
        cameras,
        renderer,
        background=background,
        fillable=fillable,
        photo_camera=photo_camera,
    )
    raise_if_cancelled(cancel)  # planning has rendered all views
    return fill_as_planned(
        gaussians,
        cameras,
        plan,
        renderer,
        network=network,
        texture=texture,
        progress=cancellable(progress, cancel),
    )


def fill_as_planned(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    plan: FillPlan,
    renderer: Renderer,
    *,
    network: ResidualNet | Literal["shipped"] | None = "shipped",
    texture: str = "auto",
    progress: Progress | None = None,
) -> Gaussians:
    """`fill` for views about which `plan_fill` has decided; see there for the arguments."""
    if not any(plan.hole_ratios):
        return gaussians

    # The fill works as after a photo, whose camera is the world's origin. So the scene and the
    # views move into the world of the camera that stands for the photo, and the result back.
    to_photo = plan.photo_camera.world_to_camera.double()
    from_photo = torch.linalg.inv(to_photo)

    def moved(camera: Camera) -> Camera:
        """A camera in the world of the photo's camera."""
        pose = camera.world_to_camera.double() @ from_photo
        if camera is plan.photo_camera:
            pose = torch.eye(4, dtype=torch.float64)  # without rounding errors
        return dataclasses.replace(camera, world_to_camera=pose).to(dtype=torch.float32)

    prediction = BasePrediction(
        gaussians.transform(to_photo), moved(plan.photo_camera), notes={}, is_metric=False
    )
    context = FillContext.of(
        prediction,
        renderer,
        shipped_network() if network == "shipped" else network,
        texture=open_texture(texture),
    )
    # The texture "none" leaves all holes open, so no view is filled.
    views = [] if texture == "none" else [moved(camera) for camera in cameras]
    filled = fill_scene(
        context,
        views,
        exact=True,  # leave no hole, however small: views are given one by one, not as a path
        progress=progress,
        fillable=plan.fillable,
        keep_empty=plan.keep_empty,  # such as sky, in which nothing may appear
        guarded_views=MAX_GUARDED_VIEWS,
    )
    return Gaussians.cat([gaussians, filled.aux.transform(from_photo)])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Removal:
    """A scene without a thing: as it is left, and with what the thing hid filled in."""

    is_kept: Tensor  # [N] bool, of the given Gaussians
    edited: Gaussians  # those that are kept, bit for bit
    patched: Gaussians  # the same, and then those that were added where the thing was


def remove(
    gaussians: Gaussians,
    marked: Tensor,
    cameras: Sequence[Camera],
    *,
    network: ResidualNet | Literal["shipped"] | None = "shipped",
    texture: str = "auto",
    renderer: Renderer | None = None,
    progress: Progress | None = None,
    cancel: Cancel | None = None,
) -> Removal:
    """Take Gaussians out of a scene, and fill what they hid, as cameras see it.

    Holes that were there before stay as they were, and where the thing stood before nothing,
    nothing is filled in.

    Args:
        gaussians: the scene, N Gaussians in any frame.
        marked: [N] bool, those to take out, such as `marked_gaussians` finds.
        cameras: the views to fill, in the scene's frame. The first one should see what the thing
            hid; it stands for the photo of a scene that was made from a photo.
        network: as for `fill`.
        texture: as for `fill`.
        renderer: as for `fill`.
        progress: as for `fill`.
        cancel: as for `fill`.

    Raises:
        ValueError: `marked` marks nothing or everything, or there are no cameras.
        Cancelled: `cancel` has asked for the end.
    """
    if tuple(marked.shape) != (len(gaussians),) or marked.dtype != torch.bool:
        raise ValueError(f"`marked` must be [{len(gaussians)}] bool")
    if not bool(marked.any()):
        raise ValueError("`marked` marks no Gaussian")
    if bool(marked.all()):
        raise ValueError("`marked` marks all Gaussians: nothing would be left to fill from")
    if not cameras:
        raise ValueError("`cameras` is empty: give the views to fill")
    renderer = renderer or get_renderer()
    is_kept = ~marked.to(gaussians.means.device)
    edited = gaussians.select(is_kept)
    patched = fill(
        edited,
        cameras,
        network=network,
        texture=texture,
        renderer=renderer,
        progress=progress,
        cancel=cancel,
        fillable=uncovered_pixels(gaussians, edited, cameras, renderer),
        photo_camera=cameras[0],
    )
    return Removal(is_kept=is_kept, edited=edited, patched=patched)


def _check_fillable(fillable: Sequence[Tensor | None], cameras: Sequence[Camera]) -> None:
    """ValueError unless there is one grid [H, W] of bools, or None, of the size of each camera."""
    if len(fillable) != len(cameras):
        raise ValueError(f"`fillable` has {len(fillable)} grids for {len(cameras)} cameras")
    for grid, camera in zip(fillable, cameras, strict=True):
        expected = (camera.height, camera.width)
        if grid is None:
            continue
        if tuple(grid.shape) != expected or grid.dtype != torch.bool:
            raise ValueError(
                f"`fillable` has {grid.dtype} of shape {tuple(grid.shape)}, "
                f"expected bool of shape {expected}"
            )


def resolve_texture(fill: str) -> str:
    """Replace "auto" by "lama" if LaMa's weights have been downloaded, else by "exemplar".

    InputError for an unknown name.
    """
    check_name_or_plugin("fill", fill, FILL_TEXTURES)
    if fill != "auto":
        return fill
    return "lama" if installed_weights("lama") else "exemplar"


def open_texture(fill: str) -> Texture | None:
    """The function that draws texture into the holes of a view.

    "lama" inpaints the widest views by the network LaMa, "exemplar" copies patches of the same
    view, and "auto" is "lama" if its weights have been downloaded, else "exemplar". A class of
    another package, `package.module:Class`, inpaints as LaMa does. None for "network" and "none",
    which add no texture. InputError for an unknown name, and for "lama" without its weights.
    """
    texture = resolve_texture(fill)
    if texture == "lama" or is_plugin(texture):
        return _open_inpainter(texture)
    if texture == "exemplar":
        return exemplar_texture
    return None


@functools.cache
def _open_inpainter(name: str) -> Texture:
    """The function that inpaints views; it is kept, because loading a network takes seconds."""
    return functools.partial(painted_texture, get_inpainter(name, InpainterOptions(), "fill"))
