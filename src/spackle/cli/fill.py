"""`spackle fill`: a scene of any program without holes in given views."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from spackle.cli.options import DeviceOption, JsonOption
from spackle.runtime.declared_options import TrajectoryKind


def fill(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A 3D Gaussian scene.")],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="FILE", help="Output file, such as filled.ply."),
    ],
    cameras: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The views to fill, in the scene's world: Spackle's cameras, transforms.json of "
            "nerfstudio, cameras.json of 3DGS, a COLMAP folder and others, see docs/inputs.md.",
            show_default="a path around the scene's own camera",
        ),
    ] = None,
    from_camera: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="CAMERA",
            help="Fill a path around this camera of --cameras, a picture's name or a number from "
            "0, in place of all its views.",
        ),
    ] = None,
    trajectory: Annotated[
        TrajectoryKind | None,
        typer.Option(help="The path around one camera.", show_default="rotate-forward"),
    ] = None,
    disparity: Annotated[
        float | None,
        typer.Option(
            help="How far that path goes to the side, as a disparity from 0 to 2; 0.3 is large.",
            show_default="the scene's own, or 0.3",
        ),
    ] = None,
    up: Annotated[
        str | None,
        typer.Option(
            metavar="DIRECTION",
            help="The scene's upward direction, such as -y or 0,-1,0: fill 12 views all around it. "
            "For scenes without any camera.",
        ),
    ] = None,
    background: Annotated[
        Literal["keep", "fill"],
        typer.Option(
            help="keep: sky and empty space around the scene stay empty; fill: everything empty "
            "is filled."
        ),
    ] = "keep",
    remove: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="MASK",
            help="Take a thing out, and fill what it hid: a picture in which it is painted white. "
            "May be given several times, each with its --camera.",
        ),
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CAMERA",
            help="The camera of --cameras in whose view the mask is: a picture's name or a number "
            "from 0.",
            show_default="the scene's own camera",
        ),
    ] = None,
    box: Annotated[
        str | None,
        typer.Option(
            metavar="X0,Y0,Z0,X1,Y1,Z1",
            help="Take out what is in this box, in the scene's world, and fill what it hid.",
        ),
    ] = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Fill a scene of any program where cameras see holes, or where a thing is taken out.

    The scene's own Gaussians do not change.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.cli.messages import CommandReporter
    from spackle.results.fill_views import FillViewsOptions
    from spackle.results.filled_scene import fill_saved_scene
    from spackle.results.removed_scene import RemovalOptions, remove_from_saved_scene

    views = FillViewsOptions(
        cameras=cameras,
        from_camera=from_camera,
        trajectory=trajectory,
        disparity=disparity,
        up=up,
    )
    reporter = CommandReporter(as_json=as_json)
    removal = RemovalOptions(remove=tuple(remove or ()), camera=tuple(camera or ()), box=box)
    if removal.is_given:
        removal.check(background)
        remove_from_saved_scene(scene, output, removal, views, reporter, device=device)
        return
    fill_saved_scene(
        scene,
        output,
        views,
        reporter,
        background=background,
        device=device,
    )
