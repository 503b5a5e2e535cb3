"""A scene for the page: a description as JSON, and layers of 20 bytes for each Gaussian.

Colours that change with the view, by spherical harmonics, are in a further file of a layer.

`page_scene` prepares a scene; `single_html` puts it and the page into one file.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import html
import io
import json
import math
import re
import zlib
from collections.abc import Mapping
from importlib import resources
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import extended_linear_to_srgb, linear_to_srgb, to_uint8
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import (
    DEFAULT_OVERSCAN,
    SHARP_TRAJECTORIES,
    DepthRange,
    Framing,
    TrajectoryKind,
    disparity_to_offset,
    trajectory_cameras,
)
from spackle.formats.compact_layer import compact_layer
from spackle.formats.quantization import encode_smallest_three, ordinary_length_factor
from spackle.runtime.errors import InputError

# The page interpolates linearly between this many positions along a path.
PATH_POSITIONS = 121

# How far the page's camera may go (a disparity), where the file of a scene does not say so: in a
# scene whose holes are filled, and in one of another program.
DEFAULT_LIMIT_OF_FILLED_SCENE = 0.3
DEFAULT_LIMIT_OF_UNFILLED_SCENE = 0.6
MIN_LIMIT = 0.01
MAX_LIMIT = 1.0

# Bytes of a Gaussian: 9 of the centre, 3 of the scales, 4 of the rotation, 3 of the colour, and
# 1 of the opacity.
BYTES_PER_GAUSSIAN = 20

HARMONICS_STEPS = 127  # a byte of the harmonics has so many steps above 0 and as many below

# A page with more bytes of Gaussians, 50,000 of them, is sent with coarser ones: a mail takes 10 or
# 20 MB, and a phone should not wait.
MAX_EXACT_BYTES = 1_000_000

# Scales beyond these bounds are clamped, because an outlier would cost the others precision.
MIN_SCALE = 1e-7
MAX_SCALE = 1e5
# The least range of the scales' logarithms, so that no step is 0.
MIN_LOG_SCALE_RANGE = 1e-3

# So many Gaussians are packed at a time that their values fit the processor's cache.
GAUSSIANS_PER_BLOCK = 1 << 16

# The items of a description that say how the page's camera looks and moves.
VIEWING_ITEMS = ("camera", "focus", "zNear", "orbit", "paths", "isMetric", "isPhoto")

# The places in the page where the title, the icon, the photo, the style and the script are put.
TITLE_TAG = "<title>Spackle</title>"
META_TAG = '<meta property="{name}" content="{value}">'
ICON_TAG = '<link rel="icon" href="data:,">'
PHOTO_TAG = '<img id="photo"'
STYLE_TAG = '<link rel="stylesheet" href="viewer.css">'
SCRIPT_TAG = '<script src="viewer.js" defer></script>'
LICENCES_END = "*/"  # of the comment with which viewer.js begins

# The end of a file's name, such as ".jpg", which a title does not show; but not of "Mt. Blanc".
FILE_SUFFIX = r"(?<=.)\.[^.\s]{1,5}$"

# Pixels of the long side of the picture that stands in a page until its scene is drawn, and of the
# icon in the browser's tab.
PREVIEW_SIDE_PX = 720
ICON_SIDE_PX = 64
OPEN_GRAPH_SIDE_PX = 400  # of the picture for previews of links
PREVIEW_JPEG_QUALITY = 70


@dataclasses.dataclass(frozen=True)
class PageScene:
    """A scene for the page: its description, and its packed Gaussians."""

    description: dict[str, object]  # to be written as JSON
    files: dict[str, bytes]  # the layers, by their file names in the description

    def first_view(self, long_side: int) -> Camera:
        """The camera of the view with which the page begins, with a long side of so many pixels.

        It stands at the photo's place, in the scene's own unit.
        """
        lens: Any = self.description["camera"]
        factor = min(1.0, long_side / max(lens["width"], lens["height"]))
        size = [max(1, round(lens[side] * factor)) for side in ("width", "height")]
        view = Camera(torch.tensor(lens["K"]), torch.eye(4), lens["width"], lens["height"])
        return view.resized(*size)


def check_has_front(name: str, base: Gaussians) -> None:
    """InputError, which begins with the scene's `name`, if nothing lies before its camera."""
    if not bool((base.means[:, 2] > 0).any()):
        problem = "no Gaussian lies in front of the photo's camera"
        raise InputError(f"{name}: {problem}: nothing can be shown")


