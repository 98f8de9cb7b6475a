"""Aligned plain-text tables, and the formatting of numbers in them."""

from __future__ import annotations

import math
from collections.abc import Sequence


def plain(header: Sequence[str], lines: Sequence[Sequence[str]], words: int = 1) -> str:
    """Return columns as wide as their widest cell; the first `words` columns are left-aligned, others right-aligned."""
    wide = [max(len(row[i]) for row in (header, *lines)) for i in range(len(header))]
    shown = [
        [cell.ljust(w) if i < words else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, wide, strict=True))]
        for row in (header, *lines)
    ]
    return "\n".join("  " + "  ".join(row).rstrip() for row in shown)


def short(number: float) -> str:
    """Format a number with three digits: 812, 9.1k, 275M."""
    unit, size = ("M", 1e6) if number >= 999_500 else ("k", 1e3) if number >= 999.5 else ("", 1)
    return f"{number / size:.3g}{unit}"


def number(value: float | None, digits: int, sign: bool = False) -> str:
    """Format a value with `digits` decimals, with a plus sign if `sign`; "" for None, a dash for NaN."""
    if value is None:
        return ""
    return "-" if math.isnan(value) else f"{value:{'+' if sign else ''}.{digits}f}"
