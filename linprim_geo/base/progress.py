"""Progress of a long job: one line that is rewritten on a terminal, or plain lines at intervals in a log."""

from __future__ import annotations

import sys
import time

from linprim_geo.base.errors import printable
from linprim_geo.base.memory import forget_peak, give_back, peak_gib


def duration(seconds: float) -> str:
    """Format a duration as 12 s, 3:04 or 1:02:03."""
    whole = int(round(seconds))
    if whole < 60:
        return f"{whole} s"
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"


class Progress:
    """Prints the progress of a job of `total` steps to stderr, with rate and time left.

    On a terminal the line is refreshed twice a second; otherwise a line is printed every 20 seconds. With `quiet`
    nothing is printed.
    """

    def __init__(self, name: str, total: int, start: int = 0, quiet: bool = False):
        self.name, self.quiet = name, quiet
        self.terminal = sys.stderr.isatty()
        self.width = 0
        self.restart(total, start)

    def restart(self, total: int, start: int = 0) -> None:
        """Restart the clock: rate and time left then refer to the steps after `start`, from now on."""
        self.total, self.start = total, start
        self.begin = self.last = time.monotonic()

    def update(self, done: int, text: str = "") -> None:
        """Report that `done` steps are finished; `text` is put at the end of the line."""
        now = time.monotonic()
        if self.quiet or now - self.last < (0.5 if self.terminal else 20.0):
            return
        self.last = now
        rate = (done - self.start) / max(now - self.begin, 1e-9)
        left = duration((self.total - done) / rate) if rate > 0 else "?"
        pace = f"{rate:.0f}/s" if rate >= 10 else f"{rate:.2g}/s"
        self._show(f"{self.name} {done}/{self.total}  {pace}  {left} left  {text}")

    def stage(self, done: int, text: str) -> None:
        """Report immediately that step `done`, counted from 0, begins, for jobs of a few long and different steps;
        prints no rate."""
        if not self.quiet:
            self.last = time.monotonic()
            self._show(f"{self.name} {done + 1}/{self.total}  {text}")

    def note(self, text: str) -> None:
        """Print a permanent line."""
        if self.quiet:
            return
        self.clear()
        _print(printable(text) + "\n")

    def clear(self) -> None:
        """Remove the line that is being rewritten."""
        if self.terminal and self.width and not self.quiet:
            _print("\r" + " " * self.width + "\r")
            self.width = 0

    def _show(self, line: str) -> None:
        if self.terminal:
            _print("\r" + line.ljust(self.width))
            self.width = len(line)
        else:
            _print(line + "\n")


def _print(text: str) -> None:
    """Print to stderr. A full disk under the log does not end the job; a closed pipe does."""
    try:
        print(text, end="", file=sys.stderr, flush=True)
    except BrokenPipeError:
        raise
    except OSError:
        pass


class Stages:
    """The clock of a job with named stages; `lap` ends the running stage."""

    def __init__(self, progress: Progress):
        self.progress = progress
        self.seconds: dict[str, float] = {}
        self.peak_gib: dict[str, float] = {}
        self._begin = time.perf_counter()
        forget_peak()

    def note(self, text: str) -> None:
        """Print a permanent line, indented below its job."""
        self.progress.note("  " + text)

    def lap(self, name: str) -> None:
        """End the stage `name`: record its seconds and the largest resident memory of this process during it (0 if
        unknown). Freed memory is returned to the system."""
        now = time.perf_counter()
        self.seconds[name] = round(self.seconds.get(name, 0.0) + now - self._begin, 3)
        self.peak_gib[name] = round(max(self.peak_gib.get(name, 0.0), peak_gib()), 3)
        self._begin = now
        give_back()
        forget_peak()

    def line(self) -> str:
        """Return one line of text with the values of `report`."""
        both = self.report()
        return ", ".join(
            f"{name} {both['seconds'][name]:.1f} s {both['peak_gib'][name]:.2f} GiB" for name in both["seconds"]
        )

    def report(self) -> dict:
        """Return `seconds` and `peak_gib` per stage, with the `total`: the sum and the maximum."""
        return {
            "seconds": self.seconds | {"total": round(sum(self.seconds.values()), 3)},
            "peak_gib": self.peak_gib | {"total": max(self.peak_gib.values(), default=0.0)},
        }
