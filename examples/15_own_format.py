"""Your own format for scenes: one function that encodes a scene, and one line that adds it.

python examples/15_own_format.py scene.ply points.xyz
"""

import sys
from pathlib import Path

import spackle
from spackle.core.color import linear_to_srgb
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import SCENE_ENCODERS


def encode_xyz(scene: SceneFile) -> bytes:
    """Encode the centres of all Gaussians as lines of `x y z red green blue`, colours in 0..255."""
    gaussians = scene.gaussians
    colors = (255 * linear_to_srgb(gaussians.colors)).round().int()
    lines = [
        f"{x:.5f} {y:.5f} {z:.5f} {red} {green} {blue}"
        for (x, y, z), (red, green, blue) in zip(
            gaussians.means.tolist(), colors.tolist(), strict=True
        )
    ]
    return "\n".join(lines).encode()


def main(scene_file: Path, out: Path) -> None:
    SCENE_ENCODERS[".xyz"] = encode_xyz
    spackle.Scene.load(scene_file).export(out)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
