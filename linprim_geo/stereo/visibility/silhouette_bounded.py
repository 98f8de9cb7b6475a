"""Find objects whose rendered depth is bounded by their outlines (visual hull), where stereo matches edges only.

On a plain object in front of others, such as a bronze statue before houses, windows of stereo match the outlines alone.
Each photograph sees the outline of a round object along another line of its surface, so that these depths are too
large, although confirmed. Training explains all photographs at once and fills the space within the outlines, but also
the space in front of plain walls. A rendered surface is accepted if, in most views that render it, it ends at something
farther on both sides, at image edges stronger than what is between them; and if two of these views look at right angles
to each other, so that the outlines of one bound the depth in the other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import maximum_filter1d

from linprim_geo.base.sorting import distinct
from linprim_geo.points.view_pairs import visible_pixels
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.visibility.thin_things import AGREEING, RenderedView

# A surface ends where the next pixel's depth differs by more than this share.
ENDS = 3 * CONFIRMED_DEPTH
# An edge is measured as the difference of colours over ACROSS pixels, at most REACH pixels from the end of the surface:
# blur and errors of poses move it by as much.
ACROSS, REACH = 3, 2
# An edge has to exceed DEVIATIONS standard deviations of the noise, and STRONGER times the geometric mean of the
# changes within the surface.
DEVIATIONS, STRONGER = 5.0, 3.0
# More than the share MOST of the views that render a surface have to see it between outlines, and the directions of two
# of them have to differ by ANGLE degrees.
MOST, ANGLE = 0.5, 90.0
# Points are grouped in cubes with sides of so many pixels; all rendered points in a cube count as known if more than
# MOST of them are.
CUBE = 4.0
POINTS_AT_A_TIME, CELLS = 1 << 15, 1 << 20


def silhouette_bounded(views: Sequence[RenderedView]) -> list[np.ndarray]:
    """Return (H, W) bool of every view: where its rendered depth is that of an object known by its outlines.

    Depths of stereo (`RenderedView.known`) are not used. Source of the bound: Laurentini 1994, the visual hull.
    """
    outlined = [between_silhouettes(view) for view in views]
    seeds = [np.zeros(between.shape, bool) for between in outlined]
    places, pixels = [], []
    for view, between, seed in zip(views, outlined, seeds, strict=True):
        points = _points(view, *np.nonzero(between))
        seed[between] = known = _are_known(points, views, outlined)
        places.append(points[known])
        pixels.append(view.rendered[seed] / view.camera.fx)
    if not any(map(len, places)):
        return seeds
    cubes = _Cubes(np.concatenate(places), CUBE * float(np.median(np.concatenate(pixels))))
    known, count, within = np.zeros(len(cubes)), np.zeros(len(cubes)), []
    for view, between, seed in zip(views, outlined, seeds, strict=True):
        row, column = np.nonzero(view.sharp & (view.rendered > 0))
        points = _points(view, row, column)
        cube = cubes.of(points)
        some = cube >= 0
        row, column, points, cube = row[some], column[some], points[some], cube[some]
        is_known, others = seed[row, column], ~between[row, column]
        is_known[others] = _are_known(points[others], views, outlined)
        known += np.bincount(cube, is_known, minlength=len(cubes))
        count += np.bincount(cube, minlength=len(cubes))
        within.append((row, column, cube))
    things = []
    for view, (row, column, cube) in zip(views, within, strict=True):
        thing = np.zeros(view.rendered.shape, bool)
        thing[row, column] = (known > MOST * count)[cube]
        things.append(thing)
    return things


def between_silhouettes(view: RenderedView) -> np.ndarray:
    """Return (H, W) bool: pixels rendered sharply whose surface ends, along the row or the column, at outlines on both
    sides."""
    depth = np.where(view.rendered > 0, view.rendered, np.inf)
    least = DEVIATIONS * np.sqrt(view.noise)
    rgb = view.rgb.astype(np.float32)
    along_rows = _along_rows(depth, rgb, least)
    along_columns = _along_rows(depth.T, rgb.transpose(1, 0, 2), least).T
    return view.sharp & np.isfinite(depth) & (along_rows | along_columns)


def _along_rows(depth: np.ndarray, rgb: np.ndarray, least: float) -> np.ndarray:
    """Return (H, W) bool, given (H, W) depths and (H, W, 3) colours: which pixels have outlines to the left and to the
    right."""
    height, width = depth.shape
    # Border k is on the left of pixel k; there are width + 1 of them.
    falls = np.zeros((2, height, width + 1), bool)  # farther on the left of the border, on the right
    falls[0, :, 1:-1] = depth[:, :-1] > (1 + ENDS) * depth[:, 1:]
    falls[1, :, 1:-1] = depth[:, 1:] > (1 + ENDS) * depth[:, :-1]
    padded = np.pad(rgb, ((0, 0), (ACROSS - 1, ACROSS), (0, 0)), mode="edge")
    change = np.abs(padded[:, ACROSS:] - padded[:, :-ACROSS]).mean(2)[:, : width + 1]
    change = maximum_filter1d(change, 2 * REACH + 1, axis=1, mode="nearest")
    ends = falls[0] | falls[1]
    ends[:, [0, -1]] = True
    border = np.arange(width + 1)
    first = np.maximum.accumulate(np.where(ends, border, 0), axis=1)[:, :-1]
    last = np.minimum.accumulate(np.where(ends, border, width)[:, ::-1], axis=1)[:, ::-1][:, 1:]
    row = np.arange(height)[:, None]
    outline = np.minimum((falls[0] * change)[row, first], (falls[1] * change)[row, last])
    # Mean change within the surface, as far from both ends as an edge there reaches.
    sums = np.pad(np.cumsum(np.log1p(change), axis=1, dtype=np.float64), ((0, 0), (1, 0)))
    start, stop = first + REACH + ACROSS - 1, last - REACH - ACROSS + 2
    count = np.maximum(stop - start, 0)
    start = np.minimum(start, width)
    inside = np.where(count > 0, (sums[row, start + count] - sums[row, start]) / np.maximum(count, 1), 0)
    return (outline > least) & (outline > STRONGER * np.expm1(inside))


def _points(view: RenderedView, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return (P, 3) rendered points of pixels."""
    rays = view.camera.world_rays()[row, column]
    return view.camera.center + rays * view.rendered[row, column, None].astype(np.float64)


