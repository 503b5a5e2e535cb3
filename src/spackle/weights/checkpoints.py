"""Load weights from an untrusted safetensors, `torch.save` or TorchScript file without running code in the file.

`torch.save` and TorchScript write a zip archive of tensors, code, and a pickle that places each tensor in a tree of
objects. The pickle is read with inert stand-ins for all its classes and functions.
"""

from __future__ import annotations

import io
import os
import pickle
import struct
import warnings
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from safetensors import safe_open
from torch import Tensor, nn

from spackle.runtime.device import report_memory_shortage
from spackle.runtime.errors import InputError, as_input_error, printable_line
from spackle.runtime.files import check_file

Network = TypeVar("Network", bound=nn.Module)
TensorShapes = dict[str, tuple[int, ...]]  # tensors' shapes by name

NAMED = 3  # number of names that a message lists
MAX_PICKLE = 4_000_000  # bytes; a pickle for a thousand tensors has a tenth
MAX_NODES = 100_000  # nodes of the tree; a repeated object counts each time
MAX_PATH = 1000  # characters of a path from the tree's root
STORAGES = {
    "torch FloatStorage": torch.float32,
    "torch HalfStorage": torch.float16,
    "torch BFloat16Storage": torch.bfloat16,
    "torch DoubleStorage": torch.float64,
    "torch LongStorage": torch.int64,
    "torch IntStorage": torch.int32,
}


def load_strict(
    network: Network,
    tensors: Mapping[str, Tensor],
    path: str | os.PathLike[str],
    advice: str,
    *,
    prepare: Callable[[nn.Module], object] | None = None,
) -> Network:
    """Fill a network with a file's tensors, converted to float32, and freeze it; integer buffers keep their values.

    Args:
        network: the network, which may be on the meta device.
        tensors: the file's tensors, see `read_tensors`.
        path, advice: the file's name, and what to do about a wrong file; both are parts of messages.
        prepare: changes the filled network in place; tensors that it leaves mapped from the file are copied afterwards.

    Raises:
        InputError: tensors are missing, unknown, of another shape, or not finite.
    """
    ours = network.state_dict()
    used = {
        name: tuple(tensor.shape) for name, tensor in ours.items() if tensor.is_floating_point()
    }
    check_tensors(tensors, used, path, advice, ignored=ours.keys() - used.keys())
    state = {name: tensors[name].float().contiguous() for name in used}
    network.load_state_dict(state, strict=False, assign=True)
    network.eval().requires_grad_(False)
    if prepare is not None:
        prepare(network)
    for name, tensor in (*network.named_parameters(), *network.named_buffers()):
        if (
            name in used and tensor.data_ptr() == tensors[name].data_ptr()
        ):  # still mapped from the file
            tensor.data = tensor.data.clone()
    check_finite(network, path, advice)
    return network


def to_channels_last(network: nn.Module) -> None:
    """Convert kernels to channels-last, which is faster on a CPU."""
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it


def check_tensors(
    found: Mapping[str, Tensor],
    expected: TensorShapes,
    path: str | os.PathLike[str],
    advice: str,
    ignored: Collection[str] = (),
) -> None:
    """Raise an InputError unless a file has float tensors of the expected names and shapes, and no others.

    Names in `ignored` are not checked.
    """
    kinds = {
        "missing": sorted(expected.keys() - found.keys()),
        "unknown": sorted(found.keys() - expected.keys() - set(ignored)),
        "of another shape": [
            f"{name} {list(found[name].shape)} instead of {list(shape)}"
            for name, shape in expected.items()
            if name in found and tuple(found[name].shape) != shape
        ],
        "not of floats": [
            name for name in expected if name in found and not found[name].is_floating_point()
        ],
    }
    problems = [f"{len(names)} {kind} ({_some(names)})" for kind, names in kinds.items() if names]
    if problems:
        raise InputError(
            f"{path}: another network's weights ({'; '.join(problems)}; {len(expected)} tensors are expected): {advice}"
        )


