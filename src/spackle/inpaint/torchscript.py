"""The tensors of a TorchScript file, or of what `torch.save` wrote, without running anything that is in it.

Such a file is a zip archive of tensors, code, and a pickle that says where in a tree of objects each tensor stands. The
code is not looked at. The pickle is read with inert stand-ins: a `Holder` in place of any class or function in it, and
a `StoredTensor` in place of what the one function that makes a tensor would return.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

MAX_PICKLE = 4_000_000  # bytes; those of a thousand tensors are a tenth of that
MAX_NODES = 100_000  # of the tree: an object that stands at several places counts at each
MAX_PATH = 1000  # letters of the names from the tree's root
REBUILD = "torch._utils _rebuild_tensor_v2"
DTYPES = {
    "torch FloatStorage": torch.float32,
    "torch HalfStorage": torch.float16,
    "torch BFloat16Storage": torch.bfloat16,
    "torch DoubleStorage": torch.float64,
    "torch LongStorage": torch.int64,
    "torch IntStorage": torch.int32,
    "torch ShortStorage": torch.int16,
    "torch CharStorage": torch.int8,
    "torch ByteStorage": torch.uint8,
    "torch BoolStorage": torch.bool,
}


class StoredTensor(NamedTuple):
    """Where a tensor lies in the archive."""

    dtype: torch.dtype
    key: str  # of the storage
    numbers: int  # in the storage
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]

    @property
    def size(self) -> int:
        """Of the storage, in bytes."""
        return self.numbers * self.dtype.itemsize


class Holder:
    """In place of an object of any class, or of what any function makes: keeps the fields that it is given."""

    kind = ""  # of a subclass: module and name of what it stands for

    def __new__(cls, *arguments: object) -> Any:
        """Whatever the arguments, an empty one; a `StoredTensor` in place of torch's function that makes a tensor."""
        return _rebuilt(arguments) if cls.kind == REBUILD else super().__new__(cls)

    def __init__(self, *arguments: object) -> None:
        self.fields: dict[object, object] = {}

    def __setitem__(self, name: object, value: object) -> None:
        self.fields[name] = value

    def __setstate__(self, state: object) -> None:
        if "fields" not in vars(self):  # pickles make objects without initialising them
            self.fields = {}
        if isinstance(state, dict):
            self.fields.update(state)


class _Reader(pickle._Unpickler):  # in Python: the one in C takes whatever memory a pickle asks for
    """Reads a pickle of plain values, `Holder` and `StoredTensor`: no class or function in it is looked up."""

    def find_class(self, module: str, name: str) -> type[Holder]:
        return type("Holder", (Holder,), {"kind": f"{module} {name}"})

    def persistent_load(self, pid: Any) -> tuple[Any, ...]:
        return tuple(pid)


class TorchScriptFile:
    """An open archive; a context manager."""

    def __init__(self, path: Path) -> None:
        """Find the tensors; ValueError or what else Python raises about bytes that are not such a file."""
        self._archive, self._size = zipfile.ZipFile(path), path.stat().st_size
        try:
            names = [name for name in self._archive.namelist() if name.count("/") == 1 and name.endswith("/data.pkl")]
            if len(names) != 1:
                raise ValueError("a zip archive without the pickle of a network")
            self._root = names[0].removesuffix("data.pkl")
            if self._archive.getinfo(names[0]).file_size > MAX_PICKLE:
                raise ValueError("its pickle is too large for a network")
            self._tensors = _tensors(_Reader(io.BytesIO(self._archive.read(names[0]))).load())
        except BaseException:
            self._archive.close()
            raise

    def __enter__(self) -> TorchScriptFile:
        return self

    def __exit__(self, *error: object) -> None:
        self._archive.close()

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of each tensor, by its path in the tree of objects, joined by dots."""
        return {name: tensor.shape for name, tensor in self._tensors.items()}

    def read(self, names: Iterable[str]) -> list[Tensor]:
        """Tensors by their names; ValueError or the like where the archive does not hold what the pickle says.

        Together they take no more memory than the file does.
        """
        tensors = [self._tensors[name] for name in names]
        if sum(tensor.size for tensor in tensors) > self._size:
            raise ValueError("its tensors are larger than the file")
        return [self._read(tensor) for tensor in tensors]

    def _read(self, tensor: StoredTensor) -> Tensor:
        record = self._archive.getinfo(f"{self._root}data/{tensor.key}")
        if record.compress_type != zipfile.ZIP_STORED or not record.file_size == record.compress_size == tensor.size:
            raise ValueError(f"storage {tensor.key[:20]} has not the {tensor.size} bytes that its tensor needs")
        whole = torch.frombuffer(bytearray(self._archive.read(record)), dtype=tensor.dtype)
        return whole.as_strided(tensor.shape, tensor.stride, tensor.offset)


def _rebuilt(arguments: Any) -> StoredTensor:
    """What torch's pickles say of a tensor: its storage, offset, shape, stride, and more that does not matter here."""
    (kind, storage, key, _, count), offset, shape, stride = arguments[:4]
    numbers = (count, offset, *shape, *stride)
    if kind != "storage" or not isinstance(key, str) or not all(type(n) is int and n >= 0 for n in numbers):
        raise ValueError("one of its tensors has no storage, shape or stride")
    if storage.kind not in DTYPES:
        raise ValueError(f"one of its tensors is of {storage.kind}")
    last = offset + sum((side - 1) * step for side, step in zip(shape, stride, strict=True))
    if math.prod(shape) > count or last >= count:
        raise ValueError(f"a tensor of shape {list(shape)[:8]} does not fit into its storage of {count} numbers")
    return StoredTensor(DTYPES[storage.kind], key, count, offset, tuple(shape), tuple(stride))


def _tensors(root: object) -> dict[str, StoredTensor]:
    """All tensors in a tree of objects and dicts by their path, joined by dots."""
    found: dict[str, StoredTensor] = {}
    waiting, nodes = [("", root)], 0
    while waiting:
        path, node = waiting.pop()
        if isinstance(node, StoredTensor):
            found[path] = node
        fields = vars(node).get("fields") if isinstance(node, Holder) else node
        if isinstance(fields, dict):
            fields = {name: child for name, child in fields.items() if isinstance(name, str)}
            nodes += len(fields)
            if nodes > MAX_NODES or len(path) > MAX_PATH:
                raise ValueError("its objects are too many or too deep, or hold themselves")
            waiting += [(f"{path}.{name}" if path else name, child) for name, child in fields.items()]
    return found
