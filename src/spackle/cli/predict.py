"""`spackle predict`: turn photos, folders of photos or a clip into completed scenes.

Options for few users are hidden; --help-all shows them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from spackle.cli.options import (
    CamerasOption,
    CheckpointOption,
    ConvergenceOption,
    DepthKindOption,
    DepthUnitOption,
    DeviceOption,
    DisparityOption,
    FitOption,
    FovOption,
    FpsOption,
    FramesOption,
    HelpAllOption,
    IpdOption,
    JsonOption,
    KeepFrameOption,
    LoopOption,
    OverscanOption,
    PathFileOption,
    RayOption,
    SecondsOption,
    SharpWindowsOption,
    ShowOption,
    SizeOption,
    StereoOption,
    ThreadsOption,
    TrajectoryOption,
    VerboseOption,
    VideoFormatOption,
    WorkersOption,
    declared,
    path_options,
)
from spackle.runtime.declared_options import FillMode, Precision
from spackle.runtime.errors import InputError

if TYPE_CHECKING:  # torch takes seconds to load
    from spackle.results.many_photos import PredictOptions
    from spackle.results.outputs import Outputs
    from spackle.runtime.progress import Reporter


def predict(
    *,
    photos: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="PHOTO...",
            help="Photos, folders of photos, lists of photos (.txt, .jsonl), or one clip.",
            show_default=False,
        ),
    ] = None,
    posed: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="One scene of all photos of a folder, which also holds their cameras: COLMAP's, "
            "transforms.json of nerfstudio, or a capture of Record3D or Polycam; see docs/fill.md.",
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT", help="Results go to OUT/PHOTO_NAME/.")
    ] = Path("out"),
    base: Annotated[str, declared("base", metavar="NAME")] = "auto",
    depth: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH_OR_FOLDER",
            help="Depth of the photo: .npy, .npz, .pfm, .exr, .tif (metres), 16-bit .png, .tif "
            "(mm), a Middlebury disparity map, or a grey picture with --depth-kind.",
        ),
    ] = None,
    depth_kind: DepthKindOption = "auto",
    depth_unit: DepthUnitOption = None,
    near: Annotated[float | None, declared("near", metavar="METRES", hidden=True)] = None,
    far: Annotated[float | None, declared("far", metavar="METRES", hidden=True)] = None,
    calib: Annotated[Path | None, declared("calib", metavar="FILE", hidden=True)] = None,
    checkpoint: CheckpointOption = None,
    precision: Annotated[Precision, declared("precision", hidden=True)] = "auto",
    sharp_windows: SharpWindowsOption = None,
    residual: Annotated[
        str | None, declared("residual", metavar="PATH|initial|none", hidden=True)
    ] = None,
    residual_network: Annotated[
        str | None, declared("residual_network", metavar="MODULE:CLASS", hidden=True)
    ] = None,
    fill: Annotated[str, declared("fill", metavar="NAME")] = "auto",
    render: Annotated[bool, typer.Option(help="Write a video.")] = True,
    outputs: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="The files of each photo, such as scene.spz,depth.npy; see docs/scale.md.",
            show_default="scene.ply,video.mp4,report.json",
        ),
    ] = None,
    keep_base: Annotated[
        bool,
        typer.Option(
            "--keep-base", hidden=True, help="Also write base.ply, the Gaussians of the base."
        ),
    ] = False,
    depth_out: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            hidden=True,
            help="Also write the depth: depth.png (mm), .npy or .exr (m).",
        ),
    ] = None,
    trajectory: TrajectoryOption = None,
    disparity: DisparityOption = None,
    path: PathFileOption = None,
    cameras: CamerasOption = None,
    frames: FramesOption = None,
    seconds: SecondsOption = None,
    video_format: VideoFormatOption = None,
    fps: FpsOption = None,
    loop: LoopOption = None,
    overscan: OverscanOption = None,
    size: SizeOption = None,
    fit: FitOption = "pad",
    show: ShowOption = "color",
    stereo: StereoOption = None,
    ipd: IpdOption = None,
    convergence: ConvergenceOption = None,
    mode: Annotated[FillMode, declared("mode", hidden=True)] = "scene",
    device: DeviceOption = "auto",
    focal_px: Annotated[float | None, declared("focal_px", hidden=True)] = None,
    focal_mm: Annotated[float | None, declared("focal_mm")] = None,
    fov: FovOption = None,
    keep_frame: KeepFrameOption = False,
    recursive: Annotated[
        bool, typer.Option("--recursive", help="Also the photos of folders below the given ones.")
    ] = False,
    tar: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            max=1_000_000,
            hidden=True,
            help="Write tars with the results of N photos each, in place of a folder for each.",
            show_default=False,
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Predict again even if results exist.")
    ] = False,
    workers: WorkersOption = None,
    threads: ThreadsOption = None,
    ray: RayOption = None,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
    help_all: HelpAllOption = False,
) -> None:
    """Turn photos into completed 3D scenes: scene.ply, video.mp4 and report.json for each.

    A depth map, or weights from `spackle weights get depth` or `sharp`, improve the geometry.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.bases.settings import BaseSettings
    from spackle.cli.messages import CommandReporter
    from spackle.pipeline import FillOptions, PipelineOptions
    from spackle.results.many_photos import PredictOptions
    from spackle.results.outputs import parse_outputs
    from spackle.results.photo_folder import SCENE_NAME, PhotoOptions

    gaussian_files: tuple[str, ...] = (SCENE_NAME,)
    views = True
    if outputs is not None:
        # `outputs` names all files, so the options that add or leave out one would contradict it.
        others = {
            "no_render": not render,
            "keep_base": keep_base,
            "depth_out": depth_out,
            "posed": posed,
        }
        _check_only_outputs(outputs, others)
        files = parse_outputs(outputs)
        _check_suits_outputs(outputs, files, video_format, residual, fill)
        gaussian_files = files.gaussian_files
        views = files.views
        depth_out = files.depth
        render = files.video_format is not None
        video_format = files.video_format
        if not files.needs_fill:
            residual = "none"

    # Each stage has its own options: the base, the camera path with its video, the fill, and the
    # files that are written.
    base_settings = BaseSettings(
        name=base,
        depth=depth,
        calib=calib,
        depth_kind=depth_kind,
        depth_unit=depth_unit,
        near=near,
        far=far,
        checkpoint=checkpoint,
        precision=precision,
        windows_per_batch=sharp_windows,
        device=device,
    )
    path_and_video = path_options(
        trajectory=trajectory,
        disparity=disparity,
        path=path,
        cameras=cameras,
        frames=frames,
        seconds=seconds,
        video_format=video_format,
        fps=fps,
        loop=loop,
        overscan=overscan,
        size=size,
        fit=fit,
        show=show,
        stereo=stereo,
        ipd=ipd,
        convergence=convergence,
    )
    options = PredictOptions(
        scene=PipelineOptions(
            base=base_settings,
            path=path_and_video,
            fill=FillOptions(
                residual=residual, residual_network=residual_network, fill=fill, mode=mode
            ),
        ),
        photo=PhotoOptions(
            lens={"focal_px": focal_px, "focal_mm": focal_mm, "fov": fov},
            render=render,
            keep_base=keep_base,
            depth_out=depth_out,
            keep_frame=keep_frame,
            timeless_report=tar is not None,
            gaussian_files=gaussian_files,
            views=views,
        ),
        tar=tar,
        overwrite=overwrite,
        workers=workers,
        threads=threads,
        ray=ray,
    )
    reporter = CommandReporter(verbose, as_json=as_json)
    if posed is not None:
        from spackle.posed.predict import predict_posed_folder

        _check_suits_posed(posed, photos, trajectory, overscan)
        _check_not_many(recursive, tar, "with --posed the results are one scene")
        predict_posed_folder(posed, output, options, reporter)
        return
    if not photos:
        raise InputError("no photo: give photos, folders of photos, one clip, or --posed FOLDER")
    failure_count = _predict_all(photos, output, options, reporter, recursive)
    # The errors have been printed already, one for each photo.
    if failure_count:
        raise typer.Exit(1)


