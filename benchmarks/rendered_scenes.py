"""Small rendered scenes with exact depth: a still life, a toy truck, a yard, a hall and a fern.

They stand where `benchmarks/reproduce.py` needs a scene in a dataset's layout and no photos with
depth can be shipped. Everything in them is made here: simple solids, painted with the pictures in
scikit-image or with patterns, under a large lamp and a bright sky. `render` gives the picture and
the depth of a scene from any eye, so a scene has true second views.

    python benchmarks/rendered_scenes.py -o scenes      # PNG files, to look at
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import math
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from skimage import data as pictures

from spackle.cli.script_command import run_script
from spackle.runtime.folders import make_folder

# The ray tracer belongs to the training of the base `lite`, which is beside the package.
sys.path.append(str(Path(__file__).parents[1] / "research" / "lite"))
from ray_tracer import BOX, CYLINDER, ELLIPSOID, SHEET, Solid, trace

Array = NDArray[Any]
Color = tuple[float, float, float]  # sRGB 0..1
Triple = Sequence[float] | Array  # [3] in metres: right, down, forward

TEXTURE_SIDE = 384  # pixels
GAMMA = 2.2  # light is added up linearly, pictures are stored as its 1/2.2th power
GRID = 4  # 4×4 rays a pixel, each with a lamp position of its own: smooth edges, soft shadows
LAMP_RAYS = 11  # of these 16 rays, so many ask for the lamp, the others for the sky
LAMP_SHARE = 0.62  # of a surface's light, if nothing shades it
AMBIENT = 0.16  # share of light that reaches every corner
SHEET_DEPTH = 0.01  # metres
LAMP_RADIUS = 0.16  # tangent of half the angle at which the lamp is seen

# Colours of paint.
CREAM, WHITE, BLACK = (0.93, 0.89, 0.80), (0.95, 0.95, 0.94), (0.06, 0.06, 0.07)
RED, GREEN, BLUE = (0.72, 0.13, 0.10), (0.16, 0.42, 0.24), (0.13, 0.25, 0.52)
OCHRE, TEAL, GREY = (0.85, 0.60, 0.18), (0.10, 0.45, 0.47), (0.55, 0.56, 0.58)
GREENS = ((0.20, 0.44, 0.14), (0.27, 0.52, 0.15), (0.17, 0.38, 0.13))  # of leaves
OAK, WALNUT = (0.72, 0.52, 0.32), (0.42, 0.26, 0.15)


@dataclasses.dataclass(frozen=True)
class Look:
    """A surface's texture by name, with how often it repeats along its two sides."""

    name: str
    color: Color = WHITE
    across: float = 1.0
    down: float = 1.0
    aspect: float = 1.0  # width over height of the surface, to which a picture is cropped


@dataclasses.dataclass
class Scene:
    """Solids with textures, seen from eyes near the origin: x right, y down, z forward, metres."""

    name: str  # as tables and figures show it, such as "rendered still life"
    pitch: float = 0.0  # how far the cameras look down, in degrees
    field_of_view: float = 55.0  # of the picture's width, in degrees
    lamp: tuple[float, float, float] = (-0.5, -0.9, -0.45)  # direction from the scene
    sky: tuple[Color, Color] = ((0.45, 0.62, 0.86), (0.88, 0.92, 0.95))  # zenith, horizon
    exposure: float = 1.25
    baseline: float = 0.1  # distance of the second views' eyes from the first, in metres
    solids: list[Solid] = dataclasses.field(default_factory=list)
    looks: list[tuple[str, Color, float]] = dataclasses.field(default_factory=list)

    def add(
        self,
        kind: int,
        center: Triple,
        half_size: Triple,
        look: Look,
        axes: Array | None = None,
        *,
        casts: bool = True,
    ) -> None:
        """Add a solid.

        Args:
            kind: SHEET, BOX, ELLIPSOID or CYLINDER.
            center: [3] in metres.
            half_size: [3] half of its width, height and depth, in metres.
            look: its texture.
            axes: [3, 3] rotation of the solid; None: upright, facing the camera.
            casts: whether it casts shadows.
        """
        key = (look.name, look.color, look.aspect)
        if key not in self.looks:
            self.looks.append(key)
        rotation = np.eye(3) if axes is None else axes
        # A sheet has no depth. A small number keeps its bounding ball small, which saves time.
        size = (*half_size[:2], SHEET_DEPTH) if kind == SHEET else half_size
        self.solids.append(
            Solid(
                kind=kind,
                center=np.asarray(center, np.float32),
                axes=np.asarray(rotation @ np.diag(size), np.float32),
                texture=self.looks.index(key),
                repeats=(look.across, look.down),
                casts=casts,
            )
        )


