"""The tensors of a TorchScript file, or of what `torch.save` wrote, without running anything that is in it.

Such a file is a zip archive of tensors, code, and a pickle that says where in a tree of objects each tensor stands. The
code is not looked at. The pickle is read as data: a class or a function in it is a name, and what it would make of its
arguments is an inert `Holder`, or for the one function that stands for a tensor a `StoredTensor`.
"""

from __future__ import annotations

import dataclasses
import math
import pickletools
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


@dataclasses.dataclass(frozen=True, eq=False)
class Holder:
    """In place of an object of any class."""

    fields: dict[str, Any] = dataclasses.field(default_factory=dict)


class _Global(NamedTuple):
    """In place of a class or a function."""

    name: str


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
            self._tensors = _tensors(_decoded(self._archive.read(names[0])))
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


def _decoded(data: bytes) -> Any:
    """What a pickle describes, of plain values, lists, tuples, dicts with names, `Holder` and `StoredTensor`."""
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}

    def since_mark() -> list[Any]:
        place = marks.pop()
        items = stack[place:]
        del stack[place:]
        return items

    def pop(count: int) -> list[Any]:
        if len(stack) < count:
            raise ValueError("its pickle takes what is not there")
        items = stack[len(stack) - count :]
        del stack[len(stack) - count :]
        return items

    value: Any
    for opcode, value, _ in pickletools.genops(data):
        match opcode.name:
            case "STOP":
                return stack.pop()
            case "PROTO" | "FRAME":
                pass
            case "MARK":
                marks.append(len(stack))
            case "BINPUT" | "LONG_BINPUT":
                memo[value] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[value])
            case "GLOBAL":
                stack.append(_Global(value))
            case "NONE":
                stack.append(None)
            case "NEWTRUE" | "NEWFALSE":
                stack.append(opcode.name == "NEWTRUE")
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_LIST":
                stack.append([])
            case "EMPTY_TUPLE":
                stack.append(())
            case "TUPLE":
                stack.append(tuple(since_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple(pop(int(opcode.name[-1]))))
            case "APPEND" | "APPENDS":
                items = pop(1) if opcode.name == "APPEND" else since_mark()
                if isinstance(stack[-1], list):
                    stack[-1].extend(items)
            case "SETITEM" | "SETITEMS":
                items = pop(2) if opcode.name == "SETITEM" else since_mark()
                _set(stack[-1], dict(zip(map(_name, items[::2]), items[1::2], strict=True)))
            case "BUILD":
                (state,) = pop(1)
                _set(stack[-1], state)
            case "NEWOBJ" | "REDUCE":
                made, arguments = pop(2)
                stack.append(_rebuilt(arguments) if made == _Global(REBUILD) else Holder())
            case "BINPERSID":
                stack.append(tuple(pop(1)[0]))
            case "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT" | "BINUNICODE" | "SHORT_BINUNICODE":
                stack.append(value)
            case name:
                raise ValueError(f"its pickle has {name}, which no network's has")
    raise ValueError("its pickle has no end")


def _name(key: object) -> str:
    """A key of a dict, where it can name a tensor; other keys are one, and of no use."""
    return key if isinstance(key, str) else ""


def _set(holder: object, items: object) -> None:
    """Give an object its fields, or a dict some items; what has none stays as it is."""
    if isinstance(items, dict):
        if isinstance(holder, Holder):
            holder.fields.update(items)
        elif isinstance(holder, dict):
            holder.update(items)


def _rebuilt(arguments: Any) -> StoredTensor:
    """What torch's pickles say of a tensor: its storage, offset, shape, stride, and more that does not matter here."""
    (kind, storage, key, _, count), offset, shape, stride = arguments[:4]
    numbers = (count, offset, *shape, *stride)
    if kind != "storage" or not isinstance(key, str) or not all(type(n) is int and n >= 0 for n in numbers):
        raise ValueError("one of its tensors has no storage, shape or stride")
    if storage.name not in DTYPES:
        raise ValueError(f"one of its tensors is of {storage.name}")
    last = offset + sum((side - 1) * step for side, step in zip(shape, stride, strict=True))
    if math.prod(shape) > count or last >= count:
        raise ValueError(f"a tensor of shape {list(shape)[:8]} does not fit into its storage of {count} numbers")
    return StoredTensor(DTYPES[storage.name], key, count, offset, tuple(shape), tuple(stride))


def _tensors(root: object) -> dict[str, StoredTensor]:
    """All tensors in a tree of objects and dicts by their path, joined by dots."""
    found: dict[str, StoredTensor] = {}
    waiting, nodes = [("", root)], 0
    while waiting:
        path, node = waiting.pop()
        if isinstance(node, StoredTensor):
            found[path] = node
        fields = node.fields if isinstance(node, Holder) else node
        if isinstance(fields, dict):
            nodes += len(fields)
            if nodes > MAX_NODES or len(path) > MAX_PATH:
                raise ValueError("its objects are too many or too deep, or hold themselves")
            waiting += [(f"{path}.{name}" if path else name, child) for name, child in fields.items()]
    return found
