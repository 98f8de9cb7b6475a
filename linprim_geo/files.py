"""Writing files so that what was there before is never lost and nothing half-written is left behind."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from .errors import LinprimError


def _read_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


# Read once: the only way to ask for it is to change it, which other threads would see.
_UMASK = _read_umask()


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[Path]:
    """Yields a temporary path beside `path` (same suffix) that replaces it when the block ends without an error.

    The data is on disk before the rename, so a crash at any moment leaves either the old file or the new one.
    On an error, or Ctrl-C, the temporary file is removed and the old file stays.

    Raises:
        LinprimError: the folder cannot be written, or the disk is full.
    """
    path = Path(path)
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=f".tmp{path.suffix}", dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        with open(temporary, "rb+") as written:
            os.fsync(written.fileno())
        os.chmod(temporary, 0o666 & ~_UMASK)
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise LinprimError(
                f"{path}: no space left on the device; the previous file is untouched"
            ) from error
        if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM, errno.ENOTDIR, errno.EEXIST):
            raise LinprimError(f"{path}: cannot be written ({os.strerror(error.errno)})") from error
        if _disk_is_full(path.parent):
            raise LinprimError(
                f"{path}: no space left on the device; the previous file is untouched"
            ) from error
        raise
    except RuntimeError as error:  # how torch reports a write that failed
        if _disk_is_full(path.parent):
            raise LinprimError(
                f"{path}: no space left on the device; the previous file is untouched"
            ) from error
        raise
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()


def write_json(path: str | os.PathLike, value: object) -> None:
    """Writes `value` as indented JSON, atomically. NaN and infinity become null, which JSON can hold."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(_finite(value), indent=2) + "\n")


def _disk_is_full(folder: Path) -> bool:
    """Whether less than a MiB is left; asked while the file that failed is still there."""
    try:
        return shutil.disk_usage(folder).free < 2**20
    except OSError:
        return False


def _finite(value):
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if hasattr(value, "tolist"):
        return _finite(value.tolist())
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value
