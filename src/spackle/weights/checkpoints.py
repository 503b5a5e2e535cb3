"""Load weights from untrusted files without running code in them.

The formats are safetensors and those of PyTorch.

`read_tensors` reads a file, `load_strict` puts its tensors into a network.
"""

from __future__ import annotations

import mmap
import os
import pickle
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import BinaryIO, TypeVar, cast

import torch
from safetensors import safe_open
from torch import Tensor, nn

from spackle.runtime.device import report_memory_shortage
from spackle.runtime.errors import InputError, as_input_error, printable_line
from spackle.runtime.files import check_file
from spackle.weights.archives import check_old_storages, read_archive, tensors_in_tree

Network = TypeVar("Network", bound=nn.Module)
StrPath = str | os.PathLike[str]
TensorShapes = dict[str, tuple[int, ...]]  # tensors' shapes by name

# How many tensors a message names, and how long a name may be before and after escaping.
MAX_NAMES_IN_MESSAGE = 3
MAX_NAME_CHARACTERS = 120
MAX_ESCAPED_NAME_CHARACTERS = 200

# How the files of each format begin. A safetensors file begins with a length of 8 bytes, and then
# a JSON object.
ZIP_SIGNATURE = b"PK\x03\x04"
PICKLE_SIGNATURE = b"\x80"
SAFETENSORS_LENGTH_BYTES = 8
JSON_OBJECT = b"{"


def load_strict(
    network: Network,
    tensors: Mapping[str, Tensor],
    path: StrPath,
    advice: str,
    *,
    prepare: Callable[[nn.Module], object] | None = None,
) -> Network:
    """Fill a network with a file's tensors, converted to float32, and freeze it.

    Only floating-point parameters and buffers are filled. Integer buffers keep their values.

    Args:
        network: the network, which may be on the meta device, where tensors take no memory.
        tensors: the file's tensors, as `read_tensors` returns them.
        path: the file's name, for messages.
        advice: what to do about a wrong file, for messages.
        prepare: a function that changes the filled network in place, for example to another data
            type. A tensor that it replaces need not be copied from the file, which saves memory.

    Returns:
        The same network, which does not depend on the file any more.

    Raises:
        InputError: tensors are missing, unknown, of another shape, or not finite.
    """
    state = network.state_dict()
    float_shapes = {
        name: tuple(tensor.shape) for name, tensor in state.items() if tensor.is_floating_point()
    }
    integer_names = state.keys() - float_shapes.keys()
    check_tensors(tensors, float_shapes, path, advice, ignored=integer_names)

    new_state = {name: tensors[name].float().contiguous() for name in float_shapes}
    network.load_state_dict(new_state, strict=False, assign=True)
    network.eval().requires_grad_(False)
    if prepare is not None:
        prepare(network)

    # A tensor with the address of the file's tensor is still mapped from the file. It is copied,
    # because the file may be changed or deleted.
    for name, tensor in (*network.named_parameters(), *network.named_buffers()):
        if name in float_shapes and tensor.data_ptr() == tensors[name].data_ptr():
            tensor.data = tensor.data.clone()
    check_finite(network, path, advice)
    return network


def to_channels_last(network: nn.Module) -> None:
    """Convert a network's kernels to the memory format channels-last, which is faster on a CPU: the
    channels of a pixel are neighbours.
    """
    # The stubs of torch lack this overload.
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def check_tensors(
    tensors: Mapping[str, Tensor],
    expected: TensorShapes,
    path: StrPath,
    advice: str,
    ignored: Collection[str] = (),
) -> None:
    """Check that a file has float tensors of the expected names and shapes, and no others.

    Args:
        tensors: the file's tensors by name.
        expected: the shapes by name.
        path: the file's name, for messages.
        advice: what to do about a wrong file, for messages.
        ignored: names of further tensors that the file may have.

    Raises:
        InputError: the tensors are others; the message names some of each kind of difference.
    """
    missing = sorted(expected.keys() - tensors.keys())
    unknown = sorted(tensors.keys() - expected.keys() - set(ignored))
    other_shapes = []
    other_types = []
    for name, shape in expected.items():
        if name not in tensors:
            continue
        if tuple(tensors[name].shape) != shape:
            other_shapes.append(f"{name} {list(tensors[name].shape)} instead of {list(shape)}")
        if not tensors[name].is_floating_point():
            other_types.append(name)

    problems = []
    for names, kind in (
        (missing, "missing"),
        (unknown, "unknown"),
        (other_shapes, "of another shape"),
        (other_types, "not of floats"),
    ):
        if names:
            problems.append(f"{len(names)} {kind} ({_name_some(names)})")
    if problems:
        differences = "; ".join([*problems, f"{len(expected)} tensors are expected"])
        raise InputError(f"{path}: another network's weights ({differences}): {advice}")


def check_finite(network: nn.Module, path: StrPath, advice: str) -> None:
    """Check that all numbers of a network are finite.

    Args:
        network: the network that was filled with a file's tensors.
        path: the file's name, for messages.
        advice: what to do about a wrong file, for messages.

    Raises:
        InputError: a tensor has NaN or inf; the message names some of these tensors.
    """
    broken_names = []
    for name, tensor in network.state_dict().items():
        # A finite sum, which costs little, proves that all numbers are finite. An infinite sum
        # proves nothing, because large finite numbers may add up to it.
        is_finite = bool(tensor.sum().isfinite()) or bool(tensor.isfinite().all())
        if not is_finite:
            broken_names.append(name)
    if broken_names:
        problem = f"contains numbers that are not finite ({_name_some(broken_names)})"
        raise InputError(f"{path}: {problem}: {advice}")


