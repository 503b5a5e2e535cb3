"""The pseudo-supervised dataset (paper, appendix): photos to views with holes and completed targets, in shards."""

from spackle.pseudo.reader import PseudoDataset, PseudoFiles
from spackle.pseudo.sample import PhotoGroup, PseudoSample

__all__ = ["PhotoGroup", "PseudoDataset", "PseudoFiles", "PseudoSample"]
