"""AC3D files, the second set of models, and worlds in the open, from models made on the spot."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from made_models import MadeModel, lights, write_catalogue
from PIL import Image

pytest.importorskip("embreex", reason="needs research/worlds/requirements.txt")

from worlds import outdoor_surfaces, surfaces, views
from worlds.ac3d_files import read_ac3d
from worlds.caster import World
from worlds.gardens import garden
from worlds.houses import Hole, choose_style, holed_wall, house, leafy, pole
from worlds.library import Library
from worlds.make import PackedWorld, make_shards, make_world
from worlds.meshes import Faces, Material, Mesh, box, face_normals, joined, quad
from worlds.outdoors import Scene, repainted, thinned
from worlds.plans import WorldPlan
from worlds.shards import read_view, world_facts, world_keys, write_shard
from worlds.streets import street
from worlds.torcs import COPYRIGHT, FREE_ART, GAME, GPL, convert
from worlds.tracks import fine_picture, road_triangles, track
from worlds.viewpoints import Viewpoint, camera_axes

from spackle.core.camera import Camera
from spackle.runtime.errors import InputError

pytestmark = pytest.mark.slow
SIZE = (48, 64)
SQUARE = """AC3Db
MATERIAL "grey" rgb 0.4 0.5 0.6 amb 0.2 0.2 0.2 emis 0 0 0 spec 0.5 0.5 0.5 shi 10 trans 0
OBJECT world
kids 1
OBJECT poly
name "a square"
texture "paint 1.png"
texrep 2 3
{place}numvert 4
0 0 0
2 0 0
2 0 -2
0 0 -2
numsurf 1
SURF 0x20
mat 0
refs 4
0 0 0
1 1 0
2 1 1
3 0 1
kids 0
"""


def area(mesh: Mesh) -> float:
    """The area of all triangles."""
    return float(np.linalg.norm(face_normals(mesh.corners), axis=1).sum()) / 2


def test_a_polygon_lies_with_z_up_and_has_material_picture_and_repeats() -> None:
    mesh = read_ac3d(SQUARE.format(place=""))
    assert area(mesh) == pytest.approx(4)
    np.testing.assert_allclose(mesh.low, [0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(mesh.high, [2, 2, 0], atol=1e-6)  # the file's −z is y
    np.testing.assert_allclose(mesh.normals.reshape(-1, 3), np.tile([0, 0, 1], (6, 1)), atol=1e-6)
    assert mesh.uv.reshape(-1, 2).max(0).tolist() == [2, 3]
    assert mesh.materials[0].texture == "paint 1.png"
    assert mesh.materials[0].color == (0.4, 0.5, 0.6)


def test_objects_are_turned_and_shifted_with_those_above_them() -> None:
    # A quarter turn about y: the file writes matrices for points as rows, (x, y, z) M.
    turn = "rot 0 0 -1 0 1 0 1 0 0\n"
    mesh = read_ac3d(SQUARE.format(place=turn + "loc 10 1 0\ndata 3\nx\ny\n"))
    # (2, 0, 0) M = (0, 0, −2) and (0, 0, −2) M = (−2, 0, 0); then z up: y = −z.
    np.testing.assert_allclose(mesh.low, [8, 0, 1], atol=1e-6)
    np.testing.assert_allclose(mesh.high, [10, 2, 1], atol=1e-6)


def test_strips_become_triangles_that_look_the_same_way() -> None:
    text = """AC3Db
MATERIAL "" rgb 1 1 1 amb 0 0 0 emis 0 0 0 spec 0 0 0 shi 0 trans 0.5
OBJECT world
kids 7
OBJECT poly
texture "ground.png" base
texture "shadow.png" shad
texture empty_texture_no_mapping skids
numvert 6
0 0 0 0 1 0
0 0 -1 0 1 0
1 0 0 0 1 0
1 0 -1 0 1 0
2 0 0 0 1 0
2 0 -1 0 1 0
numsurf 2
SURF 0x34
mat 0
refs 6
1 0 1 0 0
0 0 0 0 0
3 1 1 0 0
2 1 0 0 0
5 2 1 0 0
4 2 0 0 0
SURF 0x22
mat 0
refs 2
0 0 0
1 0 0
kids 0
"""
    mesh = read_ac3d(text)
    assert mesh.materials[0].texture == "ground.png"
    assert mesh.materials[0].opacity == 0.5
    assert mesh.count == 4
    strip = face_normals(mesh.corners)
    assert area(mesh) == pytest.approx(2)
    assert (strip[:, 2] > 0).all()
    assert (mesh.normals[..., 2] > 0.99).all()


def test_files_that_are_no_models_are_told_with_the_line() -> None:
    with pytest.raises(ValueError, match="does not begin with AC3D"):
        read_ac3d("v 0 0 0")
    with pytest.raises(ValueError, match="no triangles"):
        read_ac3d("AC3Db\n")
    broken = SQUARE.format(place="").replace("refs 4", "refs 9")
    with pytest.raises(ValueError, match=r"line \d+: expected 9 lines"):
        read_ac3d(broken)
    with pytest.raises(ValueError, match="material 4 does not exist"):
        read_ac3d(SQUARE.format(place="").replace("mat 0", "mat 4"))
    with pytest.raises(ValueError, match="ends inside an object"):
        read_ac3d(SQUARE.format(place="").split("kids 0")[0])


TERMS = """Files: *
License: GPL-2+