def turn(degrees: float) -> Array:
    """[3, 3] rotation around the vertical."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def nod(degrees: float) -> Array:
    """[3, 3] rotation around the axis to the right."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def lean(degrees: float) -> Array:
    """[3, 3] rotation around the forward axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


# --- textures


@functools.cache
def texture(name: str, color: Color, aspect: float) -> Array:
    """A texture [S, S, 4]: linear colours 0..1 and coverage 0 or 1.

    Args:
        name: one of `PATTERNS`, or a picture of scikit-image.
        color: paint of patterns and of grey pictures.
        aspect: width over height of the surface; pictures are cropped to it.
    """
    y, x = (np.mgrid[:TEXTURE_SIDE, :TEXTURE_SIDE] + 0.5) / TEXTURE_SIDE
    coverage = np.ones_like(x)
    if name in PATTERNS:
        shade, coverage = PATTERNS[name](x, y)
        rgb = shade[..., None] * np.array(color)
    else:
        rgb = _picture(name, aspect)
        is_grey = bool((rgb == rgb[..., :1]).all())
        # A grey picture such as bricks or grass becomes a pattern in the paint's colour.
        rgb = rgb * np.array(color) / 0.55 if is_grey and name not in PHOTOS else rgb
    linear = rgb.clip(0, 1) ** GAMMA
    return np.concatenate([linear, coverage[..., None]], -1).astype(np.float32)


PHOTOS = ("camera", "moon", "page", "text", "clock", "coins")  # grey, but shown as they are


def _picture(name: str, aspect: float) -> Array:
    """A picture of scikit-image, [S, S, 3] sRGB 0..1; its middle, cropped to the aspect ratio."""
    image = Image.fromarray(np.asarray(getattr(pictures, name)())).convert("RGB")
    width = min(image.width, round(image.height * aspect))
    height = min(image.height, round(image.width / aspect))
    left, top = (image.width - width) // 2, (image.height - height) // 2
    cropped = image.crop((left, top, left + width, top + height))
    return np.asarray(cropped.resize((TEXTURE_SIDE, TEXTURE_SIDE), Image.Resampling.LANCZOS)) / 255


def _noise(seed: int, cells_x: int, cells_y: int) -> Array:
    """[S, S] smooth noise of about -1..1 with this many bumps along each side."""
    bumps = np.random.default_rng(seed).standard_normal((cells_y + 3, cells_x + 3))
    image = Image.fromarray(bumps.astype(np.float32))
    smooth = image.resize((TEXTURE_SIDE, TEXTURE_SIDE), Image.Resampling.BICUBIC)
    return np.asarray(smooth) / 2


def _paint(x: Array, y: Array) -> tuple[Array, Array]:
    """Paint with faint stains."""
    return 0.97 + 0.03 * _noise(1, 6, 6) + 0.015 * _noise(2, 60, 60), np.ones_like(x)


def _plaster(x: Array, y: Array) -> tuple[Array, Array]:
    """Rough plaster."""
    return 0.93 + 0.05 * _noise(3, 9, 9) + 0.04 * _noise(4, 130, 130), np.ones_like(x)


def _bricks(x: Array, y: Array) -> tuple[Array, Array]:
    """Eight rows of four bricks, each of its own brightness, with light joints."""
    row = np.floor(8 * y)
    along = 4 * x + 0.5 * (row % 2)
    joint = (np.abs(along - np.round(along)) < 0.035) | (np.abs(8 * y - np.round(8 * y)) < 0.07)
    # A hash of the brick's place; columns repeat, so that the texture does.
    tone = 0.78 + 0.17 * np.sin(12.9 * (np.floor(along) % 4) + 78.2 * row)
    tone = tone + 0.10 * _noise(16, 70, 70)
    return np.where(joint, 1.25 + 0.05 * _noise(17, 90, 90), tone), np.ones_like(x)


def _wood(x: Array, y: Array) -> tuple[Array, Array]:
    """Four planks with grain along x."""
    plank = np.floor(4 * y)
    bent = y + 0.02 * _noise(5, 3, 8)
    grain = np.sin(2 * math.pi * (26 * bent + 0.7 * plank)) + 0.8 * _noise(6, 5, 150)
    tone = 0.86 + 0.06 * np.sin(7.3 * plank) + 0.055 * grain
    seam = np.abs(4 * y - np.round(4 * y)) < 0.012
    return np.where(seam, 0.45 * tone, tone), np.ones_like(x)


def _tiles(x: Array, y: Array) -> tuple[Array, Array]:
    """Six tiles a side with dark joints; every second one is darker."""
    column, row = np.floor(6 * x), np.floor(6 * y)
    joint = np.minimum(np.abs(6 * x - np.round(6 * x)), np.abs(6 * y - np.round(6 * y))) < 0.025
    tone = np.where((column + row) % 2 == 0, 0.97, 0.68) + 0.02 * _noise(7, 40, 40)
    return np.where(joint, 0.4, tone), np.ones_like(x)


def _stripes(x: Array, y: Array) -> tuple[Array, Array]:
    """Cloth with stripes down."""
    tone = np.where(np.floor(10 * x) % 2 == 0, 1.0, 0.55) + 0.03 * _noise(8, 120, 120)
    return tone, np.ones_like(x)


def _cover(x: Array, y: Array) -> tuple[Array, Array]:
    """The cover of a book: a frame and a title."""
    is_frame = (np.abs(x - 0.5) < 0.42) & (np.abs(y - 0.5) < 0.45)
    is_frame &= ~((np.abs(x - 0.5) < 0.40) & (np.abs(y - 0.5) < 0.435))
    is_title = (np.abs(x - 0.5) < 0.28) & ((np.abs(y - 0.28) < 0.035) | (np.abs(y - 0.38) < 0.02))
    return np.where(is_frame | is_title, 1.5, 0.92 + 0.03 * _noise(9, 90, 90)), np.ones_like(x)


def _pages(x: Array, y: Array) -> tuple[Array, Array]:
    """The edges of a book's pages."""
    return 0.9 + 0.09 * np.sin(2 * math.pi * 45 * y) + 0.02 * _noise(10, 90, 9), np.ones_like(x)