def check_finite(network: nn.Module, path: str | os.PathLike[str], advice: str) -> None:
    """Raise an InputError unless all numbers of a network are finite."""
    # A finite sum is a cheap proof; the sum of finite numbers may overflow.
    broken = [
        name
        for name, t in network.state_dict().items()
        if not (t.sum().isfinite() or t.isfinite().all())
    ]
    if broken:
        raise InputError(
            f"{path}: contains numbers that are not finite ({_some(broken)}): {advice}"
        )


def _some(names: list[str]) -> str:
    more = len(names) - NAMED
    shown = ", ".join(printable_line(name[:120])[:200] for name in names[:NAMED])
    return shown + (f", and {more} more" if more > 0 else "")


def read_tensors(path: str | os.PathLike[str], advice: str) -> dict[str, Tensor]:
    """The tensors of a file by name, mapped from the disk.

    In TorchScript and in nested dicts, a name is the path to the tensor, joined by dots. Messages end with `advice`.

    Raises:
        InputError: the file is missing or broken, or holds no weights.
    """
    with _reading_weights(path, advice):
        tensors = _read(path)
        if not tensors:
            raise ValueError("no named tensors")
    return tensors


def read_checkpoint(
    path: str | os.PathLike[str], name: str, advice: str
) -> tuple[object, dict[str, Tensor]]:
    """The value `name` of the dict in a `torch.save` file, and the dict's tensors; see `read_tensors`.

    The value is untrusted, and consists of numbers, strings, lists, dicts and inert stand-ins.
    """
    with _reading_weights(path, advice):
        root = _read_archive(path)
        if not isinstance(root, dict) or name not in root:
            raise ValueError(f"no {name}")
        return root[name], _tensors(root)


def read_metadata(path: str | os.PathLike[str], name: str) -> str | None:
    """The value `name` in a safetensors file's metadata; None if missing, or in another format."""
    with open(path, "rb") as file:
        if file.read(9)[8:] != b"{":
            return None
    with safe_open(path, framework="pt") as opened:
        return (opened.metadata() or {}).get(name)


@contextmanager
def _reading_weights(path: str | os.PathLike[str], advice: str) -> Iterator[None]:
    check_file(path, "weight file")
    with (
        as_input_error(path, f"not a file of weights, or damaged ({{reason}}): {advice}"),
        report_memory_shortage(),
    ):
        yield


