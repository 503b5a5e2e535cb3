"""Fill the holes of a scene that another tool made from a photo, such as a PLY of SHARP.

python examples/05_scene_of_another_tool.py scene.ply photo.jpg completed.ply

The Gaussians must be in the frame of the photo's camera: x right, y down, z forward, camera at the
origin.
"""

import sys
from pathlib import Path

import spackle


def main(file: Path, photo: Path, out: Path) -> None:
    gaussians = spackle.load_ply(file)
    # The focal length comes from EXIF; if EXIF has none, give fov=...
    loaded = spackle.load_photo(photo)
    camera = loaded.camera

    before = spackle.Scene(gaussians, gaussians.select(slice(0)), camera)
    path = before.path("swipe", disparity=0.3)
    # A network that looks at the photo needs it; without photo=... it would see the Gaussians,
    # rendered from the photo's camera.
    prediction = spackle.BasePrediction(gaussians, camera, notes={}, photo=loaded.rgb)
    scene = spackle.complete(prediction, path)

    holes = [spackle.hole_area_ratio(each.render(path[0]).alpha) for each in (before, scene)]
    print(f"holes at the left end of the path: {holes[0]:.1%} -> {holes[1]:.2%}")
    # the first Gaussians are equal to the Gaussians of the file, bit for bit
    scene.save(out, disparity=0.3)


if __name__ == "__main__":
    main(*(Path(word) for word in sys.argv[1:4]))