def _disk(x: Array, y: Array) -> tuple[Array, Array]:
    """A round plate."""
    return np.ones_like(x), (np.hypot(x - 0.5, y - 0.5) < 0.49).astype(float)


def _fence(x: Array, y: Array) -> tuple[Array, Array]:
    """Pickets with pointed tops, and two rails."""
    across = (9 * x) % 1
    picket = (across < 0.52) & (y > 0.10 + 0.16 * np.abs(across - 0.26))
    rails = (np.abs(y - 0.35) < 0.035) | (np.abs(y - 0.78) < 0.035)
    return np.where(picket, 1.0, 0.8) + 0.02 * _noise(11, 90, 90), (picket | rails).astype(float)


def _leaf(x: Array, y: Array) -> tuple[Array, Array]:
    """A pointed leaf along y with a midrib and side veins."""
    width = 0.46 * np.sin(math.pi * y.clip(0, 1)) ** 0.8
    aside = np.abs(x - 0.5)
    veins = 0.12 * (np.sin(2 * math.pi * (9 * y + 6 * aside)) > 0.75)
    tone = 0.85 - veins + 0.25 * (aside < 0.018) + 0.10 * _noise(12, 9, 9)
    return tone, (aside < width).astype(float)


def _foliage(x: Array, y: Array) -> tuple[Array, Array]:
    """Many small leaves with gaps between them, in a round crown."""
    away = np.hypot(x - 0.5, y - 0.5)
    crown = _noise(13, 26, 26) + 0.6 * _noise(14, 9, 9) > -0.25 + 2.2 * np.maximum(0, away - 0.3)
    return 0.75 + 0.30 * _noise(15, 40, 40), (crown & (away < 0.5)).astype(float)


Pattern = Callable[[Array, Array], tuple[Array, Array]]
# From positions 0..1 on the surface to brightness (1 is the paint's own) and coverage.
PATTERNS: dict[str, Pattern] = {
    "paint": _paint,
    "plaster": _plaster,
    "bricks": _bricks,
    "wood": _wood,
    "tiles": _tiles,
    "stripes": _stripes,
    "cover": _cover,
    "pages": _pages,
    "disk": _disk,
    "fence": _fence,
    "leaf": _leaf,
    "foliage": _foliage,
}


# --- rendering


def focal_of(scene: Scene, width: int) -> float:
    """The focal length in pixels of pictures with this width."""
    return width / 2 / math.tan(math.radians(scene.field_of_view / 2))


def render(
    scene: Scene, width: int, height: int, eye: Triple = (0.0, 0.0, 0.0)
) -> tuple[Array, Array]:
    """A picture [H, W, 3] of bytes and its depth [H, W] in metres, inf in the sky.

    All cameras of a scene have the same directions: they differ in their eye alone.

    Args:
        scene: the scene.
        width: of the picture, in pixels.
        height: of the picture, in pixels.
        eye: [3] the camera's position in its own axes (right, down, forward), in metres.
    """
    # The tracer's rays start at the origin and point along z: the scene is moved instead.
    to_camera = nod(scene.pitch)
    position = to_camera.T @ np.asarray(eye)
    solids = [
        dataclasses.replace(
            solid,
            center=np.asarray(to_camera @ (solid.center - position), np.float32),
            axes=np.asarray(to_camera @ solid.axes, np.float32),
        )
        for solid in scene.solids
    ]
    textures = np.stack([texture(*look) for look in scene.looks])
    focal = focal_of(scene, width)
    y, x = np.mgrid[:height, :width].astype(np.float32)

    def light(number: int) -> Array:
        """The picture [H, W, 3] in linear light, by one ray a pixel and one light direction."""
        # Rays lie on a grid within the pixel; a direction's number and its place are unrelated.
        place = (7 * number) % GRID**2
        down, right = divmod(place, GRID)
        rays = _rays(x + (right + 0.5) / GRID, y + (down + 0.5) / GRID, width, height, focal)
        direction = to_camera @ _light_direction(scene, number)
        background = _sky(scene, rays @ to_camera)
        colors, _ = trace(solids, textures, rays, direction.astype(np.float32), AMBIENT, background)
        is_lamp = number < LAMP_RAYS
        share = LAMP_SHARE / LAMP_RAYS if is_lamp else (1 - LAMP_SHARE) / (GRID**2 - LAMP_RAYS)
        return share * colors.reshape(height, width, 3)

    with ThreadPoolExecutor() as pool:
        linear = sum(pool.map(light, range(GRID**2)))
    rgb = (scene.exposure * np.asarray(linear)).clip(0, 1) ** (1 / GAMMA)

    # Depth belongs to the pixel's middle: an average over an edge would be no surface's depth.
    middle_rays = _rays(x + 0.5, y + 0.5, width, height, focal)
    _, depth = trace(
        solids, textures, middle_rays, np.array([0, -1, 0], np.float32), 1.0, 0 * middle_rays
    )
    return (255 * rgb + 0.5).astype(np.uint8), depth.reshape(height, width)


def _rays(u: Array, v: Array, width: int, height: int, focal: float) -> Array:
    """[N, 3] directions of depth 1 through these pixel positions."""
    directions = [(u - width / 2) / focal, (v - height / 2) / focal, np.ones_like(u)]
    return np.stack(directions, -1).reshape(-1, 3).astype(np.float32)


