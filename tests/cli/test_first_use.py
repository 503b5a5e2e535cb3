"""The second process of a first use: what it compiles, when it runs, and that it does not outlive the first."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from spackle._numba import is_compiled
from spackle.cli import photos
from spackle.render import get_renderer

KERNELS_OF_A_COMPLETION = """
import gc
import sys

from numba.core.dispatcher import Dispatcher

sys.path.insert(0, sys.argv[1])
from scenes import box_before_wall, shifted
from spackle.cli.photos import compile_kernels
from spackle.render import get_renderer
from spackle.scene_fill import FillContext, fill_scene

def there():
    kernels = [o for o in gc.get_objects() if isinstance(o, Dispatcher) and o.__module__.startswith("spackle.")]
    return {(kernel.__name__, str(signature)) for kernel in kernels for signature in kernel.signatures}

scene = box_before_wall()
base, camera = scene.base(), scene.camera
before = there()
compile_kernels()
ahead = there()
views = [shifted(camera, x) for x in (-0.4, -0.2, 0.2, 0.4)]
aux = fill_scene(FillContext(base, camera, get_renderer()), views).aux
assert len(aux) > 100, "nothing was completed"
print(len(ahead - before), *sorted(there() - ahead))
"""


def test_what_a_completion_needs_is_compiled_ahead() -> None:
    command = [sys.executable, "-c", KERNELS_OF_A_COMPLETION, Path(__file__).parent.parent]
    count, *missing = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split(maxsplit=1)
    assert int(count) > 15
    assert not missing


def test_the_second_process_works_and_ends_with_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    started: list[subprocess.Popen[bytes]] = []

    class Process(subprocess.Popen[bytes]):
        def __init__(self, *words: object, **options: object) -> None:
            super().__init__(*words, **options)  # type: ignore[call-overload]
            started.append(self)

    monkeypatch.setattr(photos.subprocess, "Popen", Process)
    for compiled, ends in ((True, False), (False, False), (False, True)):
        monkeypatch.setattr(photos, "is_compiled", lambda kernel, compiled=compiled: compiled)
        said.clear(), started.clear()
        with photos.compiled_ahead(get_renderer(), said.append):
            assert len(started) == len(said) == (not compiled)
            if ends:
                assert started[0].wait(timeout=300) == 0
            elif started:
                assert started[0].poll() is None
        assert all(process.returncode is not None for process in started)


def test_a_kernel_is_compiled_once_its_code_lies_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = time.time_ns()  # code that was never compiled
    source = f"from spackle._numba import kernel\n\n@kernel\ndef since(x):\n    return x - {now}\n"
    (tmp_path / "own_kernel.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    from own_kernel import since

    assert not is_compiled(since)
    assert since(now) == 0
    assert is_compiled(since)
