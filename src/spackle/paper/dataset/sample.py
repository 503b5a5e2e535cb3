"""Encode and decode a photo with its views as part of a tar archive; see docs/dataset.md.

The same sample always has the same bytes. The loss in colours, opacity and depth is invisible; the loss in Gaussians is
less than 1e-3 of a pixel; masks and cameras are exact.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import math
import tarfile
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from safetensors.numpy import load, save
from torch import Tensor
from torch.nn.functional import normalize

from spackle.core.camera import Camera
from spackle.core.color import to_uint8
from spackle.core.gaussians import Gaussians
from spackle.core.image_files import check_pixel_count
from spackle.formats.camera_files import camera_from_json
from spackle.paper.dataset.views import ViewStack
from spackle.render.protocol import Rendering
from spackle.runtime.errors import as_input_error

PNG_COMPRESSION_LEVEL = (
    1  # zlib's level: level 6 takes three times as long and saves a tenth of the bytes
)
MAX_CODE = 65535
MIN_SCALE = 1e-30
END_OF_ARCHIVE = bytes(2 * tarfile.BLOCKSIZE)  # the end-of-archive mark


@dataclasses.dataclass(frozen=True)
class DatasetView:
    """One view of a photo: a training sample of the paper (appendix, "Dataset")."""

    key: str  # the photo's key in its dataset
    index: int  # the view's number; 0 is the photo's camera
    photo: Tensor  # [h, w, 3] sRGB at its working size
    photo_camera: Camera
    camera: Camera  # the view's
    rendering: Rendering  # of the base: rgb [H, W, 3], depth [H, W], alpha [H, W]
    mask: Tensor  # [H, W] bool: uncovered
    target: Tensor  # [H, W, 3] sRGB, completed


def pack_sample(
    key: str, photo: Tensor, stack: ViewStack, targets: Tensor, facts: Mapping[str, Any]
) -> bytes:
    """Pack a photo for a tar archive: KEY.json, KEY.photo.png, KEY.base.safetensors, then five files per view.

    The bytes have no end-of-archive mark and record no time, owner or machine. `photo` [h, w, 3] (at its working size)
    and `targets` [V, H, W, 3] are sRGB; `facts` become part of the JSON, and must hold "threshold" (of the mask) and
    "trajectory".
    """
    files: list[tuple[str, bytes]] = []
    views: list[dict[str, Any]] = []
    for index, camera in enumerate(stack.cameras):
        rgb, depth, alpha, mask = (
            field[index] for field in (stack.rgb, stack.depth, stack.alpha, stack.mask)
        )
        depth_png, depth_range = encode_depth(depth, alpha)
        kinds = {
            "rgb": encode_rgb(rgb),
            "target": encode_rgb(targets[index]),
            "mask": _png(mask.cpu().numpy().astype(np.uint8) * np.uint8(255)),
            "alpha": encode_alpha(alpha, mask, facts["threshold"]),
            "depth": depth_png,
        }
        files += [(f"{key}.{index:02d}.{kind}.png", data) for kind, data in kinds.items()]
        views.append(
            _camera_facts(camera)
            | {"depth_range": list(depth_range), "hole": float(mask.double().mean())}
        )
    common = {"key": key, "photo_camera": _camera_facts(stack.prediction.camera), "views": views}
    text = json.dumps({**facts, **common}, indent=1, sort_keys=True, allow_nan=False) + "\n"
    first = [(f"{key}.json", text.encode()), (f"{key}.photo.png", encode_rgb(photo))]
    parts: list[bytes] = []
    for name, data in [
        *first,
        (f"{key}.base.safetensors", encode_gaussians(stack.prediction.gaussians)),
        *files,
    ]:
        header = tarfile.TarInfo(name)  # mtime 0, uid 0, gid 0, mode 644
        header.size = len(data)
        parts += [header.tobuf(tarfile.USTAR_FORMAT), data, bytes(-len(data) % tarfile.BLOCKSIZE)]
    return b"".join(parts)


@dataclasses.dataclass(frozen=True)
class PhotoGroup:
    """The encoded files of a photo."""

    key: str
    files: Mapping[str, bytes]
    facts: Mapping[str, Any]  # the contents of KEY.json
    holes: tuple[float, ...]  # HAR of each view (paper, eq. 11)
    where: str  # the source, for messages

    @staticmethod
    def from_tar(key: str, data: bytes, where: str) -> PhotoGroup:
        """Split a photo's part of a shard into files; InputError for damaged bytes."""
        files: dict[str, bytes] = {}
        with as_input_error(where, "not a photo of a dataset, or damaged: {reason}"):
            at = 0
            while at < len(data):  # `pack_sample` writes plain files only: no links or sparse files
                member = tarfile.TarInfo.frombuf(
                    data[at : at + tarfile.BLOCKSIZE], "utf-8", "strict"
                )
                begin = at + tarfile.BLOCKSIZE
                if member.type != tarfile.REGTYPE or not 0 <= member.size <= len(data) - begin:
                    raise ValueError(f"{member.name} is no plain file")
                files[member.name] = data[begin : begin + member.size]
                at = begin + member.size + -member.size % tarfile.BLOCKSIZE
            facts = json.loads(files[f"{key}.json"])
            holes = tuple(float(view["hole"]) for view in facts["views"])
        return PhotoGroup(key, files, facts, holes, where)

    @property
    def views(self) -> int:
        return len(self.holes)

    def view(self, index: int) -> DatasetView:
        """Decode one view; InputError if a file is missing or damaged."""
        with as_input_error(f"{self.where}: view {index}", "cannot be read: {reason}"):
            facts = self.facts["views"][index]
            rgb, target = (decode_rgb(self._file(index, kind)) for kind in ("rgb", "target"))
            depth = decode_depth(self._file(index, "depth"), *facts["depth_range"])
            view = DatasetView(
                key=self.key,
                index=index,
                photo=decode_rgb(self.files[f"{self.key}.photo.png"]),
                photo_camera=camera_from_json(self.facts["photo_camera"], self.where),
                camera=camera_from_json(facts, self.where),
                rendering=Rendering(rgb, depth, decode_alpha(self._file(index, "alpha"))),
                mask=torch.from_numpy(_pixels(self._file(index, "mask"), 2)) > 127,
                target=target,
            )
            for camera, pictures in (
                (view.camera, (rgb, depth, view.rendering.alpha, view.mask, target)),
                (view.photo_camera, (view.photo,)),
            ):
                if any(picture.shape[:2] != (camera.height, camera.width) for picture in pictures):
                    raise ValueError("a picture has another size than its camera")
            return view

    @functools.cached_property
    def base(self) -> Gaussians:
        """Decode the photo's Gaussians; InputError if the file is missing or damaged."""
        with as_input_error(f"{self.where}: Gaussians", "cannot be read: {reason}"):
            return decode_gaussians(self.files[f"{self.key}.base.safetensors"])

    def _file(self, index: int, kind: str) -> bytes:
        return self.files[f"{self.key}.{index:02d}.{kind}.png"]