def _light_direction(scene: Scene, number: int) -> Array:
    """[3] unit vector to a point of the lamp, or for the last numbers to a point of the sky."""
    golden_angle = math.pi * (3 - math.sqrt(5))  # spreads points evenly over a disk
    if number < LAMP_RAYS:
        middle = np.array(scene.lamp) / np.linalg.norm(scene.lamp)
        side = np.cross(middle, (0.0, 0.0, 1.0))
        side /= np.linalg.norm(side)
        radius = LAMP_RADIUS * math.sqrt((number + 0.5) / LAMP_RAYS)
        angle = number * golden_angle
        offset = math.cos(angle) * side + math.sin(angle) * np.cross(middle, side)
        direction = middle + radius * offset
    else:
        sky_rays = GRID**2 - LAMP_RAYS
        angle = 2 * math.pi * (number - LAMP_RAYS + 0.3) / sky_rays
        # Half-way up; light from the camera's side reaches what the picture shows.
        direction = np.array([0.8 * math.cos(angle), -0.8, 0.6 * math.sin(angle) - 0.45])
    unit: Array = direction / np.linalg.norm(direction)
    return unit


def _sky(scene: Scene, rays: Array) -> Array:
    """[N, 3] linear colours of the sky along rays: from the horizon's to the zenith's."""
    up = (-rays[:, 1] / np.linalg.norm(rays, axis=1)).clip(0, 1)[:, None] ** 0.6
    zenith, horizon = (np.array(color) ** GAMMA for color in scene.sky)
    # A surface's light is at most 1 in all, and so is the sky's.
    colors: Array = up * zenith + (1 - up) * horizon
    return colors.astype(np.float32)


# --- the scenes


def still_life() -> Scene:
    """Books, a mug, a globe, pens, a bottle and a framed photo on a table before a brick wall."""
    scene = Scene("rendered still life", pitch=10, field_of_view=50, baseline=0.09)
    table = 0.36
    scene.add(SHEET, (0, 0, 2.35), (3, 2, 1), Look("bricks", (0.74, 0.50, 0.42), 3, 2), casts=False)
    scene.add(SHEET, (0, table, 1.4), (2.4, 0.95, 1), Look("wood", OAK, 2, 1), nod(90), casts=False)
    _framed_picture(scene, (0.58, -0.40, 2.31), 0.36, 0.28, Look("astronaut"), 0)
    _framed_picture(scene, (-0.62, -0.40, 2.31), 0.24, 0.32, Look("page"), 0)

    # A pile of books with a mug on it.
    height = table
    pile = (-0.34, 0, 1.42)
    for thick, angle, color in (
        (0.034, -9, RED),
        (0.026, 7, BLUE),
        (0.030, -3, OCHRE),
        (0.022, 12, TEAL),
    ):
        place = (pile[0], height - thick, pile[2])
        _book(scene, place, 0.20, thick, 0.14, color, turn(angle))
        height -= 2 * thick
    _mug(scene, (pile[0] - 0.02, height, pile[2]), 0.065, 0.15, WHITE)

    # A globe on its foot, in front of the pile's other side.
    globe = (0.36, table - 0.225, 1.33)
    scene.add(ELLIPSOID, globe, (0.17, 0.17, 0.17), Look("moon", WHITE, 2, 1), turn(30))
    scene.add(
        CYLINDER, (globe[0], table - 0.03, globe[2]), (0.02, 0.03, 0.02), Look("paint", OCHRE)
    )
    _plate(scene, (globe[0], table - 0.012, globe[2]), 0.09, OCHRE)

    # Thin things: pens in a cup, close to the camera.
    cup = np.array([-0.03, table, 1.05])
    scene.add(CYLINDER, cup - (0, 0.06, 0), (0.045, 0.06, 0.045), Look("stripes", TEAL, 2, 1))
    for number, color in enumerate((RED, OCHRE, BLUE, BLACK, WHITE)):
        axes = turn(72.0 * number + 20) @ lean(13)
        middle = cup + axes @ (0, -0.11, 0)
        scene.add(CYLINDER, middle, (0.006, 0.10, 0.006), Look("paint", color), axes)

    _bottle(scene, (0.78, table, 1.55), 0.075, 0.42, GREEN)
    _bottle(scene, (-0.86, table, 1.62), 0.09, 0.30, WALNUT)
    _framed_picture(scene, (0.05, table - 0.20, 1.86), 0.21, 0.20, Look("rocket"), 14)
    scene.add(BOX, (0.10, table - 0.05, 1.52), (0.13, 0.05, 0.08), Look("chelsea"), turn(-24))
    scene.add(ELLIPSOID, (-0.62, table - 0.055, 1.16), (0.055, 0.055, 0.055), Look("paint", RED))
    scene.add(ELLIPSOID, (-0.50, table - 0.05, 1.21), (0.05, 0.05, 0.05), Look("paint", OCHRE))
    return scene


