"""The files of ProPainter's three networks: found in a folder, read without running anything, held to the networks."""

from __future__ import annotations

import hashlib
import re
import warnings
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from spackle.errors import InputError, reason_in_a_line
from spackle.image import check_file

NETWORKS = ("raft_things", "propainter_rfc", "propainter")  # flow, its completion, colours; so their files begin
SOURCE = "https://github.com/osmr/imgclsmob/releases/tag/v0.0.570"


def weight_files(folder: Path | None) -> dict[str, Path]:
    """The file of each of `NETWORKS`: NAME.pth, NAME-….pth as it is published, or .safetensors.

    Args:
        folder: where they lie, unpacked.

    Raises:
        InputError: there is no such folder, or not one file of each.
    """
    wanted = f"{', '.join(NETWORKS)}: one .pth file of each, unpacked from {SOURCE}"
    if folder is None:
        raise InputError(f"--inpainter propainter: has no weights: give --inpainter-weights FOLDER with {wanted}")
    try:
        names = sorted(file.name for file in folder.iterdir())
    except (OSError, ValueError) as error:
        raise InputError(f"--inpainter-weights {folder}: no folder that can be read: give one with {wanted}") from error
    files = {}
    for network in NETWORKS:
        own = [name for name in names if re.fullmatch(rf"{network}(-.*)?\.(pth|safetensors)", name)]
        if len(own) != 1:
            found = f"{own[0]} and {own[1]}" if own else f"no {network}-….pth"
            raise InputError(f"--inpainter-weights {folder}: holds {found}: it should hold {wanted}")
        files[network] = folder / own[0]
    return files


def give_weights(network: nn.Module, name: str, file: Path) -> None:
    """Fill a network from its file and freeze it; half precision is widened.

    As in the package that publishes them, tensors that the network does not have are passed over. Those that are no
    floats are its own constants, and stay as they are.

    Raises:
        InputError: a missing or broken file, or one of another network.
    """
    found, ours = _read(file), network.state_dict()
    used = {key: tensor for key, tensor in ours.items() if tensor.is_floating_point()}
    wrong = [key for key, tensor in used.items() if not _fits(found.get(key), tensor)]
    if wrong:
        raise InputError(
            f"{file}: not the weights of {name}: {len(wrong)} of {len(used)} tensors are missing, of another shape "
            f"or not finite, such as {wrong[0]}: give the file of that name from {SOURCE}"
        )
    network.load_state_dict(ours | {key: found[key].float() for key in used})
    network.eval().requires_grad_(False)


def _read(file: Path) -> dict[str, Tensor]:
    """Whatever is in a stranger's file, its kind told by its first bytes."""
    check_file(file, "weight file")
    try:
        with open(file, "rb") as opened:
            head = opened.read(9)
        if head[8:] == b"{":
            return dict(load_file(file))
        _check_sum(file)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about kinds of tensors that are refused
            return dict(torch.load(file, map_location="cpu", weights_only=True))
    except Exception as error:  # a stranger's bytes can raise anything
        reason = reason_in_a_line(error)
        raise InputError(f"{file}: cannot be read as weights ({reason}): unpack the file of {SOURCE} again") from error


def _check_sum(file: Path) -> None:
    """ValueError where a published name, which ends in the first digits of its SHA-1, tells of damage."""
    published = re.search(r"-\d{4}-([0-9a-f]{8})\.pth$", file.name)
    if published and not hashlib.sha1(file.read_bytes(), usedforsecurity=False).hexdigest().startswith(published[1]):
        raise ValueError("its SHA-1 is not the one in its name")


def _fits(value: object, ours: Tensor) -> bool:
    """Whether a file's value is a plain tensor that can stand for ours."""
    if type(value) not in (Tensor, nn.Parameter):  # others can hide what they are
        return False
    assert isinstance(value, Tensor)
    if value.layout != torch.strided or value.device.type != "cpu":
        return False
    return value.is_floating_point() and value.shape == ours.shape and bool(value.float().isfinite().all())
