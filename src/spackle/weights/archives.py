"""Read the zip archives that `torch.save` and TorchScript write, without running code in them.

An archive holds the numbers of each tensor as a file, some code, and a pickle that places the
tensors in a tree of objects. The pickle is read here with inert stand-ins for all its classes and
functions.

`torch.load(weights_only=True)` reads what `torch.save` writes, but not TorchScript, and
`torch.jit.load` runs the code in the file. LaMa's weights are published as TorchScript alone, so
this reader is needed; it serves `torch.save`'s archives too, because it also maps their tensors
from the disk and passes over objects of unknown classes.
"""

from __future__ import annotations

import io
import os
import pickle
import struct
import zipfile
from typing import Any, BinaryIO, ClassVar

import torch
from torch import Tensor

# The pickle of a network with a thousand tensors has a tenth of this size.
MAX_PICKLE_BYTES = 4_000_000

# PyTorch before version 1.6 wrote three pickles before that of the tree.
OLD_PICKLES_BEFORE_TREE = 3

# Bounds for the tree of objects; an object counts each time that it is met.
MAX_TREE_NODES = 100_000
MAX_TENSOR_NAME_CHARACTERS = 1000

# The types of numbers that are read, by the classes of PyTorch that stand for them in a pickle.
STORAGE_DTYPES = {
    "torch FloatStorage": torch.float32,
    "torch HalfStorage": torch.float16,
    "torch BFloat16Storage": torch.bfloat16,
    "torch DoubleStorage": torch.float64,
    "torch LongStorage": torch.int64,
    "torch IntStorage": torch.int32,
}

# In a zip archive, a record begins with a header of 30 bytes. Its last four bytes are the lengths
# of the name and of the extra field that follow it, and precede the content.
ZIP_HEADER_BYTES = 30
ZIP_NAME_LENGTH_BYTE = 26
ZIP_ENCRYPTED_FLAG = 1


def read_archive(path: str | os.PathLike[str]) -> object:
    """Read the tree of objects in an archive.

    Returns:
        The tree's root, of dicts, lists, numbers, texts, inert stand-ins for other objects, and
        tensors that are mapped from the disk.

    Raises:
        Exception: any exception, if the file is damaged or something else.
    """
    with zipfile.ZipFile(path) as archive:
        # "NAME/data.pkl", where NAME may be anything.
        pickle_names = [
            name
            for name in archive.namelist()
            if name.count("/") == 1 and name.endswith("/data.pkl")
        ]
        if len(pickle_names) != 1:
            raise ValueError("a zip archive without the pickle of a network")
        pickle_name = pickle_names[0]
        if archive.getinfo(pickle_name).file_size > MAX_PICKLE_BYTES:
            raise ValueError("the pickle is too large for a network")

        # `torch.save` can leave the checksums out: all are 0 then, and cannot be checked.
        has_checksums = any(record.CRC for record in archive.infolist())
        if has_checksums:
            damaged_name = archive.testzip()
            if damaged_name is not None:
                raise ValueError(f"damaged at {damaged_name}")

        data_folder = pickle_name.removesuffix("data.pkl") + "data/"
        pickled = archive.read(pickle_name)
        return _InertUnpickler(pickled, archive, path, data_folder).load()


def tensors_in_tree(root: object) -> dict[str, Tensor]:
    """Collect all tensors in a tree of objects and dicts.

    Args:
        root: what `read_archive` returns.

    Returns:
        The tensors by their names: the path from the root, joined by dots.

    Raises:
        ValueError: the tree is too large or too deep, or contains itself.
    """
    tensors: dict[str, Tensor] = {}
    node_count = 0
    remaining: list[tuple[str, object]] = [("", root)]
    # In a tree that contains itself, the loop ends because more and more nodes are counted.
    while remaining:
        name, node = remaining.pop()
        if isinstance(node, Tensor) and name:
            tensors[name] = node
        # A stand-in replaces an object of any class, such as a layer, and has its attributes.
        fields = node.fields if isinstance(node, _StandIn) else node
        if not isinstance(fields, dict):
            continue

        children = {key: child for key, child in fields.items() if isinstance(key, str)}
        node_count += len(children)
        if node_count > MAX_TREE_NODES or len(name) > MAX_TENSOR_NAME_CHARACTERS:
            raise ValueError("objects that are too many or too deep, or contain themselves")
        for key, child in children.items():
            child_name = f"{name}.{key}" if name else key
            remaining.append((child_name, child))
    return tensors


class _StandIn:
    """Replaces an object of any class, or the result of any function, and runs nothing."""

    # In a subclass: module and name of the replaced class or function, with a space between.
    replaced_name = ""
    # The attributes of the replaced object, or what was put into it as into a dict.
    fields: dict[object, object]

    def __new__(cls, *arguments: Any) -> Any:
        """Return what a call in the pickle gives, without running the class or function called.

        Two functions of PyTorch, which make a tensor of a storage and a parameter of a tensor, are
        replaced: both give a tensor. A call of anything else gives a stand-in without fields.
        """
        if cls.replaced_name == "torch._utils _rebuild_tensor_v2":
            storage, offset, shape, stride = arguments[:4]
            # `persistent_load` gives None for a storage whose type of numbers is unknown.
            if isinstance(storage, Tensor):
                # Raises an error if the tensor would reach beyond its storage.
                return storage.as_strided(shape, stride, offset)
        if cls.replaced_name == "torch._utils _rebuild_parameter":
            return arguments[0]
        stand_in: _StandIn = super().__new__(cls)
        stand_in.fields = {}
        return stand_in

    def __setitem__(self, name: object, value: object) -> None:
        """Keep an item that the pickle puts into the object, as into a dict."""
        self.fields[name] = value

    def __setstate__(self, state: object) -> None:
        """Keep the attributes that the pickle gives to the object."""
        if isinstance(state, dict):
            self.fields.update(state)


