"""A stereo video for a headset, and a picture for red-cyan glasses.

python examples/08_stereo.py scene.ply out
"""

import sys
from pathlib import Path

import spackle
from spackle.formats import save_png
from spackle.video.stereo import Stereo, default_ipd


def main(file: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    scene = spackle.Scene.load(file)
    depth = scene.depth_range
    ipd = default_ipd(scene.camera, depth)  # metres; 0.065 if the nearest surface is 1.8 m away

    scene.save_video(
        out / "sbs.mp4", "swipe", disparity=0.05, fps=24, seconds=1, stereo="sbs", ipd=ipd
    )

    # what is at this depth appears in the screen's plane
    glasses = Stereo("anaglyph", ipd, convergence=depth.focus)
    left, right = scene.frames(glasses.eyes(scene.camera))
    save_png(glasses.pack(left.rgb, right.rgb), out / "anaglyph.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
