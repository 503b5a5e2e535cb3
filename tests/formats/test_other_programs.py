"""Scenes of other programs: each row of the table in docs/inputs.md, written by plain writers after
the program's own rules, is read as the Gaussians that were written.
"""

from __future__ import annotations

import dataclasses
import gzip
import io
import json
import math
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.foreign_scenes import (
    KHR,
    Columns,
    Files,
    Gltf,
    draft_gltf,
    inria_table,
    khr_gltf,
    ply,
    sog,
    spz,
    spz_gltf,
    zipped,
)
from helpers.plain_scenes import zstd
from helpers.scenes import random_gaussians
from PIL import Image

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians, quat_to_matrix
from spackle.formats import save_ply
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import SCENE_ENCODERS, load_scene, scene_suffix
from spackle.runtime.errors import InputError

INPUTS_PAGE = Path(__file__).resolve().parents[2] / "docs" / "inputs.md"
GAUSSIANS = random_gaussians(60)

# The largest errors of position and of the logarithm of a scale, of the covariances relative to
# their largest entry, of sRGB and of opacity.
EXACT = (1e-5, 1e-5, 1e-4, 1e-5, 1e-5)
SPZ = (2e-4, 0.04, 0.1, 0.008, 0.003)
SPZ_1 = (3e-3, 0.04, 0.12, 0.008, 0.003)
SOG_2 = (2e-4, 0.02, 0.1, 0.006, 0.003)
SOG_1 = (2e-4, 0.02, 0.1, 0.006, 0.02)


def without(table: dict[str, Any], *words: str) -> dict[str, Any]:
    """The columns whose names do not begin with a word."""
    return {name: values for name, values in table.items() if not name.startswith(words)}


def byte_colors(table: dict[str, Any]) -> dict[str, Any]:
    """The columns with colours as bytes instead of harmonics."""
    rgb = np.round(Columns(GAUSSIANS).srgb * 255)
    colors = {name: rgb[:, index] for index, name in enumerate(("red", "green", "blue"))}
    return without(table, "f_") | colors


BYTES = dict.fromkeys(("red", "green", "blue", "alpha"), "uchar")
TABLE = inria_table(GAUSSIANS)
DISCS = dataclasses.replace(
    GAUSSIANS,
    scales=torch.cat([GAUSSIANS.scales[:, :2], GAUSSIANS.scales[:, :2].amin(1)[:, None] / 1000], 1),
)
BALLS = dataclasses.replace(
    GAUSSIANS,
    scales=GAUSSIANS.scales[:, :1].expand(-1, 3).clone(),
    quats=torch.eye(4)[:1].expand(len(GAUSSIANS), 4).clone(),
)
OPAQUE = dataclasses.replace(GAUSSIANS, opacities=torch.ones(len(GAUSSIANS)))


@dataclasses.dataclass(frozen=True)
class Row:
    """A kind of scene: its files, and what they hold."""

    files: Callable[[], Files]  # the first one is the scene
    bounds: tuple[float, float, float, float, float]
    format: str
    gaussians: Gaussians = GAUSSIANS
    degree: int = 0
    writer: str | None = None
    notes: str = ""  # a part of them


def of_ply(table: dict[str, Any], **options: Any) -> Callable[[], Files]:
    return lambda: {"scene.ply": ply(table, **options)}


def prefixed(table: dict[str, Any], prefix: str) -> dict[str, Any]:
    plain = ("x", "y", "z", "nx", "ny", "nz")
    return {name if name in plain else prefix + name: values for name, values in table.items()}