def _are_known(points: np.ndarray, views: Sequence[RenderedView], outlined: Sequence[np.ndarray]) -> np.ndarray:
    """Return (P,) bool: which of (P, 3) points are known by their outlines."""
    known = np.zeros(len(points), bool)
    for first in range(0, len(points), POINTS_AT_A_TIME):
        some = slice(first, first + POINTS_AT_A_TIME)
        known[some] = _are_known_at_once(points[some], views, outlined)
    return known


def _are_known_at_once(points: np.ndarray, views: Sequence[RenderedView], outlined: Sequence[np.ndarray]) -> np.ndarray:
    """Return `_are_known` for few points: memory grows with views times points."""
    agree = np.zeros(len(points), int)
    between = np.zeros((len(views), len(points)), bool)
    towards = np.zeros((len(views), len(points), 3), np.float32)
    for number, (view, outline) in enumerate(zip(views, outlined, strict=True)):
        inside, pixels, along = visible_pixels(view.camera, points)
        column, row = pixels.T
        same = view.sharp[row, column] & (np.abs(view.rendered[row, column] / along - 1) < CONFIRMED_DEPTH)
        rows = np.flatnonzero(inside)[same]
        agree[rows] += 1
        between[number, rows] = outline[row, column][same]
        rays = points - view.camera.center
        towards[number] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    votes = between.sum(0)
    # Of the views with outlines: the one farthest in angle from any of them, and the one farthest from that.
    every = np.arange(len(points))
    one = between.argmax(0)
    for _ in range(2):
        cosine = np.where(between, np.einsum("vpx,px->vp", towards, towards[one, every]), 1)
        one = cosine.argmin(0)
    return (votes >= AGREEING) & (votes > MOST * agree) & (cosine.min(0) <= np.cos(np.radians(ANGLE)))


class _Cubes:
    """The cubes of side `size` that hold points. Cubes that are CELLS or more away from the median point do not
    count."""

    def __init__(self, points: np.ndarray, size: float):
        self.size = size
        self.middle = np.floor(np.median(points, axis=0) / size)
        self.codes = distinct(self._codes(points))

    def __len__(self) -> int:
        return len(self.codes)

    def of(self, points: np.ndarray) -> np.ndarray:
        """Return (P,) the index of the cube of each of (P, 3) points, -1 for none."""
        codes = self._codes(points)
        number = np.minimum(np.searchsorted(self.codes, codes), len(self.codes) - 1)
        return np.where((codes >= 0) & (self.codes[number] == codes), number, -1)

    def _codes(self, points: np.ndarray) -> np.ndarray:
        """Return (P,) int64 codes of the grid's cells, three coordinates of 21 bits each; -1 far away."""
        cells = np.floor(points / self.size) - self.middle
        near = (np.abs(cells) < CELLS).all(1)
        x, y, z = np.where(near, cells.T, 0).astype(np.int64) + CELLS
        return np.where(near, (x << 42) | (y << 21) | z, -1)