def _name_some(names: list[str]) -> str:
    """List the first names of tensors, and say how many more there are.

    The names come from a file of unknown origin. So they are shortened, and control characters are
    escaped.
    """
    shortened_names = [
        # Shortened again, because escaping lengthens a name.
        printable_line(name[:MAX_NAME_CHARACTERS])[:MAX_ESCAPED_NAME_CHARACTERS]
        for name in names[:MAX_NAMES_IN_MESSAGE]
    ]
    text = ", ".join(shortened_names)
    more_count = len(names) - MAX_NAMES_IN_MESSAGE
    if more_count > 0:
        text += f", and {more_count} more"
    return text


def read_tensors(path: StrPath, advice: str) -> dict[str, Tensor]:
    """Return the tensors of a file by name, mapped from the disk.

    In TorchScript and in nested dicts, a name is the path to the tensor, joined by dots.

    Args:
        path: a safetensors, `torch.save` or TorchScript file.
        advice: what to do about a wrong file, at the end of messages.

    Raises:
        InputError: the file is missing or broken, or holds no weights.
    """
    with _weight_file_errors(path, advice):
        tensors = _read_any_format(path)
        if not tensors:
            raise ValueError("no named tensors")
        return tensors


def read_checkpoint(path: StrPath, name: str, advice: str) -> tuple[object, dict[str, Tensor]]:
    """Return one value of the dict in a `torch.save` file, and all tensors of the dict.

    Args:
        path: the file.
        name: the value's name, such as "config".
        advice: what to do about a wrong file, at the end of messages.

    Returns:
        The value, which is untrusted and consists of numbers, texts, lists, dicts, and stand-ins
        for objects of classes, none of which was run; and the tensors by name, as `read_tensors`
        returns them.

    Raises:
        InputError: the file is missing or broken, or has no such value.
    """
    with _weight_file_errors(path, advice):
        root = read_archive(path)
        if not isinstance(root, dict) or name not in root:
            raise ValueError(f"no {name}")
        return root[name], tensors_in_tree(root)


def read_metadata(path: StrPath, name: str) -> str | None:
    """Return a value of a safetensors file's metadata; None if it, or the format, is another."""
    if not _is_safetensors(_read_signature(path)):
        return None
    with safe_open(path, framework="pt") as opened:
        metadata = opened.metadata()  # None if there is none
    return None if metadata is None else metadata.get(name)


@contextmanager
def _weight_file_errors(path: StrPath, advice: str) -> Iterator[None]:
    """Turn any exception in the block, which reads a file of weights, into an InputError."""
    check_file(path, "weight file")
    problem = f"not a file of weights, or damaged ({{reason}}): {advice}"
    with as_input_error(path, problem), report_memory_shortage():
        yield


def _read_signature(path: StrPath) -> bytes:
    """Return the first bytes of a file, which tell its format."""
    with open(path, "rb") as file:
        return file.read(SAFETENSORS_LENGTH_BYTES + len(JSON_OBJECT))


def _is_safetensors(signature: bytes) -> bool:
    """Return whether the first bytes are those of a safetensors file."""
    return signature[SAFETENSORS_LENGTH_BYTES:] == JSON_OBJECT


def _read_any_format(path: StrPath) -> dict[str, Tensor]:
    """Return the tensors of a file by name; any exception if the file is no file of weights."""
    signature = _read_signature(path)
    if signature.startswith(ZIP_SIGNATURE):
        return tensors_in_tree(read_archive(path))
    if _is_safetensors(signature):
        with safe_open(path, framework="pt") as opened:
            names = opened.keys()  # what was opened is not a dictionary
            return {name: opened.get_tensor(name) for name in names}
    if signature.startswith(PICKLE_SIGNATURE):
        return _read_old_pickle(path)
    raise ValueError("neither safetensors nor PyTorch's format")


def _read_old_pickle(path: StrPath) -> dict[str, Tensor]:
    """Return the tensors of a dict that PyTorch before version 1.6 saved, which is a bare pickle.

    Raises:
        ValueError: the pickle holds more than tensors and plain values, or its tensors are larger
            than the file.
    """
    other_content = "a bare pickle with more than tensors; nothing in the pickle was run"
    try:
        # PyTorch asks for as many bytes as a length in the pickle says, which may be far too large
        # in a damaged file. A file object would allocate that many before it reads; a mapped file
        # only gives what is there.
        with open(path, "rb") as file, warnings.catch_warnings():
            # PyTorch warns about the old format; the user of a published file cannot change it.
            warnings.simplefilter("ignore")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
                readable = cast(BinaryIO, mapped)
                check_old_storages(readable, len(mapped))
                readable.seek(0)
                content = torch.load(readable, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, EOFError) as error:
        raise ValueError(other_content) from error

    tensors = {}
    for name, value in content.items():
        if not (isinstance(name, str) and isinstance(value, Tensor)):
            continue
        is_dense = value.layout == torch.strided and value.device.type == "cpu"
        if is_dense:
            # The class's method, because the file may give the tensor attributes of this name.
            tensors[name] = Tensor.detach(value)
    return tensors
