"""A photo becomes a scene, a video, and one file to send.

python examples/01_photo.py photo.jpg out
"""

import sys
from pathlib import Path

import spackle


def main(photo: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    scene = spackle.predict(photo)
    print(f"{len(scene.base):,} Gaussians from the photo, {len(scene.aux):,} in its holes")

    scene.save_video(out / "video.mp4")
    scene.save(out / "scene.ply")  # for viewers of Gaussian splats, and for spackle.Scene.load
    scene.export(out / "scene.html")  # viewer and scene in one file


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