def _read(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    with open(path, "rb") as file:
        head = file.read(9)
    if head.startswith(b"PK\x03\x04"):
        return _tensors(_read_archive(path))
    if head[8:] == b"{":
        with safe_open(path, framework="pt") as opened:
            return {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118  # it is no dict
    if not head.startswith(b"\x80"):
        raise ValueError("neither safetensors nor PyTorch's format")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded = torch.load(
                path, map_location="cpu", weights_only=True
            )  # the format of PyTorch before 1.6
    except pickle.UnpicklingError as error:
        raise ValueError(
            "a bare pickle with more than tensors; nothing in the pickle was run"
        ) from error
    tensors = {
        name: x for name, x in loaded.items() if isinstance(name, str) and isinstance(x, Tensor)
    }
    dense = {
        name: x
        for name, x in tensors.items()
        if (x.layout, x.device.type) == (torch.strided, "cpu")
    }
    return {
        name: Tensor.detach(x) for name, x in dense.items()
    }  # without attributes that replace methods


def _read_archive(path: str | os.PathLike[str]) -> object:
    """The root of the tree of objects in a zip archive."""
    with zipfile.ZipFile(path) as archive:
        names = [
            name
            for name in archive.namelist()
            if name.count("/") == 1 and name.endswith("/data.pkl")
        ]
        if len(names) != 1:
            raise ValueError("a zip archive without the pickle of a network")
        root = names[0].removesuffix("data.pkl")
        if archive.getinfo(names[0]).file_size > MAX_PICKLE:
            raise ValueError("the pickle is too large for a network")
        has_checksums = any(record.CRC for record in archive.infolist())  # torch.save can omit them
        if has_checksums and (damaged := archive.testzip()) is not None:
            raise ValueError(f"damaged at {damaged}")
        return _Unpickler(archive.read(names[0]), archive, path, f"{root}data/").load()


class _StandIn:
    """Replaces an object of any class, or the result of any function."""

    kind = ""  # in a subclass: module and name of the replaced class or function
    fields: dict[object, object]

    def __new__(cls, *arguments: Any) -> Any:
        """A tensor, if `kind` is a function of torch that rebuilds tensors or parameters; else an empty stand-in."""
        if cls.kind == "torch._utils _rebuild_tensor_v2" and isinstance(arguments[0], Tensor):
            storage, offset, shape, stride = arguments[:4]
            return storage.as_strided(shape, stride, offset)  # raises an error beyond the storage
        if cls.kind == "torch._utils _rebuild_parameter":
            return arguments[0]
        made: _StandIn = super().__new__(cls)
        made.fields = {}
        return made

    def __setitem__(self, name: object, value: object) -> None:
        self.fields[name] = value

    def __setstate__(self, state: object) -> None:
        if isinstance(state, dict):
            self.fields.update(state)


class _Unpickler(
    pickle._Unpickler
):  # in Python; the one in C allocates any amount of memory that a pickle asks for
    """Reads a pickle as plain values, `_StandIn` and tensors."""

    def __init__(
        self, data: bytes, archive: zipfile.ZipFile, path: str | os.PathLike[str], folder: str
    ) -> None:
        super().__init__(io.BytesIO(data))
        self._archive, self._path, self._folder = archive, path, folder
        self._mapped = torch.UntypedStorage.from_file(os.fspath(path), False, os.path.getsize(path))

    def find_class(self, module: str, name: str) -> type[_StandIn]:
        return type("_StandIn", (_StandIn,), {"kind": f"{module} {name}"})

    def persistent_load(self, pid: Any) -> Tensor | None:
        """A storage as a flat tensor; None for a type that is not in STORAGES."""
        _, storage, key, _, count = pid
        record = self._archive.getinfo(f"{self._folder}{key}")
        if storage.kind not in STORAGES:
            return None
        numbers = torch.empty(0, dtype=STORAGES[storage.kind])
        size = count * numbers.itemsize
        if (
            record.compress_type != zipfile.ZIP_STORED
            or record.flag_bits & 1
            or record.file_size != size
        ):
            raise ValueError(
                f"storage {str(key)[:20]} is compressed, or has not the {size} bytes of its tensor"
            )
        with open(self._path, "rb") as file:
            file.seek(record.header_offset + 26)
            name, more = struct.unpack(
                "<2H", file.read(4)
            )  # lengths of the fields before the numbers
        start = record.header_offset + 30 + name + more
        return numbers.set_(self._mapped[start : start + size])


def _tensors(root: object) -> dict[str, Tensor]:
    """All tensors in a tree of objects and dicts, by their dotted paths."""
    found: dict[str, Tensor] = {}
    waiting, nodes = [("", root)], 0
    while waiting:
        path, node = waiting.pop()
        if isinstance(node, Tensor) and path:
            found[path] = node
        fields = vars(node).get("fields") if isinstance(node, _StandIn) else node
        if isinstance(fields, dict):
            fields = {name: child for name, child in fields.items() if isinstance(name, str)}
            nodes += len(fields)
            if nodes > MAX_NODES or len(path) > MAX_PATH:
                raise ValueError("objects that are too many or too deep, or contain themselves")
            waiting += [
                (f"{path}.{name}" if path else name, child) for name, child in fields.items()
            ]
    return found
