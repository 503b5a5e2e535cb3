"""The command line. Functions declare the options of commands; they import the code of a command only when it runs."""

from __future__ import annotations

import atexit
import contextlib
import gc
import json
import os
import signal
import sys
import threading
from typing import Annotated, NoReturn

import typer
from typer.exceptions import TyperException

from spackle.cli import commands, dataset, evaluate, train, weights
from spackle.cli.messages import applications, with_flags
from spackle.cli.options import INTERRUPTED
from spackle.runtime.errors import InputError, printable_line

app = typer.Typer(
    name="spackle",
    help="""One photo in, a 3D Gaussian scene out that survives a large camera move.

    \b
    spackle predict photo.jpg -o out                     a scene, a video, a report
    spackle view photo.jpg                               the scene in the browser
    spackle export out/photo/scene.ply -o photo.html     one file to send
    """,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # panels would leave only a third of the width for the text
    # Users may type the names of options and choices with underscores.
    context_settings={
        "help_option_names": ["-h", "--help"],
        "token_normalize_func": lambda name: name.replace("_", "-"),
    },
)

app.command(short_help="Turn photos, or a clip, into completed scenes and videos")(commands.predict)
app.command(short_help="View a scene, or a photo that becomes one, in the browser")(commands.view)
app.command(short_help="Complete photos for programs, over HTTP")(commands.serve)
app.command(short_help="Render a saved scene as a video")(commands.render)
app.command(short_help="Write a scene for other viewers, or as one page to send")(commands.export)
app.command(short_help="Describe a scene, photo, depth map or clip")(commands.info)
app.command(short_help="Complete one photo and compare with its true second view")(commands.demo)
app.add_typer(
    weights.weights, name="weights", short_help="Download or list weights that others publish"
)
app.command(short_help="Train the residual network or SHARP's decoder")(train.train)
app.command(short_help="Evaluate on a dataset by the paper's protocols")(evaluate.evaluate)
app.command(short_help="Merge several evaluations into the same tables")(evaluate.tables)
app.command(short_help="Draw the paper's figures from several evaluations")(evaluate.figures)
app.command(short_help="Measure what Spackle costs, in Gaussians and in time")(evaluate.bench)
app.add_typer(
    dataset.dataset,
    name="dataset",
    short_help="Build training data: views with holes and completed targets",
)
applications.append(app)


def _version(asked: bool) -> None:
    if asked:
        from spackle import __version__

        print(f"spackle {__version__}")
        raise typer.Exit()


@app.callback()
def everywhere(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options that come before any command."""


def main() -> None:
    """Entry point; bad input prints one line and ends with exit code 2."""
    # Otherwise idle threads of torch spin, which slows completion down by a factor of three to five on busy cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Otherwise the garbage collector scans the 200,000 objects of torch and numba too often.
    gc.set_threshold(50_000)
    if (
        threading.current_thread() is threading.main_thread()
    ):  # let SIGTERM run every `finally`, too
        signal.signal(signal.SIGTERM, _end)
    try:
        code = app(standalone_mode=False)
        sys.stdout.flush()
    except InputError as error:
        _fail(str(error))
    except TyperException as error:  # an unknown option, or text in place of a number
        if type(error).__name__ == "NoArgsIsHelpError":  # no arguments: print the help
            print(error.format_message(), file=sys.stderr)
            sys.exit(2)
        _fail(
            error.format_message().replace("Value error, ", "")
        )  # pydantic's words, which typer keeps
    except OSError as error:
        if error.filename is not None:
            raise
        print(
            f"error: cannot write to the standard output: {error.strerror or error}",
            file=sys.stderr,
        )
        sys.exit(2)
    if code == INTERRUPTED:
        print("interrupted", file=sys.stderr)
    sys.exit(code)


def run() -> NoReturn:
    """Run `main` and end the process at once, because Python needs half a second to free torch."""
    code: object = 0
    try:
        main()
    except SystemExit as end:
        code = end.code or 0
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code if isinstance(code, int) else 1)


def _end(number: int, frame: object) -> NoReturn:
    sys.exit(128 + number)


def _fail(message: str) -> NoReturn:
    line = with_flags(printable_line(message))
    print(f"error: {line}", file=sys.stderr)
    if "--json" in sys.argv:
        print(json.dumps({"error": line}))
    sys.exit(2)
