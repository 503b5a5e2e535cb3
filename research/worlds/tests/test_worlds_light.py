"""Rays and light, compared with formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
from made_models import lights

pytest.importorskip("embreex", reason="needs research/worlds/requirements.txt")

from worlds.caster import World
from worlds.irradiance import hemisphere, solve, sun_on, tangents
from worlds.lights import Lights
from worlds.meshes import Material, box, joined, quad
from worlds.pictures import linear_to_srgb, pyramids, srgb_to_linear

pytestmark = pytest.mark.slow
UP = np.array([[0.0, 0.0, 1.0]], np.float32)
FLOOR = quad((-5, -5, 0), (10, 0, 0), (0, 10, 0), Material((0.5, 0.5, 0.5)))


def light_on_floor(world: World, light: Lights, x: float = 0.0) -> np.ndarray:
    """[3] irradiance on the floor near (x, 0)."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (400, 3)).astype(np.float32)
    points[:, 0] += x
    points[:, 2] = 0
    normals = np.repeat(UP, len(points), 0)
    eye = np.array([0, 0, 1.5], np.float32)
    found = solve(world, light, rng, points, normals, eye, 100.0, 0.25)
    return found.at(points, normals).mean(0)


def test_rays_meet_surfaces_at_exact_distances() -> None:
    world = World(joined([FLOOR, box((-1, -1, 0), (1, 1, 2), Material())]), {})
    origins = np.array([[0, 0, 5], [3, 0, 5], [0, -4, 1], [9, 0, 5]], np.float32)
    directions = np.array([[0, 0, -1], [0, 0, -2], [0, 1, 0], [0, 0, -1]], np.float32)
    hits = world.first_hits(origins, directions)
    np.testing.assert_allclose(hits.distance, [3, 2.5, 3, np.inf], rtol=1e-5)
    smooth, flat = world.normals(hits, directions)
    np.testing.assert_allclose(flat[:3], [[0, 0, 1], [0, 0, 1], [0, -1, 0]], atol=1e-6)
    np.testing.assert_allclose(smooth, flat, atol=1e-6)


def test_rays_pass_holes_of_a_leaf_and_panes_of_glass() -> None:
    leaf = np.full((64, 64, 4), 255, np.uint8)
    leaf[:, :32, 3] = 0
    skin = Material((1, 1, 1), "leaf")
    pane = Material((1, 1, 1), opacity=0.2)
    sheets = [
        FLOOR,
        quad((-1, -1, 1), (2, 0, 0), (0, 2, 0), skin),
        quad((2, -1, 1), (2, 0, 0), (0, 2, 0), pane),
    ]
    world = World(joined(sheets), {"leaf": leaf})
    origins = np.array([[-0.5, 0, 2], [0.5, 0, 2], [3, 0, 2]], np.float32)
    down = np.repeat(-UP, 3, 0)
    hits = world.first_hits(origins, down)
    np.testing.assert_allclose(hits.distance, [2, 1, 2], rtol=1e-5)
    np.testing.assert_array_equal(hits.transmittance < 1, [False, False, True])
    blocked = world.blocked(origins, down, np.full(3, 1.9, np.float32))
    np.testing.assert_array_equal(blocked, [False, True, False])


def test_an_open_floor_gets_pi_from_a_white_sky_and_a_wall_takes_half() -> None:
    assert light_on_floor(World(FLOOR, {}), lights()) == pytest.approx(math.pi, rel=0.03)
    wall = quad((0.0, -500, -1), (0, 1000, 0), (0, 0, 500), Material((0.0, 0.0, 0.0)))
    world = World(joined([FLOOR, wall]), {})
    halved = light_on_floor(world, lights(), x=-0.35)
    assert halved == pytest.approx(math.pi / 2, rel=0.1)


def test_a_window_lights_as_its_form_factor_says() -> None:
    # A square window of side 2 a in the ceiling, at the height h above a point of the floor. The
    # form factor of each quarter has its corner above the point.
    half = 2.0
    height = 1.5  # low, so that the cosine at the window counts
    portal = np.array([[[-half, half, height], [2 * half, 0, 0], [0, -2 * half, 0]]], np.float32)
    x = half / height
    root = math.sqrt(1 + x * x)
    quarter = 2 * x / root * math.atan(x / root) / (2 * math.pi)
    dark = quad((-5, -5, 0), (10, 0, 0), (0, 10, 0), Material((0.0, 0.0, 0.0)))
    found = light_on_floor(World(dark, {}), lights(portals=portal))
    assert found == pytest.approx(math.pi * 4 * quarter, rel=0.05)


