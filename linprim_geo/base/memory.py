"""Memory of this process and of this machine."""

from __future__ import annotations

import os
import sys

# What a process takes in any case, libraries above all, and each pixel of the image that is at work.
PROCESS_GIB, PIXEL_BYTES = 0.45, 300


def available_memory() -> int:
    """Bytes of memory that can be taken without swapping, within the limit of the container if any."""
    free = 4 * 2**30  # where the system does not tell
    try:
        with open("/proc/meminfo") as file:
            rows = dict(line.split(":", 1) for line in file)
        free = int(rows["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        try:
            free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
        except (AttributeError, ValueError, OSError):
            return free
    try:
        with open("/sys/fs/cgroup/memory.max") as top, open("/sys/fs/cgroup/memory.current") as now:
            free = min(free, max(int(top.read()) - int(now.read()), 0))
    except (OSError, ValueError):  # no container, or one without a limit ("max")
        pass
    return free


def memory_gib(entry: str = "VmRSS") -> float:
    """Resident memory of this process in GiB; 0 where the system does not tell.

    `entry` of Linux's /proc/self/status: VmRSS now, VmHWM the most since the peak was last forgotten; elsewhere the
    most ever.
    """
    try:
        with open("/proc/self/status") as status:
            for line in status:
                if line.startswith(entry + ":"):
                    return int(line.split()[1]) / 2**20
    except OSError:
        pass
    try:
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / 2**30 if sys.platform == "darwin" else peak / 2**20
    except ImportError:
        return 0.0