def placed_gltf(matrix: bool) -> Files:
    """A glTF file whose node turns, stretches and moves Gaussians to where they belong."""
    angle = 0.7
    turn = np.array(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    )
    move = np.array([0.3, -1.0, 2.0])
    stretch = np.array([2.0, 2.0, 2.0]) if matrix else np.array([2.0, 3.0, 0.5])
    linear = turn * stretch
    # The file holds balls of the right size before the node stretches them.
    flip = np.diag([-1.0, -1.0, 1.0])
    means = (GAUSSIANS.means.double().numpy() @ flip - move) @ np.linalg.inv(linear).T
    inner = dataclasses.replace(
        BALLS, means=torch.from_numpy(means @ flip), scales=BALLS.scales.double()
    )
    file = khr_gltf(inner)
    if matrix:
        whole = np.eye(4)
        whole[:3, :3], whole[:3, 3] = linear, move
        file.node["matrix"] = whole.T.ravel().tolist()
    else:
        half = angle / 2
        file.node["children"] = [1]
        del file.node["mesh"]
        file.node |= {"translation": move.tolist(), "scale": [1, 1, 1]}
        child = {"mesh": 0, "rotation": [0, math.sin(half), 0, math.cos(half)]}
        file.description["nodes"].append(child | {"scale": stretch.tolist()})
    return {"scene.glb": file.glb()}


def stretched(scales: list[float]) -> Gaussians:
    """The balls after the node of `placed_gltf` has stretched and turned them."""
    half = 0.35
    # A turn about y up by an angle is one about y down by the same angle the other way, seen from
    # axes that are turned by 180° about z.
    quats = torch.tensor([[math.cos(half), 0, -math.sin(half), 0]]).expand(len(BALLS), 4)
    return dataclasses.replace(BALLS, quats=quats, scales=BALLS.scales * torch.tensor(scales))


def with_files(file: Gltf) -> Files:
    return {"scene.gltf": file.gltf("the%20arrays.bin"), "the arrays.bin": file.body}


