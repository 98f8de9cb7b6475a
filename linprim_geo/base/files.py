"""Writes files atomically: existing files are never lost, and no partial files are left."""

from __future__ import annotations

import contextlib
import errno
import glob
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from linprim_geo.base.errors import DiskFull, LinprimError


def _read_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


# Read once, as reading it requires setting it, which other threads would notice.
_UMASK = _read_umask()


# Errors of a full disk, of a quota, and of a file system that does not support files of this size.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_LOCK = ".lock"
_SECONDS_BETWEEN_TRIES = 0.2
# Errors of a file system without locks.
_NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path beside `path` (same suffix) that replaces it if the block ends without an error.

    The data is on disk before the rename, and the rename before this returns. So a crash at any moment leaves either
    the old or the new file, and of files written one after the other a later one never survives without an earlier
    one. On an error or Ctrl-C, the temporary file is removed and the old file stays. `remove_temporary` removes what is
    left by a killed process.

    Raises:
        LinprimError: the folder cannot be written.
        DiskFull: there is no space left.
    """
    path = Path(path)
    temporary = None
    try:
        with readable_write_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=f".tmp{path.suffix}", dir=path.parent)
            os.close(handle)
            temporary = Path(name)
            yield temporary
            os.chmod(temporary, 0o666 & ~_UMASK)
            with open(temporary, "rb+") as written:
                os.fsync(written.fileno())
            os.replace(temporary, path)
            temporary = None
            _sync_folder(path.parent)
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()


@contextlib.contextmanager
def readable_write_errors(path: Path) -> Iterator[None]:
    """Convert errors of a full, failing or read-only disk to a LinprimError about `path`."""
    try:
        yield
    except OSError as error:
        found = _sentence(path, error)
        if found is None:
            raise
        raise found from error
    except RuntimeError as error:  # torch raises this for a failed write
        cause = error.__cause__ or error.__context__
        found = _sentence(path, cause) if isinstance(cause, OSError) else None
        if found is None and not _disk_is_full(path.parent):
            raise
        raise found or _full(path) from error


def remove_temporary(path: Path) -> None:
    """Remove temporary files left by a killed process that wrote `path`; call it only with the folder locked."""
    for torn in path.parent.glob(f".{glob.escape(path.stem)}.*.tmp{glob.escape(path.suffix)}"):
        with contextlib.suppress(OSError):
            torn.unlink()


def is_leftover(entry: Path) -> bool:
    """Return whether a directory entry is a remainder of `locked` or of a killed `atomic_write`."""
    return entry.name.startswith(".") and (entry.name.endswith(_LOCK) or ".tmp" in entry.name) and entry.is_file()


@contextlib.contextmanager
def locked(folder: Path, what: str, file: str = "", wait: Callable[[], object] | None = None) -> Iterator[None]:
    """Lock a folder, which is created if necessary, or only the name `file` in it, against other processes.

    The system releases the lock when this process ends for any reason. There is no lock on file systems without locks.
    `what` is used in the error message of rejected processes, such as "trained into". With `wait`, a process is not
    rejected: `wait` is called once, and then the lock is waited for.

    Raises:
        LinprimError: another process holds the lock, or the folder cannot be written.
    """
    for above in (folder, *folder.parents):
        if above.exists() and not above.is_dir():
            raise LinprimError(f"{above}: is a file, wanted a folder")
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    path = folder / (f".{file}{_LOCK}" if file else _LOCK)
    # Without flock, filelock would treat a mere file, which a killed process leaves, as a lock.
    lock, told = FileLock(path, fallback_to_soft=False), False
    with readable_write_errors(folder / file):
        while not lock.is_locked:
            folder.mkdir(parents=True, exist_ok=True)
            try:
                lock.acquire(timeout=_SECONDS_BETWEEN_TRIES)
            except Timeout:
                if wait is None:
                    raise LinprimError(
                        f"{folder / file}: is being {what} by another process, wanted another place, or to wait "
                        "for its end"
                    ) from None
                if not told:
                    wait()
                    told = True
            except FileNotFoundError:  # the previous holder has just removed the empty folder
                continue
            except OSError as error:
                if error.errno in _NO_LOCKS:
                    break
                raise
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink()  # before the release: afterwards another process may hold it
        lock.release()
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()  # only if nothing was written


def _sync_folder(folder: Path) -> None:
    """Write the entries of a folder to disk, on systems where folders can be opened for that."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def check_room(folder: Path, size: int) -> None:
    """Raise DiskFull unless `size` bytes are free in an existing folder."""
    if shutil.disk_usage(folder).free < size:
        raise DiskFull(f"{folder}: no space left on the device, wanted {size / 2**20:.0f} MiB")


def _full(path: Path) -> DiskFull:
    return DiskFull(f"{path}: no space left on the device; nothing that was saved is lost")


def _sentence(path: Path, error: OSError) -> LinprimError | None:
    if error.errno in _FULL or (error.errno is None and _disk_is_full(path.parent)):
        return _full(path)
    if error.errno in (
        errno.EACCES,
        errno.EROFS,
        errno.EPERM,
        errno.ENOTDIR,
        errno.EEXIST,
        errno.ENAMETOOLONG,
        errno.EIO,
    ):
        return LinprimError(f"{path}: cannot be written ({os.strerror(error.errno)})")
    return _full(path) if _disk_is_full(path.parent) else None


def is_file(path: Path) -> bool:
    """Return whether a file exists. False for impossible paths from untrusted files: too long, or with invalid
    characters."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Return whether a folder exists; False for impossible paths, see `is_file`."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def read_json(path: Path, wanted: str) -> object:
    """Return the value in a JSON file.

    Raises:
        LinprimError: it cannot be read, or is not JSON; `wanted` ends the message, such as "a camera's intrinsics".
    """
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except json.JSONDecodeError as error:
        found = f"not valid JSON at line {error.lineno}, column {error.colno} ({error.msg})"
    except OSError as error:
        found = f"cannot be read ({error.strerror or error})"
    except (ValueError, RecursionError) as error:  # not UTF-8, or too deeply nested
        found = f"cannot be read ({error})"
    raise LinprimError(f"{path}: {found}, wanted {wanted}")


def write_json(path: str | os.PathLike, value: object) -> None:
    """Write `value` as indented JSON, atomically. NaN and infinity become null, as JSON has neither."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(json_ready(value), indent=2) + "\n")


def _disk_is_full(folder: Path) -> bool:
    """Return whether less than a MiB is free. Called while the file whose writing failed still exists."""
    try:
        return shutil.disk_usage(folder).free < 2**20
    except OSError:
        return False


def json_ready(value: object):
    """Return `value` in types of JSON: arrays and tuples become lists, paths and keys text, NaN and infinity null."""
    if isinstance(value, dict):
        return {str(key): json_ready(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(item) for item in value]
    if hasattr(value, "tolist"):
        return json_ready(value.tolist())
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value
