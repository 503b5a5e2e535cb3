"""A photo and its depth become a video and a scene: three lines, once the files are there.

    python examples/01_photo_with_depth.py OUT

The photo is Middlebury's Motorcycle, which comes with scikit-image (pip install 'spackle-nvs[demo]').
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image
from skimage.data import stereo_motorcycle

import spackle

# Of a quarter-size photo, as Middlebury writes it. Beside a "disp…" file it makes depth out of disparity.
CALIBRATION = """cam0=[994.978 0 311.193; 0 994.978 254.877; 0 0 1]
doffs=31.086
baseline=193.001
"""


def write_files(folder: Path) -> None:
    """photo.png, disp0.npy and calib.txt: what a photo with depth looks like on disk."""
    folder.mkdir(parents=True, exist_ok=True)
    photo, _, disparity = stereo_motorcycle()  # type: ignore[no-untyped-call]
    Image.fromarray(photo).save(folder / "photo.png")
    np.save(folder / "disp0.npy", disparity)
    (folder / "calib.txt").write_text(CALIBRATION)


def main(folder: Path) -> None:
    """Complete the photo and save what comes out."""
    write_files(folder)

    scene = spackle.predict(folder / "photo.png", depth=folder / "disp0.npy")
    scene.save_video(folder / "video.mp4")
    scene.save(folder / "scene.ply")

    print(f"{len(scene.base):,} Gaussians from the photo, {len(scene.aux):,} added behind it")
    print(f"Look at {folder / 'video.mp4'}, or open {folder / 'scene.ply'} in a viewer of Gaussian splats")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "motorcycle"))
