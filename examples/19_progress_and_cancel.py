"""Your own progress line, and an end when a photo takes too long.

python examples/19_progress_and_cancel.py photo.jpg photo.ply 300

The last number is the time limit in seconds. A button of your program can set the event, too.
"""

import sys
import threading
from pathlib import Path

import spackle


def show(progress: spackle.StageProgress) -> None:
    """Print how far a stage is; nobody knows the share at its start."""
    share = "" if progress.share is None else f" {progress.share:.0%}"
    print(f"{progress.stage}{share}")


def main(photo: Path, out: Path, limit_seconds: float) -> None:
    is_late = threading.Event()
    timer = threading.Timer(limit_seconds, is_late.set)
    timer.start()
    try:
        scene = spackle.predict(photo, progress=show, cancel=is_late)
    except spackle.Cancelled:
        print(f"{photo}: ended after {limit_seconds:g} s")
        return
    finally:
        timer.cancel()
    scene.save(out)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]))
