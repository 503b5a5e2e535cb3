"""Whole worlds, from a catalogue of boxes."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
import torch
from made_models import lights, write_catalogue
from PIL import Image

pytest.importorskip("embreex", reason="needs research/worlds/requirements.txt")

from worlds import surfaces, views, world_sheet
from worlds.furniture import Furniture
from worlds.library import Library
from worlds.make import PackedWorld, make_shards, make_world, photos_of
from worlds.placing import Box, Opening, Place
from worlds.plans import WorldPlan
from worlds.rooms import furnish
from worlds.shards import read_view, shard_file, world_facts, world_keys, write_shard

from spackle.cli.script_command import run_script
from spackle.runtime.errors import InputError

pytestmark = pytest.mark.slow
SIZE = (48, 64)


@pytest.fixture(scope="module")
def furniture(tmp_path_factory: pytest.TempPathFactory) -> Furniture:
    """Boxes as furniture."""
    folder = tmp_path_factory.mktemp("library")
    write_catalogue(folder / "Boxes.sh3f")
    return Furniture(Library.open(folder / "models", [folder / "Boxes.sh3f"], print))


@pytest.fixture(autouse=True)
def small_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Textures that are quickly drawn."""
    monkeypatch.setattr(surfaces, "SIDE", 64)
    monkeypatch.setattr(surfaces, "PER_KIND", 2)
    surfaces.drawn_surfaces.cache_clear()


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for the surfaces of all tests."""
    return tmp_path_factory.mktemp("cache")


def make_room(furniture: Furniture, cache: Path, number: int, second_views: int = 6) -> PackedWorld:
    """A packed room of boxes."""

    def draw(rng: np.random.Generator) -> WorldPlan:
        """A random room without photos on its walls."""
        return furnish(rng, furniture, cache, None)

    return make_world(draw, furniture.library, 3, number, SIZE, second_views)


@functools.cache
def packed(furniture: Furniture, cache: Path, number: int) -> bytes:
    """A packed world of boxes."""
    return make_room(furniture, cache, number)[0]


def test_the_same_number_gives_the_same_bytes_and_another_one_others(
    furniture: Furniture, cache: Path
) -> None:
    again, count = make_room(furniture, cache, 0)
    assert count == 7
    assert again == packed(furniture, cache, 0)
    assert again != packed(furniture, cache, 1)


def test_depth_of_second_views_agrees_with_the_photos_depth(
    furniture: Furniture, cache: Path, tmp_path: Path
) -> None:
    path = tmp_path / "worlds.tar"
    write_shard(path, [packed(furniture, cache, number) for number in range(3)])
    shares = []
    color_errors = []
    for key in world_keys(path):
        photo = read_view(path, key, 0)
        for number in range(1, 7):
            other = read_view(path, key, number)
            known = torch.from_numpy((photo.valid == 1) & (photo.depth > 0))
            centers = photo.camera.pixel_centers()[known]
            points = photo.camera.unproject(centers, torch.from_numpy(photo.depth)[known])
            pixels, z = other.camera.project(points)
            height, width = other.depth.shape
            inside = (pixels >= 0).all(1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
            column, row = pixels[inside].long().T
            there = torch.from_numpy(other.depth)[row, column]
            # What the photo sees is seen there too, or hidden by something nearer.
            same = (there / z[inside] - 1).abs() < 0.03
            hidden = (there > 0) & (there < z[inside])
            shares.append(float((same | hidden).float().mean()))
            color = torch.from_numpy(photo.rgb)[known][inside][same].float()
            beside = torch.from_numpy(other.rgb)[row, column][same].float()
            color_errors.append(float((color - beside).abs().median()))
    assert np.mean(shares) > 0.95
    assert np.mean(color_errors) < 6  # of 255: light does not change with the view


def test_facts_name_models_trajectories_and_known_share(
    furniture: Furniture, cache: Path, tmp_path: Path
) -> None:
    path = tmp_path / "worlds.tar"
    write_shard(path, [packed(furniture, cache, 0)])
    (key,) = world_keys(path)
    facts = world_facts(path, key)
    assert len(facts["trajectories"]) == 6
    assert all(name.startswith(("Boxes#", "made#")) for name in facts["models"])
    assert all(0 <= view["known"] <= 1 for view in facts["views"])


def test_a_world_of_one_view_has_the_photo_alone(
    furniture: Furniture, cache: Path, tmp_path: Path
) -> None:
    alone, count = make_room(furniture, cache, 0, second_views=0)
    assert count == 1
    shard = shard_file(tmp_path, 0)
    write_shard(shard, [alone])
    whole = shard_file(tmp_path, 1)
    write_shard(whole, [packed(furniture, cache, 0)])
    (key,) = world_keys(shard)
    # The same camera sees the same surfaces.
    np.testing.assert_array_equal(read_view(shard, key, 0).depth, read_view(whole, key, 0).depth)
    assert len(world_facts(shard, key)["views"]) == 1


def test_a_close_up_is_taken_within_a_room_near_a_thing(furniture: Furniture, cache: Path) -> None:
    room = furnish(np.random.default_rng(4), furniture, cache, None)
    close = furnish(np.random.default_rng(4), furniture, cache, None, close=True)
    assert close.mesh.count == room.mesh.count  # the same room
    corners = close.mesh.corners.reshape(-1, 3)
    for seed in range(20):
        viewpoint = close.draw_viewpoint(np.random.default_rng(seed), 48, 64)
        assert (viewpoint.eye[:2] > corners.min(0)[:2]).all()
        assert (viewpoint.eye < corners.max(0)).all()
        # 1.8 m to the middle of a thing, and 0.7 of that above it.
        nearest = np.linalg.norm(corners - viewpoint.eye, axis=1).min()
        assert nearest < 1.8 * 1.25


def test_a_stopped_run_goes_on_and_keeps_what_is_there(tmp_path: Path) -> None:
    made: list[int] = []

    def make(number: int) -> PackedWorld:
        """Bytes that tell the number; the tenth world fails in the first run."""
        if number == 9 and len(made) == 9:
            raise KeyboardInterrupt
        made.append(number)
        return PackedWorld(bytes([number]) * 512, views=7)

    with pytest.raises(KeyboardInterrupt):
        make_shards(tmp_path, make, 12, (0, 1), print)
    assert [file.name for file in tmp_path.iterdir()] == [shard_file(tmp_path, 0).name]
    make_shards(tmp_path, make, 12, (0, 1), print)
    assert made == [*range(9), *range(8, 12)]
    assert shard_file(tmp_path, 1).read_bytes()[:1] == bytes([8])


def test_photos_that_cannot_be_read_are_named_once_and_passed_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.new("RGB", (8, 6), (90, 100, 110)).save(tmp_path / "good.png")
    (tmp_path / "broken.jpg").write_bytes(b"no photo")
    draw = photos_of(tmp_path)
    assert draw is not None
    for seed in range(8):
        assert draw(np.random.default_rng(seed)).shape == (6, 8, 3)
    assert capsys.readouterr().err.count("broken.jpg") == 1

    (tmp_path / "good.png").write_bytes(b"no photo either")
    with pytest.raises(InputError, match="contains no photos"):
        draw(np.random.default_rng(0))
    with pytest.raises(InputError, match="contains no photos"):
        photos_of(tmp_path / "none")


def test_two_processes_share_the_work(tmp_path: Path) -> None:
    def make(number: int) -> PackedWorld:
        """Bytes that tell the number."""
        return PackedWorld(bytes([number]) * 512, views=7)

    make_shards(tmp_path, make, 24, (1, 2), print)
    assert [file.name for file in tmp_path.iterdir()] == [shard_file(tmp_path, 1).name]


def test_things_stand_inside_of_the_room_and_not_in_each_other(furniture: Furniture) -> None:
    rng = np.random.default_rng(0)
    window = Opening("back", 1.0, 1.5, 0.9, 2.0, "window")
    door = Opening("left", 0.5, 0.9, 0.0, 2.0, "door")
    place = Place(rng, 4.0, 4.0, 2.5, [window, door])
    for _ in range(30):
        place.at_wall(furniture.of("bookcase"))
        place.on_floor(furniture.of("chair"))
    assert len(place.things) > 4
    boxes = [thing.box for thing in place.things]
    for number, one in enumerate(boxes):
        assert min(one.x0, one.y0) >= 0
        assert max(one.x1, one.y1) <= 4
        assert not any(one.meets(other) for other in boxes[:number])
        # High things stand before no window, and nothing before the door.
        before_window = Box(1.0, 3.6, 2.5, 4.0, 0.9, 2.0)
        assert one.z1 < 1.0 or not one.meets(before_window)
    assert not any(box.meets(place._before(door)) for box in boxes)


def test_small_things_stand_on_the_height_that_the_catalogue_gives(furniture: Furniture) -> None:
    rng = np.random.default_rng(0)
    place = Place(rng, 4.0, 4.0, 2.5, [])
    desk = place.at_wall(furniture.of("desk"))
    assert desk is not None
    found = place.on_top(desk, furniture.of("living_small"), 4)
    assert found
    assert {thing.z for thing in found} == {0.74}
    for thing in found:
        assert desk.box.x0 <= thing.x <= desk.box.x1
        assert desk.box.y0 <= thing.y <= desk.box.y1
    plant = place.on_floor(furniture.of("floor_plant"))
    assert plant is not None
    assert place.on_top(plant, furniture.of("living_small"), 1) == []


def test_outlines_are_mixed_and_depth_is_not(furniture: Furniture, cache: Path) -> None:
    from worlds.caster import World
    from worlds.meshes import Material, joined, quad
    from worlds.viewpoints import Viewpoint

    from spackle.core.camera import Camera

    black = quad((-9, 4, -9), (18, 0, 0), (0, 0, 18), Material((0, 0, 0)))
    bright = quad((0.03, 2, -9), (9, 0, 0), (0, 0, 18), Material((1, 1, 1), emission=1.0))
    world = World(joined([black, bright]), {})
    axes = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float32)
    viewpoint = Viewpoint(np.zeros(3, np.float32), axes, Camera.from_focal(20.0, 16, 8))
    dark = lights(sky=np.zeros((4, 8, 3), np.float32))
    (view,) = views.render(
        np.random.default_rng(0), world, dark, viewpoint, [viewpoint.camera], views.COARSE_M
    )
    # The outline is at 0.3 pixels right of the middle.
    row = view.radiance[4, :, 0]
    assert row[7] < 0.1
    assert 0.3 < row[8] < 0.95
    assert row[9] > 0.95
    assert set(np.round(view.depth.reshape(-1), 3).tolist()) == {2.0, 4.0}
    np.testing.assert_allclose(view.normal[4, 9], [0, 0, -1], atol=1e-5)


def test_a_sheet_of_a_folder_without_worlds_says_so_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(tmp_path), "-o", str(tmp_path / "sheet.png"), "--prefix", "streets"]
    assert run_script(lambda: world_sheet.main(arguments)) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {tmp_path}: no world to show in archives streets-NNNNN.tar")
    assert error.count("\n") == 1
    assert not (tmp_path / "sheet.png").exists()
