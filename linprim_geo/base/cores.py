"""The cores that this process may use."""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path

from linprim_geo.base.control_groups import MACHINE, group_folders, read_number

# The limit set by --threads of the running command, 0 if unset.
limit = 0


def usable_cores(root: Path = MACHINE) -> int:
    """Return the number of cores that this process may use, at least 1: the minimum of the affinity mask, the quota of
    its container rounded up, and --threads.

    `root` contains the system's /proc and /sys.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = core_quota(root)
    return min([cores, *([] if quota is None else [math.ceil(quota)]), *([limit] if limit else [])])


def core_quota(root: Path = MACHINE) -> float | None:
    """Return the core quota of the control groups of this process, in cores; None without such a limit."""
    found = []
    for folder in group_folders("cpu", root):
        quota, period = read_number(folder / "cpu.cfs_quota_us"), read_number(folder / "cpu.cfs_period_us")
        with contextlib.suppress(OSError, ValueError):
            quota, period = (int(word) for word in (folder / "cpu.max").read_text().split())
        if quota and period and quota > 0 and period > 0:  # version 1 uses -1 for no quota
            found.append(quota / period)
    return min(found, default=None)