def page_scene(
    name: str,
    base: Gaussians,
    aux: Gaussians,
    camera: Camera,
    disparity: float | None = None,
    note: str = "",
    *,
    is_metric: bool = False,
    framing: Framing | None = None,
    viewed_as: Mapping[str, Any] | None = None,
) -> PageScene:
    """Prepare a scene for the page.

    The scene becomes a description, to be written as JSON, and files of packed Gaussians. For
    each kind of path, the description's `paths` have two lists, "still" and "moving", of vectors
    [PATH_POSITIONS, 3] in metres. The page's camera is at still + disparity · moving.

    Args:
        name: the scene's name on the page.
        base: the Gaussians that come from the photo.
        aux: the Gaussians that fill holes; may be empty.
        camera: the photo's camera, at the world's origin.
        disparity: how far to the side the camera may go, because the holes that it uncovers are
            filled; a disparity of 1 shifts the nearest surface by the picture's diagonal. The
            page's camera goes no farther. None if it is not known.
        note: a text for the user; empty for none. The page shows the whole text for some seconds,
            and then only its beginning, up to the first semicolon.
        is_metric: whether the scene's unit is known to be the metre.
        framing: the target and the zoom of a completed scene's video, in the scene's unit, which
            hide most of what was made up beyond the photo's border. None: the usual ones.
        viewed_as: the description of a former state of the scene, whose lens, paths and unit of
            length the page keeps: nothing but the Gaussians changes for its user.

    Raises:
        InputError: no Gaussian lies in front of the camera.
    """
    check_has_front(name, base)

    # The page computes in half and single floats, which suit metres: a scene in another unit is
    # shown in a similar one. Its paths are multiples of its own depths, and so stay the same.
    if viewed_as is None:
        length_factor = ordinary_length_factor(base.means.detach().cpu().numpy())
    else:
        length_factor = float(viewed_as.get("lengthFactor", 1))
    depths = DepthRange.of(base, is_metric=is_metric)
    if framing is not None:
        depths = framing.of(depths)
    depths = DepthRange(near=depths.near * length_factor, focus=depths.focus * length_factor)
    if length_factor != 1:
        base = base.scaled(length_factor)
        aux = aux.scaled(length_factor)
    limit = _movement_limit(disparity, is_filled=len(aux) > 0)
    # A scene that Spackle completed is shown enlarged a little, as its videos are, which hides
    # most of what was filled in beyond the photo's border. A video that goes to the sides alone may
    # need less than usual, but the page's user goes up and down as well.
    overscan = 0.0 if disparity is None else DEFAULT_OVERSCAN
    if framing is not None:
        overscan = max(overscan, framing.overscan)
    shown_camera = camera.zoomed(1 + overscan)

    files, layers = _encode_layers({"base": base, "aux": aux})
    # How far a disparity of 1 moves the page's camera, in metres.
    metres_per_disparity = disparity_to_offset(camera, 1.0, depths)
    # The names are those that the page's script reads.
    description: dict[str, object] = {
        "name": name,
        "note": note,
        "camera": {
            "K": shown_camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
        },
        "focus": depths.focus,
        "zNear": depths.near,
        # The page begins with a disparity of at most `free`, and its user can choose up to `limit`.
        # Both are equal, because the scene can be shown everywhere within the limit.
        "orbit": {"unit": metres_per_disparity, "free": limit, "limit": limit},
        "paths": {kind: _path_positions(kind, camera, depths) for kind in SHARP_TRAJECTORIES},
        # Whether a length can be said in metres: lengths here are the scene's times `lengthFactor`.
        "isMetric": is_metric,
        # Whether Spackle completed a photo; another program's scene does not say for which range.
        "isPhoto": disparity is not None,
        "layers": layers,
    }
    if length_factor != 1:  # the server's scene has the unit of its file
        description["lengthFactor"] = length_factor
    if viewed_as is not None:
        # A description that an older server wrote may lack some.
        description |= {item: viewed_as[item] for item in VIEWING_ITEMS if item in viewed_as}
    return PageScene(description, files)


