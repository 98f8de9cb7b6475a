"""Progress of a long job: one line that is rewritten on a terminal, plain lines now and then in a log."""

from __future__ import annotations

import sys
import time


def duration(seconds: float) -> str:
    """12 s, 3:04 or 1:02:03."""
    whole = int(round(seconds))
    if whole < 60:
        return f"{whole} s"
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"


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


class Progress:
    """Prints to stderr how far a job of `total` steps is, with rate and time left.

    On a terminal the line is refreshed twice a second; elsewhere a line is printed every 20 seconds. `quiet` prints
    nothing.
    """

    def __init__(self, name: str, total: int, start: int = 0, quiet: bool = False):
        self.name, self.total, self.start, self.quiet = name, total, start, quiet
        self.terminal = sys.stderr.isatty()
        self.begin = self.last = time.monotonic()
        self.width = 0

    def update(self, done: int, text: str = "") -> None:
        """Says that `done` steps are finished; `text` goes at the end of the line."""
        now = time.monotonic()
        if self.quiet or now - self.last < (0.5 if self.terminal else 20.0):
            return
        self.last = now
        rate = (done - self.start) / max(now - self.begin, 1e-9)
        left = duration((self.total - done) / rate) if rate > 0 else "?"
        pace = f"{rate:.0f}/s" if rate >= 10 else f"{rate:.2g}/s"
        self._show(f"{self.name} {done}/{self.total}  {pace}  {left} left  {text}")

    def note(self, text: str) -> None:
        """Prints a line that stays."""
        if self.quiet:
            return
        self.clear()
        print(text, file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Removes the line that is being rewritten."""
        if self.terminal and self.width and not self.quiet:
            print("\r" + " " * self.width + "\r", end="", file=sys.stderr, flush=True)
            self.width = 0

    def _show(self, line: str) -> None:
        if self.terminal:
            print("\r" + line.ljust(self.width), end="", file=sys.stderr, flush=True)
            self.width = len(line)
        else:
            print(line, file=sys.stderr, flush=True)
