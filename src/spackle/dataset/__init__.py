"""The pseudo-supervised dataset (paper, appendix): views of photos, with holes and completed targets, in shards."""

from spackle.dataset.sample import DatasetView, PhotoGroup
from spackle.dataset.shards import DatasetFiles

__all__ = ["DatasetFiles", "DatasetView", "PhotoGroup"]
