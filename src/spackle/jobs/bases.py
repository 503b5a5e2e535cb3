"""Names for callers that have not moved to `spackle.bases.open` yet."""

from __future__ import annotations

from pathlib import Path

from spackle.bases.open import BaseSettings


def title_of(name: str) -> str:
    """As `BaseSettings.title`."""
    return BaseSettings(name).title


def says_of(name: str, checkpoint: Path | None) -> str:
    """As `BaseSettings.says`."""
    return BaseSettings(name, checkpoint=checkpoint).says


def public_name(name: str) -> str:
    """As `BaseSettings.public_name`."""
    return BaseSettings(name).public_name


def base_files(name: str, checkpoint: Path | None) -> dict[str, Path]:
    """As `BaseSettings.files`."""
    return BaseSettings(name, checkpoint=checkpoint).files
