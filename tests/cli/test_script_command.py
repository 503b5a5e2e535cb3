"""`run_script`, by which all scripts of research/ and benchmarks/ end."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NoReturn

import pytest

from spackle.cli.script_command import check_picture_file, run_script
from spackle.runtime.errors import InputError


def raises(error: BaseException) -> NoReturn:
    """A script's work that ends with an exception."""
    raise error


@pytest.mark.parametrize(("returned", "code"), [(None, 0), (0, 0), (1, 1), (130, 130)])
def test_what_the_work_returns_is_the_exit_code(returned: int | None, code: int) -> None:
    assert run_script(lambda: returned) == code


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (InputError("a.png: no such photo"), 2, "error: a.png: no such photo\n"),
        # One line, without codes that would command a terminal; options are named as flags.
        (InputError("a\x1b\nb: choose `depth_kind`"), 2, "error: a\\x1b b: choose --depth-kind\n"),
        # Of several processes that train together, all but one end so.
        (InputError(""), 2, ""),
        (MemoryError(), 2, "error: not enough memory: close other programs, or give something "),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
def test_what_ends_the_work_is_said_in_one_line(
    error: BaseException, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_script(lambda: raises(error)) == code
    output, line = capsys.readouterr()
    assert output == ""
    assert line.startswith(said)
    assert line.count("\n") == bool(said)


def test_a_file_that_the_system_refuses_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_script(lambda: raises(OSError(28, "No space left on device", "out.json"))) == 2
    line = capsys.readouterr().err
    assert line == "error: out.json: cannot be read or written: No space left on device\n"


def test_a_fault_of_the_script_keeps_its_traceback() -> None:
    with pytest.raises(ZeroDivisionError):
        run_script(lambda: 1 // 0)


def test_a_picture_file_has_a_name_that_pillow_can_write(tmp_path: Path) -> None:
    for name in ("a.png", "a.JPG", "a.tif", "a.webp"):
        check_picture_file(tmp_path / name)
    # Pillow reads .psd, but does not write it.
    for name in ("a", "a.psd", "a.json", "missing/a.png"):
        with pytest.raises(InputError, match=rf"^{re.escape(str(tmp_path / name))}: "):
            check_picture_file(tmp_path / name)
