"""A photo with its views as a part of a tar archive.

`pack_sample` writes it, `PhotoGroup` reads it.

The same sample always has the same bytes. docs/dataset.md describes the files; encoding.py has the
formats of pictures and Gaussians. Cameras are exact.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import tarfile
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import to_uint8
from spackle.core.gaussians import Gaussians
from spackle.formats.camera_files import camera_from_json
from spackle.paper.dataset.encoding import (
    decode_alpha,
    decode_depth,
    decode_gaussians,
    decode_mask,
    decode_rgb,
    encode_alpha,
    encode_depth,
    encode_mask,
    encode_rgb,
)
from spackle.paper.dataset.views import ViewStack
from spackle.render import CpuRenderer
from spackle.render.protocol import Rendering
from spackle.runtime.declared_options import KeptFiles
from spackle.runtime.errors import as_input_error

END_OF_ARCHIVE = bytes(2 * tarfile.BLOCKSIZE)  # two empty blocks end a tar archive


@dataclasses.dataclass(frozen=True)
class DatasetView:
    """One view of a photo: a training sample of the paper (appendix, "Dataset")."""

    key: str  # the photo's key in its dataset
    index: int  # the view's number; 0 is the photo's camera
    photo: Tensor  # [h, w, 3] sRGB, reduced to at most 1536 pixels on the longer side
    photo_camera: Camera
    camera: Camera  # the view's
    rendering: Rendering  # of the photo's Gaussians: rgb [H, W, 3], depth [H, W], alpha [H, W]
    mask: Tensor  # [H, W] bool: uncovered by these Gaussians
    target: Tensor  # [H, W, 3] sRGB, completed


def pack_sample(
    key: str,
    photo: Tensor,
    stack: ViewStack,
    targets: Tensor,
    facts: Mapping[str, Any],
    *,
    encoded_base: bytes,
    keep: KeptFiles = "all",
) -> bytes:
    """Pack a photo with its views for a tar archive.

    The archive's files are KEY.json, KEY.photo.png, KEY.base.safetensors (the photo's Gaussians),
    then five pictures for each view: rgb, target, mask, alpha, depth. The bytes have no
    end-of-archive mark and record no time, owner or machine.

    Args:
        key: begins the names of the files.
        photo: [h, w, 3] sRGB.
        stack: V views of the photo's Gaussians.
        targets: [V, H, W, 3] sRGB, the completed views.
        facts: become part of the JSON; they must hold "threshold" (the opacity below which a pixel
            is masked) and "trajectory".
        encoded_base: the photo's Gaussians, by `encode_gaussians`.
        keep: "targets" leaves out rgb, alpha and depth, and makes the target black outside of the
            mask.
    """
    view_files: list[tuple[str, bytes]] = []  # names and contents
    view_facts: list[dict[str, Any]] = []
    for index, camera in enumerate(stack.cameras):
        # Five pictures a view, each in the format that suits its numbers.
        alpha = stack.alpha[index]
        mask = stack.mask[index]
        depth_png, depth_range = encode_depth(stack.depth[index], alpha)
        if keep == "targets":
            hole_colors = torch.where(mask[..., None], targets[index], 0.0)
            pictures = {"target": encode_rgb(hole_colors), "mask": encode_mask(mask)}
        else:
            pictures = {
                "rgb": encode_rgb(stack.rgb[index]),
                "target": encode_rgb(targets[index]),
                "mask": encode_mask(mask),
                "alpha": encode_alpha(alpha, mask, facts["threshold"]),
                "depth": depth_png,
            }
        for kind, content in pictures.items():
            view_files.append((f"{key}.{index:02d}.{kind}.png", content))
        hole_ratio = float(mask.double().mean())
        view_facts.append(
            camera_facts(camera) | {"depth_range": list(depth_range), "hole": hole_ratio}
        )

    # What the pictures cannot say: cameras, ranges of depth, the size of the holes.
    photo_facts = {
        **facts,
        "key": key,
        "photo_camera": camera_facts(stack.prediction.camera),
        "views": view_facts,
    }
    text = json.dumps(photo_facts, indent=1, sort_keys=True, allow_nan=False) + "\n"
    # The JSON comes first, so that a reader of the archive knows what follows.
    files = [
        (f"{key}.json", text.encode()),
        (f"{key}.photo.png", encode_rgb(photo)),
        (f"{key}.base.safetensors", encoded_base),
        *view_files,
    ]
    return b"".join(tar_member(name, content) for name, content in files)


def tar_member(name: str, content: bytes) -> bytes:
    """A file as a member of a tar archive: header, content, and zeros up to a full block."""
    header = tarfile.TarInfo(name)  # mtime 0, uid 0, gid 0, mode 644
    header.size = len(content)
    padding = bytes(-len(content) % tarfile.BLOCKSIZE)  # zeros up to the next block
    return header.tobuf(tarfile.USTAR_FORMAT) + content + padding


@dataclasses.dataclass(frozen=True)
class PhotoGroup:
    """The encoded files of a photo."""

    key: str
    files: Mapping[str, bytes]  # contents by name
    facts: Mapping[str, Any]  # the contents of KEY.json
    holes: tuple[float, ...]  # share of uncovered pixels of each view (HAR, eq. 11 of the paper)
    where: str  # the source, for messages

    @staticmethod
    def from_tar(key: str, data: bytes, where: str) -> PhotoGroup:
        """Split a photo's part of a tar archive into files.

        Args:
            key: begins the names of the photo's files.
            data: the bytes that `pack_sample` has made.
            where: what messages call the data.

        Raises:
            InputError: the bytes are damaged.
        """
        with as_input_error(where, "not a photo of a dataset, or damaged: {reason}"):
            files = split_tar(data)
            facts = json.loads(files[f"{key}.json"])
            holes = tuple(float(view["hole"]) for view in facts["views"])
        return PhotoGroup(key, files, facts, holes, where)

    @property
    def views(self) -> int:
        """The number of views."""
        return len(self.holes)

    @property
    def has_renderings(self) -> bool:
        """Whether the rendered views are stored; otherwise the Gaussians give them again."""
        return f"{self.key}.00.rgb.png" in self.files

    def view(self, index: int) -> DatasetView:
        """Decode one view, by its number; InputError if a file is missing or damaged.

        A rendering that is not stored is made again, on the CPU. It has the stored bits if the
        dataset was built on a CPU, too.
        """
        camera = self.camera(index)
        with as_input_error(f"{self.where}: view {index}", "cannot be read: {reason}"):
            mask = decode_mask(self._picture(index, "mask"))
            if self.has_renderings:
                rendering = self._stored_rendering(index)
            else:
                rendering = self._render_again(camera, mask)
            view = DatasetView(
                key=self.key,
                index=index,
                photo=self.photo,
                photo_camera=self.photo_camera,
                camera=camera,
                rendering=rendering,
                mask=mask,
                target=self.target(index, rendering.rgb, mask),
            )
            check_sizes(view)
            return view

    @functools.cached_property
    def photo(self) -> Tensor:
        """[h, w, 3] sRGB of the photo at its working size; InputError for a damaged file."""
        with as_input_error(f"{self.where}: photo", "cannot be read: {reason}"):
            return decode_rgb(self.files[f"{self.key}.photo.png"])

    @property
    def photo_camera(self) -> Camera:
        """The photo's camera; InputError if the facts have none."""
        with as_input_error(f"{self.where}: photo", "cannot be read: {reason}"):
            return camera_from_json(self.facts["photo_camera"], self.where)

    def camera(self, index: int) -> Camera:
        """The camera of a view, by its number; InputError if the facts have none."""
        with as_input_error(f"{self.where}: view {index}", "cannot be read: {reason}"):
            return camera_from_json(self.facts["views"][index], self.where)

    def target(self, index: int, rendered_rgb: Tensor, mask: Tensor | None = None) -> Tensor:
        """[H, W, 3] sRGB that a view should show; InputError if a file is missing or damaged.

        Args:
            index: the view's number.
            rendered_rgb: [H, W, 3] sRGB of the view without completion. It is the target outside
                of the holes, if only the holes are stored.
            mask: [H, W] bool: the view's holes, where they are decoded already.
        """
        with as_input_error(f"{self.where}: view {index}", "cannot be read: {reason}"):
            target = decode_rgb(self._picture(index, "target"))
            if target.shape != rendered_rgb.shape:
                raise ValueError("the target has another size than the view")
            if self.has_renderings:
                return target
            if mask is None:
                mask = decode_mask(self._picture(index, "mask"))
            # Rounded as a stored target is, so that both kinds of datasets teach the same.
            rounded_rgb = to_uint8(rendered_rgb).float().cpu() / 255
            return torch.where(mask[..., None], target, rounded_rgb)

    @functools.cached_property
    def base(self) -> Gaussians:
        """The photo's Gaussians, decoded when first asked for; InputError for a damaged file."""
        with as_input_error(f"{self.where}: Gaussians", "cannot be read: {reason}"):
            return decode_gaussians(self.files[f"{self.key}.base.safetensors"])

    def _stored_rendering(self, index: int) -> Rendering:
        """What the photo's Gaussians show in a view, from its three pictures."""
        near, far = self.facts["views"][index]["depth_range"]
        return Rendering(
            decode_rgb(self._picture(index, "rgb")),
            decode_depth(self._picture(index, "depth"), near, far),
            decode_alpha(self._picture(index, "alpha")),
        )

    @torch.no_grad()
    def _render_again(self, camera: Camera, mask: Tensor) -> Rendering:
        """What the photo's Gaussians show in a view, rounded as stored pictures are.

        Args:
            camera: the view's.
            mask: [H, W] bool: the view's holes, which are stored.
        """
        rendering = CpuRenderer().render(self.base, camera)
        alpha_png = encode_alpha(rendering.alpha, mask, self.facts["threshold"])
        depth_png, (near, far) = encode_depth(rendering.depth, rendering.alpha)
        return Rendering(
            decode_rgb(encode_rgb(rendering.rgb)),
            decode_depth(depth_png, near, far),
            decode_alpha(alpha_png),
        )

    def _picture(self, index: int, kind: str) -> bytes:
        """The PNG of a view; KeyError if it is missing.

        `kind` is "rgb", "target", "mask", "alpha" or "depth".
        """
        return self.files[f"{self.key}.{index:02d}.{kind}.png"]