def _check_only_outputs(outputs: str, others: Mapping[str, object]) -> None:
    """InputError if an option beside `outputs` adds or leaves out a file.

    Args:
        outputs: the names of the files, as the user has written them.
        others: the values of such options, by their Python names; empty ones were not given.
    """
    for option, value in others.items():
        if value:
            raise InputError(f"`outputs` {outputs}: names all files: leave `{option}` out")


def _check_suits_outputs(
    outputs: str, files: Outputs, video_format: str | None, residual: str | None, fill: str
) -> None:
    """InputError for an option that none of the files in `outputs` shows; `files` is its meaning.

    The other arguments are options of the command.
    """
    if video_format not in (None, files.video_format):
        raise InputError(
            f"`outputs` {outputs}: no video.{video_format} is among them: leave `format` out"
        )
    if not files.needs_fill and (residual is not None or fill != "auto"):
        option = "fill" if residual is None else "residual"
        raise InputError(
            f"`outputs` {outputs}: none of them shows filled holes: leave `{option}` out"
        )


def _check_suits_posed(
    posed: Path, photos: list[Path] | None, trajectory: str | None, overscan: float | None
) -> None:
    """InputError for arguments that contradict a folder of photos with known cameras."""
    if photos:
        raise InputError(
            f"{photos[0]}: --posed {posed} names the photos: leave one of them out, "
            "or give one folder after --posed"
        )
    if trajectory is not None or overscan is not None:
        option = "--trajectory" if trajectory is not None else "--overscan"
        raise InputError(f"{option}: with --posed the camera goes through the photos: leave it out")


