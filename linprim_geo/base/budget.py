"""A time budget: the seconds that a command may take, and how many of them are left."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

from linprim_geo.base.errors import LinprimError

# Share of a budget that plans may use. The rest is for the end of the program, and for delays that planning notices too
# late.
AIM = 0.97


@dataclass(frozen=True)
class Budget:
    """A budget of `seconds` of wall-clock time since `began`, a reading of time.monotonic()."""

    seconds: float
    began: float = field(default_factory=time.monotonic)

    def __post_init__(self):
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise LinprimError(f"--time-budget is {self.seconds} s, wanted a positive time such as 90s or 5m")

    @staticmethod
    def of(given: Budget | float | None) -> Budget | None:
        """Return `given` itself, or a budget of so many seconds from now."""
        return given if given is None or isinstance(given, Budget) else Budget(float(given))

    def elapsed(self) -> float:
        """Return the seconds since its beginning."""
        return time.monotonic() - self.began

    def left(self) -> float:
        """Return the seconds that plans may still use; negative if there are none."""
        return AIM * self.seconds - self.elapsed()
