"""A stereo video for a headset, and a picture for red-cyan glasses.

python examples/08_stereo.py scene.ply out
"""

import sys
from pathlib import Path

import spackle
from spackle.camera_path import DepthRange
from spackle.formats import save_png, save_video
from spackle.video_frames import Stereo, default_ipd


def main(file: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    scene = spackle.Scene.load(file)
    depth = DepthRange.of(scene.base)
    ipd = default_ipd(scene.camera, depth)  # metres; 0.065 if the nearest surface is 1.8 m away

    pair = Stereo("sbs", ipd, convergence=depth.focus)  # objects at this depth appear at the depth of the screen
    path = scene.path("swipe", disparity=0.05, frames=24)
    eyes = (scene.frames(pair.eyes(camera)) for camera in path)
    save_video((pair.pack(*(view.rgb for view in views)) for views in eyes), out / "sbs.mp4", fps=24)

    glasses = Stereo("anaglyph", ipd, convergence=depth.focus)
    left, right = scene.frames(glasses.eyes(scene.camera))
    save_png(glasses.pack(left.rgb, right.rgb), out / "anaglyph.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
