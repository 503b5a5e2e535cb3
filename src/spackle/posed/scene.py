"""The way of several photos with known cameras to one scene. Begin with `complete_posed`.

photos --> base --> Gaussians --> at known depths --+
                                                    +--> merged --> holes --> fill --> aux
cameras, points ------------------------------------+
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from spackle.bases import BasePrediction
from spackle.bases.settings import AUTO, RGBD
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo, check_photo_size
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import encoder_for
from spackle.pipeline import Pipeline, fill
from spackle.posed.capture import Capture, PosedFile
from spackle.posed.correction import (
    DepthCorrection,
    FittedCorrection,
    KnownDepths,
    fit_correction,
    move_gaussians,
)
from spackle.posed.exposure import gains_of_photos, with_gain
from spackle.posed.kept_predictions import KeptPredictions
from spackle.posed.matching import match_depths
from spackle.posed.path import central_first, focus_depth, path_through, views_to_fill
from spackle.posed.union import MIN_ALPHA, PlacedPhoto, Union, merge_photos
from spackle.residual import hole_area_ratio
from spackle.results.saved_scene import PAGE_ENCODERS
from spackle.runtime.digests import file_fingerprint, json_digest
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.progress import Reporter
from spackle.scene import ViewHoles

REPORTED_VIEWS = 8  # views of the path whose holes the report says
MEASURED_ERROR = 0.01  # relative error that is expected of a measured depth map
MIN_EXPLAINED = 0.4  # a correction must explain this share of the points, else they fit no photo
MAX_ERROR = 0.25  # and to this median relative error
POINT_SOURCES = {"COLMAP": "COLMAP's points", "nerfstudio": "nerfstudio's points"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class AlignedPhoto:
    """A photo whose Gaussians stand at known depths."""

    file: PosedFile
    prediction: BasePrediction  # of the base, in the base's own unit
    camera: Camera  # float32, in the world, at the prediction's size
    own_gaussians: Gaussians  # in the frame of the camera, in the world's unit
    gaussians: Gaussians  # in the world
    error: float  # median relative error of the depths, at the points
    point_count: int
    depth_source: str  # what gave the depths: "COLMAP's points", "matched patches" or "depth map"
    base_name: str

    @property
    def line(self) -> str:
        """What the log says about the photo."""
        count = f"{len(self.gaussians):,} Gaussians from {self.base_name}"
        if self.depth_source == "depth map":
            return f"{self.file.path.name}: {count}, at the depths of its depth map"
        return (
            f"{self.file.path.name}: {count}, at the depths of {self.point_count} points "
            f"({self.depth_source}), which they miss by {self.error:.1%}"
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class PosedScene:
    """One scene of several photos, in the world of their cameras."""

    base: Gaussians  # of the photos; never changed by the fill
    aux: Gaussians  # added in the holes
    cameras: Mapping[str, Camera]  # of the photos, by their names; the most central one first
    path: Sequence[Camera]  # the views of the video
    is_metric: bool  # whether the unit of length is known to be the metre
    holes: tuple[ViewHoles, ...]  # of the reported views
    photos: tuple[AlignedPhoto, ...]  # in the order of `cameras`
    union: Union  # how the photos were merged

    @property
    def gaussians(self) -> Gaussians:
        """All Gaussians: first those of the photos, then those that fill holes."""
        return Gaussians.cat([self.base, self.aux])

    @property
    def camera(self) -> Camera:
        """The camera of the most central photo."""
        return next(iter(self.cameras.values()))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the scene; the suffix sets the format: .ply, .spz, .sog, .splat, .glb or .html.

        Raises:
            InputError: the format is not known, or the file cannot be written.
        """
        photo_path = self.photos[0].file.path  # gives the scene its name
        content = SceneFile.of_scene(
            photo_path, self.base, self.aux, self.camera, is_metric=self.is_metric
        )
        write_atomic(path, encoder_for(Path(path), PAGE_ENCODERS)(content))


