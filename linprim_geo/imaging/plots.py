"""Plots as inline SVG: an axis with round ticks, a frame with a grid, and curves over one axis; well-formed XML, no
script.

Colours are the classes `frame`, `grid`, `series0`, `series1`, `on`, `off` of `STYLE`, so that a page can be light or
dark.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

WIDTH, HEIGHT = 560, 340
LEFT, RIGHT, TOP, BOTTOM = 74, 24, 30, 52
STYLE = """
svg text { font: 11px system-ui, sans-serif; fill: var(--ink, #1b1f24); }
svg .frame { fill: var(--plot, #fafbfc); stroke: var(--edge, #c8ced6); } svg .grid { stroke: var(--line, #e3e7ec); }
svg .series0 { stroke: var(--blue, #1f63b2); } svg .series1 { stroke: var(--orange, #c25e0c); }
svg .on { stroke: var(--blue, #1f63b2); } svg .off { stroke: var(--dim, #8a939e); }
svg .on.dot { fill: var(--blue, #1f63b2); } svg .off.dot { fill: var(--dim, #8a939e); } svg .dot { stroke: none; }
svg .curve { fill: none; stroke-width: 1.6; stroke-linejoin: round; }
svg .point { stroke-width: 5; stroke-linecap: round; }
"""
# A linear axis has round steps, about so many.
_STEPS = 5


class Axis:
    """An axis over `values`, logarithmic (then they are positive) or linear, from pixel `start` to pixel `end`."""

    def __init__(self, values: Sequence[float], start: float, end: float, *, log: bool = True, room: float = 0.15):
        """`room` is the share of the range that is added on either side."""
        self.log, self.start, self.end = log, start, end
        low, high = self._scaled(min(values)), self._scaled(max(values))
        least = 0.06 if log else 0.5 * abs(low) or 0.5
        more = max(room * (high - low), least if log or high == low else 0.0)
        self.low, self.high = low - more, high + more

    def _scaled(self, value: float) -> float:
        return math.log10(value) if self.log else float(value)

    def at(self, value: float) -> float:
        """The pixel of a value."""
        return self.start + (self.end - self.start) * (self._scaled(value) - self.low) / (self.high - self.low)

    def ticks(self) -> list[float]:
        """Three to seven round values, or fewer of a short axis."""
        if not self.log:
            return self._linear_ticks()
        decades = range(math.floor(self.low), math.ceil(self.high) + 1)
        for steps in (
            (1,),
            (1, 3),
            (1, 2, 5),
            (1, 1.5, 2, 3, 4, 5, 6, 8),
            tuple(1 + k / 10 for k in range(90)),
        ):
            found = [step * 10.0**decade for decade in decades for step in steps]
            found = [value for value in found if self.low <= math.log10(value) <= self.high]
            if len(found) >= 3:
                break
        return found[:: -(-len(found) // 7) or 1]

    def _linear_ticks(self) -> list[float]:
        rough = (self.high - self.low) / _STEPS
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9))
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]


def tick(value: float) -> str:
    """A short text of a value beside an axis."""
    return (
        f"{value:.6g}"
        if value == 0 or 1e-3 <= abs(value) < 1e5
        else f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    )


def frame(x_axis: Axis, y_axis: Axis, x_label: str, y_label: str, name: str) -> list[str]:
    """The opening tag, which says `name` to who cannot see it, the grid with its ticks, and both labels; the caller
    closes it."""
    out = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" role="img" '
        f'aria-label="{escape(name)}">',
        f'<rect class="frame" x="{LEFT}" y="{TOP}" width="{WIDTH - LEFT - RIGHT}" height="{HEIGHT - TOP - BOTTOM}"/>',
    ]
    for value in x_axis.ticks():
        x = x_axis.at(value)
        out.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>')
        out.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{tick(value)}</text>')
    for value in y_axis.ticks():
        y = y_axis.at(value)
        out.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        out.append(f'<text x="{LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{tick(value)}</text>')
    out.append(
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 12}" text-anchor="middle">{escape(x_label)}</text>'
    )
    middle = (TOP + HEIGHT - BOTTOM) / 2
    out.append(
        f'<text x="15" y="{middle}" text-anchor="middle" transform="rotate(-90 15 {middle})">{escape(y_label)}</text>'
    )
    return out


def curves(
    series: Sequence[tuple[str, Sequence[float], Sequence[float]]],
    x_label: str,
    y_label: str,
    *,
    log: bool = False,
) -> str:
    """An SVG of up to two curves (name, x, y) over a linear x; y linear, or logarithmic for positive values.

    Each is named above the frame with its last value. A curve of one point is drawn as a point.
    """
    x_axis = Axis([x for _, xs, _ in series for x in xs], LEFT, WIDTH - RIGHT, log=False, room=0.0)
    y_axis = Axis([y for _, _, ys in series for y in ys], HEIGHT - BOTTOM, TOP, log=log, room=0.06)
    named = [f"{name}: {_said(ys[-1])}" for name, _, ys in series]
    out = frame(x_axis, y_axis, x_label, y_label, f"{y_label} over {x_label}; at the end {', '.join(named)}")
    left: float = LEFT
    for index, ((_, xs, ys), label) in enumerate(zip(series, named, strict=True)):
        places = [f"{x_axis.at(x):.1f} {y_axis.at(y):.1f}" for x, y in zip(xs, ys, strict=True)]
        kind = "curve" if len(places) > 1 else "curve point"
        out.append(f'<path class="{kind} series{index}" d="M{"L".join(places)}{"h0" if len(places) == 1 else ""}"/>')
        out.append(f'<path class="curve series{index}" d="M{left} {TOP - 12}h18"/>')
        out.append(f'<text x="{left + 24}" y="{TOP - 8}">{escape(label)}</text>')
        left += 40 + 6.4 * len(label)
    return "".join(out) + "</svg>"


def _said(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