def split_tar(data: bytes) -> dict[str, bytes]:
    """The contents of an archive's files by name; `data` has no end-of-archive mark.

    Only plain files are accepted, because `pack_sample` writes nothing else. Links and sparse files
    could come only from somebody else, and might be dangerous to read. ValueError, or an exception
    of tarfile, if the data are damaged.
    """
    files: dict[str, bytes] = {}
    position = 0
    while position < len(data):
        header = data[position : position + tarfile.BLOCKSIZE]
        # The header names the file and its size; its checksum is verified.
        member = tarfile.TarInfo.frombuf(header, "utf-8", "strict")
        start = position + tarfile.BLOCKSIZE
        if member.type != tarfile.REGTYPE or not 0 <= member.size <= len(data) - start:
            raise ValueError(f"{member.name} is no plain file")
        files[member.name] = data[start : start + member.size]
        padding = -member.size % tarfile.BLOCKSIZE  # zeros up to the next block
        position = start + member.size + padding
    return files


def check_sizes(view: DatasetView) -> None:
    """ValueError if a picture of a view does not have the size of its camera."""
    pictures = [
        (view.photo, view.photo_camera),
        (view.rendering.rgb, view.camera),
        (view.rendering.depth, view.camera),
        (view.rendering.alpha, view.camera),
        (view.mask, view.camera),
        (view.target, view.camera),
    ]
    for picture, camera in pictures:
        if picture.shape[:2] != (camera.height, camera.width):
            raise ValueError("a picture has another size than its camera")


def camera_facts(camera: Camera) -> dict[str, Any]:
    """A camera as JSON: intrinsics K [3, 3], world_to_camera [4, 4], position [3] and size."""
    return {
        "K": camera.K.tolist(),
        "world_to_camera": camera.world_to_camera.tolist(),
        "position": camera.position.tolist(),
        "width": camera.width,
        "height": camera.height,
    }
