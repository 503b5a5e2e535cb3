"""A photo with its views as a stretch of a tar archive, and back."""

from __future__ import annotations

import dataclasses
import io
import json
import tarfile
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.dataset.encode import (
    decode_alpha,
    decode_depth,
    decode_gaussians,
    decode_mask,
    decode_rgb,
    encode_alpha,
    encode_depth,
    encode_gaussians,
    encode_mask,
    encode_rgb,
)
from spackle.dataset.views import PathChoice
from spackle.errors import InputError
from spackle.formats.camera_files import checked_camera
from spackle.gaussians import Gaussians
from spackle.inpaint import ViewStack
from spackle.render.protocol import Rendering

BLOCK = 512
END = bytes(2 * BLOCK)  # of an archive


def pack(members: Iterable[tuple[str, bytes]]) -> bytes:
    """Named files as a stretch of a tar archive, without its end, and without time, owner or machine."""
    parts: list[bytes] = []
    for name, data in members:
        header = tarfile.TarInfo(name)  # mtime 0, uid 0, gid 0, mode 644
        header.size = len(data)
        parts += [header.tobuf(tarfile.USTAR_FORMAT), data, bytes(-len(data) % BLOCK)]
    return b"".join(parts)


def unpack(data: bytes) -> Mapping[str, bytes]:
    """The files of such a stretch by name; ValueError where it is none."""
    found: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            for member in archive:
                file = archive.extractfile(member)
                if file is None:
                    raise ValueError(f"{member.name} is no plain file")
                found[member.name] = file.read()
    except tarfile.TarError as error:
        raise ValueError(f"no tar archive: {error}") from error
    return found


@dataclasses.dataclass(frozen=True)
class DatasetView:
    """One view of a photo: what the paper's training sample holds (appendix, "Dataset")."""

    key: str  # of the photo in its dataset
    index: int  # of the view; 0 is the photo's own
    kind: str  # of the camera path
    photo: Tensor  # [h, w, 3] sRGB at its working size
    photo_camera: Camera
    camera: Camera  # the view's
    rendering: Rendering  # of the base: rgb [H, W, 3], depth [H, W], alpha [H, W]
    mask: Tensor  # [H, W] bool: uncovered
    target: Tensor  # [H, W, 3] sRGB, completed
    base: Gaussians | None  # where the reader was asked for it


def pack_sample(
    key: str, photo: Tensor, stack: ViewStack, targets: Tensor, path: PathChoice, facts: dict[str, Any]
) -> bytes:
    """A photo as a stretch of a tar archive: KEY.json, KEY.photo.png, KEY.base.safetensors, then five files a view.

    Args:
        key: how the files begin, without a dot.
        photo: [h, w, 3] sRGB at its working size.
        stack: V views of it.
        targets: [V, H, W, 3] sRGB.
        path: where the camera goes.
        facts: more for the JSON; the mask's "threshold" among them.
    """
    files: list[tuple[str, bytes]] = []
    views: list[dict[str, Any]] = []
    for index, camera in enumerate(stack.cameras):
        rgb, depth, alpha, mask = (field[index] for field in (stack.rgb, stack.depth, stack.alpha, stack.mask))
        depth_png, depth_range = encode_depth(depth, alpha)
        kinds = {
            "rgb": encode_rgb(rgb),
            "target": encode_rgb(targets[index]),
            "mask": encode_mask(mask),
            "alpha": encode_alpha(alpha, mask, facts["threshold"]),
            "depth": depth_png,
        }
        files += [(_view_file(key, index, kind), data) for kind, data in kinds.items()]
        views.append(_camera_facts(camera) | {"depth_range": list(depth_range), "hole": float(mask.double().mean())})
    common = {
        "key": key,
        "trajectory": {"kind": path.kind, "disparity": path.disparity},
        "photo_camera": _camera_facts(stack.photo_camera),
        "views": views,
    }
    text = json.dumps(facts | common, indent=1, sort_keys=True, allow_nan=False) + "\n"
    first = (f"{key}.json", text.encode()), (f"{key}.photo.png", encode_rgb(photo))
    return pack([*first, (f"{key}.base.safetensors", encode_gaussians(stack.base)), *files])


def _view_file(key: str, index: int, kind: str) -> str:
    """What a picture of a view is called."""
    return f"{key}.{index:02d}.{kind}.png"


@dataclasses.dataclass(frozen=True)
class PhotoGroup:
    """The files of a photo, not decoded yet."""

    key: str
    files: Mapping[str, bytes]
    facts: Mapping[str, Any]  # KEY.json
    where: str  # for messages

    @staticmethod
    def of(key: str, data: bytes, where: str) -> PhotoGroup:
        """Take apart the stretch of a shard that belongs to a photo; InputError where that cannot be."""
        try:
            files = unpack(data)
            facts = json.loads(files[f"{key}.json"])
            if not isinstance(facts["views"], list):
                raise TypeError("its views are no list")
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{where}: not a photo of a dataset, or damaged: {error}") from error
        return PhotoGroup(key, files, facts, where)

    @property
    def views(self) -> int:
        """How many there are."""
        return len(self.facts["views"])

    @property
    def holes(self) -> tuple[float, ...]:
        """HAR of each view (paper, eq. 11)."""
        return tuple(float(view["hole"]) for view in self.facts["views"])

    def view(self, index: int, *, with_base: bool = False) -> DatasetView:
        """Decode one view; InputError where a file of it is missing or damaged."""
        try:
            facts = self.facts["views"][index]
            rgb, target = (decode_rgb(self._file(index, kind)) for kind in ("rgb", "target"))
            depth = decode_depth(self._file(index, "depth"), *facts["depth_range"])
            rendering = Rendering(rgb, depth, decode_alpha(self._file(index, "alpha")))
            return DatasetView(
                key=self.key,
                index=index,
                kind=self.facts["trajectory"]["kind"],
                photo=decode_rgb(self.files[f"{self.key}.photo.png"]),
                photo_camera=_camera(self.facts["photo_camera"], self.where),
                camera=_camera(facts, self.where),
                rendering=rendering,
                mask=decode_mask(self._file(index, "mask")),
                target=target,
                base=self.base() if with_base else None,
            )
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise InputError(f"{self.where}: view {index} cannot be read: {error}") from error

    def only(self, index: int, *, with_base: bool = False) -> PhotoGroup:
        """No more than one view needs: so the others' bytes are free again."""
        kept = (f"{self.key}.{index:02d}.", f"{self.key}.photo.", *([f"{self.key}.base."] if with_base else []))
        return dataclasses.replace(self, files={n: data for n, data in self.files.items() if n.startswith(kept)})

    def base(self) -> Gaussians:
        """The photo's Gaussians; ValueError or KeyError where they cannot be read."""
        return decode_gaussians(self.files[f"{self.key}.base.safetensors"])

    def _file(self, index: int, kind: str) -> bytes:
        return self.files[_view_file(self.key, index, kind)]


def _camera_facts(camera: Camera) -> dict[str, Any]:
    return {
        "K": camera.K.tolist(),
        "world_to_camera": camera.world_to_camera.tolist(),
        "position": camera.position.tolist(),
        "width": camera.width,
        "height": camera.height,
    }


def _camera(facts: Mapping[str, Any], where: str) -> Camera:
    K, matrix = (torch.tensor(facts[name], dtype=torch.float64) for name in ("K", "world_to_camera"))
    return checked_camera(K, matrix, facts["width"], facts["height"], where)
