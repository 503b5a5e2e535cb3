"""The pseudo-supervised dataset (paper, appendix): photos to views with holes and completed targets, in shards."""

from spackle.dataset.reader import DatasetFiles, ViewDataset
from spackle.dataset.sample import DatasetView, PhotoGroup

__all__ = ["DatasetFiles", "DatasetView", "PhotoGroup", "ViewDataset"]