def toy_truck() -> Scene:
    """A wooden toy truck with a load of blocks on a rug, before a sofa."""
    scene = Scene(
        "rendered toy truck", pitch=20, field_of_view=48, lamp=(0.6, -1.0, -0.5), baseline=0.06
    )
    floor = 0.46
    scene.add(
        SHEET, (0, floor, 1.6), (2.8, 1.6, 1), Look("wood", WALNUT, 2, 2), nod(90), casts=False
    )
    rug = Look("immunohistochemistry")
    scene.add(SHEET, (0, floor - 0.004, 1.32), (0.85, 0.55, 1), rug, turn(8) @ nod(90))
    # The sofa: seat, back and two cushions.
    scene.add(BOX, (0, floor - 0.16, 2.25), (1.5, 0.16, 0.3), Look("stripes", TEAL, 3, 1))
    scene.add(BOX, (0, floor - 0.5, 2.5), (1.5, 0.5, 0.12), Look("stripes", TEAL, 3, 1))
    scene.add(BOX, (-0.55, floor - 0.46, 2.3), (0.22, 0.17, 0.06), Look("coffee"), turn(9))
    scene.add(BOX, (0.60, floor - 0.46, 2.3), (0.22, 0.17, 0.06), Look("chelsea"), turn(-12))

    # The truck, which drives to the right and towards the camera.
    axes = turn(28)
    middle = np.array([-0.02, floor, 1.30])

    def part(
        kind: int,
        place: Sequence[float],
        size: Sequence[float],
        look: Look,
        own: Array | None = None,
    ) -> None:
        """Add a part of the truck, with place and rotation `own` in the truck's axes."""
        rotation = axes if own is None else axes @ own
        scene.add(kind, middle + axes @ np.array(place), size, look, rotation)

    part(BOX, (0, -0.09, 0), (0.33, 0.016, 0.11), Look("wood", OAK, 1, 0.5))
    part(BOX, (0.22, -0.20, 0), (0.09, 0.10, 0.11), Look("paint", RED))
    part(BOX, (0.22, -0.235, 0), (0.093, 0.04, 0.09), Look("paint", BLACK))
    part(BOX, (0.34, -0.14, 0), (0.045, 0.045, 0.10), Look("paint", RED))
    part(BOX, (-0.12, -0.15, 0.105), (0.21, 0.045, 0.008), Look("paint", OCHRE))
    part(BOX, (-0.12, -0.15, -0.105), (0.21, 0.045, 0.008), Look("paint", OCHRE))
    part(BOX, (-0.325, -0.15, 0), (0.008, 0.045, 0.105), Look("paint", OCHRE))
    for x in (-0.2, 0.24):
        for z in (-0.13, 0.13):
            # A wheel's axis is the truck's z: it is a tube turned by a quarter.
            part(CYLINDER, (x, -0.07, z), (0.07, 0.022, 0.07), Look("paint", BLACK), nod(90))
            for side in (-0.022, 0.022):
                part(SHEET, (x, -0.07, z + side), (0.07, 0.07, 1), Look("disk", GREY))
    loads = (
        ("astronaut", -0.24, -0.155, -0.03, 0), ("rocket", -0.12, -0.155, 0.03, 17),
        ("camera", 0.0, -0.155, -0.02, 34), ("text", -0.16, -0.255, 0.0, 51),
    )  # fmt: skip
    for name, x, y, z, angle in loads:
        part(BOX, (x, y, z), (0.05, 0.05, 0.05), Look(name, OCHRE), turn(angle))

    # What lies around: a ball, blocks, a book, and a rod that stands close to the camera.
    scene.add(ELLIPSOID, (0.50, floor - 0.09, 1.22), (0.09, 0.09, 0.09), Look("stripes", RED, 2, 1))
    scene.add(BOX, (-0.56, floor - 0.05, 1.52), (0.05, 0.05, 0.05), Look("paint", BLUE), turn(20))
    scene.add(BOX, (-0.45, floor - 0.05, 1.62), (0.05, 0.05, 0.05), Look("paint", OCHRE), turn(-8))
    scene.add(BOX, (-0.51, floor - 0.15, 1.57), (0.05, 0.05, 0.05), Look("paint", RED), turn(44))
    scene.add(CYLINDER, (-0.36, floor - 0.2, 1.0), (0.008, 0.2, 0.008), Look("paint", OCHRE))
    _book(scene, (0.30, floor - 0.02, 0.98), 0.11, 0.016, 0.08, GREEN, turn(35))
    return scene


