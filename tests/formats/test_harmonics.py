"""Harmonics in files: plain writers' files are read as they were meant, and written ones again."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.foreign_scenes import Files, inria_table, khr_gltf, ply, sog, spz, zipped
from helpers.photos import read_ply
from helpers.scenes import box_before_wall, random_gaussians, random_harmonics, shifted

from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians
from spackle.core.view_colors import extended_linear_to_srgb
from spackle.formats import load_ply, save_ply
from spackle.formats.palette import palette_labels
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import SCENE_ENCODERS, load_scene
from spackle.render import CpuRenderer
from spackle.results.saved_scene import export_scene
from spackle.runtime.progress import Reporter
from spackle.scene import Scene

COUNT = 70  # more than a row of SOG's palette


def scene(degree: int) -> Gaussians:
    harmonics = random_harmonics(COUNT, degree).clamp(-0.5, 0.5)
    return dataclasses.replace(random_gaussians(COUNT), harmonics=harmonics)


LFU = np.array([[-1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x left, y front, z up: a mirror
READERS: dict[str, tuple[Callable[[Gaussians], Files], float]] = {
    "PLY": (lambda g: {"a.ply": ply(inria_table(g))}, 0),
    "PLY, text": (lambda g: {"a.ply": ply(inria_table(g), text=True)}, 0),
    "PLY, doubles": (lambda g: {"a.ply": ply(inria_table(g), default="double", order=">")}, 0),
    "SPZ 1": (lambda g: {"a.spz": spz(g, 1)}, 0.004),
    "SPZ 2": (lambda g: {"a.spz": spz(g, 2)}, 0.004),
    "SPZ 3": (lambda g: {"a.spz": spz(g, 3)}, 0.004),
    "SPZ 4": (lambda g: {"a.spz": spz(g, 4)}, 0.004),
    "SPZ 4, bounds": (lambda g: {"a.spz": spz(g, 4, bounds=(-1.0, 1.0))}, 0.004),
    "SPZ 4, axes": (lambda g: {"a.spz": spz(g, 4, axes=11, basis=LFU)}, 0.02),
    "SOG 2": (lambda g: {"a.sog": zipped(sog(g, 2))}, 0.005),
    "SOG 1": (lambda g: {"a.sog": zipped(sog(g, 1))}, 0.005),
    "glTF": (lambda g: {"a.glb": khr_gltf(g).glb()}, 1e-6),
}


def write(folder: Path, files: Files) -> Path:
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder / next(iter(files))


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_of_another_program_are_read(name: str, degree: int, tmp_path: Path) -> None:
    writer, bound = READERS[name]
    expected = scene(degree)
    found = load_scene(write(tmp_path, writer(expected)))
    assert found.gaussians.harmonics is not None
    assert expected.harmonics is not None
    torch.testing.assert_close(found.gaussians.harmonics, expected.harmonics, rtol=0, atol=bound)
    assert (found.harmonics_degree, found.losses) == (degree, [])


def test_a_node_of_gltf_turns_the_colours_with_its_gaussians(tmp_path: Path) -> None:
    some = scene(3)
    file = khr_gltf(some)
    half = 0.5**0.5
    file.node |= {"rotation": [0, half, 0, half], "translation": [1, 2, 3], "scale": [2, 2, 2]}
    found = load_scene(write(tmp_path, {"a.glb": file.glb()})).gaussians
    # A quarter turn about y up, along OpenCV's axes: x left becomes x right, y up becomes y down.
    turn = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    axes = torch.diag(torch.tensor([-1.0, -1, 1]))
    matrix = torch.eye(4)
    matrix[:3, :3] = 2 * axes @ turn @ axes
    matrix[:3, 3] = axes @ torch.tensor([1.0, 2, 3])
    expected = some.transform(matrix)
    torch.testing.assert_close(found.means, expected.means, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.harmonics, expected.harmonics, rtol=0, atol=1e-5)
    # A stretch alone turns no colour.
    file = khr_gltf(some)
    file.node["scale"] = [1, 3, 0.5]
    found = load_scene(write(tmp_path, {"b.glb": file.glb()})).gaussians
    torch.testing.assert_close(found.harmonics, some.harmonics, rtol=0, atol=1e-5)


def test_colours_outside_of_0_to_1_are_kept_where_harmonics_add_to_them(tmp_path: Path) -> None:
    table = inria_table(scene(3))
    table["f_dc_1"] = table["f_dc_1"] * 4
    constants = np.stack([table[f"f_dc_{i}"] for i in range(3)], axis=1)
    srgb = torch.from_numpy(constants * 0.28209479177387814 + 0.5)
    found = load_scene(write(tmp_path, {"a.ply": ply(table)})).gaussians
    assert float(srgb.min()) < -0.2
    torch.testing.assert_close(
        extended_linear_to_srgb(found.colors.double()), srgb, rtol=1e-5, atol=1e-5
    )
    plain = {name: values for name, values in table.items() if not name.startswith("f_rest")}
    clamped = load_scene(write(tmp_path, {"b.ply": ply(plain)})).gaussians
    torch.testing.assert_close(
        linear_to_srgb(clamped.colors.double()), srgb.clamp(0, 1), rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize("missing", ["f_rest_44", "f_rest_3"])
def test_incomplete_harmonics_are_dropped(missing: str, tmp_path: Path) -> None:
    table = {name: values for name, values in inria_table(scene(3)).items() if name != missing}
    found = load_scene(write(tmp_path, {"a.ply": ply(table)}))
    assert found.gaussians.harmonics is None
    assert "are dropped: colours do not change" in " ".join(found.losses)


def test_a_gaussian_whose_harmonics_are_not_finite_is_left_out(tmp_path: Path) -> None:
    some = dataclasses.replace(random_gaussians(300), harmonics=random_harmonics(300, 1))
    table = inria_table(some)
    table["f_rest_4"][7] = np.nan
    found = load_scene(write(tmp_path, {"a.ply": ply(table)}))
    assert len(found.gaussians) == 299
    assert "1 Gaussians that are not finite are left out" in " ".join(found.losses)


# The largest error of a coefficient, by the suffix of a format that keeps harmonics.
KEPT = {".ply": 0, ".compressed.ply": 0.017, ".spz": 0.009, ".v4.spz": 0.009, ".sog": 0.02}
KEPT |= {".glb": 0}


@pytest.mark.parametrize("suffix", KEPT)
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_written_harmonics_are_read_again(suffix: str, degree: int, tmp_path: Path) -> None:
    some = scene(degree)
    path = write(tmp_path, {f"a{suffix}": SCENE_ENCODERS[suffix](SceneFile(Path("a"), some))})
    found = load_scene(path)
    assert (found.harmonics_degree, found.losses) == (degree, [])
    assert found.gaussians.harmonics is not None
    assert some.harmonics is not None
    nearest = torch.cdist(some.means, found.gaussians.means).argmin(1)  # the order may change
    torch.testing.assert_close(
        found.gaussians.harmonics[nearest], some.harmonics, rtol=0, atol=KEPT[suffix]
    )


@pytest.mark.parametrize("suffix", KEPT)
def test_a_written_scene_looks_the_same_from_two_places(suffix: str, tmp_path: Path) -> None:
    box = box_before_wall(width=64, height=48, focal=60)
    base = box.base()
    # As in scenes that were trained: higher degrees are weaker.
    weights = torch.cat([torch.full((n,), w) for n, w in ((3, 0.5), (5, 0.3), (7, 0.2))])
    harmonics = weights[:, None] * random_harmonics(len(base), 3)
    some = dataclasses.replace(base, colors=0.2 + 0.6 * base.colors, harmonics=harmonics)
    path = write(tmp_path, {f"a{suffix}": SCENE_ENCODERS[suffix](SceneFile(Path("a"), some))})
    found = load_scene(path).gaussians
    for camera in (box.camera, shifted(box.camera, 0.5)):
        before, after = (CpuRenderer().render(g, camera).rgb for g in (some, found))
        plain = CpuRenderer().render(some.with_harmonics_count(0), camera).rgb
        error = float((before - after).square().mean())
        assert error < float((before - plain).square().mean()) / 50
        assert -10 * np.log10(max(error, 1e-12)) > 35


def test_a_ply_keeps_the_bits_of_the_first_gaussians(tmp_path: Path) -> None:
    base, aux = scene(3), random_gaussians(30, seed=9)
    save_ply(base, tmp_path / "base.ply")
    save_ply(Gaussians.cat([base, aux]), tmp_path / "filled.ply", base_count=COUNT)
    one, other = (read_ply(tmp_path / f"{name}.ply") for name in ("base", "filled"))
    assert one.names == other.names
    assert len(one.names) == 17 + 45
    assert other.body.startswith(one.body)
    assert not np.frombuffer(other.body, "<f4").reshape(-1, 62)[COUNT:, 9:54].any()
    # Read and written again, too.
    loaded = load_ply(tmp_path / "filled.ply")
    assert torch.equal(loaded.harmonics[:COUNT], base.harmonics)
    save_ply(loaded, tmp_path / "again.ply", base_count=COUNT)
    again = np.frombuffer(read_ply(tmp_path / "again.ply").body, "<f4").reshape(-1, 62)
    first = np.frombuffer(other.body, "<f4").reshape(-1, 62)
    assert np.array_equal(again[:, :3], first[:, :3])
    assert np.array_equal(again[:, 9:54], first[:, 9:54])
    np.testing.assert_allclose(again, first, rtol=1e-5, atol=1e-5)


def test_what_has_no_room_for_harmonics_says_so(tmp_path: Path) -> None:
    save_ply(scene(2), tmp_path / "scene.ply")
    lines: list[str] = []

    class Lines(Reporter):
        def log(self, line: str) -> None:
            lines.append(line)

    outputs = [tmp_path / name for name in ("a.splat", "a.html", "a.spz")]
    export_scene(tmp_path / "scene.ply", outputs, Lines())
    said = [line for line in lines if "harmonics of degree 2 are dropped" in line]
    assert [Path(line.split(":")[0]).name for line in said] == ["a.splat"]
    page = Scene.load(tmp_path / "scene.ply").page("scene", "first")
    assert page.description["note"] == "first"
    assert load_scene(tmp_path / "a.splat").gaussians.harmonics is None


def test_similar_vectors_share_an_entry_of_the_palette() -> None:
    generator = np.random.default_rng(3)
    centers = generator.normal(size=(16, 9)).astype(np.float32)
    vectors = np.repeat(centers, 32, axis=0)
    vectors += 1e-3 * generator.normal(size=vectors.shape).astype(np.float32)
    labels = palette_labels(vectors, 16)
    assert sorted(np.bincount(labels)) == [32] * 16
    spread = [np.ptp(vectors[labels == label], axis=0).max() for label in range(16)]
    assert max(spread) < 0.01
    more = palette_labels(vectors, 100)
    assert len(np.unique(more)) == 100
    assert len(np.unique(np.stack([labels, more]), axis=1)[0]) == 100  # groups are only divided
    few = palette_labels(np.repeat(vectors[:5], 3, axis=0), 1000)
    assert len(np.unique(few)) == 5