def _encode_layers(
    layers: Mapping[str, Gaussians],
) -> tuple[dict[str, bytes], list[dict[str, object]]]:
    """Pack layers of Gaussians by name for the page.

    Returns:
        The packed bytes of each layer by file name; and the description of each layer. A byte b of
        a scale in the file stands for the logarithm scaleLow + b · scaleStep. A layer whose colours
        change with the view has the item harmonics: the name of a further file, the count of
        harmonics, and the limit of `encode_harmonics`.
    """
    files = {}
    descriptions: list[dict[str, object]] = []
    for name, gaussians in layers.items():
        file_name = f"{name}.splats"
        files[file_name], scale_low, scale_step = encode_layer(gaussians)
        description: dict[str, object] = {
            "name": name,
            "file": file_name,
            "count": len(gaussians),
            "scaleLow": scale_low,
            "scaleStep": scale_step,
        }
        # Gaussians that completion added to a scene with harmonics have harmonics of 0. These are
        # left out, because they would only make the page larger.
        harmonics = gaussians.harmonics
        if harmonics is not None and bool(harmonics.any()):
            harmonics_file = f"{name}.harmonics"
            files[harmonics_file], limit = encode_harmonics(gaussians.colors, harmonics)
            description["harmonics"] = {
                "file": harmonics_file,
                "count": harmonics.shape[1],
                "limit": limit,
            }
        descriptions.append(description)
    return files, descriptions


def _movement_limit(disparity: float | None, is_filled: bool) -> float:
    """Return the largest disparity to which the page's camera may go.

    A disparity of 1 is a sideways movement that shifts the nearest surface by the picture's
    diagonal.

    Args:
        disparity: the largest one for which the scene's holes are filled; None if the scene's file
            does not say it.
        is_filled: whether the scene has Gaussians that fill holes.
    """
    limit = disparity
    if limit is None:
        limit = DEFAULT_LIMIT_OF_FILLED_SCENE if is_filled else DEFAULT_LIMIT_OF_UNFILLED_SCENE
    return min(max(limit, MIN_LIMIT), MAX_LIMIT)


def _path_positions(
    kind: TrajectoryKind, camera: Camera, depths: DepthRange
) -> dict[str, list[list[float]]]:
    """Return the camera positions along a path, split into two parts for the page.

    The user of the page chooses how far the camera goes to the side, as a disparity d: d = 1 shifts
    the nearest surface by the picture's diagonal. A position is still + d · moving, because
    sideways motion grows with d and forward motion does not. So the page gets both parts.

    Args:
        kind: the kind of path, such as "swipe".
        camera: the photo's camera, at the path's middle.
        depths: the scene's depths; the nearest one sets how many metres a disparity of 1 is.

    Returns:
        The lists "still" and "moving" of vectors [PATH_POSITIONS][3] in metres, whose numbers are
        rounded to nine digits.
    """
    exact_camera = camera.to("cpu", torch.float64)

    def positions(disparity: float) -> Tensor:
        views = trajectory_cameras(kind, exact_camera, disparity, depths, PATH_POSITIONS)
        return torch.stack([view.position for view in views])  # [PATH_POSITIONS, 3]

    still = positions(0.0)
    moving = positions(1.0) - still
    return {"still": _rounded_rows(still), "moving": _rounded_rows(moving)}


def _rounded_rows(positions: Tensor) -> list[list[float]]:
    """Return positions [N, 3] as lists of numbers with nine digits, without -0."""
    return [[float(f"{x:.9g}") + 0.0 for x in row] for row in positions.tolist()]


