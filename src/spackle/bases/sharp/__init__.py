"""SHARP, Apple's network that predicts Gaussians from one photo, reimplemented for speed.

Read `network` first, then `encoder`; `base` loads and runs them, `stretch` converts to metres.
"""

from spackle.bases.sharp.base import SharpBase

__all__ = ["SharpBase"]
