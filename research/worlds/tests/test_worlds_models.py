"""Models: OBJ files, catalogues and the library."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from made_models import BOX, MODELS, write_catalogue
from worlds.catalogue import read_catalogue, read_model
from worlds.furniture import GROUPS
from worlds.library import Library
from worlds.meshes import Material, box, face_normals, joined, smooth_normals
from worlds.obj_files import read_mtl, read_obj

pytestmark = pytest.mark.slow


def nothing(path: str) -> bytes | None:
    """No other files."""
    return None


def test_polygons_become_triangles_that_cover_the_same_area() -> None:
    mesh = read_obj(BOX, "", nothing)
    assert mesh.count == 12
    area = np.linalg.norm(face_normals(mesh.corners), axis=1).sum() / 2
    assert area == pytest.approx(6 * 4)


def test_indices_count_from_the_end_where_they_are_negative() -> None:
    mesh = read_obj("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1", "", nothing)
    np.testing.assert_allclose(mesh.corners[0], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def test_faces_without_area_or_with_missing_corners_are_left_out() -> None:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 1 2\nf 1 2 9"
    assert read_obj(text, "", nothing).count == 1
    with pytest.raises(ValueError, match="no triangles"):
        read_obj("v 0 0 0\nf 1 1 1", "", nothing)


def test_broken_normals_are_made_from_the_faces() -> None:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 0\nf 1//1 2//1 3//1"
    np.testing.assert_allclose(read_obj(text, "", nothing).normals[0], [[0, 0, 1]] * 3)


def test_a_box_keeps_its_edges_and_a_ball_is_smooth() -> None:
    cube = box((0, 0, 0), (1, 1, 1), Material())
    flat = face_normals(cube.corners)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    np.testing.assert_allclose(
        smooth_normals(cube.corners), np.repeat(flat[:, None], 3, 1), atol=1e-6
    )

    # A ball of longitudes and latitudes: its normals are its points.
    rows, columns = 24, 48
    theta, phi = np.meshgrid(
        np.linspace(0.2, np.pi - 0.2, rows), np.linspace(0, 2 * np.pi, columns), indexing="ij"
    )
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    first = np.stack([points[:-1, :-1], points[1:, :-1], points[1:, 1:]], -2).reshape(-1, 3, 3)
    second = np.stack([points[:-1, :-1], points[1:, 1:], points[:-1, 1:]], -2).reshape(-1, 3, 3)
    ball = np.concatenate([first, second])
    inner = (np.abs(ball[..., 2]) < 0.9).all(1)  # borders of the open ball see one side only
    cosines = (smooth_normals(ball) * ball).sum(-1)[inner]
    assert cosines.min() > 0.99


def test_materials_have_picture_opacity_and_shine() -> None:
    text = "newmtl a b\nKd 0.1 0.2 0.3\nmap_Kd -s 1 1 1 my wood.jpg\nnewmtl pane\nd 0.3\n"
    materials = read_mtl(text, "folder")
    assert materials["a b"].texture == "folder/my wood.jpg"
    assert materials["a b"].color == (0.1, 0.2, 0.3)
    assert materials["pane"].opacity == 0.3


def test_a_model_has_the_catalogues_size_stands_on_the_floor_and_looks_forward(
    tmp_path: Path,
) -> None:
    path = tmp_path / "Boxes.sh3f"
    write_catalogue(path)
    entries = read_catalogue(path)
    assert [entry.key for entry in entries] == [f"Boxes#{model[0]}" for model in MODELS]
    assert {entry.licence for entry in entries} == {"CC0"}
    assert entries[0].top_m == pytest.approx(0.4)
    assert entries[2].top_m is None
    with zipfile.ZipFile(path) as archive:
        mesh = read_model(archive, entries[0])
    np.testing.assert_allclose(mesh.low, [-0.9, -0.4, 0], atol=1e-6)
    np.testing.assert_allclose(mesh.high, [0.9, 0.4, 0.8], atol=1e-6)
    # In the file, z points to the viewer: the face at z = 1 becomes the front at -y.
    grey = mesh.corners[mesh.material == 2]  # after the nameless one and skin
    assert (np.abs(grey[..., 1] + 0.4) < 1e-6).all(1).any()


def test_the_library_is_made_once_and_gives_the_same_triangles(tmp_path: Path) -> None:
    path = tmp_path / "Boxes.sh3f"
    write_catalogue(path)
    lines: list[str] = []
    made = Library.open(tmp_path / "library", [path], lines.append)
    again = Library.open(tmp_path / "library", [path], lines.append)
    assert made == again
    assert lines == ["reading Boxes.sh3f"]
    mesh = again.mesh(again.models[0])
    skin = mesh.materials[0] if mesh.materials[0].texture else mesh.materials[1]
    assert skin.texture is not None
    assert Path(skin.texture).is_file()


def test_joined_meshes_share_equal_materials() -> None:
    red = Material((1, 0, 0))
    both = joined([box((0, 0, 0), (1, 1, 1), red), box((2, 0, 0), (3, 1, 1), red)])
    assert both.count == 24
    assert both.materials == (red,)


def test_no_line_break_cuts_the_name_of_a_model_in_two() -> None:
    names = [name for group in GROUPS.values() for name in group.split()]
    assert [name for name in names if name.startswith("-") or name.endswith("-")] == []
