"""What `spackle info` says about a scene, photo, depth map or clip."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL.Image import DecompressionBombError

from spackle.clips.files import is_clip, read_clip
from spackle.core.camera import Camera
from spackle.core.image_files import open_image
from spackle.core.photo import load_photo
from spackle.depth.depth_map import NEAR_AND_FAR_QUANTILES
from spackle.depth.in_photo.layouts import load_photo_depth
from spackle.depth.readers import DEPTH_SUFFIXES, load_depth
from spackle.formats.scene_files import is_scene_folder, load_scene, scene_suffix
from spackle.runtime.files import check_file
from spackle.runtime.progress import Reporter

FactsOfFile = dict[str, object]  # by the name that the terminal shows


def print_facts(path: Path, reporter: Reporter) -> None:
    """Describe a scene, photo, depth map or clip; InputError for other files."""
    if not is_scene_folder(path):
        check_file(path, "scene, photo, depth map or clip")
    # A file that is none of the others is read as a photo; the reader of photos refuses all else.
    if scene_suffix(path):
        facts = scene_facts(path)
    elif is_clip(path):
        facts = clip_facts(path)
    elif is_depth_map(path):
        facts = depth_facts(path)
    else:
        facts = photo_facts(path)
    reporter.result({"file": path, **facts})
    if not reporter.as_json:
        for name, value in facts.items():
            print(f"{name:<12} {value}")


def is_depth_map(path: Path) -> bool:
    """Whether a file is a depth map, by its suffix or, for a picture, by its kind of numbers."""
    # Photos, too, may be PNG and TIFF files, so for these the suffix decides nothing.
    suffix = path.suffix.lower()
    if suffix not in (".png", ".tif", ".tiff"):
        return suffix in DEPTH_SUFFIXES
    try:
        with open_image(path, ("PNG", "TIFF")) as image:
            # Pillow's modes: F for floats, I… for whole numbers over 8 bits. A grey TIFF of those
            # is more often the scan of a photo.
            return image.mode == "F" or (suffix == ".png" and image.mode.startswith("I"))
    except (OSError, ValueError, SyntaxError, DecompressionBombError):
        return False  # the reader of photos reports the error


def scene_facts(path: Path) -> FactsOfFile:
    """Counts, depths and camera of a scene; InputError for a file that cannot be read."""
    scene = load_scene(path)
    count = len(scene.gaussians)
    # Only our own files say how many Gaussians come from the photo (base), before those that fill
    # holes (aux).
    if scene.base_count is None:
        parts = "number of base Gaussians unknown"
    else:
        parts = f"{scene.base_count:,} base, {count - scene.base_count:,} aux"
    facts: FactsOfFile = {
        "kind": f"scene ({scene_suffix(path)})",
        "Gaussians": f"{count:,} ({parts})",
        "format": scene.format,
    }
    if scene.writer is not None:
        facts["written by"] = scene.writer

    # Quantiles instead of the extremes, because a few stray Gaussians lie far from all others.
    depths = scene.gaussians.means[:, 2].double().numpy()  # [N]
    near_quantile, far_quantile = NEAR_AND_FAR_QUANTILES
    near, median, far = np.quantile(depths, [near_quantile, 0.5, far_quantile])
    facts["depth"] = (
        f"{near:.3g} near, {median:.3g} median, {far:.3g} far (metres if the base is metric)"
    )
    if scene.camera is None:
        facts["camera"] = "not stored: give --fov, and --size to `spackle render`"
    else:
        facts["camera"] = describe_camera(scene.camera)
    if scene.disparity is not None:
        facts["completed"] = f"for --disparity {scene.disparity:g}"
    if scene.losses:
        facts["notes"] = "; ".join(scene.losses)
    facts["next"] = (
        f"spackle view {path}; `spackle render` makes a video, `spackle export` other formats"
    )
    return facts


def describe_camera(camera: Camera) -> str:
    """Size and focal length of a camera in words."""
    # The horizontal focal length, because the field of view is that of the width.
    focal_px = camera.focal[0]
    fov_degrees = math.degrees(2 * math.atan(camera.width / 2 / focal_px))
    size = f"{camera.width}×{camera.height}"
    return f"{size}, focal length {focal_px:.1f} px, {fov_degrees:.1f}° wide"


def clip_facts(path: Path) -> FactsOfFile:
    """Size, frames, duration and sound of a clip; InputError for a clip that cannot be read."""
    clip = read_clip(path)
    return {
        "kind": "clip",
        "size": f"{clip.width}×{clip.height}",
        "frames": f"{len(clip)}, {float(clip.rate):.4g} a second",
        "seconds": f"{float(clip.seconds):.3g}",
        "sound": clip.audio or "none",
        "next": f"spackle predict {path} -o out",
    }


def depth_facts(path: Path) -> FactsOfFile:
    """Size, meaning and range of a depth map; InputError for a map that cannot be read."""
    depth_map = load_depth(path)
    height, width = depth_map.depth.shape
    unknown_ratio = float((~depth_map.valid).float().mean())
    return {
        "kind": "depth map",
        "size": f"{width}×{height}",
        "holds": f"{depth_map.quantity}, read as {depth_map.meaning}",
        "depth": depth_map.range_in_words,
        "unknown": f"{unknown_ratio:.1%} of the pixels",
        "next": f"spackle predict PHOTO --depth {path}",
    }


def photo_facts(path: Path) -> FactsOfFile:
    """Size, camera and depth of a photo; InputError for a photo that cannot be read."""
    photo = load_photo(path, keep_frame=False)
    facts: FactsOfFile = {
        "kind": "photo",
        "size": f"{photo.width}×{photo.height}",
        "camera": f"{describe_camera(photo.camera)} ({photo.focal_source.value})",
    }
    if photo.frame is not None:
        facts["frame"] = "a uniform frame is cropped; --keep-frame keeps the frame"
    depth_map = load_photo_depth(path)
    if depth_map is None:
        facts["depth"] = "none inside"
    else:
        facts["depth"] = f"inside: {depth_map.note}; {depth_map.range_in_words}"
    if photo.notes:
        facts["note"] = "; ".join(photo.notes)
    facts["next"] = f"spackle predict {path} -o out; spackle view {path}"
    return facts