@torch.no_grad()
def encode_layer(gaussians: Gaussians) -> tuple[bytes, float, float]:
    """Pack N Gaussians for the page as byte planes, which compress well.

    A plane has one byte of each Gaussian. In their order, the 20 planes hold:

    * 9 planes: x, y and z, each as the upper 24 bits of a float32, lowest byte first. Rounding
      to 24 bits moves a centre by at most 2⁻¹⁶ of its distance to the photo's camera, which is
      a hundredth of a pixel.
    * 3 planes: the logarithms of the three scales.
    * 4 planes: the index of the largest component of the quaternion (w, x, y, z), which is made
      positive; and the other three components, with 128 for 0 and ±127 for ±1/√2.
    * 4 planes: red, green and blue in sRGB, and the opacity.

    Returns:
        The bytes of the planes [20, N]; the logarithm of the scale for byte 0; and the increase
        of the logarithm per step.
    """
    gaussians = gaussians.detach().to("cpu", torch.float32)
    low, step = _log_scale_steps(gaussians.scales)
    planes = np.empty((BYTES_PER_GAUSSIAN, len(gaussians)), np.uint8)
    for start in range(0, len(gaussians), GAUSSIANS_PER_BLOCK):
        block = slice(start, start + GAUSSIANS_PER_BLOCK)
        part = gaussians.select(block)
        log_scales = part.scales.clamp(MIN_SCALE, MAX_SCALE).log()
        quats = torch.nn.functional.normalize(part.quats, dim=-1)
        largest, others = encode_smallest_three(quats.numpy())

        planes[0:9, block] = _center_planes(part.means)
        planes[9:12, block] = _byte_planes((log_scales - low) / step)
        planes[12, block] = largest
        planes[13:16, block] = _byte_planes(torch.from_numpy(others) * (127 * math.sqrt(2)) + 128)
        planes[16:19, block] = _byte_planes(linear_to_srgb(part.colors) * 255)
        planes[19, block] = _byte_planes(part.opacities[:, None] * 255)
    return planes.tobytes(), low, step


@torch.no_grad()
def encode_harmonics(colors: Tensor, harmonics: Tensor) -> tuple[bytes, float]:
    """Pack the harmonics of N Gaussians for the page as byte planes.

    A plane has one byte of each Gaussian. In their order, the planes hold:

    * 3 planes: how far red, green and blue of the constant colour, in sRGB, lie above 1 or, with
      a negative sign, below 0. `encode_layer` stores the constant colour cut to 0..1, and the page
      adds what is stored here.
    * 3 · K planes: red, green and blue of the first harmonic's coefficients, then of the second's,
      and so on.

    The byte 128 + s, with s from -127 to 127, stands for (s / 127)² · limit with the sign of s:
    most coefficients are small, and a single large one does not cost them precision.

    Args:
        colors: [N, 3] linear RGB of the constant part.
        harmonics: [N, K, 3] coefficients of K harmonics.

    Returns:
        The bytes of the planes [3 · (1 + K), N]; and the limit, the largest amount of a value.
    """
    count = len(harmonics)
    harmonics = harmonics.detach().to("cpu", torch.float32)
    srgb = extended_linear_to_srgb(colors.detach().to("cpu", torch.float32))
    excess = srgb - srgb.clamp(0, 1)
    limit = max(float(excess.abs().max()), float(harmonics.abs().max()))
    divisor = limit if limit > 0 else 1.0  # if all values are 0, all bytes are 128

    planes = np.empty((3 + 3 * harmonics.shape[1], count), np.uint8)
    for start in range(0, count, GAUSSIANS_PER_BLOCK):
        block = slice(start, start + GAUSSIANS_PER_BLOCK)
        values = torch.cat([excess[block], harmonics[block].flatten(1)], dim=1)
        steps = (values.abs() / divisor).sqrt() * HARMONICS_STEPS  # 0 to 127
        planes[:, block] = _byte_planes(steps * values.sign() + 128)
    return planes.tobytes(), limit


