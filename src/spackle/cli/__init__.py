"""The command line.

One file declares the options of one command and calls the library; it imports the command's work
only when the command runs, so that help does not wait for torch. `main` is the entry.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import json
import os
import signal
import sys
import threading
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup
from typer.exceptions import TyperException

from spackle.cli.bench import bench
from spackle.cli.dataset import dataset
from spackle.cli.demo import demo
from spackle.cli.evaluate import evaluate
from spackle.cli.export import export
from spackle.cli.figures import figures
from spackle.cli.fill import fill
from spackle.cli.info import info
from spackle.cli.messages import applications, with_flags, with_suggestion
from spackle.cli.options import BAD_INPUT, INTERRUPTED, PAPER_PANEL
from spackle.cli.predict import predict
from spackle.cli.render import render
from spackle.cli.serve import serve
from spackle.cli.system_errors import problem_of_system
from spackle.cli.tables import tables
from spackle.cli.train import train
from spackle.cli.view import view
from spackle.cli.weights import weights
from spackle.runtime.errors import InputError, printable_line

# The garbage collector runs after so many new objects, not after 2,000, because each time it scans
# the 200,000 objects of torch and numba.
OBJECTS_BETWEEN_COLLECTIONS = 50_000


class GroupedCommands(TyperGroup):
    """Commands whose help lists those of the paper's experiments apart from all others."""

    def format_commands(self, context: Any, formatter: Any) -> None:
        """Write the list of commands in the help, in one section for each panel.

        A panel is the title under which a command is registered; commands without one come under
        "Commands". Sections have the order of their first commands.
        """
        # The rows of each section: a command's name, and its help in one line.
        sections: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(context):
            command: Any = self.get_command(context, name)
            # Typer keeps the panel's title for the library rich, which is switched off here.
            panel = getattr(command, "rich_help_panel", None)
            title = panel if isinstance(panel, str) else "Commands"
            help_text = command.get_short_help_str(limit=formatter.width)
            sections.setdefault(title, []).append((name, help_text))
        for title, rows in sections.items():
            with formatter.section(title):
                formatter.write_dl(rows)


app = typer.Typer(
    name="spackle",
    cls=GroupedCommands,
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

app.command(short_help="Turn photos, or a clip, into completed scenes and videos")(predict)
app.command(short_help="View a scene, or a photo that becomes one, in the browser")(view)
app.command(short_help="Complete photos for programs, over HTTP")(serve)
app.command(short_help="Fill holes of a scene that another program made")(fill)
app.command(short_help="Render a saved scene as a video")(render)
app.command(short_help="Write a scene for other viewers, or as one page to send")(export)
app.command(short_help="Describe a scene, photo, depth map or clip")(info)
app.command(short_help="Complete one photo and compare with its true second view")(demo)
app.add_typer(weights, name="weights", short_help="Download or list weights that others publish")

app.command(
    short_help="Train the residual network or SHARP's decoder", rich_help_panel=PAPER_PANEL
)(train)
app.command(
    short_help="Evaluate on a dataset by the paper's protocols", rich_help_panel=PAPER_PANEL
)(evaluate)
app.command(
    short_help="Merge several evaluations into the same tables", rich_help_panel=PAPER_PANEL
)(tables)
app.command(
    short_help="Draw the paper's figures from several evaluations", rich_help_panel=PAPER_PANEL
)(figures)
app.command(
    short_help="Measure what Spackle costs, in Gaussians and in time", rich_help_panel=PAPER_PANEL
)(bench)
app.add_typer(
    dataset,
    name="dataset",
    short_help="Build training data: views with holes and completed targets",
    rich_help_panel=PAPER_PANEL,
)
applications.append(app)


def _print_version(asked: bool) -> None:
    """Print the version and end the command, if `--version` is given."""
    if asked:
        from spackle import __version__

        print(f"spackle {__version__}")
        raise typer.Exit()


@app.callback()
def options_before_any_command(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Options that come before any command."""


def main() -> None:
    """Run the command of `sys.argv`; bad input prints one line and ends with exit code 2."""
    # Otherwise idle threads of torch spin, which makes completion three to five times slower on
    # busy cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Each collection scans all objects of torch and numba, so there should be few.
    gc.set_threshold(OBJECTS_BETWEEN_COLLECTIONS)
    # SIGTERM then ends the process by an exception, so that every `finally` runs. Only the main
    # thread may set this.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _exit_at_signal)

    try:
        # In its standalone mode typer would print errors itself, and end the process. Without it,
        # errors come here, and the code of a typer.Exit is returned.
        code = app(standalone_mode=False)
        # Errors of the standard output should come here, not when Python ends.
        sys.stdout.flush()
    except InputError as error:
        _exit_with_error(str(error))
    except TyperException as error:  # an unknown option, or text in place of a number
        if type(error).__name__ == "NoArgsIsHelpError":  # without arguments the help is printed
            print(error.format_message(), file=sys.stderr)
            sys.exit(BAD_INPUT)
        _exit_with_error(with_suggestion(error))
    except Exception as error:
        problem = problem_of_system(error)
        if problem is None:
            raise
        # The traceback holds what filled the memory, and the message needs a little of it.
        error.__traceback__ = None
        _exit_with_error(problem)

    if code == INTERRUPTED:
        print("interrupted", file=sys.stderr)
    sys.exit(code)


def run() -> NoReturn:
    """Run `main`, and end the process without Python's clean-up, which takes half a second.

    Nearly all of this time goes into freeing torch, whose memory the system takes back anyway.
    """
    code: object = 0
    try:
        main()
    except SystemExit as end:
        code = end.code or 0  # None means success

    # `os._exit` skips what Python does at the end. These two steps of it are needed: functions that
    # were registered for the exit, such as those that end workers, and the output in buffers.
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        # The other end of a pipe may be closed already.
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code if isinstance(code, int) else 1)  # Python, too, ends with 1 for other values


def _exit_at_signal(number: int, frame: object) -> NoReturn:
    """End the process with the exit code that shells give a process ended by this signal."""
    sys.exit(128 + number)  # the shells' rule: 128 and the signal's number, such as 143 for SIGTERM


def _exit_with_error(message: str) -> NoReturn:
    """Print an error in one line, and as JSON if the user asked for JSON; exit code 2."""
    line = with_flags(printable_line(message))
    print(f"error: {line}", file=sys.stderr)
    # The error may have come before the options were parsed.
    if "--json" in sys.argv:
        # If the standard output has failed, nothing more can be said there.
        with contextlib.suppress(OSError):
            print(json.dumps({"error": line}), flush=True)
    sys.exit(BAD_INPUT)
