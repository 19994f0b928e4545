"""Reading a pickled SMPL model as data: arrays, sparse matrices and plain containers only.

The published SMPL models are Python pickles. A pickle is a program; this module runs it with
every name replaced by a harmless holder of data, and refuses any name that it does not know.
No class or function of numpy, scipy or chumpy is ever called with what the file says: the
holders keep the file's bytes, and :func:`as_array` turns them into arrays after checking them.

Facts on the format: numpy arrays are ``_reconstruct`` calls followed by a state (version,
shape, dtype, Fortran order, raw bytes); scipy matrices are dictionaries of such arrays; chumpy
wraps arrays in ``Ch`` objects (data under ``x``) and ``Select`` objects (rows ``idxs`` of the
raveled ``a``, reshaped to ``preferred_shape``).
"""

from __future__ import annotations

import io
import math
import pickle
from collections import OrderedDict
from typing import Any

import numpy as np


class Forbidden(ValueError):
    """A pickle asks for a name that no SMPL model needs."""


class _Held:
    """An object of the file as data: constructor arguments and state, nothing executed."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs, self.state = args, kwargs, None

    def __new__(cls, *args: Any, **kwargs: Any) -> _Held:
        held = super().__new__(cls)
        held.args, held.kwargs, held.state = args, kwargs, None
        return held

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Held):
    pass


class _FromBuffer(_Held):
    pass


class _Scalar(_Held):
    pass


class _Dtype(_Held):
    pass


class _Csc(_Held):
    pass


class _Csr(_Held):
    pass


class _Chumpy(_Held):
    pass


class _Select(_Held):
    pass


class _Rebuilt(_Held):
    """``copyreg._reconstructor(cls, base, state)``: an empty holder of the class."""

    def __new__(cls, *args: Any, **kwargs: Any) -> _Held:
        wanted = args[0] if args else None
        if not (isinstance(wanted, type) and issubclass(wanted, _Held)) or wanted is _Rebuilt:
            raise Forbidden("it rebuilds an object that is not an array")
        return wanted()


class _Encoded(bytes):
    """``_codecs.encode(text, "latin1")``: how pickles of protocol 2 write bytes."""

    def __new__(cls, text: Any = None, encoding: Any = None) -> _Encoded:
        if encoding != "latin1" or not isinstance(text, str):
            raise Forbidden("it encodes text in another way than pickled bytes do")
        return super().__new__(cls, text.encode("latin1"))

    def __setstate__(self, state: Any) -> None:
        raise Forbidden("it gives bytes a state")


class _NdarrayMark(_Held):
    """Stands where the file names the class numpy.ndarray."""


# Holders are classes, never functions: a pickle may set attributes of a function that it is given,
# but a class whose instances define __setstate__ refuses a state of its own.
_KNOWN: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _NdarrayMark,
    ("numpy", "dtype"): _Dtype,
    ("collections", "OrderedDict"): OrderedDict,
    ("_codecs", "encode"): _Encoded,
    ("copyreg", "_reconstructor"): _Rebuilt,
    ("copy_reg", "_reconstructor"): _Rebuilt,
    ("chumpy.ch", "Ch"): _Chumpy,
    ("chumpy", "Ch"): _Chumpy,
    ("chumpy.reordering", "Select"): _Select,
}
for _core in ("numpy.core", "numpy._core"):
    _KNOWN[f"{_core}.multiarray", "_reconstruct"] = _Array
    _KNOWN[f"{_core}.multiarray", "scalar"] = _Scalar
    _KNOWN[f"{_core}.numeric", "_frombuffer"] = _FromBuffer
for _kind, _holder in (("csc", _Csc), ("csr", _Csr)):
    for _module in (f"scipy.sparse.{_kind}", f"scipy.sparse._{_kind}", "scipy.sparse"):
        for _suffix in ("matrix", "array"):
            _KNOWN[_module, f"{_kind}_{_suffix}"] = _holder
for _builtins in ("builtins", "__builtin__"):
    _KNOWN[_builtins, "object"] = object
    _KNOWN[_builtins, "set"] = set
    _KNOWN[_builtins, "frozenset"] = frozenset
    _KNOWN[_builtins, "bytearray"] = bytearray


class _DataUnpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str) -> Any:
        try:
            return _KNOWN[module_name, global_name]
        except KeyError:
            raise Forbidden(f"it asks for '{module_name}.{global_name}'") from None


def load_data(raw: bytes) -> Any:
    """The object in a pickle, with every array a holder that :func:`as_array` opens.

    Raises Forbidden where the pickle names anything but arrays, sparse matrices, chumpy arrays
    and plain containers, and ValueError where it is damaged. Never runs code of the file.
    """
    try:
        return _DataUnpickler(io.BytesIO(raw), encoding="latin1").load()
    except Forbidden:
        raise
    except Exception as error:  # a damaged pickle can fail in any opcode
        raise ValueError(f"damaged pickle ({type(error).__name__}: {error})") from None


def as_array(value: Any) -> np.ndarray:
    """A dense numeric array from a held object, a list of numbers or an array.

    Sparse matrices become dense. Raises ValueError where sizes, types or indices do not fit.
    """
    return _as_array(value, depth=0)


def _as_array(value: Any, depth: int) -> np.ndarray:
    if depth > 8:
        raise ValueError("arrays wrapped in arrays without end")
    match value:
        case np.ndarray():
            array = value
        case _Array():
            array = _from_state(value.state)
        case _FromBuffer():
            array = _from_buffer(value.args)
        case _Scalar():
            array = _numbers(_bytes(value.args[1]), _dtype(value.args[0]), (), "C")
        case _Csc() | _Csr():
            array = _dense(value, depth)
        case _Chumpy():
            array = _as_array(_entry(value, "x"), depth + 1)
        case _Select():
            array = _selected(value, depth)
        case list() | tuple() | int() | float():
            array = np.asarray(value)
        case _:
            raise ValueError(f"a {type(value).__name__.strip('_')} where numbers should be")
    if array.dtype.kind not in "biuf":
        raise ValueError(f"an array of type {array.dtype} where numbers should be")
    return array


def _entry(held: _Held, *names: str) -> Any:
    state = held.state
    if isinstance(state, tuple) and len(state) == 2:  # (dict, slots)
        state = state[0]
    if isinstance(state, dict):
        for name in names:
            if name in state:
                return state[name]
    raise ValueError(f"an object without its '{names[0]}'")


def _bytes(raw: Any) -> bytes:
    if isinstance(raw, str):  # a Python 2 string read as latin1
        return raw.encode("latin1")
    if isinstance(raw, bytes | bytearray):
        return bytes(raw)
    raise ValueError("an array of Python objects where numbers should be")


def _dtype(held: Any) -> np.dtype:
    if not isinstance(held, _Dtype) or not held.args or not isinstance(held.args[0], str):
        raise ValueError("an array without a number type")
    code = held.args[0].lstrip("<>=|")
    if code[:1] not in tuple("biuf") or not code[1:].isdigit():
        raise ValueError(f"an array of type '{held.args[0]}' where numbers should be")
    order = "<"
    if isinstance(held.state, tuple) and len(held.state) > 1 and held.state[1] == ">":
        order = ">"
    try:
        return np.dtype(order + code)
    except TypeError as error:
        raise ValueError(f"unknown number type '{code}' ({error})") from None


def _shape(shape: Any) -> tuple[int, ...]:
    if isinstance(shape, int) and not isinstance(shape, bool):
        shape = (shape,)
    if not isinstance(shape, tuple | list) or len(shape) > 4:
        raise ValueError("an array without a shape")
    if not all(isinstance(n, int) and 0 <= n < 2**31 for n in shape):
        raise ValueError(f"an array of shape {shape}")
    return tuple(shape)


def _numbers(raw: bytes, dtype: np.dtype, shape: tuple[int, ...], order: str) -> np.ndarray:
    if len(raw) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{len(raw)} bytes for an array of shape {shape} of {dtype}")
    return np.frombuffer(raw, dtype=dtype).reshape(shape, order="F" if order == "F" else "C")


def _from_state(state: Any) -> np.ndarray:
    if not isinstance(state, tuple) or len(state) not in (4, 5):
        raise ValueError("an array without data")
    shape, dtype, fortran, raw = state[-4:]
    return _numbers(_bytes(raw), _dtype(dtype), _shape(shape), "F" if fortran else "C")


def _from_buffer(args: tuple[Any, ...]) -> np.ndarray:
    if len(args) != 4:
        raise ValueError("an array without data")
    raw, dtype, shape, order = args
    return _numbers(_bytes(raw), _dtype(dtype), _shape(shape), order)


def _dense(held: _Held, depth: int) -> np.ndarray:
    """Compressed sparse columns or rows as a dense array."""
    rows, columns = _shape(_entry(held, "_shape", "shape"))
    data = _as_array(_entry(held, "data"), depth + 1).ravel()
    minor = _as_array(_entry(held, "indices"), depth + 1).ravel().astype(np.int64)
    pointer = _as_array(_entry(held, "indptr"), depth + 1).ravel().astype(np.int64)
    by_column = isinstance(held, _Csc)
    outer, inner = (columns, rows) if by_column else (rows, columns)
    fits = (
        len(pointer) == outer + 1
        and len(data) == len(minor) == pointer[-1]
        and pointer[0] == 0
        and bool(np.all(np.diff(pointer) >= 0))
        and (len(minor) == 0 or (minor.min() >= 0 and minor.max() < inner))
    )
    if not fits or rows * columns > 2**28:
        raise ValueError(f"a sparse matrix of shape ({rows}, {columns}) whose parts do not fit")
    major = np.repeat(np.arange(outer), np.diff(pointer))
    dense = np.zeros((rows, columns))
    np.add.at(dense, (minor, major) if by_column else (major, minor), data)
    return dense


def _selected(held: _Held, depth: int) -> np.ndarray:
    source = _as_array(_entry(held, "a"), depth + 1).ravel()
    index = _as_array(_entry(held, "idxs"), depth + 1).astype(np.int64)
    if index.size and (index.min() < 0 or index.max() >= source.size):
        raise ValueError("a selection beyond the end of its array")
    chosen = source[index]
    try:
        shape = _entry(held, "preferred_shape")
    except ValueError:
        return chosen
    shape = _shape(tuple(int(n) for n in _as_array(shape, depth + 1).ravel()))
    if math.prod(shape) != chosen.size:
        raise ValueError(f"a selection of {chosen.size} numbers in the shape {shape}")
    return chosen.reshape(shape)
