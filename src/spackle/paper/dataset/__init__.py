"""The pseudo-supervised dataset (paper, appendix): photos' views with holes, and completed targets, in shards."""

from spackle.paper.dataset.sample import DatasetView, PhotoGroup
from spackle.paper.dataset.shards import DatasetFiles

__all__ = ["DatasetFiles", "DatasetView", "PhotoGroup"]