def test_a_lamp_falls_off_with_the_square_and_a_board_shades_it() -> None:
    lamp = {
        "portals": np.array([[[90, 90, 9], [1, 0, 0], [0, 1, 0]]], np.float32),  # far: no sky
        "lamp_positions": np.array([[0, 0, 2]], np.float32),
        "lamp_radii": np.array([0.02], np.float32),
        "lamp_colors": np.array([[4, 2, 1]], np.float32),
    }
    dark = quad((-5, -5, 0), (10, 0, 0), (0, 10, 0), Material((0.0, 0.0, 0.0)))
    found = light_on_floor(World(dark, {}), lights(**lamp))
    np.testing.assert_allclose(found, np.array([4, 2, 1]) / 4, rtol=0.06)
    board = quad((-1, -1, 1), (2, 0, 0), (0, 2, 0), Material((0.0, 0.0, 0.0)))
    shaded = light_on_floor(World(joined([dark, board]), {}), lights(**lamp))
    assert shaded.max() < 0.01


def test_walls_of_a_closed_room_light_each_other() -> None:
    # Light that walls of albedo a give back adds up to a geometric series: with the lamp's mean
    # irradiance E, all walls together have E / (1 - a).
    albedo = 0.5
    grey = float(linear_to_srgb(np.array([albedo]))[0])
    room = box((-1, -1, 0), (1, 1, 2), Material((grey, grey, grey)))
    world = World(room, {})
    lamp = {
        "portals": np.array([[[90, 90, 9], [1, 0, 0], [0, 1, 0]]], np.float32),
        "lamp_positions": np.array([[0, 0, 1]], np.float32),
        "lamp_radii": np.array([0.02], np.float32),
        "lamp_colors": np.array([[1, 1, 1]], np.float32),
    }
    rng = np.random.default_rng(0)
    origins = np.repeat(np.array([[0, 0, 1.0]], np.float32), 4000, 0)
    around = rng.standard_normal((4000, 3)).astype(np.float32)
    hits = world.first_hits(origins, around)
    normals, _ = world.normals(hits, around)
    points = (origins + hits.distance[:, None] * around).astype(np.float32)
    found = solve(world, lights(**lamp), rng, points, normals, origins[0], 100.0, 0.25)
    # By area: each ray stands for r² / cosine of the wall.
    lengths = hits.distance * np.linalg.norm(around, axis=1)
    unit = around / np.linalg.norm(around, axis=1, keepdims=True)
    area = lengths**2 / np.abs((unit * normals).sum(1))
    mean = np.average(found.at(points, normals)[:, 0], weights=area)
    emitted = 4 * math.pi / 24  # 4 π units of light fall on 24 m²
    assert mean == pytest.approx(emitted / (1 - albedo), rel=0.08)


def test_sunlight_counts_by_its_cosine_and_not_in_shadow() -> None:
    world = World(joined([FLOOR, box((1, -1, 0), (2, 1, 3), Material())]), {})
    sun = np.array([math.sin(0.6), 0, math.cos(0.6)], np.float32)
    points = np.array([[-4, 0, 0.001], [0.5, 0, 0.001]], np.float32)
    np.testing.assert_allclose(
        sun_on(world, sun, points, np.repeat(UP, 2, 0)), [math.cos(0.6), 0], atol=1e-5
    )


def test_gathering_rays_are_as_dense_as_their_cosine() -> None:
    rng = np.random.default_rng(1)
    normals = rng.standard_normal((200, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    rays = hemisphere(rng, normals, 32)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-5)
    cosines = (rays * normals[:, None]).sum(-1)
    assert cosines.min() >= -1e-5
    assert cosines.mean() == pytest.approx(2 / 3, abs=0.01)
    first, second = tangents(normals)
    np.testing.assert_allclose((first * second).sum(1), 0, atol=1e-5)


def test_textures_are_averaged_as_light_where_they_are_small() -> None:
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 255
    made = pyramids([stripes])
    assert made.mean[0] == pytest.approx([0.5] * 3, abs=0.01)
    world = World(quad((0, 0, 0), (1, 0, 0), (0, 1, 0), Material((1, 1, 1), "s")), {"s": stripes})
    origins = np.array([[0.3, 0.4, 1]], np.float32)
    hits = world.first_hits(origins, -UP)
    far = world.albedo(hits, np.array([0.5], np.float32))
    np.testing.assert_allclose(far, 0.5, atol=0.02)
    values = np.linspace(0, 1, 50, dtype=np.float32)
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(values)), values, atol=1e-5)
