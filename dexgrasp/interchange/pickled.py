"""NumPy files that hold pickled containers, read without trusting them.

A pickle is a program. The one that runs here can make None, numbers, texts, lists, tuples, dictionaries, sets and
arrays of numbers or texts, and nothing else: NumPy's own constructors are replaced by stand-ins that only note their
arguments, and every other name is refused before anything is called.
"""

import io
import pickle
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dexgrasp.errors import DexgraspError
from dexgrasp.sensing.arrays import load_npy
from dexgrasp.sensing.limits import GRASPS, sized

KINDS = "biufcSU?"
"""Kinds of numbers and texts of which arrays may be."""
DEEPEST = 50
MOST = 1_000_000
"""Values of one pickle, each counted as often as it stands in another: a small one can stand for endlessly many."""
WIDEST = 4096
"""Bytes, or letters, of one value of an array."""


class _Refused(Exception):
    """The pickle asks for more than data."""


class _Dtype:
    """Notes what a dtype is made of; only its byte order is taken from its state."""

    def __init__(self, text: Any) -> None:
        if not isinstance(text, str) or len(text) > 20:
            raise _Refused("an array of structures")
        self.text, self.order = text, ""

    def __setstate__(self, state: Any) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        if not isinstance(order, str) or order not in "<>|=" or (len(state) > 4 and state[3] is not None):
            raise _Refused("an array of structures")
        self.order = "" if order in "|=" else order

    def made(self) -> np.dtype[Any]:
        if not (self.text[:1] in KINDS and self.text[1:].isdigit() and 0 < int(self.text[1:]) <= WIDEST):
            raise _Refused(f"an array of dtype {self.text[:20]!r}")
        return np.dtype(self.order + self.text)


class _Array:
    """Notes an array's state."""

    def __init__(self) -> None:
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Scalar:
    """Notes a number of NumPy."""

    def __init__(self, dtype: Any, raw: Any) -> None:
        self.dtype, self.raw = dtype, raw


class _Call:
    """What stands for a permitted name: calls a stand-in, and has no state that a pickle could change."""

    __slots__ = ("made",)
    made: Any

    def __init__(self, made: Any) -> None:
        object.__setattr__(self, "made", made)

    def __call__(self, *arguments: Any) -> Any:
        return self.made(*arguments)

    def __setattr__(self, name: str, value: Any) -> None:
        raise _Refused("changing what a name means")

    def __setstate__(self, state: Any) -> None:
        raise _Refused("changing what a name means")


def _text_bytes(text: Any, encoding: Any = "latin1") -> bytes:
    """What `_codecs.encode` is for in old pickles: bytes told as text."""
    if not isinstance(text, str) or encoding != "latin1":
        raise _Refused("an encoding")
    return text.encode("latin1")


def _from_buffer(buffer: Any, dtype: Any, shape: Any, order: Any, *rest: Any) -> _Array:
    """Pickles of protocol 5 tell an array's bytes so."""
    made = _Array()
    made.state = (1, shape, dtype, order == "F", bytes(buffer) if isinstance(buffer, bytes | bytearray) else None)
    return made


def _pairs(items: Any = ()) -> dict[Any, Any]:
    """What an ordered dictionary is made of."""
    if not isinstance(items, list | tuple) or any(
        not isinstance(each, list | tuple) or len(each) != 2 for each in items
    ):
        raise _Refused("a dictionary of no pairs")
    _hashed([key for key, _ in items])
    return dict(items)


def _permitted() -> dict[tuple[str, str], _Call]:
    names: dict[tuple[str, str], _Call] = {
        ("numpy", "dtype"): _Call(lambda text, *rest: _Dtype(text)),
        ("numpy", "ndarray"): _Call(None),
        ("_codecs", "encode"): _Call(_text_bytes),
        ("collections", "OrderedDict"): _Call(_pairs),
    }
    for package in ("numpy.core.multiarray", "numpy._core.multiarray"):
        names[package, "_reconstruct"] = _Call(lambda *arguments: _Array())
        names[package, "scalar"] = _Call(_Scalar)
        names[package.replace("multiarray", "numeric"), "_frombuffer"] = _Call(_from_buffer)
    return names


_PYTHONS: Any = vars(pickle)["_Unpickler"]


