"""Export: independent readers compare every format with the scene; messages of the command."""

from __future__ import annotations

import dataclasses
import io
import math
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import DATA
from helpers.plain_scenes import FORMATS, gaussians_of, glb_parts
from helpers.scenes import box_before_wall, psnr, random_gaussians, shifted, slanted_plane
from rich.console import Console

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians, quat_to_matrix
from spackle.formats import load_ply, save_ply
from spackle.formats.compressed_ply import morton_order, spatial_order
from spackle.formats.quantization import ordinary_length_factor
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import SCENE_ENCODERS, encoder_for, load_scene
from spackle.formats.spz import MAX_BYTES_PER_GAUSSIAN
from spackle.render import CpuRenderer
from spackle.results.saved_scene import PAGE_ENCODERS, export_scene
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Reporter
from spackle.scene import Scene

CPU = CpuRenderer()
BOX = box_before_wall(width=64, height=48, focal=54)
# Bounds of a format's rounding: PSNR between renders, and the largest errors of position (in
# standard deviations), of the logarithm of a scale, of an axis, of sRGB and of opacity.
BOUNDS = {
    "compressed.ply": (50, 0.1, 0.01, 0.005, 0.003, 0.003),
    "spz": (43, 0.04, 0.04, 0.01, 0.008, 0.003),
    "v4.spz": (43, 0.04, 0.04, 0.01, 0.008, 0.003),
    "splat": (50, 0.0, 1e-5, 0.02, 0.003, 0.003),
    "sog": (50, 0.1, 0.03, 0.02, 0.006, 0.003),
    "glb": (80, 0.0, 1e-5, 1e-5, 1e-5, 1e-6),
}


def encode(
    kind: str, gaussians: Gaussians, camera: Camera | None = None, base_count: int | None = None
) -> bytes:
    path = Path(f"a.{kind}")
    return encoder_for(path)(SceneFile(path, gaussians, camera, base_count, 0.2))


def read(kind: str, data: bytes) -> Gaussians:
    """Read with an independent reader."""
    return gaussians_of(FORMATS[kind](data), flipped=kind.endswith(("spz", "glb")))


def in_file_order(kind: str, gaussians: Gaussians, base_count: int = 0) -> Gaussians:
    """The Gaussians in the file's order; a compressed PLY sorts them by position."""
    if kind != "compressed.ply":
        return gaussians
    parts = [gaussians.select(slice(0, base_count)), gaussians.select(slice(base_count, None))]
    return Gaussians.cat(
        part.select(torch.from_numpy(spatial_order(part.means.numpy()))) for part in parts
    )


def looks(found: Gaussians, gaussians: Gaussians, *cameras: Camera) -> float:
    """The lowest PSNR between renders of two scenes."""
    return min(
        psnr(CPU.render(found, camera).rgb, CPU.render(gaussians, camera).rgb) for camera in cameras
    )


@pytest.mark.parametrize("kind", FORMATS)
def test_a_scene_read_back_is_the_scene(kind: str) -> None:
    decibels, place, size, turn, color, opacity = BOUNDS[kind]
    gaussians = random_gaussians()
    found = read(kind, encode(kind, gaussians))
    expected = in_file_order(kind, gaussians)
    middle = expected.scales.median(dim=1).values[:, None]
    assert float(((found.means - expected.means).abs() / middle).max()) <= place
    assert float((found.scales.log() - expected.scales.log()).abs().max()) <= size
    ball = expected.scales.amax(dim=1) < 1.07 * expected.scales.amin(
        dim=1
    )  # it has no axes that could be kept
    axes = (quat_to_matrix(found.quats) - quat_to_matrix(expected.quats))[~ball]
    assert float(axes.abs().max()) <= 2 * turn
    assert (
        float((linear_to_srgb(found.colors) - linear_to_srgb(expected.colors)).abs().max()) <= color
    )
    assert float((found.opacities - expected.opacities).abs().max()) <= opacity
    base = BOX.base()
    data = encode(kind, base)
    assert data == encode(kind, base)
    assert looks(read(kind, data), base, BOX.camera, shifted(BOX.camera, 0.3)) >= decibels