def _check_not_many(recursive: bool, tar: int | None, reason: str) -> None:
    """InputError for an option that is for many photos only."""
    if recursive or tar is not None:
        option = "--recursive" if recursive else "--tar"
        raise InputError(f"{option}: {reason}: leave it out")


def _predict_all(
    sources: list[Path],
    output: Path,
    options: PredictOptions,
    reporter: Reporter,
    recursive: bool,
) -> int:
    """Predict a clip, or photos and folders of photos; returns how many photos failed.

    InputError if an option, a clip or a single photo cannot be used.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.clips.files import is_clip
    from spackle.clips.predict import VIDEO_FILE, clip_options, predict_clip
    from spackle.core.photo_lists import is_photo_list
    from spackle.pipeline import Pipeline
    from spackle.results.many_photos import predict_photos, say_if_kernels_compile
    from spackle.results.photo_names import files_of_pattern, find_photos
    from spackle.runtime.files import check_file
    from spackle.runtime.folders import results_folder

    left_out: list[str] = []
    photos = find_photos(sources, output, left_out.append, recursive=recursive)
    # Of an animation in a folder or list of photos, the first picture is a photo like the others.
    given_files: set[Path] = set()
    for source in sources:
        if not source.is_dir() and not is_photo_list(source):
            given_files.update(files_of_pattern(source))
    clips = [photo for photo in photos if photo.path in given_files and is_clip(photo.path)]
    if not clips:
        # A folder with one photo is not a single photo: the next run may find more in it.
        is_file = len(photos) == 1 and [photos[0].path] == sources
        is_single_photo = is_file and options.tar is None
        return predict_photos(
            photos,
            output,
            options,
            reporter,
            is_single=is_single_photo,
            left_out=left_out,
        )

    # A clip has options and results of its own, so it is not predicted together with photos.
    clip = clips[0]
    if len(sources) > 1 or len(photos) > 1:
        raise InputError(f"{clip.path}: is a clip: give it alone, without other photos or clips")

    _check_not_many(recursive, options.tar, f"{clip.path} is a clip")
    # `clip_options` refuses options that a clip cannot take.
    pipeline = Pipeline.open(clip_options(options.scene, options.photo, options.workers))
    say_if_kernels_compile(pipeline, reporter)
    check_file(clip.path, "clip")
    folder = output / clip.name
    with results_folder(output):
        predict_clip(clip.path, folder, pipeline, options.photo.lens, reporter)
    reporter.log(f"Look at {folder / VIDEO_FILE}")
    return 0