def _camera_facts(camera: Camera) -> dict[str, Any]:
    return {
        "K": camera.K.tolist(),
        "world_to_camera": camera.world_to_camera.tolist(),
        "position": camera.position.tolist(),
        "width": camera.width,
        "height": camera.height,
    }


def encode_rgb(rgb: Tensor) -> bytes:
    """Encode sRGB [H, W, 3] in 0..1 as PNG."""
    return _png(to_uint8(rgb).numpy())


def decode_rgb(data: bytes) -> Tensor:
    """Decode a PNG to sRGB [H, W, 3] in 0..1."""
    return torch.from_numpy(_pixels(data, 3)).float() / 255


def encode_alpha(alpha: Tensor, mask: Tensor, threshold: float) -> bytes:
    """Encode opacity [H, W] in 0..1 as 16-bit PNG, so that exactly the pixels of `mask` stay below `threshold`."""
    codes = (alpha.detach().cpu().double() * MAX_CODE).round().clamp(0, MAX_CODE)
    last = math.ceil(threshold * MAX_CODE) - 1  # the greatest code below the threshold
    codes = torch.where(mask.cpu(), codes.clamp_max(last), codes.clamp_min(last + 1))
    return _png(codes.numpy().astype(np.uint16))


def decode_alpha(data: bytes) -> Tensor:
    """Decode opacity [H, W] in 0..1."""
    return torch.from_numpy(_pixels(data, 2).astype(np.float64) / MAX_CODE).float()


