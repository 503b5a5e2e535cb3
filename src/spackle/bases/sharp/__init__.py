"""SHARP: Apple's network from one photo to Gaussians, written anew for speed and for processors."""

from spackle.bases.sharp.base import SharpBase

__all__ = ["SharpBase"]
