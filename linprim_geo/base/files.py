"""Writing files so that what was there before is never lost and nothing half-written is left behind."""

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


# Read once: the only way to ask for it is to change it, which other threads would see.
_UMASK = _read_umask()


# What a full disk says, a quota, or a file system that takes no file of this size.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_LOCK = ".lock"
_SECONDS_BETWEEN_TRIES = 0.2
# What a file system says that knows no locks.
_NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[Path]:
    """Yields a temporary path beside `path` (same suffix) that replaces it when the block ends without an error.

    The data is on disk before the rename and the rename before this returns, so a crash at any moment leaves either the
    old file or the new one, and files that are written one after the other are never lost the other way round. On an
    error, or Ctrl-C, the temporary file is removed and the old file stays; `remove_temporary` removes what a kill
    has left.

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
    """Turns the errors of a disk that is full, fails or may not be written into one sentence about `path`."""
    try:
        yield
    except OSError as error:
        found = _sentence(path, error)
        if found is None:
            raise
        raise found from error
    except RuntimeError as error:  # how torch reports a write that failed
        cause = error.__cause__ or error.__context__
        found = _sentence(path, cause) if isinstance(cause, OSError) else None
        if found is None and not _disk_is_full(path.parent):
            raise
        raise found or _full(path) from error


def remove_temporary(path: Path) -> None:
    """Removes what writing `path` left behind when it was killed; only for who holds the lock of its folder."""
    for torn in path.parent.glob(f".{glob.escape(path.stem)}.*.tmp{glob.escape(path.suffix)}"):
        with contextlib.suppress(OSError):
            torn.unlink()


def is_leftover(entry: Path) -> bool:
    """Whether a directory entry is nothing but what `locked` or a killed `atomic_write` leaves."""
    return entry.name.startswith(".") and (entry.name.endswith(_LOCK) or ".tmp" in entry.name) and entry.is_file()


@contextlib.contextmanager
def locked(folder: Path, what: str, file: str = "", wait: Callable[[], object] | None = None) -> Iterator[None]:
    """Holds a folder, which is made if need be, or only the name `file` in it, against other processes.

    The system lets go of it when this process ends, however it does; where the file system knows no locks there is
    none. `what` goes into the sentence of those that are refused: "trained into". With `wait` nobody is refused: it is
    called once, and the lock waited for.

    Raises:
        LinprimError: another process holds it, or the folder cannot be written.
    """
    for above in (folder, *folder.parents):
        if above.exists() and not above.is_dir():
            raise LinprimError(f"{above}: is a file, wanted a folder")
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    path = folder / (f".{file}{_LOCK}" if file else _LOCK)
    # Without flock filelock would take the mere existence of the file for a lock, which a kill leaves behind.
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
            except FileNotFoundError:  # the process that held it has just removed the folder, which was empty
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
    """Puts the names in a folder on disk, where folders can be opened for that."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def check_room(folder: Path, size: int) -> None:
    """Raises DiskFull unless so many bytes are free in a folder that there is."""
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
    """Whether there is a file, also for paths out of a file that no file can have: too long, or with characters that
    are none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Whether there is a folder, also for paths that no folder can have, see `is_file`."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def read_json(path: Path, wanted: str) -> object:
    """The value in a JSON file.

    Raises:
        LinprimError: it cannot be read, or is no JSON; `wanted` ends the sentence: "a camera's intrinsics".
    """
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except json.JSONDecodeError as error:
        found = f"not valid JSON at line {error.lineno}, column {error.colno} ({error.msg})"
    except OSError as error:
        found = f"cannot be read ({error.strerror or error})"
    except (ValueError, RecursionError) as error:  # not UTF-8, or lists in lists without end
        found = f"cannot be read ({error})"
    raise LinprimError(f"{path}: {found}, wanted {wanted}")


def write_json(path: str | os.PathLike, value: object) -> None:
    """Writes `value` as indented JSON, atomically. NaN and infinity become null, which JSON can hold."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(json_ready(value), indent=2) + "\n")


def _disk_is_full(folder: Path) -> bool:
    """Whether less than a MiB is left; asked while the file that failed is still there."""
    try:
        return shutil.disk_usage(folder).free < 2**20
    except OSError:
        return False


def json_ready(value: object):
    """`value` as JSON can hold it: arrays and tuples become lists, paths and keys text, NaN and infinity null."""
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