def complete_posed(
    capture: Capture,
    pipeline: Pipeline,
    reporter: Reporter,
    *,
    frame_count: int = 120,
    kept: KeptPredictions | None = None,
) -> PosedScene:
    """Turn photos with known cameras into one completed scene.

    Args:
        capture: the photos, their cameras, and points or depth maps if there are any.
        pipeline: base, network and renderer.
        reporter: gets messages and progress, and times the stages.
        frame_count: number of views of the path.
        kept: predictions of an earlier run that was killed, to which those of this one are added.

    Raises:
        InputError: a photo, depth map or point file cannot be used, or depths fit no photo.
    """
    for note in capture.notes:
        reporter.log(note)

    # photos --> base --> Gaussians --> at known depths
    photos = align_photos(capture, pipeline, reporter, kept)

    # --> merged
    with reporter.stage("merge"):
        placed = [
            PlacedPhoto.of(photo.gaussians, photo.camera, photo.error, pipeline.renderer)
            for photo in photos
        ]
        gains = gains_of_photos(placed)
        placed = [with_gain(photo, gain) for photo, gain in zip(placed, gains, strict=True)]
        union = merge_photos(placed, pipeline.renderer)
    for photo, gain in zip(photos, gains.tolist(), strict=True):
        if gain != [1.0, 1.0, 1.0]:
            factors = ", ".join(f"{factor:.2f}" for factor in gain)
            reporter.log(f"{photo.file.path.name}: red, green, blue times {factors}, as the others")
    total = sum(len(photo.gaussians) for photo in photos)
    reporter.log(
        f"{len(photos)} photos together: {len(union.gaussians):,} of {total:,} Gaussians; "
        f"{union.doubled:,} show what another photo shows better, "
        f"{union.contradicted:,} stand where another photo sees through"
    )

    # --> holes --> fill --> aux
    cameras = [photo.camera for photo in photos]
    focus_depths = [focus_depth(union.gaussians, camera) for camera in cameras]
    path = path_through(cameras, focus_depths, frame_count)
    aux = Gaussians.empty()
    if pipeline.options.fill.texture != "none":
        views = views_to_fill(
            cameras,
            path,
            [photo.own_gaussians for photo in photos],
            pipeline.options.path.disparity_or(photos[0].prediction.max_disparity),
        )
        with reporter.stage("complete") as progress:
            filled = fill(
                union.gaussians,
                views,
                background="fill",  # photos show a sky, too, so that what is empty is a hole
                network=pipeline.network,
                texture=pipeline.options.fill.texture,
                renderer=pipeline.renderer,
                progress=progress,
            )
        aux = filled.select(slice(len(union.gaussians), None))
    with reporter.stage("measure"):
        holes = _measure(union.gaussians, aux, path, pipeline)
    return PosedScene(
        base=union.gaussians,
        aux=aux,
        cameras={photo.file.name: photo.camera for photo in photos},
        path=path,
        is_metric=capture.is_metric,
        holes=holes,
        photos=tuple(photos),
        union=union,
    )


