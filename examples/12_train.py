"""Make a dataset of your photos, train a residual network with the dataset, and complete a photo by
the network.

python examples/12_train.py photos out

Give three or more photos; this takes a few minutes on two cores. The guides on datasets and
training list the options for real runs.
"""

import subprocess
import sys
from pathlib import Path

import spackle

SMALL = [
    "network=unet",
    "data.views=24",
    "data.validation_views=4",
    "data.cells=24",
    "loss.features=none",
]
SHORT = [
    "optim.steps=40",
    "optim.warmup=5",
    "optim.batch=4",
    "run.validate_every=20",
    "run.save_every=20",
]


def run(*words: object) -> None:
    """Run a `spackle` command."""
    subprocess.run([sys.executable, "-m", "spackle", *map(str, words)], check=True)


def main(photos: Path, out: Path) -> None:
    views = ["--views", 4, "--disparity", 0.2, 0.4]
    run(
        "dataset",
        "build",
        photos,
        "-o",
        out / "set",
        "--base",
        "lite",
        "--inpainter",
        "exemplar",
        *views,
    )
    run(
        "train",
        "--recipe",
        "paper",
        "-o",
        out / "run",
        f"data.pseudo={out / 'set'}",
        *SMALL,
        *SHORT,
    )

    photo = min(path for path in photos.iterdir() if path.suffix in (".jpg", ".png"))
    scene = spackle.predict(photo, residual=out / "run" / "best.safetensors")
    scene.save_video(out / "video.mp4")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
