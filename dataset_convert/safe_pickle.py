"""Reads `.npy` files from strangers; those that hold pickles without running or trusting anything in them.

CALVIN's index files are pickled dicts of lists and arrays. An unpickler that knows stand-ins for numpy's constructors,
and nothing else, loads them; the arrays are made of the stand-ins afterwards, with every size checked.
"""

import io
import pickle
import pickletools
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

# ---- .npy files


def read_index_file(path: Path) -> bytes:
    """An index file's bytes.

    Raises:
        FileNotFoundError: The file is missing.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path} is missing: --root must hold a complete CALVIN split") from error


def load_object_array(path: Path) -> Any:
    """Loads the object stored in a 0-d object `.npy` file without running or trusting anything in it.

    Args:
        path: A file written by `numpy.save` from a dict.

    Returns:
        The stored object: containers of arrays, strings and numbers; numpy's scalars become Python's.

    Raises:
        FileNotFoundError: The file is missing.
        OSError: The machine cannot read it.
        ValueError: It is not such a file, it is damaged, or it names anything but numpy arrays.
    """
    content = read_index_file(path)
    try:
        header = _npy_header_of(content)
        if not _parse_npy_header(header)[2].hasobject:
            raise ValueError("holds no pickled object")
        stored = _unpickle(content[len(header) :])
        return stored.item() if isinstance(stored, np.ndarray) and stored.ndim == 0 else stored
    except Exception as error:  # see _unpickle
        raise ValueError(f"{path}: not an index file of arrays, strings and numbers ({error!r})") from error


def parse_npy(content: bytes) -> np.ndarray:
    """What `numpy.load` does, 3 times faster for small arrays: frames share a handful of headers, which are cached."""
    header = _npy_header_of(content)
    shape, fortran_order, dtype = _parse_npy_header(header)
    array = np.frombuffer(content, dtype, offset=len(header))
    return array.reshape(shape, order="F" if fortran_order else "C")


def _npy_header_of(content: bytes) -> bytes:
    return content[: 10 + int.from_bytes(content[8:10], "little")]


@lru_cache(maxsize=64)
def _parse_npy_header(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype]:
    file = io.BytesIO(header)
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
        raise ValueError(f"unknown npy version {version}")
    try:
        return np.lib.format.read_array_header_1_0(file)
    except MemoryError as error:  # raised by Python's parser, not for lack of memory
        raise ValueError("npy header is nested too deeply") from error


# ---- stand-ins: what a pickle gets in place of numpy's types

_DTYPE = re.compile(r"b1|[iu][1248]|f[248]|[SU][1-9]\d*|O8?")
"""Numpy's names of the dtypes that an index file may hold."""


@dataclass
class _Dtype:
    """Stands in for `numpy.dtype`: a kind, a size and a byte order; the rest of its state is ignored.

    numpy trusts a pickled dtype's state; a wrong size makes it read out of bounds.
    """

    name: Any
    order: Any = "="

    def __setstate__(self, state: Any) -> None:
        self.order = state[1]

    def numpy(self) -> np.dtype:
        if not _DTYPE.fullmatch(self.name):
            raise pickle.UnpicklingError(f"refused dtype {self.name!r}")
        return np.dtype(self.name).newbyteorder(self.order)


@dataclass
class _Array:
    """Stands in for an array: what the file says about it, unchecked until the whole file is read.

    `data` are bytes, or for an array of objects the list of them in C order, whatever the array's own order.
    """

    shape: Any = None
    dtype: Any = None
    fortran_order: Any = None
    data: Any = None

    def __setstate__(self, state: Any) -> None:
        _version, self.shape, self.dtype, self.fortran_order, self.data = state

    def numpy(self, done: dict[int, Any]) -> np.ndarray:
        """The array, its objects passed through `_with_arrays`."""
        dtype = self.dtype.numpy()
        if not all(type(length) is int and length >= 0 for length in self.shape):
            raise pickle.UnpicklingError(f"refused shape {self.shape!r}")
        if dtype.hasobject:
            objects = [_with_arrays(item, done) for item in self.data]
            return np.fromiter(objects, dtype, len(objects)).reshape(self.shape)
        array = np.frombuffer(self.data, dtype).copy()
        if dtype.kind == "U":
            array.tolist()  # numpy notices invalid characters only when a string is taken out
        return array.reshape(self.shape, order="F" if self.fortran_order else "C")