ROWS = {
    # PLY
    "INRIA's 3DGS": Row(of_ply(TABLE), EXACT, "PLY", degree=3),
    "degree 1 or 2": Row(of_ply(inria_table(GAUSSIANS, 24)), EXACT, "PLY", degree=2),
    "Mip-Splatting": Row(of_ply(TABLE | {"filter_3D": TABLE["x"]}), EXACT, "PLY", degree=3),
    "no normals": Row(of_ply(without(TABLE, "n")), EXACT, "PLY", degree=3),
    "other order, more properties": Row(
        of_ply(
            dict(reversed(TABLE.items())) | {"red": TABLE["nx"], "semantic_id": TABLE["nx"]},
            types={"red": "uchar", "semantic_id": "int"},
        ),
        EXACT,
        "PLY",
        degree=3,
    ),
    "double": Row(of_ply(TABLE, default="double"), EXACT, "PLY", degree=3),
    "big-endian": Row(of_ply(TABLE, order=">"), EXACT, "PLY", degree=3),
    "text": Row(of_ply(TABLE, text=True), EXACT, "text PLY", degree=3),
    "header of Windows": Row(of_ply(TABLE, line_end="\r\n"), EXACT, "PLY", degree=3),
    "2DGS": Row(
        of_ply(without(TABLE, "scale_2")), EXACT, "PLY", DISCS, degree=3, notes="flat discs"
    ),
    "nerfstudio": Row(
        of_ply(TABLE, comments=("Generated by Nerfstudio 1.1.5", "Vertical Axis: z")),
        EXACT,
        "PLY",
        degree=3,
        writer="Nerfstudio 1.1.5",
    ),
    "nerfstudio, colours": Row(
        of_ply(byte_colors(TABLE), types=BYTES), (1e-5, 1e-5, 1e-4, 0.003, 1e-5), "PLY"
    ),
    "CloudCompare": Row(
        of_ply(prefixed(TABLE, "scalar_"), types=dict.fromkeys("xyz", "double")),
        EXACT,
        "PLY",
        degree=3,
    ),
    "one scale": Row(
        of_ply(without(TABLE, "scale_1", "scale_2", "rot_")), EXACT, "PLY", BALLS, degree=3
    ),
    "no opacity": Row(
        of_ply(without(TABLE, "opacity")), EXACT, "PLY", OPAQUE, degree=3, notes="opaque"
    ),
    "alpha": Row(
        of_ply(
            without(TABLE, "opacity") | {"alpha": np.round(Columns(GAUSSIANS).opacities * 255)},
            types=BYTES,
        ),
        (1e-5, 1e-5, 1e-4, 1e-5, 0.003),
        "PLY",
        degree=3,
    ),
    # SPZ
    "SPZ 1": Row(lambda: {"scene.spz": spz(GAUSSIANS, 1)}, SPZ_1, "SPZ 1"),
    "SPZ 2": Row(lambda: {"scene.spz": spz(GAUSSIANS, 2, degree=3)}, SPZ, "SPZ 2", degree=3),
    "SPZ 3": Row(lambda: {"scene.spz": spz(GAUSSIANS, 3, degree=1)}, SPZ, "SPZ 3", degree=1),
    "SPZ 4": Row(lambda: {"scene.spz": spz(GAUSSIANS, 4)}, SPZ, "SPZ 4"),
    "SPZ 4, harmonics": Row(
        lambda: {"scene.spz": spz(GAUSSIANS, 4, degree=4)}, SPZ, "SPZ 4", degree=4
    ),
    "SPZ, other axes": Row(
        # LFU, number 11: x left, y front, z up, which also mirrors.
        lambda: {
            "scene.spz": spz(
                GAUSSIANS, 4, axes=11, basis=np.array([[-1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
            )
        },
        SPZ,
        "SPZ 4",
    ),
    "SPZ 3, other axes": Row(
        lambda: {"scene.spz": spz(GAUSSIANS, 3, degree=2, axes=6, basis=np.eye(3))},
        SPZ,
        "SPZ 3",
        degree=2,
    ),
    # SOG
    "SOG 2, a folder": Row(
        lambda: sog(GAUSSIANS, 2, bands=3), SOG_2, "SOG 2", degree=3, writer="a program 1.0"
    ),
    "SOG 2, bundled": Row(
        lambda: {"scene.sog": zipped(sog(GAUSSIANS, 2))}, SOG_2, "SOG 2", writer="a program 1.0"
    ),
    "SOG, a zipped folder": Row(
        lambda: {"scene.zip": zipped(sog(GAUSSIANS, 2), "scene/")},
        SOG_2,
        "SOG 2",
        writer="a program 1.0",
    ),
    "SOG 1": Row(lambda: sog(GAUSSIANS, 1, bands=2), SOG_1, "SOG 1", degree=2),
    # glTF
    "glTF": Row(
        lambda: {"scene.glb": khr_gltf(GAUSSIANS).glb()}, EXACT, "glTF 2", writer="a program 1.0"
    ),
    "glTF, logarithms": Row(
        lambda: {"scene.glb": khr_gltf(GAUSSIANS, log_scales=True).glb()},
        EXACT,
        "glTF 2",
        writer="a program 1.0",
    ),
    "glTF, whole numbers": Row(
        lambda: {"scene.glb": khr_gltf(GAUSSIANS, quantized=True).glb()},
        (1e-5, 1e-5, 1e-3, 1e-5, 1e-4),
        "glTF 2",
        writer="a program 1.0",
    ),
    "glTF, early draft": Row(
        lambda: {"scene.glb": draft_gltf(GAUSSIANS).glb()},
        (1e-5, 1e-5, 1e-4, 0.003, 0.003),
        "glTF 2",
        writer="a program 1.0",
    ),
    "glTF with arrays in the text": Row(
        lambda: {"scene.gltf": khr_gltf(GAUSSIANS).gltf()},
        EXACT,
        "glTF 2",
        writer="a program 1.0",
    ),
    "glTF with a file of arrays": Row(
        lambda: with_files(khr_gltf(GAUSSIANS)), EXACT, "glTF 2", writer="a program 1.0"
    ),
    "glTF, moved and scaled": Row(
        lambda: placed_gltf(matrix=True),
        EXACT,
        "glTF 2",
        stretched([2.0, 2.0, 2.0]),
        writer="a program 1.0",
    ),
    "glTF, stretched": Row(
        lambda: placed_gltf(matrix=False),
        EXACT,
        "glTF 2",
        stretched([2.0, 3.0, 0.5]),
        writer="a program 1.0",
    ),
    "glTF with SPZ 2": Row(
        lambda: {"a.glb": spz_gltf(GAUSSIANS, f"{KHR}_compression_spz_2", 2).glb()},
        SPZ,
        "glTF 2",
        writer="a program 1.0",
    ),
    "glTF with SPZ": Row(
        lambda: {"a.glb": spz_gltf(GAUSSIANS, f"{KHR}_compression_spz", 3).glb()},
        SPZ,
        "glTF 2",
        writer="a program 1.0",
    ),
    "glTF with SPZ, first name": Row(
        lambda: {"a.glb": spz_gltf(GAUSSIANS, "KHR_spz_gaussian_splats_compression", 2).glb()},
        SPZ,
        "glTF 2",
        writer="a program 1.0",
    ),
}


def write(folder: Path, files: Files) -> Path:
    """Write files into a folder, and return the first one."""
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder / next(iter(files))


def assert_same(found: Gaussians, expected: Gaussians, bounds: tuple[float, ...]) -> None:
    place, size, shape, color, opacity = bounds
    expected = expected.to(dtype=torch.float32)
    torch.testing.assert_close(found.means, expected.means, rtol=0, atol=place)
    logs, expected_logs = found.scales.log(), expected.scales.log()
    # In which order the axes stand, the file decides.
    torch.testing.assert_close(logs.sort()[0], expected_logs.sort()[0], rtol=0, atol=size)
    spread = expected.covariances().abs().amax(dim=(1, 2), keepdim=True)
    difference = (found.covariances() - expected.covariances()) / spread
    assert float(difference.abs().max()) <= shape
    srgb, expected_srgb = linear_to_srgb(found.colors), linear_to_srgb(expected.colors)
    torch.testing.assert_close(srgb, expected_srgb, rtol=0, atol=color)
    torch.testing.assert_close(found.opacities, expected.opacities, rtol=0, atol=opacity)


@pytest.mark.parametrize("name", ROWS)
def test_a_scene_of_another_program_is_read_as_it_was_meant(name: str, tmp_path: Path) -> None:
    row = ROWS[name]
    path = write(tmp_path, row.files())
    found = load_scene(path)
    assert_same(found.gaussians, row.gaussians, row.bounds)
    assert (found.format, found.writer) == (row.format, row.writer)
    assert row.notes in " ".join(found.notes)
    said = " ".join(found.losses)
    assert found.harmonics_degree == row.degree
    # The degrees 1 to 3 are kept; the fourth, which only SPZ has, is dropped.
    assert found.gaussians.harmonics_count == (0, 3, 8, 15, 15)[row.degree]
    assert ("harmonics of degree 4 are dropped" in said) == (row.degree == 4)
    assert ("harmonics" in said) == (row.degree == 4)
    if path.name == "meta.json":
        assert_same(load_scene(tmp_path).gaussians, row.gaussians, row.bounds)
        assert found.byte_count == sum(file.stat().st_size for file in tmp_path.iterdir())


def test_each_kind_of_scene_on_the_page_is_read_in_a_test() -> None:
    section = INPUTS_PAGE.read_text(encoding="utf-8").split("## Scenes")[1].split("\n## ")[0]
    listed = re.findall(r"^\| [^|]+ \|[^|]*\| (.+?) \|$", section, re.MULTILINE)
    named = {name.strip("` ") for cell in listed for name in cell.split(";")} - {"kinds", "---"}
    assert named == set(ROWS)


def compressed(extension: str) -> bytes:
    file = khr_gltf(GAUSSIANS)
    file.description["bufferViews"][0]["extensions"] = {extension: {}}
    return file.glb()


def extended() -> bytes:
    file = khr_gltf(GAUSSIANS)
    file.primitive["extensions"][KHR]["extensions"] = {"X_lgsc": {}}
    return file.glb()


def shape_gltf(mode: int) -> bytes:
    file = Gltf()
    file.primitive |= {"mode": mode, "extensions": {}}
    file.add("POSITION", np.zeros((3, 3)))
    return file.glb()


def mirrored() -> bytes:
    file = khr_gltf(GAUSSIANS)
    file.node["scale"] = [-1, 1, 1]
    return file.glb()


POINTS = {name: values for name, values in byte_colors(TABLE).items() if len(name) != 7}
UNSUPPORTED = {
    "SPZ 5": ("a.spz", spz(GAUSSIANS, 4).replace(b"NGSP\4", b"NGSP\5"), "SPZ version 5"),
    "SPZ 9 in gzip": ("a.spz", gzip.compress(b"NGSP\t" + bytes(11)), "SPZ version 9"),
    "SPZ of degree 7": (
        "a.spz",
        gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 7, 12, 0, 0)),
        "harmonics of degree 7",
    ),
    "SPZ with unknown axes": ("a.spz", spz(GAUSSIANS, 4, axes=99), "axes of the unknown kind 99"),
    "a PLY in gzip": ("a.ply.gz", gzip.compress(ply(TABLE)), "unpack it"),
    "SOG 3": (
        "meta.json",
        json.dumps({"version": 3, "means": 0, "scales": 0, "quats": 0, "sh0": 0}).encode(),
        "SOG version 3",
    ),
    "streamed SOG": ("lod-meta.json", b'{"lodLevels": 3}', "several levels"),
    "another meta.json": ("meta.json", b'{"name": 1}', "not the description of a SOG scene"),
    "a PLY in a zip": ("a.zip", zipped({"a.ply": ply(TABLE)}), "unpack it"),
    "glTF 1": ("a.glb", b"glTF" + struct.pack("<II", 1, 20) + bytes(8), "glTF version 1"),
    "glTF 1 as text": ("a.gltf", b'{"asset": {"version": "1.0"}}', "glTF version '1.0'"),
    "meshopt": ("a.glb", compressed("EXT_meshopt_compression"), "EXT_meshopt_compression"),
    "an unknown extension": ("a.glb", extended(), "X_lgsc"),
    "a point cloud in glTF": ("a.glb", shape_gltf(0), "a cloud of points"),
    "a mesh in glTF": ("a.glb", shape_gltf(4), "a mesh"),
    "a mirroring node": ("a.glb", mirrored(), "mirrors"),
    "arrays elsewhere": (
        "a.gltf",
        khr_gltf(GAUSSIANS).gltf("https://example.org/a.bin"),
        "put the file beside it",
    ),
    "arrays outside": ("a.gltf", khr_gltf(GAUSSIANS).gltf("../a.bin"), "put the file beside it"),
    "a point cloud": ("a.ply", ply(POINTS, types=BYTES), "point clouds and meshes"),
    "ksplat": ("a.ksplat", bytes(5000), "splat-transform a.ksplat scene.ply"),
    "XGRIDS": ("a.lcc", b"{}", "splat-transform a.lcc scene.ply"),
    "USD": ("a.usdz", zipped({"a.usda": b""}), "save the scene as PLY"),
    "a mesh": ("a.obj", b"v 0 0 0\n", "has no Gaussians: give a scene"),
    "SuperSplat's project": ("a.ssproj", zipped({"document.json": b"{}"}), "export the scene"),
    "nerfstudio's checkpoint": ("a.ckpt", zipped({"data.pkl": b""}), "ns-export"),
}


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_a_sound_file_that_is_not_read_is_never_called_damaged(name: str, tmp_path: Path) -> None:
    file, content, says = UNSUPPORTED[name]
    path = write(tmp_path, {file: content})
    assert scene_suffix(path) is not None or name == "a PLY in gzip"
    with pytest.raises(InputError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert says in message
    assert not re.search("damaged|cut off|export it again|another program", message)
    assert re.search("save|give|convert|unpack|export|put|not a Gaussian scene", message)


def test_the_folder_of_a_training_names_its_newest_scene(tmp_path: Path) -> None:
    for number in (7000, 30000):
        folder = tmp_path / "point_cloud" / f"iteration_{number}"
        folder.mkdir(parents=True)
        write(folder, {"point_cloud.ply": ply(TABLE)})
    newest = tmp_path / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    for folder in (tmp_path, tmp_path / "point_cloud"):
        with pytest.raises(InputError, match="the folder of a training: give its scene") as caught:
            load_scene(folder)
        assert str(caught.value).endswith(f", {newest}")


def test_what_stands_in_place_of_a_scene_is_named(tmp_path: Path) -> None:
    for content, says in (
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        (b"<!DOCTYPE html><html>", "a web page: download the file itself"),
    ):
        with pytest.raises(InputError, match=says):
            load_scene(write(tmp_path, {"a.ply": content}))


def test_a_splat_of_an_odd_length_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="70 bytes, which is no multiple of 32"):
        load_scene(write(tmp_path, {"a.splat": bytes(70)}))


def zip_bomb(version: int) -> bytes:
    """An SPZ file of a few kilobytes that claims five million Gaussians."""
    count = 5_000_000
    head = struct.pack("<4sIIBBBB", b"NGSP", version, count, 0, 12, 0, 5 if version == 4 else 0)
    if version == 3:
        return gzip.compress(head + bytes(20 * 1000))
    parts = [bytes(count * width) for width in (9, 1, 3, 3, 4)]
    frames = [zstd.compress(part) for part in parts]
    sizes = zip(frames, parts, strict=True)
    table = b"".join(struct.pack("<QQ", len(frame), len(part)) for frame, part in sizes)
    return head + struct.pack("<I12x", 32) + table + b"".join(frames)


def image_bomb() -> bytes:
    """A SOG scene of some kilobytes with an image of 64 million pixels."""
    files = sog(GAUSSIANS, 2)
    stream = io.BytesIO()
    Image.new("RGBA", (8000, 8000)).save(stream, "WEBP", lossless=True)
    files["means_l.webp"] = stream.getvalue()
    return zipped(files)


DAMAGED = {
    "SPZ 4, a bomb": ("a.spz", zip_bomb(4)),
    "SPZ 3, a bomb": ("a.spz", zip_bomb(3)),
    "SOG, a bomb": ("a.sog", image_bomb()),
    "SPZ 4, cut off": ("a.spz", spz(GAUSSIANS, 4)[:-40]),
    "SPZ 4, head only": ("a.spz", spz(GAUSSIANS, 4)[:20]),
    "SPZ 3, cut off": ("a.spz", spz(GAUSSIANS, 3)[:-40]),
    "GLB, cut off": ("a.glb", khr_gltf(GAUSSIANS).glb()[:-40]),
    "SOG, no image": ("meta.json", sog(GAUSSIANS, 2)["meta.json"]),
    "text PLY, cut off": ("a.ply", ply(TABLE, text=True)[:-400]),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_file_is_called_damaged(name: str, tmp_path: Path) -> None:
    file, content = DAMAGED[name]
    with pytest.raises(InputError, match=r"damaged|cut off|numbers for") as caught:
        load_scene(write(tmp_path, {file: content}))
    assert str(tmp_path) in str(caught.value)


def test_a_description_reaches_no_file_outside_its_folder(tmp_path: Path) -> None:
    files = sog(GAUSSIANS, 2)
    folder = tmp_path / "scene"
    folder.mkdir()
    (tmp_path / "secret.webp").write_bytes(files["sh0.webp"])
    files["meta.json"] = files["meta.json"].replace(b'"sh0.webp"', b'"../secret.webp"')
    with pytest.raises(InputError, match=r"is not a file beside meta\.json"):
        load_scene(write(folder, files))


def test_what_spackle_writes_as_glb_it_reads_with_camera_and_base_count(tmp_path: Path) -> None:
    lens = Camera.from_focal(50, 64, 48)
    camera = lens.looking(torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.5, 4.0]))
    path = tmp_path / "a.glb"
    path.write_bytes(SCENE_ENCODERS[".glb"](SceneFile(path, GAUSSIANS, camera, 20)))
    found = load_scene(path)
    assert_same(found.gaussians, GAUSSIANS, EXACT)
    assert (found.base_count, found.writer) == (20, "Spackle")
    assert found.camera is not None
    torch.testing.assert_close(found.camera.K, camera.K)
    pose = camera.world_to_camera.float()
    torch.testing.assert_close(found.camera.world_to_camera, pose)
    path.write_bytes(SCENE_ENCODERS[".glb"](SceneFile(path, GAUSSIANS)))
    assert load_scene(path).camera is load_scene(path).base_count is None