def _log_scale_steps(scales: Tensor) -> tuple[float, float]:
    """Return the logarithm of the scale for byte 0, and its increase per step of a byte.

    Args:
        scales: [N, 3] standard deviations.
    """
    if scales.numel() == 0:
        return 0.0, 1.0  # without Gaussians, any numbers will do
    smallest, largest = torch.aminmax(scales)
    low = math.log(min(max(float(smallest), MIN_SCALE), MAX_SCALE))
    high = math.log(min(max(float(largest), MIN_SCALE), MAX_SCALE))
    return low, max(high - low, MIN_LOG_SCALE_RANGE) / 255  # 255 steps from byte 0 to byte 255


def _center_planes(means: Tensor) -> NDArray[np.uint8]:
    """Return the planes [9, N] of centres [N, 3]: the upper 24 bits of each float32."""
    coordinates = means.T.contiguous().numpy()  # [3, N]
    # Half of the lowest byte's range is added, so that dropping this byte rounds.
    words = coordinates.view(np.uint32) + np.uint32(0x80)
    four_bytes = words.view(np.uint8).reshape(3, -1, 4)  # the lowest byte first
    return four_bytes[:, :, 1:].transpose(0, 2, 1).reshape(9, -1)


def _byte_planes(values: Tensor) -> NDArray[np.uint8]:
    """Round values [N, C], clamp them to 0..255, and return them as planes [C, N]."""
    return values.round().clamp(0, 255).to(torch.uint8).T.numpy()


def html_safe_json(value: object) -> bytes:
    """Return a value as JSON in ASCII that can stand inside HTML."""
    text = json.dumps(value, allow_nan=False)
    # These characters would begin or end a tag; JSON can write them as \u003c.
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text.encode("ascii")


def single_html(scene: PageScene, caption: str = "", preview: Tensor | None = None) -> bytes:
    """Return the page with a scene embedded; it opens from a disk or an e-mail.

    It shows the picture and its motion, and all controls behind one button. The page fetches
    nothing. Its Content-Security-Policy forbids browsers to run any script in it but its own.

    Args:
        scene: the scene, whose name is the page's title.
        caption: a text below the picture; empty for none.
        preview: [H, W, 3] sRGB, the photo's view; it stands in the page until the scene is drawn,
            and is its icon. None: nothing stands there.
    """
    page = read_page_file("index.html").decode()
    css = read_page_file("viewer.css").decode() + read_page_file("gift.css").decode()
    viewer = read_page_file("viewer.js").decode()
    # The licences of what the viewer is made of stay readable.
    licences = viewer[: viewer.index(LICENCES_END) + len(LICENCES_END)]
    unpack = f"{licences}\n{read_page_file('unpack.js').decode()}"

    files, compact_files = _files_to_send(scene)
    embedded_files = {}
    for name, data in files.items():
        embedded_files[name] = base64.b64encode(_gzip(data)).decode()
    content = {
        "description": scene.description,
        "files": embedded_files,
        "compact": compact_files,
    }
    scene_json = html_safe_json(content).decode()

    # The page's own script and style, which are named by their digests, are allowed. The script
    # may compile WebAssembly, start workers, and show images and videos that it has made.
    policy = (
        f"default-src 'none'; script-src {_policy_digest(unpack)} {_policy_digest(viewer)} "
        "'wasm-unsafe-eval'; "
        f"style-src {_policy_digest(css)}; worker-src blob:; "
        "img-src data: blob:; media-src blob:; form-action 'none'; base-uri 'none'"
    )
    meta = f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
    style = f"<style>{css}</style>"
    embedded_scene = f'<script type="application/json" id="spackle-scene">{scene_json}</script>'
    packed_viewer = base64.b64encode(_gzip(viewer.encode())).decode()
    embedded_viewer = f'<script type="text/plain" id="spackle-viewer">{packed_viewer}</script>'
    script = f"<script>{unpack}</script>"
    page = page.replace(TITLE_TAG, _title_tags(str(scene.description["name"]), caption, preview))
    if preview is not None:
        icon = _jpeg_address(preview, ICON_SIDE_PX)
        page = page.replace(ICON_TAG, f'<link rel="icon" href="{icon}">')
        photo = _jpeg_address(preview, PREVIEW_SIDE_PX)
        page = page.replace(PHOTO_TAG, f'{PHOTO_TAG} src="{photo}"')
    page = page.replace(STYLE_TAG, f"{meta}\n{style}")
    page = page.replace(SCRIPT_TAG, f"{embedded_scene}\n{embedded_viewer}\n{script}")
    return page.encode()