def yard() -> Scene:
    """A brick house with a shed, a picket fence, trees and a bench on a lawn, under the sky."""
    scene = Scene(
        "rendered yard", pitch=4, field_of_view=62, lamp=(-0.7, -0.8, -0.6), baseline=0.35
    )
    ground = 1.55
    lawn = Look("grass", (0.34, 0.52, 0.20), 26, 26)
    scene.add(SHEET, (0, ground, 30), (60, 60, 1), lawn, nod(90), casts=False)
    path = Look("gravel", (0.74, 0.70, 0.64), 2, 9)
    scene.add(
        SHEET, (-0.9, ground - 0.01, 6.5), (0.75, 6, 1), path, turn(-4) @ nod(90), casts=False
    )

    # The house, with a pitched roof of two sheets, a door and windows.
    front, left, right = 9.0, -3.4, 1.6
    middle, half, tall = (left + right) / 2, (right - left) / 2, 1.45
    house = (middle, ground - tall, front + 2)
    scene.add(BOX, house, (half, tall, 2), Look("bricks", (0.72, 0.42, 0.32), 2, 2))
    for side in (-1, 1):
        place = (middle, ground - 2 * tall - 0.62, front + 2 + side * 1.1)
        roof = Look("tiles", (0.55, 0.25, 0.20), 3, 1.5)
        scene.add(SHEET, place, (half + 0.25, 1.5, 1), roof, nod(-side * 58))
    scene.add(BOX, (-1.25, ground - 0.98, front), (0.45, 0.98, 0.05), Look("wood", WALNUT))
    for x in (-2.6, 0.45):
        scene.add(BOX, (x, ground - 1.55, front), (0.52, 0.5, 0.04), Look("paint", WHITE))
        for pane in (-0.24, 0.24):
            glass = Look("paint", (0.16, 0.22, 0.28))
            scene.add(BOX, (x + pane, ground - 1.55, front - 0.02), (0.20, 0.42, 0.04), glass)

    fence = Look("fence", WHITE, 2, 1)
    scene.add(SHEET, (2.9, ground - 0.5, 6.0), (1.9, 0.5, 1), fence, turn(-9))
    scene.add(SHEET, (-4.6, ground - 0.5, 6.6), (1.6, 0.5, 1), fence, turn(16))
    _tree(scene, (2.1, ground, 4.3), 2.7, seed=0)
    _tree(scene, (-3.3, ground, 5.2), 3.0, seed=5)
    _tree(scene, (4.8, ground, 12.0), 5.0, seed=9)
    _tree(scene, (-6.4, ground, 14.0), 6.0, seed=13)

    # A bench near the path, a ball and a lamp post close to the camera.
    for height, deep in ((0.45, 0.0), (0.45, 0.16), (0.72, 0.27), (0.90, 0.30)):
        slat = (0.72, ground - height, 4.25 + deep)
        scene.add(BOX, slat, (0.62, 0.025, 0.055), Look("wood", OAK, 1, 0.25), turn(-14))
    for x in (-0.5, 0.5):
        foot = np.array((0.72, ground - 0.22, 4.4)) + turn(-14) @ (x, 0, 0)
        scene.add(BOX, foot, (0.03, 0.22, 0.16), Look("paint", BLACK), turn(-14))
    scene.add(CYLINDER, (-1.75, ground - 1.2, 3.6), (0.035, 1.2, 0.035), Look("paint", BLACK))
    scene.add(ELLIPSOID, (-1.75, ground - 2.45, 3.6), (0.14, 0.16, 0.14), Look("paint", CREAM))
    scene.add(
        ELLIPSOID, (0.05, ground - 0.2, 3.7), (0.2, 0.2, 0.2), Look("stripes", RED, 2, 1), lean(30)
    )
    return scene


def hall() -> Scene:
    """A hall with columns, pipes along the wall, crates and barrels, and posters."""
    scene = Scene(
        "rendered hall", pitch=5, field_of_view=60, lamp=(0.55, -0.9, -0.7), baseline=0.18
    )
    floor, ceiling, back = 1.35, -1.55, 6.2
    scene.add(
        SHEET,
        (0, floor, 4),
        (5, 6, 1),
        Look("tiles", (0.72, 0.70, 0.66), 2, 2),
        nod(90),
        casts=False,
    )
    beige = Look("plaster", CREAM, 2, 1)
    scene.add(
        SHEET, (0, -0.1, back), (5, 1.5, 1), Look("bricks", (0.66, 0.62, 0.60), 4, 1.4), casts=False
    )
    scene.add(SHEET, (-3.0, -0.1, 3), (4, 1.5, 1), beige, turn(90), casts=False)
    scene.add(SHEET, (0, ceiling, 4), (5, 6, 1), Look("plaster", WHITE, 2, 2), nod(90), casts=False)

    for x, z in ((-1.75, 4.3), (0.25, 4.5), (2.2, 4.0)):
        scene.add(CYLINDER, (x, -0.1, z), (0.17, 1.45, 0.17), Look("plaster", WHITE, 2, 1))
        scene.add(BOX, (x, floor - 0.09, z), (0.26, 0.09, 0.26), Look("paint", GREY))
        scene.add(BOX, (x, ceiling + 0.09, z), (0.26, 0.09, 0.26), Look("paint", GREY))
    for y, radius, color in ((-1.05, 0.09, RED), (-0.80, 0.06, BLUE), (-0.62, 0.05, OCHRE)):
        scene.add(
            CYLINDER, (0, y, back - 0.25), (radius, 4.5, radius), Look("paint", color), lean(90)
        )
    scene.add(CYLINDER, (1.15, 0.2, back - 0.25), (0.07, 1.2, 0.07), Look("paint", RED))

    _framed_picture(scene, (-0.85, 0.1, back - 0.02), 0.52, 0.52, Look("astronaut"), 0)
    _framed_picture(scene, (2.3, 0.15, back - 0.02), 0.6, 0.42, Look("rocket"), 0)

    # Crates in a pile, barrels, and a ladder that leans on a column.
    for x, y, z, size, angle in (
        (-1.05, 0, 3.1, 0.34, 18), (-0.42, 0, 3.45, 0.30, -12), (-0.85, 0.66, 3.2, 0.24, 38),
        (2.75, 0, 4.9, 0.38, 20),
    ):  # fmt: skip
        place = (x, floor - y - size, z)
        scene.add(BOX, place, (size, size, size), Look("wood", OAK, 1, 1), turn(angle))
    for x, z, color in ((1.05, 3.2, TEAL), (1.62, 3.45, RED)):
        scene.add(CYLINDER, (x, floor - 0.42, z), (0.25, 0.42, 0.25), Look("paint", color))
        _plate(scene, (x, floor - 0.842, z), 0.25, color)
        for height in (0.22, 0.62):
            ring = (x, floor - height, z)
            scene.add(CYLINDER, ring, (0.26, 0.015, 0.26), Look("paint", BLACK))
    _ladder(scene, (0.42, floor, 4.05), 2.3, 0.22)
    scene.add(ELLIPSOID, (0.15, floor - 0.14, 2.7), (0.14, 0.14, 0.14), Look("coins", OCHRE, 2, 1))
    return scene