def test_both_versions_of_spz_hold_the_same_gaussians(tmp_path: Path) -> None:
    scene = SceneFile(tmp_path / "a", GAUSSIANS)
    loaded = []
    for suffix in (".spz", ".v4.spz"):
        path = tmp_path / f"a{suffix}"
        path.write_bytes(SCENE_ENCODERS[suffix](scene))
        loaded.append(load_scene(path))
    assert [file.format for file in loaded] == ["SPZ 3", "SPZ 4"]
    for old, new in zip(loaded[0].gaussians.tensors, loaded[1].gaussians.tensors, strict=True):
        assert torch.equal(old, new)


def test_an_archive_that_is_no_scene_is_not_taken_for_one(tmp_path: Path) -> None:
    np.savez(tmp_path / "depth.npz", depth=np.ones((4, 4)))
    assert scene_suffix(tmp_path / "depth.npz") is None


def test_plain_colours_are_fractions_by_their_type(tmp_path: Path) -> None:
    table = without(TABLE, "f_", "n") | {
        name: Columns(GAUSSIANS).srgb[:, index]
        for index, name in enumerate(("red", "green", "blue"))
    }
    path = write(tmp_path, {"a.ply": ply(table)})
    assert_same(load_scene(path).gaussians, GAUSSIANS, EXACT)


