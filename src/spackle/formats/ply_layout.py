"""Which properties of a PLY file's vertices are a Gaussian's position, colour, opacity and shape.

All programs follow INRIA's names, but some leave properties out or store them in another way. A new
way belongs into `PlyLayout.find`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.core.spherical_harmonics import HARMONICS_COUNTS, MAX_DEGREE
from spackle.formats.gaussian_columns import SH_C0, Floats

MEANS = ("x", "y", "z")
HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")
PLAIN_COLORS = ("red", "green", "blue")
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")

# CloudCompare puts one of these before the names of properties that it does not know.
FOREIGN_PREFIXES = ("scalar_", "scal_")

# The discs of 2D Gaussian splatting get this thickness, as a fraction of the smaller radius.
DISC_THICKNESS = 1e-3

# The number that stands for a colour or opacity of 1, by NumPy's type; for other types it is 1.
LARGEST_OF_TYPE = {"u1": 255, "u2": 65_535}

# The sigmoid of this logit is 1 in float32.
OPAQUE_LOGIT = 30.0


class NoGaussiansError(ValueError):
    """The vertices of a file are no Gaussians; the text says what is missing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlyLayout:
    """The names of the properties in a file, and how their values are stored."""

    means: tuple[str, ...]  # x, y, z
    colors: tuple[str, ...]  # red, green, blue
    # Colours are fractions of this number; None: coefficients of the constant spherical harmonic.
    largest_color: float | None
    opacity: str | None  # None: all Gaussians are opaque
    largest_opacity: float | None  # opacities are fractions of this number; None: logits
    scales: tuple[str, ...]  # natural logarithms: of a ball one, of a disc two, else three
    quats: tuple[str, ...]  # w, x, y, z; none for balls that are not turned
    # Of the degrees 1 to 1, 2 or 3: all of red, then of green, then of blue; none if the colours do
    # not change with the view.
    harmonics: tuple[str, ...] = ()

    @staticmethod
    def find(fields: Iterable[tuple[str, str]]) -> PlyLayout:
        """Find the properties of Gaussians.

        Args:
            fields: name and NumPy type of each property in the file.

        Raises:
            NoGaussiansError: a property is missing.
        """
        stored_names: dict[str, str] = {}
        types: dict[str, str] = {}
        for stored_name, field_type in fields:
            name = plain_name(stored_name)
            stored_names.setdefault(name, stored_name)
            types.setdefault(name, field_type[-2:])  # without the order of bytes

        is_plain_color = HARMONICS[0] not in types and PLAIN_COLORS[0] in types
        color_names = PLAIN_COLORS if is_plain_color else HARMONICS
        # The last scales may be missing: discs have two, balls one.
        scale_count = max([1, *(index + 1 for index in range(3) if SCALES[index] in types)])
        scale_names = SCALES[:scale_count]
        is_ball = scale_count == 1 and not set(QUATS) & set(types)
        quat_names = () if is_ball else QUATS

        needed = (*MEANS, *color_names, *scale_names, *quat_names)
        missing = [name for name in needed if name not in types]
        if missing:
            problem = f"its vertices have no {', '.join(missing)}"
            if not set(SCALES) & set(types):
                problem += ", as those of point clouds and meshes: give a scene of Gaussians"
            raise NoGaussiansError(problem)

        opacity_name = next((name for name in ("opacity", "alpha") if name in types), None)
        largest_opacity = None
        if opacity_name == "alpha":
            largest_opacity = LARGEST_OF_TYPE.get(types["alpha"], 1)
        largest_color = LARGEST_OF_TYPE.get(types["red"], 1) if is_plain_color else None
        return PlyLayout(
            means=tuple(stored_names[name] for name in MEANS),
            colors=tuple(stored_names[name] for name in color_names),
            largest_color=largest_color,
            opacity=None if opacity_name is None else stored_names[opacity_name],
            largest_opacity=largest_opacity,
            scales=tuple(stored_names[name] for name in scale_names),
            quats=tuple(stored_names[name] for name in quat_names),
            harmonics=() if is_plain_color else view_harmonics(stored_names),
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """What had to be assumed about Gaussians, each in a few words."""
        notes = []
        if len(self.scales) == 2:
            notes.append(
                "its flat discs (2D Gaussian splatting) are made a thousandth of their radius thick"
            )
        if self.opacity is None:
            notes.append("it has no opacities: all Gaussians are opaque")
        return tuple(notes)

    def read_means(self, rows: NDArray[Any]) -> Floats:
        """Return positions [3, N] of rows [N] of the table."""
        return _stack(rows, self.means)

    def read_harmonics(self, rows: NDArray[Any]) -> Floats:
        """Return the coefficients [3, N] of the constant spherical harmonic."""
        colors = _stack(rows, self.colors)
        if self.largest_color is None:
            return colors
        return (colors / np.float32(self.largest_color) - np.float32(0.5)) / np.float32(SH_C0)

    def read_view_harmonics(self, rows: NDArray[Any]) -> Floats:
        """Return the coefficients [N, K, 3] of the K harmonics of degree 1 and higher."""
        stored = _stack(rows, self.harmonics)  # [3·K, N]
        return stored.reshape(3, -1, len(rows)).transpose(2, 1, 0)

    def read_logits(self, rows: NDArray[Any]) -> Floats:
        """Return the logits [N] of opacities."""
        if self.opacity is None:
            return np.full(len(rows), OPAQUE_LOGIT, np.float32)
        values = rows[self.opacity].astype(np.float32)
        if self.largest_opacity is None:
            return values
        opacities = values / np.float32(self.largest_opacity)
        # An opacity of 0 or 1 has an infinite logit, which is allowed.
        with np.errstate(divide="ignore", invalid="ignore"):
            logits: Floats = np.log(opacities / (1 - opacities))
        return logits

    def read_log_scales(self, rows: NDArray[Any]) -> Floats:
        """Return the natural logarithms [3, N] of the scales."""
        stored = _stack(rows, self.scales)
        if len(self.scales) == 1:
            return np.repeat(stored, 3, axis=0)
        if len(self.scales) == 2:
            thickness = stored.min(axis=0) + np.float32(np.log(DISC_THICKNESS))
            return np.concatenate([stored, thickness[None]])
        return stored

    def read_quats(self, rows: NDArray[Any]) -> Floats:
        """Return the rotations [4, N] as quaternions (w, x, y, z) of any length."""
        if not self.quats:
            return np.repeat(np.array([[1], [0], [0], [0]], np.float32), len(rows), axis=1)
        return _stack(rows, self.quats)


def view_harmonics(stored_names: Mapping[str, str]) -> tuple[str, ...]:
    """Return the stored names of the harmonics of the degrees 1 to 3 at most; none if incomplete.

    Args:
        stored_names: the name of each property in the file by its plain name. Coefficients are
            called f_rest_0, f_rest_1, …: all of red, then all of green, then all of blue.
    """
    total = sum(name.startswith("f_rest_") for name in stored_names)
    count = total // 3  # for each colour
    degree = math.isqrt(count + 1) - 1
    is_complete = all(f"f_rest_{index}" in stored_names for index in range(total))
    if not is_complete or total != 3 * ((degree + 1) ** 2 - 1):
        return ()
    kept_count = HARMONICS_COUNTS[min(degree, MAX_DEGREE)]
    indices = [color * count + index for color in range(3) for index in range(kept_count)]
    return tuple(stored_names[f"f_rest_{index}"] for index in indices)


def plain_name(name: str) -> str:
    """Return a property's name without the prefix of a program that does not know it."""
    for prefix in FOREIGN_PREFIXES:
        name = name.removeprefix(prefix)
    return name


def _stack(rows: NDArray[Any], names: tuple[str, ...]) -> Floats:
    """Return the properties of rows [N] as [len(names), N]; beyond float32 they are infinite."""
    with np.errstate(over="ignore"):
        return np.stack([rows[name].astype(np.float32) for name in names])
