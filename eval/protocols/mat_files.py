"""Real arrays out of MATLAB files (version 5 to 7), which are walked first: scipy's reader crashes on some damaged
ones."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError

# Types of data elements: 8-bit to 64-bit numbers, a matrix, a compressed element. Classes of arrays: double to 64-bit
# whole numbers.
_NUMBERS, _MATRIX, _COMPRESSED = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}, 14, 15
_REAL_CLASSES = range(6, 16)
_COMPLEX = 0x0800
# A compressed element is not unpacked beyond this.
_LARGEST = 2**31


def read_arrays(path: str | os.PathLike, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """{name: float64 array, or bool or whole numbers as stored} of real arrays in a MATLAB file.

    Raises:
        LinprimError: unreadable, damaged, or one of them is not there.
    """
    from scipy.io import loadmat

    try:
        data = Path(path).read_bytes()
        if len(data) < 128 or 0 not in data[:4]:
            _check(data, names)
        values = loadmat(path, appendmat=False, variable_names=names)
    except OSError as error:
        raise LinprimError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # every damage has its own error; version 7.3 is NotImplementedError
        raise LinprimError(f"{path}: is not a MATLAB file up to version 7 ({error})") from error
    missing = [name for name in names if name not in values]
    if missing:
        raise LinprimError(f"{path}: has no {' and no '.join(missing)}, expected {', '.join(names)}")
    arrays = {name: np.asarray(values[name]) for name in names}
    for name, array in arrays.items():
        if array.dtype.kind not in "uifb":
            raise LinprimError(f"{path}: {name} is {array.dtype}, expected real numbers")
    return arrays


def _check(data: bytes, names: tuple[str, ...]) -> None:
    """Raises ValueError unless every array of these names is real and its parts are as long as they say."""
    if len(data) < 128:
        raise ValueError("it is cut short")
    if data[125 if data[126:127] == b"I" else 124] == 2:
        return  # version 7.3, which scipy names
    order = "<" if data[126:128] == b"IM" else ">"
    place = 128
    while place < len(data):
        kind, content, place = _element(data, place, order, whole=True)
        if kind == _COMPRESSED:
            unpacked = zlib.decompressobj().decompress(content, _LARGEST)
            kind, content, _ = _element(unpacked, 0, order, whole=True)
        if kind == _MATRIX:
            _check_matrix(content, order, names)


def _check_matrix(content: bytes, order: str, names: tuple[str, ...]) -> None:
    kinds, parts, place = [], [], 0
    for _ in range(3):  # flags, dimensions, name
        kind, part, place = _element(content, place, order)
        kinds.append(kind)
        parts.append(part)
    flags, shape, name = parts
    if name.decode("latin-1") not in names:
        return
    if kinds != [6, 5, 1] or len(flags) != 8 or len(shape) % 4 or not 8 <= len(shape) <= 128:
        raise ValueError("an array has no flags, dimensions and name")
    (bits,) = struct.unpack_from(order + "I", flags)
    if bits & 0xFF not in _REAL_CLASSES or bits & _COMPLEX:
        raise ValueError("an array is not of real numbers")
    kind, part, place = _element(content, place, order)
    sizes = struct.unpack(f"{order}{len(shape) // 4}i", shape)
    count = 1
    for size in sizes:
        count *= size
    if min(sizes) < 0 or kind not in _NUMBERS or count * _NUMBERS[kind] != len(part):
        raise ValueError(f"an array of {sizes} has {len(part)} bytes of the type {kind}")


def _element(data: bytes, place: int, order: str, whole: bool = False) -> tuple[int, bytes, int]:
    """(type, content, where the next one begins); only those inside of others (not `whole`) are padded or short."""
    if place + 8 > len(data):
        raise ValueError("an element is cut short")
    kind, size = struct.unpack_from(order + "II", data, place)
    if not whole and kind >> 16:
        kind, size = kind & 0xFFFF, kind >> 16
        if size > 4:
            raise ValueError(f"a short element has {size} bytes")
        return kind, data[place + 4 : place + 4 + size], place + 8
    begin = place + 8
    if begin + size > len(data):
        raise ValueError("an element is cut short")
    return kind, data[begin : begin + size], begin + (size if whole else -(-size // 8) * 8)
