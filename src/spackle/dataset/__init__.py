"""The pseudo-supervised dataset (paper, appendix): photos to views with holes and completed targets, in shards."""

from spackle.dataset.reader import PseudoDataset, PseudoFiles
from spackle.dataset.sample import PhotoGroup, PseudoSample

__all__ = ["PhotoGroup", "PseudoDataset", "PseudoFiles", "PseudoSample"]
