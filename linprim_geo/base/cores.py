"""The cores that this process may use."""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path

from linprim_geo.base.control_groups import MACHINE, group_folders, read_number


def usable_cores(root: Path = MACHINE) -> int:
    """Cores that this process may use, at least 1: the affinity mask, and the quota of its container rounded up.

    `root` holds the system's /proc and /sys.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for folder in group_folders("cpu", root):
        quota, period = read_number(folder / "cpu.cfs_quota_us"), read_number(folder / "cpu.cfs_period_us")
        with contextlib.suppress(OSError, ValueError):
            quota, period = (int(word) for word in (folder / "cpu.max").read_text().split())
        if quota and period and quota > 0 and period > 0:  # version 1 says -1 for no quota
            cores = min(cores, math.ceil(quota / period))
    return cores