@torch.no_grad()
def _measure(
    base: Gaussians, aux: Gaussians, path: Sequence[Camera], pipeline: Pipeline
) -> tuple[ViewHoles, ...]:
    """The share of holes in about 8 views along the path, before and after the fill.

    Args:
        base: the photos' Gaussians.
        aux: the Gaussians that the fill has added.
        path: the views of the video, which go through the photos and back.
        pipeline: has the renderer.
    """
    # The second half of the path goes back, and shows the same as the first.
    last = len(path) // 2
    step = max(1, len(path) // (2 * REPORTED_VIEWS))
    holes = []
    for index in range(0, last + 1, step):
        before = pipeline.renderer.render(base, path[index])
        after = pipeline.renderer.render([base, aux], path[index])
        holes.append(
            ViewHoles(
                view=f"frame {index}",
                before=hole_area_ratio(before.alpha),
                after=hole_area_ratio(after.alpha),
            )
        )
    return tuple(holes)


def align_photos(
    capture: Capture,
    pipeline: Pipeline,
    reporter: Reporter,
    kept: KeptPredictions | None = None,
) -> list[AlignedPhoto]:
    """Predict each photo, and bring its Gaussians to known depths; the most central photo first.

    Predictions that are in `kept` are not made again, and new ones are added to it.

    Raises:
        InputError: a photo cannot be used, or the points fit no photo.
    """
    order = central_first([file.camera for file in capture.photos])
    files = [capture.photos[index] for index in order]
    loaded = [file.load() for file in files]
    for photo in loaded:
        check_photo_size(photo.width, photo.height, photo.path)

    photos: list[AlignedPhoto] = []
    failures: list[str] = []
    with reporter.stage("photos") as progress:
        for index, (file, photo) in enumerate(zip(files, loaded, strict=True)):
            prediction, base_name = _predict(file, photo, pipeline, reporter, kept)
            camera = _camera_at_size(file.camera, prediction.camera)
            # A measured depth map stands at known depths already. What a network has guessed is
            # compared with the known depths of some pixels, and corrected.
            if base_name == RGBD:
                found = None
                source = "depth map"
            else:
                rendering = pipeline.renderer.render(prediction.gaussians, prediction.camera)
                depth = rendering.depth.cpu()
                is_known = rendering.alpha.cpu() >= MIN_ALPHA
                known, source = _known_depths(capture, files, loaded, index, camera)
                found = fit_correction(known, depth, is_known)
                problem = _problem_of(found)
                if problem:
                    failures.append(f"{photo.path.name}: {problem} ({source})")
                    progress(index + 1, len(files))
                    continue
            aligned = _aligned(file, prediction, camera, found, source, base_name)
            reporter.log(aligned.line)
            photos.append(aligned)
            progress(index + 1, len(files))

    for line in failures:
        reporter.log(f"{line}: left out")
    if len(photos) < 2:
        reasons = "; ".join(failures)
        raise InputError(
            f"{capture.folder}: fewer than two photos agree with their cameras: {reasons}: "
            "check that photos and cameras belong together"
        )
    return photos


def _predict(
    file: PosedFile,
    photo: Photo,
    pipeline: Pipeline,
    reporter: Reporter,
    kept: KeptPredictions | None,
) -> tuple[BasePrediction, str]:
    """What the base makes of a photo, and the base's name; from an earlier run if it was kept.

    The base is what turns a photo into Gaussians: a network, or the depth map beside the photo.
    """
    key = json_digest([file.name, file_fingerprint(file.path, "photo")])
    if kept is not None:
        earlier = kept.load(key)
        if earlier is not None:
            reporter.log(f"{photo.path.name}: predicted by an earlier run")
            return earlier
    depth = file.depth if _lifts_depth(pipeline) else None
    prediction, base = pipeline.base.predict(photo, depth, log=reporter.warn)
    if base.note:
        reporter.log(f"{photo.path.name}: {base.note}")
    if kept is not None:
        kept.save(key, prediction, base.name)
    return prediction, base.name


def _lifts_depth(pipeline: Pipeline) -> bool:
    """Whether depth maps beside the photos are lifted, instead of a network's depth."""
    return pipeline.options.base.name in (AUTO, RGBD)


def _camera_at_size(camera: Camera, predicted: Camera) -> Camera:
    """A photo's camera in the world, float32, at the size of the base's prediction."""
    return camera.resized(predicted.width, predicted.height).to(dtype=torch.float32)


def _known_depths(
    capture: Capture,
    files: Sequence[PosedFile],
    loaded: Sequence[Photo],
    index: int,
    camera: Camera,
) -> tuple[KnownDepths, str]:
    """The depths that are known in a photo, in pixels of `camera`, and where they come from.

    Points of the reconstruction; without them, depths of patches that other photos show, too.
    """
    file = files[index]
    if capture.points is not None:
        seen = capture.points.seen_by(file.camera, file.name)
        to_size = torch.tensor(
            [camera.width / file.camera.width, camera.height / file.camera.height]
        )
        return KnownDepths(seen.uv * to_size, seen.z), POINT_SOURCES[capture.kind]
    pictures = [photo.rgb for photo in loaded]
    return match_depths(pictures, [one.camera for one in files], index, camera), "matched patches"


def _problem_of(found: FittedCorrection | None) -> str:
    """Why a photo's depth cannot be trusted; empty if it can."""
    if found is None:
        return "too few known depths"
    if found.explained_ratio < MIN_EXPLAINED or found.error > MAX_ERROR:
        return f"{found.point_count} points contradict what it shows"
    return ""


def _aligned(
    file: PosedFile,
    prediction: BasePrediction,
    camera: Camera,
    found: FittedCorrection | None,
    source: str,
    base_name: str,
) -> AlignedPhoto:
    """A photo with its Gaussians moved to known depths; without a correction they stay.

    Args:
        file: the photo's file.
        prediction: what the base made of the photo.
        camera: the photo's true camera, in the world, at the prediction's size.
        found: the correction of the base's depths; None: they are measured, by a depth map.
        source: what gave the depths, in words.
        base_name: of the base.
    """
    # Factor 1, no shift, and no further factors: the logs of a field of 2×2×2 nodes, the smallest.
    unchanged = DepthCorrection(
        scale=1.0, shift=0.0, field=torch.zeros(2, 2, 2, dtype=torch.float64)
    )
    correction = unchanged if found is None else found.correction
    own = move_gaussians(prediction.gaussians, correction, prediction.camera, camera)
    camera_to_world = torch.linalg.inv(camera.world_to_camera.double())
    return AlignedPhoto(
        file=file,
        prediction=prediction,
        camera=camera,
        own_gaussians=own,
        gaussians=own.transform(camera_to_world),
        error=MEASURED_ERROR if found is None else found.error,
        point_count=0 if found is None else found.point_count,
        depth_source=source,
        base_name=base_name,
    )
