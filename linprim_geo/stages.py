"""Stages of a job: what each took in seconds and in memory at its peak, and the lines that are printed meanwhile."""

from __future__ import annotations

import time

from .progress import Progress, memory_gib


class Stages:
    """Clock of a job made of named stages; `lap` ends the one that is running."""

    def __init__(self, progress: Progress):
        self.progress = progress
        self.seconds: dict[str, float] = {}
        self.peak_gib: dict[str, float] = {}
        self._begin = time.perf_counter()
        _forget_peak()

    def note(self, text: str) -> None:
        """Prints a line that stays, indented under its job."""
        self.progress.note("  " + text)

    def lap(self, name: str) -> None:
        """Ends the stage `name`: its seconds, and the largest resident memory of this process during it (0 where
        unknown)."""
        now = time.perf_counter()
        self.seconds[name] = round(self.seconds.get(name, 0.0) + now - self._begin, 3)
        self.peak_gib[name] = round(max(self.peak_gib.get(name, 0.0), memory_gib("VmHWM")), 3)
        self._begin = now
        _forget_peak()

    def line(self) -> str:
        """One printed line of what `report` returns."""
        both = self.report()
        return ", ".join(
            f"{name} {both['seconds'][name]:.1f} s {both['peak_gib'][name]:.2f} GiB" for name in both["seconds"]
        )

    def report(self) -> dict:
        """`seconds` and `peak_gib` per stage, each with the `total`: their sum and their largest."""
        return {
            "seconds": self.seconds | {"total": round(sum(self.seconds.values()), 3)},
            "peak_gib": self.peak_gib | {"total": max(self.peak_gib.values(), default=0.0)},
        }


def _forget_peak() -> None:
    """Sets the peak that the system keeps to what is resident now; where that cannot be done the peaks are those since
    the start."""
    try:
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
    except OSError:
        pass