class _Reader(_PYTHONS):  # type: ignore[misc]
    """Python's own reader in Python: that in C takes memory as a pickle tells it to, before anything is checked."""

    dispatch: ClassVar[dict[int, Any]] = dict(_PYTHONS.dispatch)

    def __init__(self, file: io.BufferedIOBase) -> None:
        super().__init__(file)
        self.names = _permitted()

    def load_setitem(self) -> None:
        _hashed(self.stack[-2:-1])
        super().load_setitem()

    def load_setitems(self) -> None:
        _hashed(self.stack[::2])
        super().load_setitems()

    def load_dict(self) -> None:
        _hashed(self.stack[::2])
        super().load_dict()

    def load_additems(self) -> None:
        _hashed(self.stack)
        super().load_additems()

    def load_frozenset(self) -> None:
        _hashed(self.stack)
        super().load_frozenset()

    dispatch[pickle.SETITEM[0]] = load_setitem
    dispatch[pickle.SETITEMS[0]] = load_setitems
    dispatch[pickle.DICT[0]] = load_dict
    dispatch[pickle.ADDITEMS[0]] = load_additems
    dispatch[pickle.FROZENSET[0]] = load_frozenset

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self.names:
            raise _Refused(f"{module}.{name}")
        return self.names[module, name]

    def persistent_load(self, pid: Any) -> Any:
        raise _Refused("a persistent object")


def _hashed(keys: list[Any]) -> None:
    """Keys are texts and numbers: to hash tuples of tuples can take for ever."""
    for key in keys:
        if not isinstance(key, str | bytes | int | float | _Scalar | None):
            raise _Refused(f"a {type(key).__name__.lstrip('_').lower()} as a key")


def load(file: io.BufferedIOBase, where: str) -> Any:
    """Return the data of a pickle; raises DexgraspError where it holds anything but data, or is no pickle."""
    try:
        return _plain(_Reader(file).load(), DEEPEST, [MOST])
    except _Refused as refused:
        remedy = "do not open it with anything that trusts it; ask its author for plain data"
        raise DexgraspError(f"nothing but data in {where}", f"a pickle that asks for {refused}", remedy) from None
    except Exception as error:  # a broken pickle can fail in any way; none of its code has run
        raise DexgraspError(f"a readable pickle in {where}", f"{type(error).__name__}: {error}", "mend it") from error


def read_npy(path: Path) -> Any:
    """Return what a .npy file holds: an array, or for arrays of objects the plain object (one) or list (several)."""
    try:
        with io.BytesIO(sized(path, GRASPS).read_bytes()) as file:
            version = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            _, _, dtype = header(file)
            if dtype.hasobject:
                return load(file, str(path))
            return load_npy(file.getvalue())
    except DexgraspError:
        raise
    except Exception as error:  # whatever is wrong in such a file
        raise DexgraspError(f"a NumPy file {path}", f"{type(error).__name__}: {error}", "check the path") from error


def _plain(value: Any, depth: int, left: list[int]) -> Any:
    """Return data in which arrays stand for their stand-ins."""
    left[0] -= 1
    if depth == 0 or left[0] < 0:
        raise _Refused("containers within containers without end")
    if isinstance(value, dict):
        return {_plain(key, depth - 1, left): _plain(each, depth - 1, left) for key, each in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return type(value)(_plain(each, depth - 1, left) for each in value)
    if isinstance(value, _Array):
        return _array(value, depth, left)
    if isinstance(value, _Scalar):
        if not isinstance(value.dtype, _Dtype) or not isinstance(value.raw, bytes):
            raise _Refused("a number that is none")
        return np.frombuffer(value.raw, value.dtype.made(), count=1)[0]
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | bytearray):
        return value
    raise _Refused(f"a {type(value).__name__.lstrip('_').lower()}")


def _array(value: _Array, depth: int, left: list[int]) -> Any:
    state = value.state
    if not isinstance(state, tuple) or len(state) != 5 or not isinstance(state[2], _Dtype):
        raise _Refused("an array without its state")
    _, shape, dtype, fortran, raw = state
    sound = isinstance(shape, tuple) and all(type(size) is int and size >= 0 for size in shape)
    if not sound:
        raise _Refused("an array of no shape")
    if dtype.text.startswith("O"):
        if not isinstance(raw, list):
            raise _Refused("an array of objects that is no list")
        values = [_plain(each, depth - 1, left) for each in raw]
        return values[0] if shape == () and len(values) == 1 else values
    if not isinstance(raw, bytes):
        raise _Refused("an array without its bytes")
    flat = np.frombuffer(raw, dtype.made())
    return flat.reshape(shape, order="F" if fortran else "C").copy()