def fern() -> Scene:
    """A fern in a pot on a stool, in front of shelves with books and a picture."""
    rng = np.random.default_rng(40)
    scene = Scene(
        "rendered fern", pitch=7, field_of_view=55, lamp=(-0.75, -0.8, -0.6), baseline=0.10
    )
    back = 3.0
    scene.add(
        SHEET, (0, 0, back), (3, 2, 1), Look("plaster", (0.82, 0.86, 0.84), 2, 1), casts=False
    )
    scene.add(SHEET, (0, 1.05, 2), (3, 2, 1), Look("wood", WALNUT, 2, 2), nod(90), casts=False)
    _framed_picture(scene, (-0.86, -0.42, back - 0.02), 0.40, 0.40, Look("astronaut"), 0)

    # Shelves on the right: two boards with books that stand on them.
    colors = (RED, BLUE, OCHRE, TEAL, GREEN, CREAM, BLACK)
    for level, height in enumerate((0.55, 0.02, -0.52)):
        board = (0.95, height, back - 0.18)
        scene.add(BOX, board, (0.75, 0.015, 0.18), Look("wood", OAK, 2, 0.3))
        x = 0.28
        while x < 1.5:
            thick, tall = rng.uniform(0.018, 0.045), rng.uniform(0.12, 0.19)
            place = (x + thick, height - 0.015 - tall, back - 0.16)
            color = colors[int(rng.integers(len(colors)))]
            tilt = lean(rng.choice((0, 0, 0, 6)))
            scene.add(BOX, place, (thick, tall, 0.11), Look("cover", color), tilt)
            x += 2.1 * thick
            if rng.random() < 0.10:
                x += 0.16
        if level == 1:
            scene.add(ELLIPSOID, (1.58, height - 0.1, back - 0.2), (0.09, 0.09, 0.09), Look("moon"))

    # The stool and the pot.
    pot = np.array([-0.16, 0.55, 1.55])
    for x, z in ((-0.17, -0.17), (0.17, -0.17), (-0.17, 0.17), (0.17, 0.17)):
        leg = (pot[0] + x, 0.8, pot[2] + z)
        scene.add(CYLINDER, leg, (0.015, 0.25, 0.015), Look("wood", OAK))
    scene.add(
        BOX, (pot[0], 0.565, pot[2]), (0.21, 0.015, 0.21), Look("wood", OAK, 1, 0.5), turn(12)
    )
    scene.add(CYLINDER, pot - (0, 0.11, 0), (0.12, 0.11, 0.12), Look("paint", (0.70, 0.36, 0.22)))
    scene.add(
        CYLINDER, pot - (0, 0.205, 0), (0.133, 0.022, 0.133), Look("paint", (0.74, 0.40, 0.26))
    )
    _plate(scene, pot - (0, 0.215, 0), 0.125, (0.20, 0.14, 0.10))
    for number in range(10):
        _frond(scene, pot - (0, 0.2, 0), 36.0 * number + rng.uniform(-8, 8), rng)
    _mug(scene, (0.46, 0.55, 1.75), 0.05, 0.11, RED)
    scene.add(BOX, (0.46, 0.565, 1.75), (0.16, 0.015, 0.16), Look("wood", WALNUT), turn(20))
    scene.add(CYLINDER, (0.46, 0.82, 1.75), (0.02, 0.24, 0.02), Look("paint", BLACK))
    return scene


SCENES: dict[str, Callable[[], Scene]] = {
    "still_life": still_life,
    "toy_truck": toy_truck,
    "yard": yard,
    "hall": hall,
    "fern": fern,
}


# --- things


def _framed_picture(
    scene: Scene,
    center: Triple,
    half_width: float,
    half_height: float,
    look: Look,
    yaw: float,
) -> None:
    """Add a picture in a wooden frame; it leans back a little if it is turned."""
    axes = turn(yaw) @ nod(0 if yaw == 0 else -8)
    frame = (half_width + 0.02, half_height + 0.02, 0.012)
    scene.add(BOX, center, frame, Look("wood", WALNUT, 1, 0.2), axes)
    in_front = np.asarray(center) + axes @ (0, 0, -0.014)
    picture = dataclasses.replace(look, aspect=half_width / half_height)
    scene.add(SHEET, in_front, (half_width, half_height, 1), picture, axes, casts=False)


def _plate(scene: Scene, center: Triple, radius: float, color: Color) -> None:
    """Add a level disk."""
    scene.add(SHEET, center, (radius, radius, 1), Look("disk", color), nod(90))


def _book(
    scene: Scene, center: Triple, half_width: float, half_thick: float, half_deep: float,
    color: Color, axes: Array,
) -> None:  # fmt: skip
    """Add a book that lies flat: its cover on top, and its pages at the sides."""
    inside = (half_width - 0.006, half_thick - 0.004, half_deep - 0.006)
    scene.add(BOX, center, inside, Look("pages", CREAM, 1, 1), axes)
    for side in (-1, 1):
        place = np.add(center, (0, side * (half_thick - 0.003), 0))
        scene.add(BOX, place, (half_width, 0.003, half_deep), Look("cover", color), axes)


