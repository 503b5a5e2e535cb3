"""A Gaussian decoder by itself: 31 MB that stand for a whole checkpoint, because they say which one the rest is in."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path

from safetensors.torch import save
from torch import Tensor, nn

from spackle.bases.sharp.tensor_file import plain_text, read_notes, read_tensors
from spackle.errors import InputError, reason_in_a_line

NOTE = "spackle.gaussian_decoder"  # in the file's metadata: JSON, for safetensors shuffles several notes
PARTS = ("feature_model.", "prediction_head.")  # how its tensors' names begin
BLOCK = 1 << 20  # bytes of a file read at once


@dataclasses.dataclass(frozen=True)
class Owner:
    """The checkpoint that a decoder was trained on, and needs for all that was not trained."""

    path: Path  # where it lies; of one that a decoder's file names, the name alone
    sha256: str

    @property
    def places(self) -> tuple[str, str]:
        """What it, or a link to it, is called beside a decoder: the link of `link_owner`, and its own name."""
        return f"trained-on-{plain_text(Path(self.sha256).name, 12)}.link", self.path.name


def decoder_bytes(decoder: nn.Module, owner: Owner) -> bytes:
    """A safetensors file in float32: weights that have not changed come back bit for bit.

    Args:
        decoder: a `GaussianDecoder`.
        owner: its checkpoint.
    """
    tensors = {name: tensor.detach().float().cpu().contiguous() for name, tensor in decoder.state_dict().items()}
    return save(tensors, {NOTE: json.dumps({"checkpoint": owner.path.name, "sha256": owner.sha256})})


def link_owner(owner: Owner, folder: Path) -> None:
    """Let decoders in a folder find their checkpoint; the link's name is one that nothing is ever written to."""
    link = folder / owner.places[0]
    with contextlib.suppress(OSError):  # this place has no links: then a person puts the checkpoint there
        if link.is_symlink() and not link.exists():  # to where it lay once
            link.unlink()
        if not link.exists():
            link.symlink_to(owner.path.absolute())


def owner_of(path: str | os.PathLike[str]) -> Owner | None:
    """The checkpoint that a decoder's file names; None where a file holds something else.

    Args:
        path: a file that `read_tensors` has read.

    Raises:
        InputError: it says that it is a decoder, and not whose.
    """
    note = read_notes(path).get(NOTE)
    if note is None:
        return None
    try:
        facts = json.loads(note)
        return Owner(Path(Path(str(facts["checkpoint"])).name), str(facts["sha256"]))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: does not say which checkpoint it was trained on: train it again") from error


def with_owner(decoder: Mapping[str, Tensor], path: str | os.PathLike[str], owner: Owner) -> dict[str, Tensor]:
    """A whole checkpoint: the owner's tensors, with the decoder's in place of those of the same names.

    The owner is looked for beside the decoder.

    Args:
        decoder: the tensors of the decoder's file.
        path: that file, for messages.
        owner: what it names.

    Raises:
        InputError: the owner is not there, cannot be read or has changed, or the decoder is another network's.
    """
    beside = Path(path).absolute().parent
    home = next((beside / name for name in owner.places if os.path.isfile(beside / name)), None)
    name = plain_text(owner.path.name)
    if home is None:
        raise InputError(
            f"{path}: a decoder trained on {name}, which is not beside it: put that checkpoint, or a link to it, there"
        )
    if _sha256(home) != owner.sha256:
        raise InputError(
            f"{path}: trained on a checkpoint with the SHA-256 {plain_text(owner.sha256)}, which {home} has not: "
            f"put that {name} beside it"
        )
    whole = read_tensors(home)
    replaced = {name for name in whole if name.startswith(PARTS)}
    if wrong := sorted(replaced ^ decoder.keys()):
        raise InputError(
            f"{path}: not the decoder of {home}: {len(wrong)} names differ, e.g. {plain_text(wrong[0])}: "
            "give what `spackle train --method direct-ft` wrote"
        )
    return {**whole, **decoder}


def _sha256(path: Path) -> str:
    """Of a whole file; InputError where it cannot be read."""
    found = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            while block := file.read(BLOCK):
                found.update(block)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {reason_in_a_line(error)}") from error
    return found.hexdigest()