def some_nan(count: int) -> dict[str, Any]:
    """The columns of 200 Gaussians, the first ones not finite."""
    table = inria_table(random_gaussians(200))
    table["scale_0"] = table["scale_0"].copy()
    table["scale_0"][:count] = math.nan
    return table


def test_a_few_gaussians_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    path = write(tmp_path, {"a.ply": ply(some_nan(2))})
    found = load_scene(path)
    assert_same(found.gaussians, random_gaussians(200).select(slice(2, None)), EXACT)
    assert found.notes == ("2 Gaussians that are not finite are left out",)
    glb = khr_gltf(random_gaussians(200))
    place = bytearray(glb.body)
    place[:4] = struct.pack("<f", math.nan)
    glb.body = bytes(place)
    other = load_scene(write(tmp_path, {"a.glb": glb.glb()}))
    assert len(other.gaussians) == 199
    assert "1 Gaussians that are not finite" in other.losses[0]


@pytest.mark.parametrize(("count", "comment"), [(3, "by a test"), (2, "spackle_base 150")])
def test_many_of_them_or_some_in_a_completed_scene_are_refused(
    count: int, comment: str, tmp_path: Path
) -> None:
    path = write(tmp_path, {"a.ply": ply(some_nan(count), comments=(comment,))})
    with pytest.raises(InputError, match=f"{count} of 200 Gaussians are not finite"):
        load_scene(path)


def test_rotations_of_all_axes_are_proper(tmp_path: Path) -> None:
    path = write(tmp_path, ROWS["SPZ, other axes"].files())
    rotations = quat_to_matrix(load_scene(path).gaussians.quats)
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(len(rotations)))


def test_a_scene_that_spackle_wrote_has_no_losses(tmp_path: Path) -> None:
    save_ply(GAUSSIANS, tmp_path / "a.ply")
    assert load_scene(tmp_path / "a.ply").losses == []
