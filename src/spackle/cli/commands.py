"""Options of `spackle predict`, `render`, `export`, `info`, `view`, `serve` and `demo`."""

from __future__ import annotations

import dataclasses
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from spackle.cli.options import (
    INTERRUPTED,
    CheckpointOption,
    DepthKindOption,
    DeviceOption,
    FovOption,
    HostOption,
    JsonOption,
    KeepFrameOption,
    PortOption,
    PrecisionName,
    SharpOption,
    VerboseOption,
    sharp_speed,
    with_path_options,
)

if TYPE_CHECKING:  # torch takes seconds to load
    from spackle.views import PathOptions


@with_path_options
def predict(
    *,
    photos: Annotated[
        list[Path],
        typer.Argument(metavar="PHOTO...", help="Photos, folders of photos, or one clip."),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT", help="Results go to OUT/PHOTO_NAME/.")
    ] = Path("out"),
    base: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Base, which turns the photo into Gaussians. rgbd: a depth map; sharp: Apple's network; moge: MoGe-2, "
            "with metric depth and focal length; lite: small networks inside Spackle, with rough depth; hf:OWNER/NAME "
            "or hf:FOLDER: a depth model of transformers. auto: the given depth map, or the one in the photo's file, "
            "else sharp or moge if their weights are downloaded, else lite.",
        ),
    ] = "auto",
    depth: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH_OR_FOLDER",
            help="Depth of the photo: .npy, .npz, .pfm, .exr (metres), 16-bit .png (mm), a Middlebury disparity map, "
            "or a grey picture with --depth-kind.",
        ),
    ] = None,
    depth_kind: DepthKindOption = "auto",
    near: Annotated[
        float | None,
        typer.Option(
            hidden=True,
            metavar="METRES",
            help="Distance in metres of the nearest part of a relative --depth.",
            show_default="1.5",
        ),
    ] = None,
    far: Annotated[
        float | None,
        typer.Option(
            hidden=True,
            metavar="METRES",
            help="Distance in metres of the farthest part of a relative --depth.",
            show_default="15",
        ),
    ] = None,
    calib: Annotated[
        Path | None,
        typer.Option(
            hidden=True, metavar="FILE", help="calib.txt, if it is not in the map's folder."
        ),
    ] = None,
    checkpoint: CheckpointOption = None,
    precision: Annotated[
        PrecisionName,
        typer.Option(
            hidden=True,
            help="Precision of the base's network; auto: bf16 if the hardware supports it.",
        ),
    ] = "auto",
    sharp: SharpOption = None,
    residual: Annotated[
        str | None,
        typer.Option(
            metavar="PATH|initial|none",
            hidden=True,
            help="Weights of the residual. initial: no network; none: no fill. Default: the weights in the package.",
        ),
    ] = None,
    fill: Annotated[
        Literal["auto", "network", "exemplar", "lama", "none"],
        typer.Option(
            help="Texture in the holes. lama: LaMa (`spackle weights get lama`); exemplar: patches of the photo; "
            "network: no texture; none: no fill; auto: lama if its weights are downloaded, else exemplar."
        ),
    ] = "auto",
    render: Annotated[bool, typer.Option(help="Write a video.")] = True,
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
    path: PathOptions,
    mode: Annotated[
        Literal["scene", "view"],
        typer.Option(
            hidden=True,
            help="scene: one set of aux Gaussians for all views; view: a set for each view.",
        ),
    ] = "scene",
    device: DeviceOption = "auto",
    focal_px: Annotated[
        float | None, typer.Option(hidden=True, help="Focal length in pixels of the photo.")
    ] = None,
    focal_mm: Annotated[
        float | None, typer.Option(help="Focal length in mm, 35 mm equivalent.")
    ] = None,
    fov: FovOption = None,
    keep_frame: KeepFrameOption = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Predict again even if results exist.")
    ] = False,
    workers: Annotated[
        int,
        typer.Option(
            hidden=True,
            min=1,
            max=1024,
            help="Number of processes that share the photos, each with its own copy of the base's network.",
        ),
    ] = 1,
    threads: Annotated[
        int | None,
        typer.Option(
            hidden=True,
            min=1,
            max=1024,
            help="Threads of each worker; the last bits of a network's output depend on their number.",
            show_default="the cores, shared evenly",
        ),
    ] = None,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Turn photos into completed 3D scenes: scene.ply, video.mp4 and report.json for each.

    A depth map, or weights from `spackle weights get depth` or `sharp`, improve the geometry.
    """
    from spackle.bases.settings import BaseSettings
    from spackle.cli.messages import CommandReporter
    from spackle.cli.photos import PredictOptions, predict_all
    from spackle.pipeline import FillOptions, PipelineOptions
    from spackle.results.photo_folder import PhotoOptions

    settings = BaseSettings(
        name=base,
        depth=depth,
        calib=calib,
        depth_kind=depth_kind,
        near=near,
        far=far,
        checkpoint=checkpoint,
        precision=precision,
        device=device,
        **sharp_speed(sharp),
    )
    scene = PipelineOptions(
        base=settings, path=path, fill=FillOptions(residual=residual, fill=fill, mode=mode)
    )
    lens = {"focal_px": focal_px, "focal_mm": focal_mm, "fov": fov}
    photo = PhotoOptions(
        lens=lens, render=render, keep_base=keep_base, depth_out=depth_out, keep_frame=keep_frame
    )
    options = PredictOptions(
        scene=scene, photo=photo, overwrite=overwrite, workers=workers, threads=threads
    )
    if predict_all(photos, output, options, CommandReporter(verbose, as_json=as_json)):
        raise typer.Exit(1)


@with_path_options
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
    path: PathOptions,
    focal_px: Annotated[
        float | None, typer.Option(help="Focal length in pixels of the video.")
    ] = None,
    fov: FovOption = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Render a saved scene along a camera path."""
    from spackle.cli.messages import CommandReporter
    from spackle.cli.saved_scene import render_scene

    path = dataclasses.replace(path, video=dataclasses.replace(path.video, compare=compare))
    render_scene(
        scene,
        output,
        path,
        {"focal_px": focal_px, "fov": fov},
        device,
        CommandReporter(verbose, as_json=as_json),
    )