EXTREMES = {
    "scales": {
        "scales": [[1e-30, 1e-30, 1e-30], [1e-6, 1.0, 1e6], [0.0, 0.1, 0.2], [math.inf, 0.1, 0.1]]
    },
    "opacities": {"opacities": [0.0, 1.0, 1e-9, 0.9999]},
    "far": {"means": [[1e6, 0, 1e6], [0, -3e7, 1.0], [0, 0, 0], [0.001, 0.002, 0.3]]},
    "quats": {
        "quats": [[-0.1, 0.2, 0.3, -0.9], [0.0, 0, 0, 0], [-1.0, 0, 0, 0], [0.5, -0.5, 0.5, -0.5]]
    },
    "colors": {"colors": [[-1.0, 0.5, 2.0], [0.0, 0, 0], [1.0, 1, 1], [1e9, -1e9, 0.2]]},
    "alike": {
        "means": [[1.0, 1, 1]] * 4,
        "scales": [[0.1, 0.1, 0.1]] * 4,
        "colors": [[0.5, 0.5, 0.5]] * 4,
    },
}


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("extreme", EXTREMES)
def test_extremes_come_back_as_well_as_the_format_can(kind: str, extreme: str) -> None:
    given = {name: torch.tensor(values) for name, values in EXTREMES[extreme].items()}
    gaussians = dataclasses.replace(random_gaussians(4), **given)
    found = read(kind, encode(kind, gaussians))
    expected = in_file_order(kind, gaussians)
    assert all(bool(torch.isfinite(t).all()) for t in found.tensors)
    torch.testing.assert_close(found.opacities, expected.opacities, rtol=0, atol=0.003)
    colors = linear_to_srgb(found.colors)
    expected_colors = linear_to_srgb(expected.colors)
    torch.testing.assert_close(colors, expected_colors, rtol=0, atol=BOUNDS[kind][4])
    if extreme != "far":
        ends = {"spz": (-10, 5.94), "compressed.ply": (-20, 20)}.get(
            kind.removeprefix("v4."), (-85, 85)
        )
        logs, expected_logs = (scene.scales.log().clamp(*ends) for scene in (found, expected))
        torch.testing.assert_close(logs, expected_logs, rtol=0, atol=0.07)
        torch.testing.assert_close(found.means, expected.means, rtol=0, atol=0.06)
    if extreme == "quats":
        unit = expected.quats.clone()
        unit[unit.norm(dim=1) == 0] = torch.tensor([1.0, 0, 0, 0])
        torch.testing.assert_close(
            quat_to_matrix(found.quats), quat_to_matrix(unit), rtol=0, atol=0.05
        )


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("extreme", [None, *EXTREMES])
def test_scenes_are_read_as_the_plainest_reader_does(
    tmp_path: Path, kind: str, extreme: str | None
) -> None:
    gaussians = random_gaussians(4 if extreme else 700)
    path = tmp_path / f"a.{kind}"
    given = {name: torch.tensor(values) for name, values in EXTREMES.get(extreme or "", {}).items()}
    path.write_bytes(
        encode(kind, dataclasses.replace(gaussians, **given), Camera.from_focal(50, 64, 48), 3)
    )
    found = load_scene(path)
    expected = read(kind, path.read_bytes())
    for mine, plain in zip(found.gaussians.tensors, expected.tensors, strict=True):
        torch.testing.assert_close(
            mine, plain, rtol=1e-4, atol=2e-5 + 1e-7 * float(plain.abs().max())
        )
    known: tuple[int | None, float | None, float | None] = (None, None, None)
    if kind in ("compressed.ply", "glb"):
        known = (3, 50.0, 0.2 if kind == "compressed.ply" else None)
    assert (found.base_count, found.camera and found.camera.focal[0], found.disparity) == known
    renamed = (
        path.rename(tmp_path / "other.bin") if kind != "splat" else path
    )  # the content decides
    assert len(load_scene(renamed).gaussians) == len(gaussians)
    assert Scene.load(renamed).to_bytes(kind) == Scene.load(renamed).to_bytes(kind)


def test_other_programs_spz() -> None:
    found = load_scene(DATA / "version_2.spz").gaussians
    flipped = torch.tensor([[0.5, 0.5, 0.5, -0.5], [1.0, 0, 0, 0], [0.6, 0, -0.8, 0]])
    torch.testing.assert_close(
        quat_to_matrix(found.quats), quat_to_matrix(flipped), atol=0.02, rtol=0
    )
    assert (found.scales == 1).all()
    assert (found.opacities == 1).all()


