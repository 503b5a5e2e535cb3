"""Videos of a scene along built-in paths, along keyframes from a file, and by your own cameras.

python examples/07_video_paths.py scene.ply out
"""

import dataclasses
import json
import sys
from pathlib import Path

import spackle
from spackle.formats import load_path
from spackle.video.encoding import save_video

AHEAD = {"target": [0, 0, 3]}  # metres in front of the photo's camera
KEYFRAMES = {
    "keyframes": [
        {"time": 0, "eye": [0, 0, 0], **AHEAD},
        {"time": 1, "eye": [0.1, 0, 0.05], **AHEAD},
    ]
}


def main(file: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    scene = spackle.Scene.load(file)
    scene.save_video(out / "swipe.mp4", "swipe", frames=48, fps=24)
    scene.save_video(out / "loop.webp", "rotate", frames=24, fps=12)  # repeats for ever

    (out / "path.json").write_text(json.dumps(KEYFRAMES))
    cameras = scene.along(load_path(out / "path.json"), frames=24)
    save_video((view.rgb for view in scene.frames(cameras)), out / "keyframes.mp4")

    def at(x: float) -> spackle.Camera:
        """The photo's camera, moved by x metres to the right."""
        pose = scene.camera.world_to_camera.clone()
        pose[0, 3] -= x
        return dataclasses.replace(scene.camera.even(), world_to_camera=pose)

    save_video(
        (scene.render(at(0.002 * step)).rgb for step in range(24)), out / "truck.mp4", fps=24
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
