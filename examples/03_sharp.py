"""SHARP as the base, loaded once for many photos.

python examples/03_sharp.py sharp.pt out photo.jpg...

`spackle weights get sharp` downloads Apple's weights, for research only. `python
benchmarks/random_weights.py sharp.pt` makes random weights, which take as long as Apple's weights
but give meaningless scenes.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import spackle


def main(weights: Path, out: Path, photos: Sequence[Path]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    session = spackle.Spackle(spackle.SharpBase.load(weights))
    for photo in photos:
        scene = session.predict(photo, trajectory="swipe")
        scene.save(out / f"{photo.stem}.ply")
        print(
            f"{photo.name}: {len(scene.base):,} Gaussians of SHARP, {len(scene.aux):,} in its holes"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), [Path(word) for word in sys.argv[3:]])
