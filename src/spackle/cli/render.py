"""`spackle render`: a saved scene as a video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import (
    CamerasOption,
    ConvergenceOption,
    DeviceOption,
    DisparityOption,
    FitOption,
    FovOption,
    FpsOption,
    FramesOption,
    HelpAllOption,
    IpdOption,
    JsonOption,
    LoopOption,
    OverscanOption,
    PathFileOption,
    SecondsOption,
    ShowOption,
    SizeOption,
    StereoOption,
    TrajectoryOption,
    VerboseOption,
    VideoFormatOption,
    path_options,
)


def render(
    *,
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A 3D Gaussian scene.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT", help="A folder, or a video file.")
    ],
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="Show the base, with holes, on the left, and the completed scene on the right.",
        ),
    ] = False,
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
    focal_px: Annotated[
        float | None, typer.Option(help="Focal length in pixels of the video.")
    ] = None,
    fov: FovOption = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
    help_all: HelpAllOption = False,
) -> None:
    """Render a saved scene along a camera path."""
    # Imported here, because the help must not wait for torch.
    from spackle.cli.messages import CommandReporter
    from spackle.results.saved_scene import render_scene

    # A new focal length is no option of the path: it changes the scene's camera, around which any
    # path is laid.
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
        compare=compare,
    )
    render_scene(
        scene,
        output,
        path_and_video,
        CommandReporter(verbose, as_json=as_json),
        focal_px=focal_px,
        fov=fov,
        device=device,
    )
