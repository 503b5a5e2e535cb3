"""`spackle info`: describe a file, and name commands that take the file."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL import Image

from spackle.clips.files import is_clip, read_clip
from spackle.core.camera import Camera
from spackle.core.photo import load_photo
from spackle.depth.depth_map import NEAR_AND_FAR_QUANTILES
from spackle.depth.in_photo.layouts import load_photo_depth
from spackle.depth.readers import DEPTH_SUFFIXES, load_depth
from spackle.formats.scene_files import load_scene, scene_suffix
from spackle.runtime.files import check_file
from spackle.runtime.progress import Reporter

Facts = dict[str, object]


def show_info(path: Path, reporter: Reporter) -> None:
    """Describe a scene, photo, depth map or clip; InputError for other files."""
    check_file(path, "scene, photo, depth map or clip")
    if scene_suffix(path):
        facts = scene_facts(path)
    else:
        facts = (
            clip_facts(path)
            if is_clip(path)
            else depth_facts(path)
            if is_depth(path)
            else photo_facts(path)
        )
    reporter.result({"file": path, **facts})
    if not reporter.as_json:
        for name, value in facts.items():
            print(f"{name:<12} {value}")


def is_depth(path: Path) -> bool:
    """Whether a file is a depth map, by its suffix or, for a PNG, by 16 bits in one channel."""
    if path.suffix.lower() != ".png":
        return path.suffix.lower() in DEPTH_SUFFIXES
    try:
        with Image.open(path) as image:
            return image.mode.startswith("I")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return False  # the reader of photos reports the error


def scene_facts(path: Path) -> Facts:
    scene = load_scene(path)
    count, base = len(scene.gaussians), scene.base_count
    parts = (
        "number of base Gaussians unknown"
        if base is None
        else f"{base:,} base, {count - base:,} aux"
    )
    facts: Facts = {"kind": f"scene ({scene_suffix(path)})", "Gaussians": f"{count:,} ({parts})"}
    depths = scene.gaussians.means[:, 2].double().numpy()
    near, middle, far = np.quantile(
        depths, [NEAR_AND_FAR_QUANTILES[0], 0.5, NEAR_AND_FAR_QUANTILES[1]]
    )
    facts["depth"] = (
        f"{near:.3g} near, {middle:.3g} median, {far:.3g} far (metres if the base is metric)"
    )
    facts["camera"] = (
        "not stored: give --fov, and --size to `spackle render`"
        if scene.camera is None
        else lens_of(scene.camera)
    )
    if scene.disparity is not None:
        facts["completed"] = f"for --disparity {scene.disparity:g}"
    if scene.unread_harmonics:
        facts["harmonics"] = f"{scene.unread_harmonics} of each Gaussian above degree 0, not read"
    facts["next"] = (
        f"spackle view {path}; `spackle render` makes a video, `spackle export` other formats"
    )
    return facts


def lens_of(camera: Camera) -> str:
    """Size and focal length of a camera in words."""
    focal = camera.focal[0]
    fov = math.degrees(2 * math.atan(camera.width / 2 / focal))
    return f"{camera.width}×{camera.height}, focal length {focal:.1f} px, {fov:.1f}° wide"


def clip_facts(path: Path) -> Facts:
    clip = read_clip(path)
    size, rate = f"{clip.width}×{clip.height}", f"{len(clip)}, {float(clip.rate):.4g} a second"
    facts: Facts = {
        "kind": "clip",
        "size": size,
        "frames": rate,
        "seconds": f"{float(clip.seconds):.3g}",
    }
    return facts | {"sound": clip.audio or "none", "next": f"spackle predict {path} -o out"}


def depth_facts(path: Path) -> Facts:
    found = load_depth(path)
    height, width = found.depth.shape
    facts: Facts = {"kind": "depth map", "size": f"{width}×{height}", "holds": found.quantity}
    facts |= {
        "depth": found.range_in_words,
        "unknown": f"{float((~found.valid).float().mean()):.1%} of the pixels",
    }
    return facts | {"next": f"spackle predict PHOTO --depth {path}"}


def photo_facts(path: Path) -> Facts:
    photo = load_photo(path, keep_frame=False)
    facts: Facts = {"kind": "photo", "size": f"{photo.width}×{photo.height}"}
    facts["camera"] = f"{lens_of(photo.camera)} ({photo.focal_source.value})"
    if photo.frame is not None:
        facts["frame"] = "a uniform frame is cropped; --keep-frame keeps the frame"
    inside = load_photo_depth(path)
    facts["depth"] = (
        "none inside" if inside is None else f"inside: {inside.note}; {inside.range_in_words}"
    )
    return facts | {"next": f"spackle predict {path} -o out; spackle view {path}"}
