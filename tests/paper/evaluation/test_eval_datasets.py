"""Datasets of the evaluation: small trees in the official formats, projections of known points,
and scales."""

from __future__ import annotations

import dataclasses
import math
import shutil
import struct
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from helpers import DATA
from helpers.photos import write_photo
from numpy.typing import NDArray

from spackle.bases.settings import BaseSettings
from spackle.core.camera import Camera
from spackle.core.focal_length import FocalSource
from spackle.core.photo import working_size
from spackle.depth.depth_map import DepthMap
from spackle.paper.evaluation.alignment import align, camera_in_base_scene
from spackle.paper.evaluation.case import Case, Points, SecondViews, known_depth, load_case
from spackle.paper.evaluation.datasets import DATASETS, read_cases
from spackle.paper.evaluation.datasets.multiview import (
    PosedPhoto,
    make_cases,
    spread_over_scenes,
)
from spackle.paper.evaluation.evaluation import choose_second_views, open_evaluation
from spackle.paper.evaluation.options import EvaluateOptions
from spackle.runtime.errors import InputError

Array = NDArray[Any]
# Of the stored photos, in pixels.
WIDTH, HEIGHT = 48, 36
FOCAL = 40.0
POINTS = np.array(
    [[x, y, 4 + 0.5 * x + 0.2 * y] for x in (-1.0, -0.3, 0.4, 1.1) for y in (-0.8, 0.0, 0.7)]
)


@dataclasses.dataclass(frozen=True)
class Eye:
    """A camera that uses no code of the package: OpenCV axes, the first pixel's corner is (0,
    0)."""

    at: tuple[float, float, float]
    turn: float = 0.0  # radians to the right

    @property
    def to_world(self) -> Array:
        """[4, 4], columns right, down, forward, eye."""
        c = np.cos(self.turn)
        s = np.sin(self.turn)
        return np.array(
            [[c, 0, s, self.at[0]], [0, 1, 0, self.at[1]], [-s, 0, c, self.at[2]], [0, 0, 0, 1.0]]
        )

    def pixel(self, point: Array) -> tuple[float, float, float]:
        """x, y and depth."""
        right, down, forward, eye = self.to_world[:3].T
        x, y, z = (float((point - eye) @ axis) for axis in (right, down, forward))
        return FOCAL * x / z + WIDTH / 2, FOCAL * y / z + HEIGHT / 2, z


EYES = [
    Eye((0, 0, 0)),
    Eye((0.4, 0, 0), -0.06),
    Eye((0, 0.5, 0.1), 0.05),
    Eye((0.9, 0, 0)),
    Eye((-0.5, 0.1, 0), 0.02),
]


def stored(name: str, scene: Path) -> Path:
    """A stored scene with photos of `WIDTH` by `HEIGHT`.

    WildRGB-D's has the cameras `EYES`, with smaller distances; LLFF's, ETH3D's and Tanks and
    Temples' have `EYES` and, as COLMAP models, `POINTS`; LLFF's photos have a quarter of the size
    in the poses.
    """
    return Path(shutil.copytree(DATA / "datasets" / name, scene))


def lens(model: int, *numbers: float) -> bytes:
    """Content of a cameras.bin."""
    return struct.pack(f"<QiiQQ{len(numbers)}d", 1, 4, model, WIDTH, HEIGHT, *numbers)


PLACES = {
    "middlebury": "Piano-perfect",
    "booster": "train/balanced/Bathroom",
    "wildrgbd": "apple/scenes/scene_000",
    "eth3d": "courtyard",
    "llff": "llff_fern",
    "tanks": "Truck",
}


