"""SHARP, Apple's network that predicts Gaussians from one photo, reimplemented for speed, and for CPUs."""

from spackle.bases.sharp.base import SharpBase

__all__ = ["SharpBase"]