@pytest.mark.parametrize("kind", FORMATS)
def test_one_gaussian_and_none(kind: str) -> None:
    one = random_gaussians(1)
    torch.testing.assert_close(read(kind, encode(kind, one)).means, one.means, rtol=0, atol=0.03)
    if kind in ("sog", "glb"):
        with pytest.raises(InputError, match="without Gaussians"):
            encode(kind, Gaussians.empty())
    with pytest.raises(ValueError, match="not all finite"):
        encode(kind, dataclasses.replace(one, scales=one.scales * math.nan))


def test_glb_and_ply_keep_the_photos_camera_and_the_border(tmp_path: Path) -> None:
    lens = Camera.from_focal(50, 64, 48)
    camera = lens.looking(torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.5, 4.0]))
    gltf, _ = glb_parts(encode("glb", random_gaussians(1), camera, 1))
    scene, photo = gltf["nodes"]
    (found,) = gltf["cameras"]
    assert scene["extras"] == {"spackle_base": 1}
    assert gltf["scenes"][0]["nodes"] == [0, 1]
    assert found["extras"] == {"K": camera.K.tolist(), "width": 64, "height": 48}
    assert found["perspective"]["yfov"] == pytest.approx(2 * math.atan(24 / 50))
    assert found["perspective"]["aspectRatio"] == pytest.approx(64 / 48)
    # What lies a metre before the photo's camera lies a metre along -z of glTF's.
    there = torch.tensor(photo["matrix"]).reshape(4, 4).T @ torch.tensor([0.1, -0.2, -1.0, 1.0])
    expected = torch.linalg.inv(camera.world_to_camera) @ torch.tensor([0.1, 0.2, 1.0, 1.0])
    torch.testing.assert_close(there[:3] * torch.tensor([1.0, -1.0, -1.0]), expected[:3])
    still, _ = glb_parts(encode("glb", random_gaussians(1), lens))
    assert "matrix" not in still["nodes"][1]
    # A PLY keeps the camera's pose in a comment of its own.
    file = tmp_path / "scene.ply"
    file.write_bytes(encode("ply", random_gaussians(1), camera))
    kept = load_scene(file).camera
    assert kept is not None
    torch.testing.assert_close(kept.world_to_camera.float(), camera.world_to_camera)


def test_compressed_ply_keeps_the_base_before_the_aux() -> None:
    gaussians = random_gaussians(700)
    data = encode("compressed.ply", gaussians, Camera.from_focal(50, 64, 48), 300)
    found = read("compressed.ply", data)
    expected = in_file_order("compressed.ply", gaussians, 300)
    assert float((found.means - expected.means).abs().max()) < 0.005
    assert not torch.allclose(
        found.means, in_file_order("compressed.ply", gaussians).means, atol=0.1
    )
    assert b"comment spackle_camera 50.0 50.0 32.0 24.0 64 48\ncomment spackle_base 300\n" in data


def test_morton_order_is_that_of_interleaved_bits_of_logarithms() -> None:
    grid = np.array(np.meshgrid(*[range(8)] * 3)).reshape(3, -1).T
    points = np.vstack([grid, [1e4] * 3]).astype(np.float32)
    cells = (np.log1p(points.astype(float)) / np.log1p(1e4) * 1023).astype(int).tolist()
    curve = [
        sum((cell[axis] >> bit & 1) << (3 * bit + axis) for bit in range(10) for axis in range(3))
        for cell in cells
    ]
    assert [curve[i] for i in morton_order(points)] == sorted(curve)


def spz_scene(near: float, far: float) -> Gaussians:
    """A plane at `near` and a sky at `far`, both as fine as a photo's pixels."""
    x, y = (
        t.flatten()
        for t in torch.meshgrid(
            torch.linspace(-0.5, 0.5, 40), torch.linspace(-0.4, 0.4, 32), indexing="xy"
        )
    )
    depth = torch.where(y < 0, far, near)[:, None]
    ones = torch.ones_like(x)
    scales = depth / 60 * torch.tensor([1.0, 1.0, 0.1])
    quats = torch.eye(4)[:1].expand(len(x), 4)
    colors = 0.5 + 0.4 * torch.stack(
        [torch.sin(20 * x), torch.sin(15 * y), torch.cos(12 * x + 9 * y)], dim=1
    )
    return Gaussians(torch.stack([x, y, ones], dim=1) * depth, quats, scales, 0.99 * ones, colors)