def _mug(scene: Scene, foot: Triple, radius: float, height: float, color: Color) -> None:
    """Add a mug of coffee with a handle on its right."""
    x, y, z = foot
    scene.add(CYLINDER, (x, y - height / 2, z), (radius, height / 2, radius), Look("paint", color))
    _plate(scene, (x, y - 0.93 * height, z), 0.97 * radius, (0.20, 0.10, 0.05))
    for part in range(7):
        angle = -60 + 20 * part
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        ring = 0.32 * height
        place = (x + radius * 0.9 + ring * c, y - height / 2 + ring * s, z)
        piece = (0.011, 0.19 * ring, 0.011)
        scene.add(CYLINDER, place, piece, Look("paint", color), lean(angle))


def _bottle(scene: Scene, foot: Triple, radius: float, height: float, color: Color) -> None:
    """Add a bottle: body, shoulder, neck and label."""
    x, y, z = foot
    body = 0.31 * height
    look = Look("paint", color)
    scene.add(CYLINDER, (x, y - body, z), (radius, body, radius), look)
    scene.add(ELLIPSOID, (x, y - 2 * body, z), (radius, 0.16 * height, radius), look)
    scene.add(
        CYLINDER, (x, y - 0.85 * height, z), (0.3 * radius, 0.15 * height, 0.3 * radius), look
    )
    label = (1.01 * radius, 0.5 * body, 1.01 * radius)
    scene.add(CYLINDER, (x, y - body, z), label, Look("text", CREAM, 2, 1))


def _tree(scene: Scene, foot: Triple, height: float, seed: int) -> None:
    """Add a tree: a trunk, two branches, and a crown of leaves with gaps."""
    rng = np.random.default_rng(seed)
    base = np.asarray(foot)
    thick = 0.035 * height
    bark = Look("gravel", (0.40, 0.30, 0.22), 1, 2)
    scene.add(CYLINDER, base - (0, 0.36 * height, 0), (thick, 0.36 * height, thick), bark)
    for side in (-1, 1):
        axes = lean(side * 34)
        middle = base - (0, 0.62 * height, 0) + axes @ (0, -0.16 * height, 0)
        scene.add(CYLINDER, middle, (0.45 * thick, 0.16 * height, 0.45 * thick), bark, axes)
    for number in range(9):
        place = base - (0, 0.86 * height, 0) + rng.normal(0, 0.13, 3) * height
        size = height * rng.uniform(0.18, 0.30)
        green = GREENS[int(rng.integers(len(GREENS)))]
        axes = turn(rng.uniform(-50, 50)) @ nod(rng.uniform(-30, 30)) @ lean(40.0 * number)
        scene.add(SHEET, place, (size, size, 1), Look("foliage", green), axes)


def _ladder(scene: Scene, foot: Triple, length: float, half_width: float) -> None:
    """Add a ladder that leans backwards."""
    axes = turn(10) @ nod(-13)
    base = np.asarray(foot)
    for side in (-1, 1):
        rail = base + axes @ (side * half_width, -length / 2, 0)
        scene.add(BOX, rail, (0.022, length / 2, 0.03), Look("wood", OAK, 1, 0.1), axes)
    steps = 8
    for number in range(steps):
        step = base + axes @ (0, -length * (number + 0.5) / steps, 0)
        scene.add(BOX, step, (half_width, 0.014, 0.025), Look("wood", OAK, 1, 0.1), axes)


def _frond(scene: Scene, root: Array, yaw: float, rng: np.random.Generator) -> None:
    """Add a frond of a fern: an arching stem with pairs of leaves that become smaller."""
    length = rng.uniform(0.42, 0.62)
    rise = rng.uniform(50, 78)  # the angle at the root, in degrees above the horizontal
    place = np.asarray(root, float)
    pieces = 6
    for number in range(pieces):
        share = number / pieces
        # The stem bends down along its way.
        axes = turn(yaw) @ lean(90 - rise + 95 * share**1.4)
        step = axes @ (0, -length / pieces, 0)
        middle = place + step / 2
        stem = Look("paint", (0.25, 0.34, 0.12))
        scene.add(CYLINDER, middle, (0.004, 0.55 * length / pieces, 0.004), stem, axes)
        size = 0.135 * math.sin(math.pi * (0.18 + 0.80 * share))
        green = GREENS[int(rng.integers(len(GREENS)))]
        for side in (-1, 1):
            blade = axes @ nod(side * 62.0)
            center = middle + blade @ (0, -size, 0)
            scene.add(SHEET, center, (0.36 * size, size, 1), Look("leaf", green), blade @ turn(90))
        place = place + step


def main() -> None:
    """Write each scene's picture and depth as PNG, to look at."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True, help="a folder")
    parser.add_argument("--width", type=int, default=640, help="of the pictures, in pixels")
    words = parser.parse_args()
    make_folder(words.output)
    for name, make in SCENES.items():
        scene = make()
        rgb, depth = render(scene, words.width, words.width * 3 // 4)
        Image.fromarray(rgb).save(words.output / f"{name}.png")
        near = depth.min() / depth  # 1 is nearest, 0 the sky
        Image.fromarray((255 * near).astype(np.uint8)).save(words.output / f"{name}.depth.png")


if __name__ == "__main__":
    sys.exit(run_script(main))
