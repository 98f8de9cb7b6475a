"""A time budget: the seconds that a command may take, and how much of them is left."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

from linprim_geo.base.errors import LinprimError

# Share of a budget that is planned for: what is left ends the program and takes up what the correction comes too late
# for.
AIM = 0.97


@dataclass(frozen=True)
class Budget:
    """`seconds` of wall-clock time since `began`, a reading of time.monotonic()."""

    seconds: float
    began: float = field(default_factory=time.monotonic)

    def __post_init__(self):
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise LinprimError(f"--time-budget is {self.seconds} s, wanted a positive time such as 90s or 5m")

    @staticmethod
    def of(given: Budget | float | None) -> Budget | None:
        """`given` itself, or a budget of so many seconds from now."""
        return given if given is None or isinstance(given, Budget) else Budget(float(given))

    def elapsed(self) -> float:
        """Seconds since it began."""
        return time.monotonic() - self.began

    def left(self) -> float:
        """Seconds that may still be planned for; negative if there are none."""
        return AIM * self.seconds - self.elapsed()
