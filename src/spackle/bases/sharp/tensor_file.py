"""Named tensors from a file that a stranger wrote: its kind told by its content, and nothing in it run."""

from __future__ import annotations

import os
import pickle
import warnings
import zipfile
from collections.abc import Mapping

import torch
from safetensors import safe_open
from torch import Tensor

from spackle.bases.device import enough_memory
from spackle.errors import InputError, reason_in_a_line
from spackle.image import check_file

MAX_HEADER = 100_000_000  # bytes of a safetensors header; the format allows no more
ENCRYPTED = 1  # a zip member's flag


def read_tensors(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """The tensors of a checkpoint, their numbers read from the disk only when they are used.

    Args:
        path: what torch.save wrote, or a safetensors file, whatever its name.

    Raises:
        InputError: a missing or broken file, or one that holds anything but named tensors.
    """
    check_file(path, "checkpoint")
    try:
        with enough_memory():
            loaded = _read(path)
    except InputError:
        raise
    except pickle.UnpicklingError as error:
        raise InputError(
            f"{path}: holds more than tensors, or is damaged; nothing in it was run: "
            "give Apple's checkpoint as it was downloaded, or a .safetensors file"
        ) from error
    except Exception as error:  # a stranger's bytes can raise anything
        reason = plain_text(reason_in_a_line(error), 200)
        raise InputError(f"{path}: not a checkpoint, or cut off ({reason}): download it again") from error
    if not isinstance(loaded, Mapping) or not loaded:
        raise InputError(f"{path}: holds no named tensors: give SHARP's checkpoint")
    for name, value in loaded.items():
        if not isinstance(name, str):
            raise InputError(f"{path}: a {type(name).__name__} stands for a name: give SHARP's weights alone")
        if not _is_plain(value):
            raise InputError(f"{path}: {plain_text(name)} is no plain tensor of floats: give SHARP's weights alone")
    return dict(loaded)


def read_notes(path: str | os.PathLike[str]) -> dict[str, str]:
    """What a safetensors file says about itself; nothing where it says nothing, or is another kind of file.

    Args:
        path: a file that `read_tensors` has read.
    """
    with open(path, "rb") as file:
        head = file.read(9)
    if not _is_safetensors(head):
        return {}
    with safe_open(path, framework="pt") as opened:
        return dict(opened.metadata() or {})


def plain_text(text: str, longest: int = 120) -> str:
    """A stranger's text for a message: as it is where it is plain, else quoted and escaped."""
    text = text[:longest]
    return text if text.isascii() and text.isprintable() else ascii(text)[:longest]


def _read(path: str | os.PathLike[str]) -> object:
    """Whatever is in a file, by its first bytes: people rename files."""
    with open(path, "rb") as file:
        head = file.read(9)
    if head.startswith(b"PK\x03\x04"):
        _check_archive(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about kinds of tensors that are refused
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    if _is_safetensors(head):
        with safe_open(path, framework="pt") as opened:
            return {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118  # it is no dict
    if head.startswith(b"\x80"):
        raise InputError(
            f"{path}: a bare pickle, as PyTorch wrote before 1.6; nothing in it was run: "
            "save it again with a current torch.save, or give Apple's checkpoint as it was downloaded"
        )
    raise InputError(f"{path}: neither a PyTorch checkpoint nor a safetensors file: give SHARP's checkpoint")


def _is_safetensors(head: bytes) -> bool:
    """By the first nine bytes of a file."""
    return head[8:] == b"{" and int.from_bytes(head[:8], "little") <= MAX_HEADER


def _check_archive(path: str | os.PathLike[str]) -> None:
    """InputError unless a zip's members lie in it plainly and undamaged: torch maps them, and looks at nothing."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED or member.flag_bits & ENCRYPTED for member in members):
            raise InputError(
                f"{path}: zipped again by another program: give Apple's checkpoint as it was downloaded, "
                "or what torch.save writes"
            )
        # The record says little or big, and torch refuses whatever else it says.
        if any(member.filename.endswith("/byteorder") and member.file_size == len("big") for member in members):
            raise InputError(f"{path}: its numbers are big-endian: save it again on a little-endian machine")
        summed = any(member.CRC for member in members)  # torch.save can be told to leave the sums out
        if summed and (damaged := archive.testzip()) is not None:
            raise InputError(f"{path}: damaged at {plain_text(damaged)}: download it again")


def _is_plain(value: object) -> bool:
    """A dense tensor of floats with nothing attached: a file can give a tensor attributes that hide its methods."""
    if type(value) not in (Tensor, torch.nn.Parameter) or vars(value):
        return False
    assert isinstance(value, Tensor)
    dense = not value.is_nested and value.layout == torch.strided and value.device.type == "cpu"
    return dense and value.is_floating_point()