def error_of(name: str, root: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_cases(name, root)
    message = str(caught.value)
    assert "\n" not in message
    return message


MIDDLEBURY, BOOSTER, WILD = (PLACES[name] for name in ("middlebury", "booster", "wildrgbd"))
MODEL = "courtyard/dslr_calibration_undistorted"
BROKEN: list[
    tuple[str, str, str | None, str]
] = [  # dataset, file, its content (None: no file), the message
    ("middlebury", f"{MIDDLEBURY}/disp0.pfm", None, "no disp0GT.pfm or disp0.pfm"),
    ("booster", f"{BOOSTER}/disp_00.npy", None, "give train/balanced"),
    ("llff", "llff_fern/images_4/image001.png", None, "5 rows, but there are 4 photos"),
    ("tanks", "Truck/sparse/0/cameras.bin", None, "expected cameras, images, points3D"),
    ("eth3d", f"{MODEL}/images.txt", None, "images.txt: "),
    ("middlebury", f"{MIDDLEBURY}/calib.txt", "cam0=[1 2]\n", "calib.txt: "),
    (
        "booster",
        f"{BOOSTER}/calib_00-02.xml",
        "<opencv_storage><proj_matL/></opencv_storage>",
        "calib_00-02.xml: ",
    ),
    ("wildrgbd", f"{WILD}/metadata", '{"w": 4, "h": 3, "K": [1, 2]}', "metadata: "),
    ("wildrgbd", f"{WILD}/cam_poses.txt", "0 1 2 3\n", "cam_poses.txt: "),
    ("eth3d", f"{MODEL}/cameras.txt", "4 PINHOLE 48 36 40 40\n", "cameras.txt: "),
    ("llff", "llff_fern/poses_bounds.npy", "not NumPy", "poses_bounds.npy: "),
    ("tanks", "Truck/sparse/0/points3D.bin", "\xff" * 30, "points3D.bin: "),
    ("wildrgbd", f"{WILD}/cam_poses.txt", "0 " + "0 " * 16 + "\n1 " + "1 " * 16, "cam_poses.txt: "),
]


@pytest.mark.parametrize(("name", "file", "content", "says"), BROKEN)
def test_a_lost_or_damaged_file_is_named(
    name: str, file: str, content: str | None, says: str, tmp_path: Path
) -> None:
    stored(name, tmp_path / PLACES[name])
    (tmp_path / file).unlink()
    if content is not None:
        (tmp_path / file).write_bytes(content.encode("latin-1"))
    assert says in error_of(name, tmp_path)


def test_odd_poses_and_bent_lenses_are_refused(tmp_path: Path) -> None:
    assert "no such folder" in error_of("llff", tmp_path / "nowhere")
    assert "no scene of llff in this folder or below: expected SCENE/poses_bounds.npy" in error_of(
        "llff", tmp_path
    )
    path = stored("llff", tmp_path / "poses" / "fern") / "poses_bounds.npy"
    table = np.load(path)
    table[2, :3] = 1e30  # no rotation
    np.save(path, table)
    assert "poses_bounds.npy: image002.png: " in error_of("llff", tmp_path / "poses")
    cameras = stored("tanks", tmp_path / "tanks/Truck") / "sparse/0/cameras.bin"
    cameras.write_bytes(lens(2, FOCAL, WIDTH / 2, HEIGHT / 2, 0.4))
    assert "distorts the corners of photos: undistort" in error_of("tanks", tmp_path / "tanks")
    # FULL_OPENCV: k1, k2, p1, p2, then k3 of r⁷ and the divisor's k4, k5, k6.
    pinhole = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    for place in (4, 5):
        distortion = [0.0] * 8
        distortion[place] = 0.4
        cameras.write_bytes(lens(6, *pinhole, *distortion))
        assert "distorts the corners" in error_of("tanks", tmp_path / "tanks")
    cameras.write_bytes(lens(6, *pinhole, *[0.0] * 8))
    assert read_cases("tanks", tmp_path / "tanks")
    # The corners of a long lens are near the axis.
    cameras.write_bytes(lens(2, 20 * FOCAL, WIDTH / 2, HEIGHT / 2, 0.4))
    assert read_cases("tanks", tmp_path / "tanks")
    cameras.write_bytes(lens(5, *[1.0] * 8))
    assert "camera model OPENCV_FISHEYE is not a pinhole" in error_of("tanks", tmp_path / "tanks")


def assert_pair(
    case: Case, disparity: float, z: float, x: int = 30, y: int = 9
) -> tuple[torch.Tensor, torch.Tensor]:
    """Check where the right camera sees the centre of a left pixel; returns the pixels with known
    depth, and K."""
    assert case.camera is not None
    assert case.read_depth is not None
    known = case.read_depth()
    K = case.camera.K
    assert bool(known.valid[y, x])
    point = case.camera.unproject(torch.tensor([x + 0.5, y + 0.5]), known.depth[y, x])
    uv, depth = case.second_views[0].camera.project(point)
    torch.testing.assert_close(uv, torch.tensor([x + 0.5 - disparity, y + 0.5]), atol=1e-3, rtol=0)
    torch.testing.assert_close([float(depth), float(known.depth[y, x])], [z, z], rtol=1e-5, atol=0)
    return known.valid, K


def test_middlebury_2014(tmp_path: Path) -> None:
    for name, truth in (
        ("Piano-perfect", "disp0.pfm"),
        ("Piano-imperfect", "disp0.pfm"),
        ("Art", "disp0GT.pfm"),
    ):
        known = stored("middlebury", tmp_path / "trainingQ" / name) / "disp0.pfm"
        known.rename(known.with_name(truth))
    (stored("middlebury", tmp_path / "testQ/Djembe") / "disp0.pfm").unlink()
    found = read_cases("middlebury", tmp_path)
    assert [case.name for case in found] == ["Art", "Piano-perfect"]
    for case in found:
        valid, K = assert_pair(case, 5.0, FOCAL * 0.193001 / (5.0 + 3.5))
        # In the file (0, 0) is the first pixel's middle.
        assert float(K[0, 2]) == 20.75
        assert not valid[0, 0]
    stored("middlebury", tmp_path / "trainingH/Art")
    assert "give a folder with a single size" in error_of("middlebury", tmp_path)


def test_booster(tmp_path: Path) -> None:
    scene = stored("booster", tmp_path / BOOSTER)
    stored("booster", tmp_path / "train/unbalanced/Bathroom")
    (scene / "camera_00/im0.png").write_bytes(b"no picture")  # affects no other photo
    first, second = read_cases("booster", tmp_path)
    assert [first.name, second.name] == ["Bathroom/im0", "Bathroom/im1"]
    assert second.second_views[0].photo == scene / "camera_02/im1.png"
    valid, K = assert_pair(second, 7.0, FOCAL * 0.08 / (7.0 + 3.0))
    assert (K[:2, 2].tolist(), bool(valid[:2].any())) == ([22.5, 18.5], False)
    with pytest.raises(InputError, match=r"im0\.png"):
        load_case(first)


@pytest.mark.parametrize(
    ("name", "tree", "scale"),
    [
        ("wildrgbd", "wildrgbd", 0.15),
        ("eth3d", "eth3d", 1.0),
        *(("tanks", tree, 1.0) for tree in ("tanks", "tanks-text", "tanks-dense")),
        *(
            ("llff", tree, 1.0) for tree in ("llff", "llff-sparse", "llff-colmap")
        ),  # poses, a model too, a model only
    ],
)
def test_points_land_on_their_pixels(name: str, tree: str, scale: float, tmp_path: Path) -> None:
    stored(tree, tmp_path / PLACES[name])
    found = read_cases(name, tmp_path)
    names = [case.name for case in found]
    assert (
        names == sorted(names) == [case.name for case in read_cases(name, tmp_path / PLACES[name])]
    )
    assert sum(len(case.second_views) for case in found) > 5
    for case, eye in zip(found, EYES, strict=True):
        assert case.camera is not None
        assert torch.equal(case.camera.world_to_camera, torch.eye(4))
        own = np.linalg.inv(eye.to_world)
        local = torch.from_numpy(POINTS @ own[:3, :3].T + own[:3, 3]).float() * scale
        views = [
            (case.camera, eye),
            *((view.camera, EYES[names.index(view.name)]) for view in case.second_views),
        ]
        for camera, other in views:
            uv, z = camera.project(local)
            expected = torch.tensor([other.pixel(point) for point in POINTS]).float()
            torch.testing.assert_close(uv, expected[:, :2], atol=2e-3, rtol=0)
            torch.testing.assert_close(z / scale, expected[:, 2], atol=1e-4, rtol=1e-5)
        if case.read_points is not None:
            points = case.read_points()
            expected = torch.tensor(
                [eye.pixel(point) for point in POINTS]
            ).float()  # the model's point with an error of 7 px is left out
            torch.testing.assert_close(points.uv, expected[:, :2], atol=1e-4, rtol=0)
            torch.testing.assert_close(points.z, expected[:, 2], atol=1e-4, rtol=0)


def test_second_views_are_the_nearest_but_not_the_same(tmp_path: Path) -> None:
    # Cameras at x = 0, 0.01, 0.3, 0.35, 0.4, 0.5, 3, and at 0.25 turned by one radian; the middle
    # depth is 4.
    stored("llff-beside", tmp_path / "fern")
    first = read_cases("llff", tmp_path)[0]
    assert [view.name for view in first.second_views if view.is_among_nearest] == [
        "fern/image002",
        "fern/image003",
        "fern/image004",
    ]
    assert len(first.second_views) == 7  # all other photos, the nearest first
    assert [view.name for view in first.second_views][::6] == ["fern/image001", "fern/image006"]
    settings: dict[str, Any] = {
        "base": BaseSettings(name="lite"),
        "metrics": (),
        "residual": "initial",
    }
    choices: dict[SecondViews, int] = {"all": 7, "nearest": 3, "spread": 7, "adjacent": 1}
    for choice, count in choices.items():
        evaluation = open_evaluation(
            EvaluateOptions(
                dataset="llff",
                root=tmp_path,
                protocol="near-view",
                second_views=choice,
                **settings,
            )
        )
        assert len(evaluation.cases[0].second_views) == count
        assert evaluation.config["second_views"] == choice
    assert first.depth_bounds == (3.0, 6.0)


def test_by_default_video_frames_have_neighbours_and_photos_have_eight_others() -> None:
    defaults = {name: dataset.second_views for name, dataset in DATASETS.items()}
    assert {name for name, choice in defaults.items() if choice == "adjacent"} == {"wildrgbd"}
    assert {choice for name, choice in defaults.items() if name != "wildrgbd"} == {"spread"}
    for name, choice in defaults.items():
        options = EvaluateOptions(dataset=name, root=Path("unused"), protocol="near-view")
        assert options.chosen_second_views == choice

    # 300 cameras along a line, of which one has a photo on both sides.
    photos = []
    for index in range(300):
        camera = Camera.from_focal(60, 64, 48)
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = -0.01 * index
        camera = dataclasses.replace(camera, K=camera.K.double(), world_to_camera=pose)
        photos.append(PosedPhoto(f"{index:03d}", Path(f"{index}.png"), camera, middle_depth=2.0))
    (case,) = make_cases(photos, [100])
    chosen = {
        choice: [view.name for view in choose_second_views(case.second_views, choice)]
        for choice in get_args(SecondViews)
    }
    assert sorted(chosen["adjacent"]) == ["099", "101"]
    assert (len(chosen["all"]), len(chosen["spread"])) == (299, 8)
    distances = [abs(int(name) - 100) for name in chosen["spread"]]
    assert distances == sorted(distances)
    # Their mean distance is that of all views, within a few per cent.
    all_distances = [abs(int(name) - 100) for name in chosen["all"]]
    assert sum(distances) / 8 == pytest.approx(sum(all_distances) / 299, rel=0.03)


def test_frames_are_spread_evenly() -> None:
    sizes = {"Barn": 10, "Church": 1000, "Truck": 100}
    taken = spread_over_scenes(list(sizes), lambda name: range(sizes[name]), 60)
    assert {name: len(frames) for name, frames in taken.items()} == {
        "Barn": 10,
        "Church": 25,
        "Truck": 25,
    }
    assert [np.ptp(np.diff(frames)) for frames in taken.values()] == [0, 0, 0]
    assert (
        sum(
            map(
                len, spread_over_scenes(list(sizes), lambda name: range(sizes[name]), 5000).values()
            )
        )
        == 1110
    )
    scenes = [
        f"{group}/scene_{k:03d}"
        for group, n in (("apple", 200), ("box", 30), ("car", 5))
        for k in range(n)
    ]
    # With more scenes than frames each category gets its share.
    more = spread_over_scenes(scenes, lambda scene: range(300), 45)
    assert list(more.values()) == [[150]] * 45
    assert list(more) == [*scenes[:20], *scenes[200:220], *scenes[230:]]


def test_working_sizes_give_the_papers_dense_counts() -> None:
    # Width, height, and the paper's number of 2×2 cells; ETH3D's mean is 393,246.72.
    stored_sizes = [
        (4112, 3008, 431_616),  # Booster
        (640, 480, 76_800),  # WildRGB-D
        (480, 640, 76_800),
        (1920, 1080, 331_776),  # Tanks and Temples
        (1008, 756, 190_512),  # LLFF
        (6048, 4032, 393_216),  # ETH3D
        (6208, 4135, 393_216),
    ]
    for stored_width, stored_height, cells in stored_sizes:
        width, height = working_size(stored_width, stored_height)
        assert math.ceil(width / 2) * math.ceil(height / 2) == cells


def test_photos_and_cameras_are_brought_to_the_working_size(tmp_path: Path) -> None:
    stored("llff", tmp_path / "fern")
    case = read_cases("llff", tmp_path)[0]
    big = dataclasses.replace(case, photo=write_photo(tmp_path / "big.png", 96, 72))
    seconds = [
        dataclasses.replace(case.second_views[0], photo=write_photo(tmp_path / "odd.png", 36, 27))
    ]
    loaded = load_case(dataclasses.replace(big, second_views=tuple(seconds)), max_side=64)
    assert (loaded.full_photo.width, loaded.photo.width, loaded.photo.height) == (96, 64, 48)
    assert loaded.photo.focal_px == pytest.approx(FOCAL * 64 / 48)
    (second,) = loaded.second_viewpoints
    assert second.read_true_picture is not None
    assert second.read_true_picture().shape == (26, 36, 3)
    for eye, camera, width in ((EYES[0], loaded.camera, 64), (EYES[1], second.camera, 36)):
        uv, _ = camera.project(torch.tensor(POINTS).float())
        expected = torch.tensor([eye.pixel(point)[:2] for point in POINTS]).float() * width / WIDTH
        torch.testing.assert_close(uv, expected, atol=2e-3, rtol=0)


def test_files_that_are_no_photos_of_the_case(tmp_path: Path) -> None:
    stored("middlebury", tmp_path / "Piano")
    (case,) = read_cases("middlebury", tmp_path)
    write_photo(tmp_path / "Piano/im1.png", HEIGHT, WIDTH)
    with pytest.raises(
        InputError, match=r"im1\.png: 36×48 pixels upright, but the calibration is for 48×36"
    ):
        load_case(case)
    lonely = load_case(Case("lonely", write_photo(tmp_path / "lonely.png", WIDTH, HEIGHT)))
    assert (lonely.camera.width, lonely.photo.focal_source, lonely.second_viewpoints) == (
        WIDTH,
        FocalSource.ASSUMED,
        (),
    )


def ramp(height: int = 60, width: int = 80, spoilt: float = 0.0) -> torch.Tensor:
    """A depth map; a share of the pixels is five times as far."""
    depth = torch.linspace(2, 5, height)[:, None].expand(height, width)
    return torch.where(
        torch.rand(depth.shape, generator=torch.Generator().manual_seed(0)) < spoilt,
        5 * depth,
        depth,
    )


def aligned(z_base: torch.Tensor, unseen: slice = slice(0), **known: Any) -> float:
    """The scale for a base without pixels in some columns."""
    seen = torch.ones_like(z_base, dtype=torch.bool)
    seen[:, unseen] = False
    return align(
        Case("case", Path("photo.png"), Camera.from_focal(100.0, 160, 120), **known), z_base, seen
    )


def test_a_known_factor_comes_back_under_outliers() -> None:
    truth = ramp(120, 160)
    depth = DepthMap(truth, torch.rand(truth.shape) < 0.7, None, None, "depth", Path("d.npy"))
    z_base = ramp(spoilt=0.3) / 3.7
    z_base[:, :5] = torch.nan
    assert aligned(z_base, slice(5, 10), read_depth=lambda: depth) == pytest.approx(3.7, rel=0.01)
    y, x = torch.meshgrid(
        torch.arange(2, 120, 10) + 0.3, torch.arange(3, 160, 10) + 0.9, indexing="ij"
    )
    inside = torch.stack([x, y], -1).reshape(-1, 2)
    uv = torch.cat([inside, torch.tensor([[500.0, 5.0], [-1.0, 5.0]])])
    points = Points(uv, 0.25 * (2 + 3 * uv[:, 1] / 120))
    assert aligned(ramp(spoilt=0.2), read_points=lambda: points) == pytest.approx(0.25, rel=0.02)


def test_bounds_are_the_last_resort_and_nothing_is_an_error() -> None:
    assert aligned(ramp(), depth_bounds=(4.0, 10.0)) == pytest.approx(2.0, rel=1e-3)
    for known in ({}, {"read_points": lambda: Points(torch.ones(3, 2), torch.ones(3))}):
        with pytest.raises(InputError, match="case: the base's scale cannot be found"):
            aligned(ramp(), **known)


@pytest.mark.parametrize(
    ("turn", "off", "tolerance"),
    [(0.0, (9.0, -4.0), 1e-3), (0.2, (0.0, 0.0), 1e-3), (0.05, (1.0, 0.5), 0.02)],
)
def test_a_second_camera_in_the_bases_world(
    turn: float, off: tuple[float, float], tolerance: float
) -> None:
    base = Camera.from_focal(40.0, 48, 36)
    scale = 2.5
    K = base.K.clone()
    K[:2, 2] += torch.tensor(off)
    given = Camera(K, torch.eye(4), 48, 36).resized(96, 72)
    pose = torch.from_numpy(np.linalg.inv(Eye((0.4, 0.1, -0.2), turn).to_world)).float()
    view = dataclasses.replace(given, world_to_camera=pose)
    pixels = torch.rand(50, 2, generator=torch.Generator().manual_seed(2)) * torch.tensor(
        [48.0, 36.0]
    )
    z_base = torch.linspace(0.8, 3.0, 50)
    expected, z = view.project(given.unproject(2 * pixels, scale * z_base))
    moved = camera_in_base_scene(view, given, base, scale)
    uv, z_moved = moved.project(base.unproject(pixels, z_base))
    torch.testing.assert_close(uv, expected, atol=tolerance * 96, rtol=0)
    torch.testing.assert_close(z_moved * scale, z, rtol=0.02, atol=0)
    rotation = moved.world_to_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-6, rtol=0)
    assert (moved.width, moved.height) == (view.width, view.height)


def test_points_are_a_depth_map_with_gaps_and_the_nearest_stay() -> None:
    camera = Camera.from_focal(10, 6, 4)
    uv = torch.tensor(
        [[0.5, 0.5], [5.9, 3.9], [2.2, 1.7], [2.9, 1.1], [6.0, 1.0], [1.0, -0.1], [3.5, 2.5]]
    )
    points = Points(uv, torch.tensor([4.0, 5.0, 7.0, 3.0, 2.0, 2.0, -1.0]))
    found = known_depth(Case("a", Path("a.png"), camera, read_points=lambda: points))
    assert found.valid.nonzero().tolist() == [[0, 0], [1, 2], [3, 5]]
    assert found.depth[found.valid].tolist() == [4.0, 3.0, 5.0]
    outside = Points(uv[4:6], torch.ones(2))
    with pytest.raises(InputError, match="not one of its 2 points lies in the photo"):
        known_depth(Case("a", Path("a.png"), camera, read_points=lambda: outside))