def _scalar(dtype: _Dtype, data: bytes) -> Any:
    """Stands in for numpy's constructor of scalars and returns Python's numbers and strings."""
    return np.frombuffer(data, dtype.numpy()).item()


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any) -> _Array:
    """Stands in for the constructor by which pickle protocol 5 writes arrays."""
    return _Array(shape, dtype, order == "F", data)


def _encode_latin1(text: str, encoding: str) -> bytes:
    """Stands in for `codecs.encode`, by which pickle protocol 2 writes bytes."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"refused encoding {encoding!r}")
    return text.encode("latin1")


# All names that a file may use, under numpy 1 and numpy 2, and their stand-ins. numpy's own constructors trust their
# arguments and their state: a crafted file could read the process's memory through them, or crash it.
_STAND_INS: dict[tuple[str, str], Any] = {
    ("_codecs", "encode"): _encode_latin1,
    ("__builtin__", "bytes"): lambda: b"",  # how protocol 2 writes empty bytes
    ("numpy", "ndarray"): None,  # only ever an argument of _reconstruct
    ("numpy", "dtype"): lambda name, *_: _Dtype(name),
    **{(f"numpy.{core}.multiarray", "_reconstruct"): lambda *_: _Array() for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _scalar for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _from_buffer for core in ("core", "_core")},
}


# ---- unpickling


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickles dicts, lists, tuples, strings, numbers and stand-ins for arrays, and refuses the rest."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _STAND_INS:
            raise pickle.UnpicklingError(f"refused to load {module}.{name}")
        return _STAND_INS[module, name]


def _unpickle(content: bytes) -> Any:
    """What a pickle holds, with arrays.

    Raises:
        Exception: Of nearly any kind, if the pickle is damaged or asks for anything but arrays, strings and numbers.
    """
    # The unpickler itself reserves memory for any size and memo index it reads; genops raises at a wrong size.
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name.endswith("PUT") and (argument or 0) > len(content):
            raise pickle.UnpicklingError(f"refused memo index {argument}")
    return _with_arrays(_ArrayUnpickler(io.BytesIO(content)).load(), {})


def _with_arrays(stored: Any, done: dict[int, Any]) -> Any:
    """Copies containers with arrays in place of their stand-ins.

    Args:
        stored: What the unpickler returned, or a part of it.
        done: The copies made so far, by the id of the original; an object that occurs repeatedly is copied once.

    Returns:
        The copy, of dicts, lists, tuples, arrays, strings and numbers alone.

    Raises:
        pickle.UnpicklingError: There is anything else in it.
        TypeError, ValueError: An array contradicts itself.
        RecursionError: It is nested too deeply.
    """
    if stored is None or isinstance(stored, (str, bytes, int, float)):
        return stored
    if id(stored) in done:
        return done[id(stored)]
    copy: Any
    if isinstance(stored, _Array):
        copy = stored.numpy(done)
    elif isinstance(stored, dict):
        copy = {_with_arrays(key, done): _with_arrays(value, done) for key, value in stored.items()}
    elif isinstance(stored, list):
        copy = [_with_arrays(item, done) for item in stored]
    elif isinstance(stored, tuple):
        copy = tuple([_with_arrays(item, done) for item in stored])
    else:
        raise pickle.UnpicklingError(f"refused {type(stored).__name__}")
    done[id(stored)] = copy
    return copy
