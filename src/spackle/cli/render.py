"""`spackle render`, as the command line has it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import (
    CamerasOption,
    ConvergenceOption,
    Device,
    DeviceOption,
    DisparityOption,
    FormatOption,
    FpsOption,
    FramesOption,
    IpdOption,
    JsonOption,
    LoopOption,
    PathOption,
    ShowChoice,
    ShowOption,
    SizeOption,
    StereoOption,
    TrajectoryOption,
    VerboseOption,
    chosen_way,
    video_options,
)


def render(
    scene: Annotated[Path, typer.Option("-i", "--input", metavar="SCENE.ply", help="A 3D Gaussian scene.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="A folder, or name.mp4|webm|gif|webp.")],
    trajectory: TrajectoryOption = None,
    disparity: DisparityOption = None,
    path: PathOption = None,
    cameras: CamerasOption = None,
    frames: FramesOption = None,
    video_format: FormatOption = None,
    fps: FpsOption = None,
    loop: LoopOption = None,
    size: SizeOption = None,
    show: ShowOption = ShowChoice.color,
    stereo: StereoOption = None,
    ipd: IpdOption = None,
    convergence: ConvergenceOption = None,
    focal_px: Annotated[float | None, typer.Option(help="Focal length in pixels of the video.")] = None,
    device: DeviceOption = Device.auto,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Draw a saved scene along a camera path."""
    from spackle.jobs.render import RenderOptions, render_scene
    from spackle.progress import Reporter

    kind, far = chosen_way(trajectory, disparity, frames, path, cameras)
    options = RenderOptions(
        trajectory=kind,
        disparity=far,
        cameras=cameras,
        path=path,
        frames=frames,
        video=video_options(video_format, fps, loop, size, show, stereo, ipd, convergence),
        focal_px=focal_px,
        device=device.value,
    )
    render_scene(scene, output, options, Reporter(verbose, as_json=as_json))


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(short_help="A saved scene to a video")(render)