@pytest.mark.parametrize("far", [30.0, 5000.0])
def test_spz_shows_what_is_near_and_a_far_sky(far: float) -> None:
    gaussians = spz_scene(0.3, far)
    camera = Camera.from_focal(60, 64, 48)
    found = read("spz", encode("spz", gaussians))
    assert looks(found, gaussians, camera) >= 43
    assert looks(found, gaussians, shifted(camera, 0.02, 0.3)) >= 41


def test_spz_is_an_eighth_of_the_ply() -> None:
    base = slanted_plane(1.5, 6, 0).base()
    assert len(encode("spz", base)) <= MAX_BYTES_PER_GAUSSIAN * len(base) == 68 * len(base) / 8


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save_ply(BOX.base(), tmp_path / "scene.ply", camera=BOX.camera, base_count=1000)
    return tmp_path / "scene.ply"


def export(scene: Path, *names: str) -> str:
    """Write files beside the scene, and return the log."""
    text = io.StringIO()
    export_scene(
        scene,
        [scene.parent / name for name in names],
        Reporter(console=Console(file=text, width=300)),
    )
    return text.getvalue()


def test_a_scene_never_overwrites_itself(scene: Path) -> None:
    (scene.parent / "link.ply").symlink_to(scene)
    for name in ("scene.ply", "link.ply"):
        with pytest.raises(InputError, match="is the scene itself"):
            export(scene, name)


def test_all_formats_at_once(scene: Path, tmp_path: Path) -> None:
    names = [*(f"out{suffix}" for suffix in (*SCENE_ENCODERS, *PAGE_ENCODERS)), "A.SPLAT"]
    export(scene, *names)
    base = load_ply(scene)
    for a, b in zip(load_ply(tmp_path / "out.ply").tensors, base.tensors, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)
    heads = [
        path.read_bytes().partition(b"end_header")[0] for path in (scene, tmp_path / "out.ply")
    ]
    assert heads[0] == heads[1]
    for kind in FORMATS:
        assert (
            looks(read(kind, (tmp_path / f"out.{kind}").read_bytes()), base, BOX.camera)
            >= BOUNDS[kind][0]
        )
    assert "spackle-scene" in (tmp_path / "out.html").read_text(encoding="utf-8")
    assert (tmp_path / "A.SPLAT").stat().st_size == 32 * len(base)
    assert {p.name for p in tmp_path.iterdir()} == {"scene.ply", *names}


def test_what_a_format_cannot_hold_is_said(scene: Path, tmp_path: Path) -> None:
    foreign = tmp_path / "inria.ply"
    far = tmp_path / "far.ply"
    shutil.copy(DATA / "ply" / "little float, cameras before.ply", foreign)
    save_ply(spz_scene(0.3, 5000.0), far)
    for path, says in (
        (foreign, "harmonics of degree 3 are dropped"),
        (far, "640 Gaussians beyond 1,024 m"),
        (scene, ""),
    ):
        said = export(path, "out.splat" if path == foreign else "out.spz")
        assert says in said
        assert len(said.splitlines()) == (2 if says else 1)


def with_factor(gaussians: Gaussians, factor: float) -> Gaussians:
    """The scene in another unit."""
    return dataclasses.replace(
        gaussians, means=gaussians.means * factor, scales=gaussians.scales * factor
    )