Files: data/cars/models/car1-trb1/*
       data/tracks/road/loop/*
License: Free-Art-License
"""


def write_package(root: Path) -> None:
    """Write a package as Debian's, with a track of grass and road, and a car on wheels."""
    game = root / GAME
    terms = root / COPYRIGHT
    terms.parent.mkdir(parents=True)
    terms.write_text(TERMS, encoding="utf-8")
    road = game / "tracks" / "road" / "loop"
    road.mkdir(parents=True)
    ground = SQUARE.format(place="").replace("paint 1.png", "grass.png")
    ground = ground.replace("2 0", "400 0").replace("-2", "-400")
    lane = SQUARE.format(place="loc 190 0.02 0\n").replace("paint 1.png", "asphalt.rgb")
    lane = lane.replace("2 0 0\n2 0 -2\n0 0 -2", "9 0 0\n9 0 -400\n0 0 -400")
    wall = SQUARE.format(place="loc 204 0 0\n").replace("paint 1.png", "nowhere.rgb")
    wall = wall.replace("2 0 0\n2 0 -2\n0 0 -2", "0 3 0\n0 3 -400\n0 0 -400")
    bodies = [one.split("kids 1\n")[1] for one in (lane, wall)]
    (road / "loop.acc").write_text(ground + "".join(bodies), encoding="latin1")
    (road / "readme.txt").write_bytes("Copyright \xa9 2005 A. Müller\n".encode("latin1"))
    Image.new("RGB", (16, 16), (60, 90, 40)).save(road / "grass.png")
    Image.new("RGB", (16, 16), (90, 90, 90)).save(game / "asphalt.rgb", "SGI")
    (game / "data" / "textures").mkdir(parents=True)
    (game / "asphalt.rgb").rename(game / "data" / "textures" / "asphalt.rgb")
    for name in ("car1-trb1", "car2-trb1"):
        car = game / "cars" / name
        car.mkdir(parents=True)
        body = SQUARE.format(place="loc -1 0.5 1\n").replace("paint 1.png", "paint.png")
        (car / f"{name}.acc").write_text(body, encoding="latin1")
        Image.new("RGB", (8, 8), (200, 0, 0)).save(car / "paint.png")
        sections = [f'<section name="{end} Axle"><attnum name="xpos" max="9" val="{x}"/></section>'
                    for end, x in (("Front", 1.2), ("Rear", -1.3))]  # fmt: skip
        for end in ("Front", "Rear"):
            for side, y in (("Right", -0.8), ("Left", 0.8)):
                facts = {"ypos": y, "tire width": 200, "rim diameter": 20,
                         "tire height-width ratio": 0.5}  # fmt: skip
                words = "".join(f'<attnum name="{key}" val="{v}"/>' for key, v in facts.items())
                sections.append(f'<section name="{end} {side} Wheel">{words}</section>')
        (car / f"{name}.xml").write_text("".join(sections), encoding="latin1")
    wheel = game / "wheels" / "trb1-1"
    wheel.mkdir(parents=True)
    tyre = SQUARE.format(place="loc -0.5 0 0.5\n").replace("paint 1.png", "tyre.png")
    tyre = tyre.replace("2 0 0\n2 0 -2\n0 0 -2", "1 0.5 0\n1 -0.5 -1\n0 0.5 -1")
    (wheel / "wheel0.acc").write_text(tyre, encoding="latin1")
    Image.new("RGB", (8, 8), (20, 20, 20)).save(wheel / "tyre.png")


@pytest.fixture(scope="module")
def torcs(tmp_path_factory: pytest.TempPathFactory) -> Library:
    """The library of a small package."""
    folder = tmp_path_factory.mktemp("torcs")
    write_package(folder / "root")
    return convert(folder / "root", folder / "library", print)


def test_the_second_set_has_licences_authors_and_pictures(torcs: Library, tmp_path: Path) -> None:
    entries = {model.entry.name: model.entry for model in torcs.models}
    assert {name: one.licence for name, one in entries.items()} == {
        "loop": f"{FREE_ART}; its common pictures: {GPL}",
        "car1-trb1": FREE_ART,
        "car2-trb1": GPL,
    }
    assert entries["loop"].creator == "Copyright © 2005 A. Müller"
    assert "Espié" in entries["car1-trb1"].creator
    mesh = torcs.mesh(torcs.models[0])
    pictures = [one.texture for one in mesh.materials]
    assert [picture is None for picture in pictures] == [False, False, True]  # one is missing
    assert all(Path(picture).is_file() for picture in pictures if picture is not None)
    (tmp_path / COPYRIGHT).parent.mkdir(parents=True)
    (tmp_path / COPYRIGHT).write_text("")
    with pytest.raises(InputError, match="no track or car"):
        convert(tmp_path, tmp_path / "library", print)


def test_a_car_stands_on_four_wheels_and_looks_forward(torcs: Library) -> None:
    mesh = torcs.mesh(next(one for one in torcs.models if one.entry.name == "car1-trb1"))
    # A rim of 20 inches with tyres of half of 20 cm: 0.708 m. Front axle at 1.2 m, towards −y.
    diameter = 20 * 0.0254 + 0.2
    tyres = mesh.corners[mesh.material > 0].reshape(-1, 3)
    assert tyres[:, 2].min() == pytest.approx(0, abs=1e-6)
    assert tyres[:, 2].max() == pytest.approx(diameter)
    assert tyres[:, 1].min() == pytest.approx(-1.2 - diameter / 2)
    assert tyres[:, 1].max() == pytest.approx(1.3 + diameter / 2)
    assert tyres[:, 0].max() == pytest.approx(0.8 + 0.1)


def test_faces_are_those_of_boxes_and_parallelograms() -> None:
    red, blue = Material((1, 0, 0)), Material((0, 0, 1))
    faces = Faces()
    faces.box((0, 1, 2), (3, 5, 8), red, 0.5)
    faces.quad((1, 1, 1), (2, 0, 1), (0, 3, 0), blue, 0.7, (0.1, 0.2))
    made = faces.mesh()
    known = joined(
        [
            box((0, 1, 2), (3, 5, 8), red, (0.5, 0.5)),
            quad((1, 1, 1), (2, 0, 1), (0, 3, 0), blue, (0.7, 0.7), (0.1, 0.2)),
        ]
    )
    assert made.materials == known.materials
    for name in ("corners", "normals", "uv", "material"):
        np.testing.assert_allclose(getattr(made, name), getattr(known, name), atol=1e-6)


def test_a_wall_has_the_area_that_its_holes_leave_and_is_open_there() -> None:
    holes = [
        Hole(1.0, 2.0, 1.0, 2.2, "window"),
        Hole(1.5, 2.5, 3.8, 5.0, "window"),
        Hole(4.0, 5.0, 0.0, 2.0, "door"),
    ]
    faces = Faces()
    holed_wall(faces, 6.0, 0.0, 6.0, holes, Material(), 1.0)
    mesh = faces.mesh()
    assert area(mesh) == pytest.approx(36 - 1.2 - 1.2 - 2.0)
    world = World(mesh, {})
    rng = np.random.default_rng(0)
    x, z = rng.uniform(0.01, 5.99, (2, 500))
    origins = np.stack([x, np.full(500, -1.0), z], 1).astype(np.float32)
    forward = np.tile(np.array([[0, 1, 0]], np.float32), (500, 1))
    met = world.first_hits(origins, forward).triangle >= 0
    inside = np.zeros(500, bool)
    for one in holes:
        inside |= (x > one.left) & (x < one.right) & (z > one.low) & (z < one.high)
    np.testing.assert_array_equal(met, ~inside)


def test_a_pole_has_the_area_and_the_normals_of_its_prism() -> None:
    mesh = pole((0, 0, 0), (0, 0, 2), 0.1, Material(), 8)
    assert area(mesh) == pytest.approx(8 * 2 * 0.1 * math.sin(math.pi / 8) * 2, rel=1e-5)
    points = mesh.corners[..., :2]
    np.testing.assert_allclose(mesh.normals[..., :2], points / 0.1, atol=1e-5)


def test_thinned_leaves_cover_as_much_and_trunks_stay() -> None:
    rng = np.random.default_rng(0)
    leaves = rng.uniform(0, 5, (8000, 1, 3)) + rng.normal(0, 0.02, (8000, 3, 3))
    trunk = box((0, 0, 0), (1, 1, 4), Material())
    crown = Mesh(
        leaves.astype(np.float32), np.zeros((8000, 3, 3), np.float32),
        np.zeros((8000, 3, 2), np.float32), np.zeros(8000, np.int32), (Material((0, 1, 0)),),
    )  # fmt: skip
    thin = thinned(joined([trunk, crown]), 0.25, 1)
    assert thin.count == pytest.approx(12 + 2000, rel=0.1)
    assert area(thin) - area(trunk) == pytest.approx(area(crown), rel=0.1)
    np.testing.assert_array_equal(thin.corners[:12], trunk.corners)


def test_a_painted_car_keeps_its_glass_and_tyres() -> None:
    body = box((0, 0, 0), (4, 2, 1), Material((0.5, 0.1, 0.1)))
    glass = box((0, 0, 1), (1, 1, 2), Material((0.5, 0.5, 0.5), opacity=0.3))
    tyre = box((0, 0, -1), (0.5, 0.5, 0), Material((0.05, 0.05, 0.05)))
    car = joined([body, glass, tyre])
    painted = repainted(np.random.default_rng(3), car)
    assert painted.materials[0] != car.materials[0]
    assert painted.materials[1:] == car.materials[1:]


def test_a_hedge_stays_in_its_box_and_hides_what_is_behind() -> None:
    rng = np.random.default_rng(0)
    mesh = leafy(rng, np.zeros(3), np.array([2.0, 0.5, 1.0]), 4000, (0.2, 0.3, 0.1))
    assert mesh.low.min() > -0.25
    assert (mesh.high < np.array([2.0, 0.5, 1.0]) + 0.25).all()
    world = World(mesh, {})
    x, z = rng.uniform([0.1, 0.1], [1.9, 0.9], (200, 2)).T
    origins = np.stack([x, np.full(200, -2.0), z], 1).astype(np.float32)
    hits = world.first_hits(origins, np.tile(np.array([[0, 1, 0]], np.float32), (200, 1)))
    assert (hits.triangle >= 0).all()


def looking(eye: tuple[float, float, float]) -> Viewpoint:
    """A camera that looks along y."""
    axes = camera_axes(math.pi / 2, 0.0, 0.0)
    return Viewpoint(np.array(eye, np.float32), axes, Camera.from_focal(20.0, 16, 8))


def test_a_leafs_picture_is_cut_out_in_depth_too() -> None:
    checks = np.zeros((8, 8, 4), np.uint8)
    checks[..., 3] = 255 * (np.indices((8, 8)).sum(0) % 2)
    leaf = quad((-4, 2, -2), (8, 0, 0), (0, 0, 4), Material((1, 1, 1), "leaf"), (4.0, 4.0))
    wall = quad((-20, 5, -20), (40, 0, 0), (0, 0, 40), Material())
    world = World(joined([leaf, wall]), {"leaf": checks})
    viewpoint = looking((0.03, 0.0, 0.04))
    (view,) = views.render(
        np.random.default_rng(0), world, lights(), viewpoint, [viewpoint.camera], 1.0
    )
    near = view.depth < 3
    np.testing.assert_allclose(view.depth[near], 2, atol=1e-3)
    np.testing.assert_allclose(view.depth[~near], 5, atol=1e-3)
    assert 0.3 < near.mean() < 0.7
    assert (view.valid == 1).all()


def test_haze_replaces_light_with_distance() -> None:
    wall = quad((-90, 30, -90), (180, 0, 0), (0, 0, 180), Material((1, 1, 1), emission=1.0))
    haze = {"haze_m": 60.0, "haze_color": np.array([0.2, 0.3, 0.4], np.float32)}
    viewpoint = looking((0, 0, 0))
    found = []
    for changes in ({}, haze):
        (view,) = views.render(
            np.random.default_rng(0),
            World(wall, {}),
            lights(sky=np.zeros((4, 8, 3), np.float32), **changes),
            viewpoint,
            [viewpoint.camera],
            1.0,
        )
        found.append(view.radiance[4, 8])
    clear = math.exp(-30.0 / 60.0)  # the middle ray is 30 m long, the pixel beside it 30.05 m
    expected = found[0] * clear + (1 - clear) * haze["haze_color"]
    np.testing.assert_allclose(found[1], expected, rtol=0.01)


@pytest.fixture(autouse=True)
def small_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Textures that are quickly drawn."""
    monkeypatch.setattr(surfaces, "SIDE", 64)
    monkeypatch.setattr(surfaces, "PER_KIND", 2)
    surfaces.drawn_surfaces.cache_clear()


OUTDOOR_MODELS: tuple[MadeModel, ...] = (
    ("fordFocus", 190, 430, 150, None),
    ("poplar", 300, 300, 700, None),
    ("acacia", 300, 300, 600, None),
    ("palm", 300, 300, 900, None),
    ("peachBlossom", 300, 300, 500, None),
    ("copperBeech", 300, 300, 500, None),
    ("candelabre", 40, 140, 730, None),
    ("male01", 50, 40, 180, None),
    ("bush", 100, 100, 100, None),
    ("oakTable", 140, 80, 75, None),
)


@pytest.fixture(scope="module")
def outdoor_library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    """Boxes as cars, trees and people."""
    folder = tmp_path_factory.mktemp("outdoor")
    write_catalogue(folder / "Boxes.sh3f", OUTDOOR_MODELS)
    return Library.open(folder / "models", [folder / "Boxes.sh3f"], print)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for the surfaces of all tests."""
    return tmp_path_factory.mktemp("cache")


def seam_ratio(picture: np.ndarray) -> float:
    """How strong a picture's seam is: near 1 or below if it repeats without one.

    It is the difference of the first and last column, over the largest difference of two columns
    side by side; or that of rows if this is larger. `picture` is [H, W, 3].
    """
    ratios = []
    for axis in (0, 1):
        steps = np.abs(np.roll(picture, -1, axis) - picture).mean((1 - axis, 2))
        ratios.append(steps[-1] / steps[:-1].max())
    return max(ratios)


def test_textures_repeat_without_a_seam(tmp_path: Path) -> None:
    ratios = {}
    for kind in [*surfaces.KINDS, *outdoor_surfaces.OUTDOOR_KINDS]:
        one = outdoor_surfaces.outdoor_surfaces(tmp_path, kind)[0]
        picture = np.asarray(Image.open(one.file), np.float64)
        assert picture.shape == (64, 64, 3)
        assert 0.1 < one.tile_m < 6
        ratios[kind] = seam_ratio(picture)
    del ratios["panes"]  # laid over a window once, so that they need not repeat
    assert max(ratios.values()) < 2, ratios
    # What has a seam is found: a ramp that gets lighter by 1 from pixel to pixel, along both sides.
    ramp = np.repeat(np.indices((64, 64)).sum(0)[..., None], 3, 2)
    assert seam_ratio(ramp) == pytest.approx(63)


def test_size_and_gloss_are_the_same_without_the_picture() -> None:
    for draw in [*surfaces.KINDS.values(), *outdoor_surfaces.OUTDOOR_KINDS.values()]:
        with_picture = draw(np.random.default_rng(3), True)
        without = draw(np.random.default_rng(3), False)
        assert with_picture.picture is not None
        assert without == with_picture._replace(picture=None)


def test_a_house_stands_in_its_place_with_its_roof_above(cache: Path) -> None:
    for roof in ("ridge along", "ridge across", "flat"):
        scene = Scene(np.random.default_rng(1), Library(cache, ()), cache)
        style = choose_style(scene.rng, scene.surface)
        mesh = house(scene.rng, scene.surface, style, 9.0, 8.0, 2, roof, shop=True, balconies=True)
        walls = 2 * style.floor_m
        assert mesh.high[2] > walls
        assert (mesh.low[:2] > -1.6).all()
        assert (mesh.high[:2] < np.array([9.0, 8.0]) + 0.8).all()
        # Closed from above: rays that fall on its ground plan meet something above the ground.
        x, y = scene.rng.uniform([0.3, 0.3], [8.7, 7.7], (200, 2)).T
        origins = np.stack([x, y, np.full(200, 60.0)], 1).astype(np.float32)
        hits = World(mesh, {}).first_hits(
            origins, np.tile(np.array([[0, 0, -1]], np.float32), (200, 1))
        )
        assert (60 - hits.distance > walls - 0.1).all()


@pytest.mark.parametrize("rules", [street, garden])
def test_things_stand_apart_and_models_are_named(
    rules: object, outdoor_library: Library, cache: Path
) -> None:
    assert callable(rules)
    plan = rules(np.random.default_rng(5), outdoor_library, cache)
    assert isinstance(plan, WorldPlan)
    assert plan.models
    assert all(name.startswith("Boxes#") for name in plan.models)
    scene = Scene(np.random.default_rng(0), outdoor_library, cache)
    cars = scene.find("fordFocus nothing")
    assert scene.put(cars, 0, 0, 0, 90.0)
    assert not scene.put(cars, 2.0, 0, 0, 90.0)  # it is 4.3 m long along x now
    assert scene.put(cars, 0, 2.5, 0, 90.0)
    assert not scene.put([], 0, 9, 0, 0.0)


def test_the_same_number_gives_the_same_open_world_with_licences(
    outdoor_library: Library, cache: Path, tmp_path: Path
) -> None:
    def draw(rng: np.random.Generator) -> WorldPlan:
        """A street of boxes."""
        return street(rng, outdoor_library, cache)

    made, count = make_world(draw, outdoor_library, 3, 0, SIZE)
    again, _ = make_world(draw, outdoor_library, 3, 0, SIZE)
    assert count == 7
    assert made == again
    path = tmp_path / "streets-00000.tar"
    write_shard(path, [made])
    (key,) = world_keys(path)
    facts = world_facts(path, key)
    assert facts["licences"] == ["CC0"]
    assert facts["creators"] == ["A tester"]
    photo = read_view(path, key, 0)
    assert (photo.valid == 1).mean() >= 0.5
    shares = []
    for number in range(1, 7):
        other = read_view(path, key, number)
        known = (photo.valid == 1) & (photo.depth > 0) & (photo.depth < 40)
        mask = torch.from_numpy(known)
        points = photo.camera.unproject(
            photo.camera.pixel_centers()[mask], torch.from_numpy(photo.depth)[mask]
        )
        pixels, z = other.camera.project(points)
        height, width = other.depth.shape
        inside = (pixels >= 0).all(1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
        column, row = pixels[inside].long().T
        there = torch.from_numpy(other.depth)[row, column]
        same = (there / z[inside] - 1).abs() < 0.05
        hidden = (there > 0) & (there < z[inside])
        shares.append(float((same | hidden).float().mean()))
    assert np.mean(shares) > 0.9


def test_a_track_has_its_road_under_the_camera_and_names_its_terms(
    torcs: Library, tmp_path: Path
) -> None:
    mesh = torcs.mesh(torcs.models[0])
    road = road_triangles(mesh, "loop")
    sides = face_normals(mesh.corners[road])
    assert np.linalg.norm(sides, axis=1).sum() / 2 == pytest.approx(9 * 400)

    def draw(rng: np.random.Generator) -> WorldPlan:
        """A place at the only track."""
        return track(rng, torcs)

    data, _ = make_world(draw, torcs, 1, 0, SIZE)
    path = tmp_path / "tracks-00000.tar"
    write_shard(path, [data])
    facts = world_facts(path, world_keys(path)[0])
    assert facts["kind"] == "track"
    assert any(one.startswith(FREE_ART) for one in facts["licences"])
    assert "torcs#loop" in facts["models"]
    plan = draw(np.random.default_rng(4))
    viewpoint = plan.draw_viewpoint(np.random.default_rng(0), *SIZE)
    assert 0.5 < viewpoint.eye[2] < 1.8  # above the ground, which is at 0


def test_fine_pictures_keep_their_mean(tmp_path: Path) -> None:
    file = tmp_path / "road.png"
    Image.new("RGB", (32, 16), (90, 100, 110)).save(file)
    fine = fine_picture(str(file))
    assert fine.shape == (512, 1024, 3)
    np.testing.assert_allclose(fine.mean((0, 1)), [90, 100, 110], atol=1.5)
    assert fine.std() > 5


def test_archives_are_called_by_their_kind(tmp_path: Path) -> None:
    def make(number: int) -> PackedWorld:
        """Bytes that tell the number."""
        return PackedWorld(bytes([number]) * 512, views=7)

    make_shards(tmp_path, make, 3, (0, 1), print, "tracks")
    assert [file.name for file in tmp_path.iterdir()] == ["tracks-00000.tar"]