def export(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A 3D Gaussian scene.")],
    output: Annotated[
        list[Path],
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="Output file; the suffix sets the format: .ply, .compressed.ply, .spz, .splat, .sog, .glb, or .html "
            "(a page with the scene). The option may be repeated.",
        ),
    ],
    as_json: JsonOption = False,
) -> None:
    """Write a scene in the formats that other viewers read."""
    from spackle.cli.messages import CommandReporter
    from spackle.cli.saved_scene import export_scene

    export_scene(scene, output, CommandReporter(as_json=as_json))


def info(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Scenes, photos, depth maps or clips.")
    ],
    as_json: JsonOption = False,
) -> None:
    """Describe files: size, depth range, Gaussians and camera, and commands that take the file."""
    from spackle.cli.info import show_info
    from spackle.cli.messages import CommandReporter

    for file in files:
        show_info(file, CommandReporter(as_json=as_json))


def view(
    target: Annotated[
        Path | None,
        typer.Argument(
            metavar="SCENE_OR_PHOTO",
            help="A scene, or a photo to complete; by default the page is empty.",
        ),
    ] = None,
    base: Annotated[
        str, typer.Option(metavar="NAME", help="Base, as for `spackle predict`.")
    ] = "auto",
    depth: Annotated[Path | None, typer.Option(metavar="FILE", help="Depth of the photo.")] = None,
    depth_kind: DepthKindOption = "auto",
    checkpoint: CheckpointOption = None,
    disparity: Annotated[
        float | None,
        typer.Option(
            help="How far the camera moves to the side, as a disparity from 0 to 2; 0.3 is large.",
            show_default="chosen for each photo, at most 0.15 with lite, else 0.3",
        ),
    ] = None,
    focal_px: Annotated[float | None, typer.Option(help="Focal length in pixels.")] = None,
    fov: FovOption = None,
    keep_frame: KeepFrameOption = False,
    device: DeviceOption = "auto",
    host: HostOption = "127.0.0.1",
    port: PortOption = 0,
    browser: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in a browser.")
    ] = True,
    token: Annotated[
        bool,
        typer.Option(
            "--token/--no-token",
            help="Put a secret token into the page's address. With --no-token everybody on this machine can open the "
            "page, and nobody can send photos.",
        ),
    ] = True,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Open a page in the browser that shows a scene or completes photos. Ctrl-C ends the server."""
    from spackle.bases.settings import BaseSettings
    from spackle.cli import serve as app
    from spackle.cli.messages import CommandReporter

    settings = BaseSettings(
        name=base, depth=depth, depth_kind=depth_kind, checkpoint=checkpoint, device=device
    )
    place = app.Place(host, port, secrets.token_urlsafe(16) if token else None, browser)
    reporter = CommandReporter(verbose, as_json=as_json)
    usual = {"disparity": disparity, "keep_frame": keep_frame, "depth_kind": depth_kind}
    app.view(target, settings, usual, {"focal_px": focal_px, "fov": fov}, place, reporter)
    raise typer.Exit(INTERRUPTED)


def serve(
    host: HostOption = "127.0.0.1",
    port: PortOption = 8080,
    token: Annotated[
        str | None,
        typer.Option(
            help="The token that clients must send.",
            show_default="a new one",
            envvar="SPACKLE_TOKEN",
        ),
    ] = None,
    workers: Annotated[
        int,
        typer.Option(
            min=1,
            max=64,
            help="Number of processes that share the photos, each with its own copy of the base's network.",
        ),
    ] = 1,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT", help="Folder of photos and scenes.")
    ] = Path("spackle-scenes"),
    keep: Annotated[
        float, typer.Option(min=0, metavar="DAYS", help="Delete scenes after this number of days.")
    ] = 7,
    quota: Annotated[
        float,
        typer.Option(min=0, metavar="GB", help="Delete the oldest scenes if all take more space."),
    ] = 20,
    waiting: Annotated[
        int,
        typer.Option(
            min=1, metavar="N", help="Number of photos that may wait; more photos are refused."
        ),
    ] = 32,
    base: Annotated[
        str, typer.Option(metavar="NAME", help="Base, as for `spackle predict`.")
    ] = "auto",
    checkpoint: CheckpointOption = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Serve an HTTP interface and a page that complete photos (see docs/http.md). Ctrl-C ends the server."""
    from spackle.bases.settings import BaseSettings
    from spackle.cli import serve as app
    from spackle.cli.messages import CommandReporter
    from spackle.web.jobs import RetentionLimits
    from spackle.web.work import SceneWork

    work = SceneWork(BaseSettings(name=base, checkpoint=checkpoint, device=device), verbose=verbose)
    place = app.Place(host, port, token or secrets.token_urlsafe(16), False)
    app.serve(
        output,
        work,
        workers,
        RetentionLimits(keep * 86400, quota * 1e9, waiting),
        place,
        CommandReporter(verbose, as_json=as_json),
    )
    raise typer.Exit(INTERRUPTED)


def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT", help="Folder for the results.")
    ] = Path("demo-output"),
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Complete Middlebury's Motorcycle photo and compare with the true second photo (needs scikit-image)."""
    from spackle.cli.demo import run_demo
    from spackle.cli.messages import CommandReporter

    run_demo(output, CommandReporter(verbose, as_json=as_json))
