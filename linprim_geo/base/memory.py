"""Memory use of this process and memory of this machine, within the limits of containers."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from pathlib import Path

from linprim_geo.base.control_groups import MACHINE, group_folders, read_number

# Memory of any process, mostly libraries, and of each pixel of the image being processed.
PROCESS_GIB, PIXEL_BYTES = 0.45, 300
# Files of a control group: limit, use, and the lines of memory.stat that count cached pages of files. Version 2 has two
# limits; above the second, a process is slowed down until it hardly progresses. In version 1, lines with the prefix
# total_ include the groups below, as the use does.
_FILES = (
    ("memory.max", "memory.current", ("inactive_file", "active_file")),
    ("memory.high", "memory.current", ("inactive_file", "active_file")),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", ("total_inactive_file", "total_active_file")),
)


def available_memory(root: Path = MACHINE) -> int:
    """Return the bytes of memory available without swapping, within the limits of a container if any.

    `root` contains the system's /proc and /sys with the control groups.
    """
    import psutil  # takes 70 ms, so not imported at the start of the command line

    return min([psutil.virtual_memory().available, *(free for _, free in _group_memory(root))])


def total_memory(root: Path = MACHINE) -> int:
    """Return the bytes of memory of this machine, or the limit of the container if that is less."""
    import psutil

    return min([psutil.virtual_memory().total, *(limit for limit, _ in _group_memory(root))])


def memory_gib() -> float:
    """Return the resident memory of this process in GiB."""
    import psutil

    return psutil.Process().memory_info().rss / 2**30


def peak_gib() -> float:
    """Return the peak resident memory of this process in GiB since `forget_peak`; since its start without Linux's
    /proc.

    psutil reports the peak on Windows only.
    """
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 2**20
    try:
        import resource
    except ImportError:  # Windows
        return memory_gib()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**30 if sys.platform == "darwin" else peak / 2**20


def forget_peak() -> None:
    """Reset the peak on Linux to the present resident memory; elsewhere the peak remains that since the start."""
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as file:
        file.write("5")


def give_back() -> None:
    """Return freed memory to the system. glibc keeps it: after the first large array is freed, others of up to 32 MiB
    come from its heap, which shrinks only at its end. Other allocators are not affected."""
    with contextlib.suppress(OSError, TypeError, AttributeError):  # Windows has no CDLL(None)
        ctypes.CDLL(None).malloc_trim(0)


def _group_memory(root: Path) -> list[tuple[int, int]]:
    """Return (limit, free) in bytes of every control group of this process that has a limit. Cached pages of files
    count as free, since the system drops them before it refuses memory."""
    found = []
    for folder in group_folders("memory", root):
        for limit_file, use_file, cached in _FILES:
            limit, used = read_number(folder / limit_file), read_number(folder / use_file)
            if limit is not None and used is not None:
                used -= sum(read_number(folder / "memory.stat", entry) or 0 for entry in cached)
                found.append((limit, min(limit, max(limit - used, 0))))
    return found