@pytest.mark.parametrize(
    ("parts", "suffix", "is_kept"),
    [
        ([1], "spz", True),
        ([0.001], "spz", True),  # stored in another unit
        ([0.001], "v4.spz", True),
        ([1e-6], "spz", True),
        ([1e5], "spz", True),
        ([0.001], "sog", True),
        ([1e7], "sog", True),
        ([0.001, 1000], "sog", False),  # steps of 0.2 mm near the origin
        ([0.001, 1000], "compressed.ply", False),  # neighbours in the file share bounds
        ([1e-6], "compressed.ply", True),
        ([0.001, 1000], "splat", True),
        ([0.001, 1000], "glb", True),
    ],
)
def test_what_a_format_is_too_coarse_for_is_said(
    scene: Path, parts: list[float], suffix: str, is_kept: bool
) -> None:
    base = BOX.base()
    save_ply(Gaussians.cat(with_factor(base, factor) for factor in parts), scene)
    said = export(scene, f"out.{suffix}")
    assert ("get a wrong place or size" not in said) == is_kept
    # The independent reader agrees: if nothing is said, Gaussians are where they were.
    stored = read(suffix, (scene.parent / f"out.{suffix}").read_bytes())
    original = in_file_order(suffix, load_ply(scene))
    # It knows nothing of the factor to an ordinary unit.
    if suffix.endswith(("spz", "sog")):
        original = with_factor(original, ordinary_length_factor(original.means.numpy()))
    middle = original.scales.median(dim=1).values
    moved = (stored.means - original.means).norm(dim=1) > middle
    if is_kept:
        assert not moved.any()


REQUESTS = [
    ("scene.ply", ["a.spz", "a.obj"], r"a\.obj: which format"),
    ("text.ply", ["a.spz", "none/a.sog"], "not a PLY"),
]


@pytest.mark.parametrize(("source", "outputs", "says"), REQUESTS)
def test_bad_requests_leave_nothing(
    scene: Path, source: str, outputs: list[str], says: str
) -> None:
    scene.with_name("text.ply").write_text("hello")
    with pytest.raises(InputError, match=says):
        export(scene.with_name(source), *outputs)
    assert {p.name for p in scene.parent.iterdir()} == {"scene.ply", "text.ply"}
    assert len(load_ply(scene)) == len(BOX.base())


LIMITS = [
    ("v4.spz", "spz.MAX_COUNT", 3000),
    ("spz", "spz.MAX_COUNT", 3000),
    ("sog", "sog.MAX_IMAGE_SIDE_PX", 40),
    ("glb", "gltf.MAX_GLB_BYTES", 1 << 17),
]


@pytest.mark.parametrize(("kind", "limit", "value"), LIMITS)
def test_too_large_a_scene_is_told_and_an_older_file_stays(
    scene: Path, monkeypatch: pytest.MonkeyPatch, kind: str, limit: str, value: int
) -> None:
    output = scene.with_suffix(f".{kind}")
    output.write_bytes(b"older")
    monkeypatch.setattr(f"spackle.formats.{limit}", value)
    with pytest.raises(InputError, match=rf"{output.name}: [0-9,]+ Gaussians are too many"):
        export(scene, output.name)
    assert output.read_bytes() == b"older"


