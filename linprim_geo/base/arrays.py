"""Reads arrays from untrusted .npy and .npz files. The shape and type in the header are checked before memory is
allocated, as a few bytes may declare an array of any size, and a few more may decompress to one."""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO

import numpy as np

from linprim_geo.base.errors import LinprimError

# Headers of numeric arrays have some hundred bytes. numpy reads a header whole, whatever its length, before checking
# it.
_LONGEST_HEADER = 10_000

# Raises LinprimError if an array of this shape and type is not acceptable.
Check = Callable[[tuple[int, ...], np.dtype], None]


def read_array(path: str | os.PathLike, check: Check) -> np.ndarray:
    """Read the array of a .npy file, or the first array of an .npz file.

    Raises:
        LinprimError: raised by `check`.
        Exception: numpy and zipfile raise a dozen kinds of exceptions for damaged files.
    """
    if Path(path).suffix != ".npz":
        with open(path, "rb") as file:
            check(*_header(file))
            file.seek(0)
            return np.lib.format.read_array(file, allow_pickle=False)
    with zipfile.ZipFile(path) as archive:
        return read_member(archive, archive.infolist()[0], check)


def read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, check: Check) -> np.ndarray:
    """Read one array of an .npz file; raises the same errors as `read_array`."""
    # Other compression methods than numpy's allocate as much memory as the file demands before any output.
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{member.filename} is packed by the method {member.compress_type}")
    with archive.open(member) as file:
        check(*_header(file))
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def read_named(path: str | os.PathLike, wanted: Mapping[str, tuple[tuple[int | None, ...], str]]) -> list[np.ndarray]:
    """Read arrays of an .npz file written by `numpy.savez`.

    Args:
        wanted: by name the shape, with None for any length, and the letter of numpy's kind: "f", "i", "u", "b".

    Raises:
        LinprimError: the file is missing or damaged, or an array is missing, of another shape or kind, or declares
            more bytes than the file has.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        with zipfile.ZipFile(path) as archive:
            members = {info.filename: info for info in archive.infolist()}
            if missing := [name for name in wanted if f"{name}.npy" not in members]:
                raise LinprimError(f"{path}: the array {missing[0]} is missing")
            checks = {name: _check_of(f"{path}: {name}", shape, kind, size) for name, (shape, kind) in wanted.items()}
            return [read_member(archive, members[f"{name}.npy"], check) for name, check in checks.items()]
    except LinprimError:
        raise
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds for damaged files
        raise LinprimError(f"{path}: cannot be read ({error})") from None


def _check_of(what: str, shape: tuple[int | None, ...], kind: str, size: int) -> Check:
    """Return a check for an array of this shape and kind in an uncompressed file of `size` bytes."""

    def check(claimed: tuple[int, ...], dtype: np.dtype) -> None:
        fits = len(claimed) == len(shape) and all(n in (None, found) for n, found in zip(shape, claimed, strict=True))
        if dtype.kind != kind or not fits:
            lengths = ", ".join("any" if length is None else str(length) for length in shape)
            raise LinprimError(f"{what} is {dtype} of shape {claimed}, wanted kind {kind} of shape ({lengths})")
        if not 0 <= math.prod(claimed) * dtype.itemsize <= size:
            raise LinprimError(f"{what} claims {claimed} {dtype}, but the file has {size} bytes")

    return check


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    """Return the shape and type declared at the start of a .npy file."""
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"the array format is {version}")
    field, reader = (
        (file.read(2), np.lib.format.read_array_header_1_0)
        if version == (1, 0)
        else (file.read(4), np.lib.format.read_array_header_2_0)
    )
    length = int.from_bytes(field, "little")
    if length > _LONGEST_HEADER:
        raise ValueError(f"the header of an array claims {length} bytes")
    shape, _, dtype = reader(io.BytesIO(field + file.read(length)))
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    return shape, dtype
