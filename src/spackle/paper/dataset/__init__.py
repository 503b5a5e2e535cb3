"""The pseudo-supervised dataset (paper, appendix): views with holes, and completed targets.

Read `build_dataset` in build.py for the way from photos to files, and `DatasetFiles` in shards.py
for the way back.
"""

from spackle.paper.dataset.sample import DatasetView, PhotoGroup
from spackle.paper.dataset.shards import DatasetFiles

__all__ = ["DatasetFiles", "DatasetView", "PhotoGroup"]