def _gzip(data: bytes) -> bytes:
    """Return data as a gzip file, the same bytes for the same data."""
    # Planes of small differences have few repetitions: this strategy saves 2 % of a large scene.
    compressor = zlib.compressobj(level=9, wbits=16 + zlib.MAX_WBITS, strategy=zlib.Z_FILTERED)
    return compressor.compress(data) + compressor.flush()


def _files_to_send(scene: PageScene) -> tuple[dict[str, bytes], list[str]]:
    """Return a scene's files, those of a large one made compact; and the names of the compact ones.

    A small scene keeps every bit.
    """
    files = dict(scene.files)
    compact_names: list[str] = []
    if sum(map(len, files.values())) <= MAX_EXACT_BYTES:
        return files, compact_names
    layers: Any = scene.description["layers"]
    lens: Any = scene.description["camera"]
    for layer in layers:
        name = layer["file"]
        compact = compact_layer(files[name], lens)
        if compact is not None:
            files[name] = compact
            compact_names.append(name)
    return files, compact_names


def with_tags(page: bytes, caption: str, image_address: str | None = None) -> bytes:
    """Return a page of `single_html` with another caption.

    Args:
        page: the page.
        caption: the text below the picture; empty for none.
        image_address: where programs that show previews of links find the picture, on the web;
            None leaves it within the page.
    """
    tags = {"og:description": caption}
    if image_address is not None:
        tags["og:image"] = image_address
    for name, value in tags.items():
        pattern = re.escape(META_TAG.format(name=name, value="VALUE")).replace("VALUE", '[^"]*')
        tag = META_TAG.format(name=name, value=html.escape(value)).encode()
        # The tags stand before everything that was embedded.
        page = re.sub(pattern.encode(), lambda _, tag=tag: tag, page, count=1)  # type: ignore[misc]
    return page


def _title_tags(name: str, caption: str, preview: Tensor | None) -> str:
    """Return the tags of a page's head that say what it is: to browsers, and to link previews.

    The page reads its caption from the description.
    """
    # A file's name may have bytes that are no text.
    printable_name = name.encode("utf-8", "replace").decode()
    title = html.escape(re.sub(FILE_SUFFIX, "", printable_name))
    tags = [
        f"<title>{title}</title>",
        META_TAG.format(name="og:title", value=title),
        META_TAG.format(name="og:description", value=html.escape(caption)),
    ]
    if preview is not None:
        # Programs that show previews of links want an address on the web here, which only who
        # publishes the page can know; some take the picture itself.
        image = _jpeg_address(preview, OPEN_GRAPH_SIDE_PX)
        tags.append(META_TAG.format(name="og:image", value=image))
    return "\n".join(tags)


def _jpeg_address(picture: Tensor, side: int) -> str:
    """Return a picture [H, W, 3] sRGB as the address data:… of a JPEG with this long side."""
    image = Image.fromarray(to_uint8(picture.cpu()).numpy())
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    image.save(file, "JPEG", quality=PREVIEW_JPEG_QUALITY, optimize=True)
    return f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"


def _policy_digest(text: str) -> str:
    """Return the digest with which a Content-Security-Policy names a script or a style."""
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def read_page_file(name: str) -> bytes:
    """Read a file of the page, such as "index.html", from the installed package."""
    # By the path, because importing `spackle.web` imports FastAPI, which takes a second.
    return resources.files("spackle").joinpath("web", "page", name).read_bytes()
