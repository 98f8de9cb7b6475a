"""Arrays out of .npy and .npz files that are not to be trusted: what the header claims is checked before any memory is
taken for it, for a few bytes may claim, and a few more may unpack to, an array of any size."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np

# Headers of arrays of numbers take some hundred bytes. numpy reads one whole, whatever its length, before it looks.
_LONGEST_HEADER = 10_000

# Raises LinprimError unless an array of this shape and type is wanted.
Check = Callable[[tuple[int, ...], np.dtype], None]


def read_array(path: str | os.PathLike, check: Check) -> np.ndarray:
    """The array of a .npy file, or the first of an .npz file.

    Raises:
        LinprimError: what `check` raises.
        Exception: numpy and zipfile raise a dozen kinds for damaged files.
    """
    if Path(path).suffix != ".npz":
        with open(path, "rb") as file:
            check(*_header(file))
            file.seek(0)
            return np.lib.format.read_array(file, allow_pickle=False)
    with zipfile.ZipFile(path) as archive:
        return read_member(archive, archive.infolist()[0], check)


def read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, check: Check) -> np.ndarray:
    """One array of an .npz file; errors as of `read_array`."""
    # Other methods than numpy's take as much memory as the file asks for before they give a byte.
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{member.filename} is packed by the method {member.compress_type}")
    with archive.open(member) as file:
        check(*_header(file))
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type that the start of a .npy file claims."""
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