def _refuse_bytearray(unpickler: object) -> None:
    """ValueError: Python would first take as much memory as the pickle says, and then read."""
    raise ValueError("a bytearray, which PyTorch does not write")


# The unpickler in Python; the one in C would allocate any amount of memory that a pickle asks for.
class _PlainUnpickler(pickle._Unpickler):
    """Reads a pickle as plain values and stand-ins."""

    dispatch: ClassVar[Any] = {
        **pickle._Unpickler.dispatch,
        pickle.BYTEARRAY8[0]: _refuse_bytearray,
    }

    def find_class(self, module: str, name: str) -> type[_StandIn]:
        """Return a stand-in for a class or function that the pickle names."""
        return type("_StandIn", (_StandIn,), {"replaced_name": f"{module} {name}"})


class _StorageCounter(_PlainUnpickler):
    """Reads a pickle of PyTorch before version 1.6, and only counts what its tensors take."""

    def __init__(self, file: BinaryIO) -> None:
        """Read from an open file."""
        super().__init__(file)
        self.bytes_of_storages: dict[object, int] = {}  # by the key of each storage

    def persistent_load(self, pid: Any) -> None:
        """Note how many bytes a storage takes, to which the pickle refers.

        `pid` has as its second value the storage's class, as the third its key, and as the fifth
        how many numbers it has.
        """
        _, storage_class, key, _, count, *_ = pid
        dtype = STORAGE_DTYPES.get(storage_class.replaced_name, torch.uint8)
        self.bytes_of_storages[key] = int(count) * dtype.itemsize


def check_old_storages(file: BinaryIO, file_bytes: int) -> None:
    """Raise a ValueError if tensors of an old file take more memory than the file has bytes.

    PyTorch takes as much memory as the pickle asks for before it reads the numbers.

    Args:
        file: begins with the pickles of the format: its magic number, its version, facts about the
            system, and the tree of objects.
        file_bytes: size of the whole file.
    """
    for _ in range(OLD_PICKLES_BEFORE_TREE):
        _PlainUnpickler(file).load()
    counter = _StorageCounter(file)
    counter.load()
    storage_bytes = sum(counter.bytes_of_storages.values())
    if storage_bytes > file_bytes:
        problem = f"its tensors take {storage_bytes:,} bytes, and the file has {file_bytes:,}"
        raise ValueError(f"{problem}: it is damaged or cut off")


class _InertUnpickler(_PlainUnpickler):
    """Reads a pickle as plain values, stand-ins and tensors."""

    def __init__(
        self,
        pickled: bytes,
        archive: zipfile.ZipFile,
        path: str | os.PathLike[str],
        data_folder: str,
    ) -> None:
        """Prepare to read the objects of a pickle, whose tensors will be mapped from the disk.

        Args:
            pickled: the bytes of the pickle.
            archive: the archive that holds the pickle.
            path: the archive's file.
            data_folder: the folder in the archive with the numbers of the tensors.
        """
        super().__init__(io.BytesIO(pickled))
        self._archive = archive
        self._path = path
        self._data_folder = data_folder
        # Not shared: a change of a tensor is never written to the file.
        self._mapped_file = torch.UntypedStorage.from_file(
            os.fspath(path), shared=False, nbytes=os.path.getsize(path)
        )

    def persistent_load(self, pid: Any) -> Tensor | None:
        """Return the numbers of a storage, to which the pickle refers, as a flat tensor.

        A storage holds the numbers of one or several tensors.

        Args:
            pid: what the pickle says about the storage: five values, of which the second is the
                storage's class, the third the name of a file in the archive, and the fifth how many
                numbers the file has.

        Returns:
            A tensor mapped from the disk; None for a type that is not in STORAGE_DTYPES.

        Raises:
            ValueError: the file in the archive is compressed, encrypted or of another size.
        """
        _, storage_class, file_name, _, count = pid
        record = self._archive.getinfo(f"{self._data_folder}{file_name}")
        # The class is a stand-in, which keeps the name of the class that the pickle asks for.
        if storage_class.replaced_name not in STORAGE_DTYPES:
            return None
        numbers = torch.empty(0, dtype=STORAGE_DTYPES[storage_class.replaced_name])
        size = count * numbers.itemsize
        is_plain = record.compress_type == zipfile.ZIP_STORED
        is_encrypted = record.flag_bits & ZIP_ENCRYPTED_FLAG
        if not is_plain or is_encrypted or record.file_size != size:
            problem = f"is compressed, or has not the {size} bytes of its tensor"
            raise ValueError(f"storage {str(file_name)[:20]} {problem}")

        start = self._content_start(record)
        return numbers.set_(self._mapped_file[start : start + size])

    def _content_start(self, record: zipfile.ZipInfo) -> int:
        """Return the offset in the file at which the content of a record in the archive begins."""
        with open(self._path, "rb") as file:
            file.seek(record.header_offset + ZIP_NAME_LENGTH_BYTE)
            # Two numbers of 16 bits, lowest byte first.
            name_length, extra_length = struct.unpack("<2H", file.read(4))
        return record.header_offset + ZIP_HEADER_BYTES + int(name_length) + int(extra_length)