def agree(found: Gaussians, expected: Gaussians, turn: float) -> None:
    expected = expected.to(dtype=torch.float32)
    torch.testing.assert_close(found.means, expected.means, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(found.scales, expected.scales, rtol=1e-3, atol=0)
    torch.testing.assert_close(found.opacities, expected.opacities, rtol=0, atol=1e-3)
    torch.testing.assert_close(
        quat_to_matrix(found.quats), quat_to_matrix(expected.quats), rtol=0, atol=turn
    )


def splat_transform(source: Path, target: Path, *actions: str) -> None:
    """Convert a scene with PlayCanvas's program; skip the test if there is none."""
    given = os.environ.get("SPLAT_TRANSFORM")
    found = shutil.which("splat-transform")
    if not (given or found):
        pytest.skip("splat-transform is not installed: npm install -g @playcanvas/splat-transform")
    command = ["node", given] if given else [str(found)]
    done = subprocess.run(
        [*command, "-q", source, *actions, target], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ["a.spz", "a.sog", "meta.json", "a.glb", "a.compressed.ply"])
def test_what_splat_transform_writes_is_read_as_it_was_meant(name: str, tmp_path: Path) -> None:
    gaussians = random_gaussians(50)
    save_ply(gaussians, tmp_path / "scene.ply")
    folder = tmp_path / "out"
    folder.mkdir()
    splat_transform(tmp_path / "scene.ply", folder / name)
    found = load_scene(folder / name).gaussians
    # The program sorts some formats; each Gaussian is found by its place.
    distances = torch.cdist(gaussians.means, found.means)
    order = distances.argmin(dim=1)
    assert len(set(order.tolist())) == len(gaussians)
    found = found.select(order)
    torch.testing.assert_close(found.means, gaussians.means, rtol=0, atol=0.004)
    spread = gaussians.covariances().abs().amax(dim=(1, 2), keepdim=True)
    difference = (found.covariances() - gaussians.covariances()).abs() / spread
    assert float(difference.max()) < 0.15
    colors, expected = linear_to_srgb(found.colors), linear_to_srgb(gaussians.colors)
    torch.testing.assert_close(colors, expected, rtol=0, atol=0.01)
    torch.testing.assert_close(found.opacities, gaussians.opacities, rtol=0, atol=0.004)


@pytest.mark.parametrize(
    "kind", [kind for kind in FORMATS if kind != "glb"]
)  # which it writes but does not read
def test_splat_transform_reads_the_scene(kind: str, tmp_path: Path) -> None:
    data = encode(kind, random_gaussians(50))
    path = tmp_path / f"a.{kind}"
    path.write_bytes(data)
    splat_transform(path, tmp_path / "b.ply")
    copy = load_ply(tmp_path / "b.ply")
    expected = read(kind, data)
    agree(
        copy, expected, 0.02 if kind == "splat" else 0.001
    )  # of .splat's bytes it takes 127.5 for 0, others 128
    torch.testing.assert_close(copy.colors, expected.colors.float(), rtol=0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.ply", "v3.spz", "v4.spz"])
def test_what_gsply_writes_is_read_as_it_was_meant(name: str, tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply")
    if name == "v4.spz":
        pytest.importorskip("zstandard")  # with which it compresses
    gaussians = random_gaussians(50)
    # Its SPZ has the axes of its data, which are then y up, z back.
    turn = torch.tensor([1.0, 1, -1, -1]) if name.endswith("spz") else torch.ones(4)
    data = gsply.GSData(
        means=(gaussians.means * turn[1:]).numpy(),
        scales=gaussians.scales.log().numpy(),
        quats=(torch.nn.functional.normalize(gaussians.quats, dim=1) * turn).numpy(),
        opacities=torch.logit(gaussians.opacities).numpy(),
        sh0=((linear_to_srgb(gaussians.colors) - 0.5) / 0.28209479177387814).numpy(),
        shN=np.zeros((50, 0, 3), np.float32),
    )
    if name == "a.ply":
        gsply.plywrite(tmp_path / name, data)
    else:
        gsply.write_spz(tmp_path / name, data, version=int(name[1]))
    found = load_scene(tmp_path / name)
    assert found.format == {"a.ply": "PLY", "v3.spz": "SPZ 3", "v4.spz": "SPZ 4"}[name]
    torch.testing.assert_close(found.gaussians.means, gaussians.means, rtol=0, atol=3e-4)
    spread = gaussians.covariances().abs().amax(dim=(1, 2), keepdim=True)
    difference = (found.gaussians.covariances() - gaussians.covariances()).abs() / spread
    assert float(difference.max()) < 0.15
    colors, expected = linear_to_srgb(found.gaussians.colors), linear_to_srgb(gaussians.colors)
    torch.testing.assert_close(colors, expected, rtol=0, atol=0.01)
    torch.testing.assert_close(found.gaussians.opacities, gaussians.opacities, rtol=0, atol=0.004)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["spz", "compressed.ply"])
def test_gsply_reads_the_scene_and_we_what_it_writes(kind: str, tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply")
    path = tmp_path / f"a.{kind}"
    path.write_bytes(encode(kind, random_gaussians(50)))
    raw = gsply.read_spz(path) if kind == "spz" else gsply.plyread(path)
    expected = read(kind, path.read_bytes())
    means, quats, scales, opacities = map(
        torch.as_tensor, (raw.means, raw.quats, raw.scales, raw.opacities)
    )
    flip = torch.tensor([1.0, 1.0, -1.0, -1.0]) if kind == "spz" else torch.ones(4)
    agree(
        Gaussians(means * flip[1:], quats * flip, scales.exp(), opacities.sigmoid(), means),
        expected,
        0.01,
    )
    gsply.write_spz(path, raw) if kind == "spz" else gsply.plywrite(path, raw, compressed=True)
    agree(load_scene(path).gaussians, expected, 0.01)
