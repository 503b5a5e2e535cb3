"""What several tests need: scenes, photos, weights and clients made on the spot, and plain
oracles.
"""

from pathlib import Path

ROOT = Path(__file__).parents[2]  # the repository
DATA = Path(__file__).parents[1] / "data"