def encode_depth(depth: Tensor, alpha: Tensor) -> tuple[bytes, tuple[float, float]]:
    """Encode expected z [H, W] as PNG, in logarithmic steps; also returns (near, far) for `decode_depth`."""
    z = depth.detach().cpu().double().numpy()
    known = (alpha.detach().cpu().numpy() > 0) & np.isfinite(z) & (z > 0)
    near, far = (float(z[known].min()), float(z[known].max())) if known.any() else (1.0, 1.0)
    codes = np.zeros(z.shape, np.uint16)
    span = max(math.log(far / near), 1e-12)
    codes[known] = 1 + np.round((MAX_CODE - 1) * np.log(z[known] / near) / span)
    return _png(codes), (near, far)


def decode_depth(data: bytes, near: float, far: float) -> Tensor:
    """Decode expected z [H, W]; 0 means unknown."""
    codes = _pixels(data, 2).astype(np.float64)
    z = near * np.exp((codes - 1) / (MAX_CODE - 1) * math.log(far / near))
    return torch.from_numpy(np.where(codes > 0, z, 0.0)).float()


def encode_gaussians(gaussians: Gaussians) -> bytes:
    """Encode Gaussians as safetensors, 34 bytes each."""
    means, quats, scales, opacities, colors = (t.detach().cpu().float() for t in gaussians.tensors)
    logs = scales.double().clamp_min(MIN_SCALE).log()
    low, high = (float(logs.min()), float(logs.max())) if len(means) else (0.0, 0.0)
    steps = ((logs - low) / max(high - low, 1e-12) * MAX_CODE).round()
    arrays: dict[str, NDArray[Any]] = {
        "means": means.numpy(),
        "quats": normalize(quats, dim=-1).half().numpy(),
        "scales": steps.numpy().astype(np.uint16),
        "scale_logs": np.array([low, high]),
        "opacities": (opacities.double() * MAX_CODE)
        .round()
        .clamp(0, MAX_CODE)
        .numpy()
        .astype(np.uint16),
        "colors": colors.half().numpy(),
    }
    return save(arrays)


def decode_gaussians(data: bytes) -> Gaussians:
    """Decode bytes of `encode_gaussians` to float32; other bytes may raise any exception."""
    arrays = load(data)
    low, high = arrays["scale_logs"].tolist()
    scales = np.exp(low + arrays["scales"].astype(np.float64) / MAX_CODE * max(high - low, 1e-12))
    opacities = arrays["opacities"].astype(np.float64) / MAX_CODE
    columns = (arrays["means"], arrays["quats"], scales, opacities, arrays["colors"])
    gaussians = Gaussians(
        *(torch.from_numpy(np.ascontiguousarray(column)).float() for column in columns)
    )
    if not gaussians.finite:
        raise ValueError("Gaussians that are not finite")
    return gaussians


def _png(pixels: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG", compress_level=PNG_COMPRESSION_LEVEL)
    return file.getvalue()


def _pixels(data: bytes, axes: int) -> NDArray[Any]:
    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        check_pixel_count(*image.size, len(data), "a picture")
        pixels = np.array(image)
    if pixels.ndim != axes:
        raise ValueError(f"a picture with {pixels.ndim} axes instead of {axes}")
    return pixels
