"""Reads real arrays from MATLAB files (version 5 to 7) by scipy, in a separate process, as scipy's reader crashes on
some damaged files."""

from __future__ import annotations

import io
import os
import subprocess
import sys

import numpy as np

from linprim_geo.base.errors import LinprimError

# Writes the arrays as npz to stdout, or exits with status 1 and one line about the error.
_READER = """
import io, sys
import numpy as np
from scipy.io import loadmat
try:
    found = loadmat(sys.argv[1], appendmat=False, variable_names=sys.argv[2:])
    arrays = {name: np.asarray(found[name]) for name in sys.argv[2:] if name in found}
    for name, array in arrays.items():
        if array.dtype.kind not in "uifb":
            raise TypeError(f"{name} is {array.dtype}, expected real numbers")
    written = io.BytesIO()
    np.savez(written, **arrays)
except Exception as error:
    sys.exit(" ".join(str(error).split()) or type(error).__name__)
sys.stdout.buffer.write(written.getvalue())
"""


def read_arrays(path: str | os.PathLike, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return real arrays of a MATLAB file by name: float64, or bool or integers as stored.

    Raises:
        LinprimError: the file is unreadable or damaged, or lacks one of them.
    """
    try:
        with open(path, "rb"):
            pass
    except OSError as error:
        raise LinprimError(f"{path}: cannot be read ({error.strerror or error})") from error
    # -P: no module is imported from the current folder.
    done = subprocess.run([sys.executable, "-P", "-c", _READER, os.fspath(path), *names], capture_output=True)
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip() if done.returncode == 1 else "its reader crashes on it"
        raise LinprimError(f"{path}: is not a MATLAB file up to version 7 ({said})")
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
        arrays = dict(found)
    missing = [name for name in names if name not in arrays]
    if missing:
        raise LinprimError(f"{path}: has no {' and no '.join(missing)}, expected {', '.join(names)}")
    return arrays
