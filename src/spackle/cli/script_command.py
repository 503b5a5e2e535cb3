"""What the scripts of research/ and benchmarks/ share, which begin by `python FILE`.

They end in the same way as the command `spackle`, see `spackle.cli.main`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from spackle.cli.messages import with_flags
from spackle.cli.options import BAD_INPUT, INTERRUPTED
from spackle.cli.system_errors import problem_of_system
from spackle.runtime.errors import InputError, printable_line, unknown_suffix
from spackle.runtime.files import check_writable

USUAL_PICTURES = (".png", ".jpg", ".webp")  # of all suffixes of pictures, those to advise


def run_script(main: Callable[[], int | None]) -> int:
    """Run a script's `main`; returns the exit code: its own, 2 for bad input, 130 after Ctrl-C.

    Bad input, and a file, disk or memory that fails, print one line that begins with "error: ".
    Ctrl-C prints "interrupted". Any other exception is a fault of the script and goes on as it is.

    Args:
        main: the script's work; what it returns is the exit code, and None is 0.
    """
    try:
        return main() or 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except InputError as error:
        message = str(error)
    except Exception as error:
        problem = problem_of_system(error)
        if problem is None:
            raise
        message = problem
    # If several processes train together, one reports the error, and the others' is empty.
    if message:
        print(f"error: {with_flags(printable_line(message))}", file=sys.stderr)
    return BAD_INPUT


def check_picture_file(path: Path) -> None:
    """Check, before long work, that Pillow can write a picture to a path.

    Raises:
        InputError: `check_writable` refuses the path, or its suffix is no picture's.
    """
    from PIL import Image  # the help need not wait for it

    check_writable(path)
    picture_format = Image.registered_extensions().get(path.suffix.lower())
    if picture_format not in Image.SAVE:
        raise unknown_suffix(path, "not a name for a picture", USUAL_PICTURES)
