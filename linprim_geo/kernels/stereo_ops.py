"""PatchMatch stereo of the compiled core (a plane of inverse depth per pixel), its filters, comparison of plain regions
by shading, and votes for Delaunay cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linprim_geo import _core
from linprim_geo.geometry.camera import Camera


@dataclass(frozen=True)
class StereoImage:
    """A photograph as stereo input: `camera`, `grey` (H, W) uint8, and `quads` (H, W) uint32, each of which holds the
    grey values of 2 by 2 pixels for bilinear interpolation."""

    camera: Camera
    grey: np.ndarray
    quads: np.ndarray

    @classmethod
    def of(cls, camera: Camera, grey: np.ndarray) -> StereoImage:
        """Return a stereo image of (H, W) uint8 grey values. Border pixels are repeated beyond the right and lower
        border."""
        padded = np.pad(grey, ((0, 1), (0, 1)), mode="edge").astype(np.uint32)
        quads = padded[:-1, :-1] | padded[:-1, 1:] << 8 | padded[1:, :-1] << 16 | padded[1:, 1:] << 24
        return cls(camera, np.ascontiguousarray(grey), np.ascontiguousarray(quads))


@dataclass
class DepthPlanes:
    """Depth planes of a photograph's pixels.

    `plane` (H, W, 3) float32: inverse depth and its slope per column and per row. `cost` (H, W) float32: from 0 (all
    source views agree) to 2. `chosen` (H, W) uint8: one bit for each source view that agrees.
    """

    plane: np.ndarray
    cost: np.ndarray
    chosen: np.ndarray

    @classmethod
    def unknown(cls, height: int, width: int) -> DepthPlanes:
        """Return planes of NaN; `patch_match` starts from random planes there."""
        return cls(
            np.full((height, width, 3), np.nan, np.float32),
            np.full((height, width), 2, np.float32),
            np.zeros((height, width), np.uint8),
        )


def patch_match(
    image: StereoImage,
    sources: list[StereoImage],
    planes: DepthPlanes,
    inverse_depths: tuple[float, float],
    noise: float,
    iterations: int,
    *,
    first: int = 0,
    seed: int = 0,
    source_depths: list[np.ndarray] | None = None,
) -> None:
    """Improve the planes of an image in place: recompute their cost, then run `iterations` red-black sweeps.

    The cost of a plane in a source view is 1 minus the normalised cross-correlation of 11 by 11 pixel windows with
    bilateral weights. `noise` is added to both variances, so that windows without texture neither agree nor disagree. A
    plane maps a window by its derivative at the centre. With `source_depths`, 0.1 is added to the cost per pixel of
    forward-backward reprojection error, up to 0.4.

    Args:
        sources: 1 to 8 source views.
        inverse_depths: smallest (0: infinity) and largest inverse depth.
        noise: variance of the grey values.
        first: number of the first sweep; steps get smaller and source views are selected more strictly as it grows.
        source_depths: (H, W) float32 inverse depths of each source view, NaN where unknown.

    Raises:
        ValueError: shapes or dtypes that do not fit.

    Results depend on the seed, not on the number of threads; the last bits also depend on the instruction set.
    """
    given = []
    for number, source in enumerate(sources):
        to, shift = _between(image.camera, source.camera)
        back, back_shift = _between(source.camera, image.camera)
        depth = None if source_depths is None else source_depths[number]
        given.append((to, shift, back, back_shift, source.quads, depth))
    camera = image.camera
    lens = (camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5)
    _core.patch_match(
        image.grey,
        lens,
        inverse_depths,
        noise,
        seed,
        given,
        first,
        iterations,
        planes.plane,
        planes.cost,
        planes.chosen,
    )


def support(grey: np.ndarray, plane: np.ndarray, tolerance: float) -> np.ndarray:
    """Return (H, W) float32: the share of the pixels in each pixel's cross whose depth continues its surface; 0 where
    there is no plane.

    The cross of a pixel contains up to 10 pixels up and down with grey values within 25 of its own and, from each of
    these, up to 10 to the left and right with grey values within 25 of that one. A pixel continues the surface if its
    inverse depth agrees with the centre pixel's plane there, or the centre's inverse depth with its own plane at the
    centre, up to the relative `tolerance`.

    Args:
        grey: (H, W) uint8.
        plane: (3, H, W) float32 inverse depths, not positive or NaN where unknown, and their slopes per pixel.

    Raises:
        ValueError: shapes that do not fit.

    Source: Zhang, Lu, Lafruit 2009, cross-based local stereo matching.
    """
    share = np.empty(grey.shape, np.float32)
    _core.support(grey, np.ascontiguousarray(plane), tolerance, share)
    return share


def fit_surfaces(grey: np.ndarray, planes: DepthPlanes, known: np.ndarray, tolerance: float) -> None:
    """Fit a surface of inverse depth around every pixel, and replace the pixel's plane, in place, by the tangent plane
    there.

    Candidates are the pixel's own plane and those of every fifth pixel in each direction of its cross (see `support`).
    The candidate with the most pixels of the cross on it is selected, by the sum of the counts within `tolerance`, 1/2,
    1/4 and 1/8 of it. More than half of the cross must lie within `tolerance` of it; otherwise the pixel keeps its own
    plane. Then a second-order surface is fitted in two rounds to the pixels of the 21x21 window that lie on it, within
    the narrowest of the tolerances that contains more than half of the cross. The pixel gets the selected plane
    unchanged if fewer than 12 pixels can be fitted or if the fit would move it by more than `tolerance`. If the
    selected plane differs from the pixel's own by more than that, its `cost` becomes the mean cost of the pixels on the
    plane, because the pixel may have no match of its own. `chosen` is unchanged.

    Args:
        grey: (H, W) uint8.
        known: (H, W) bool, which planes are used.
        tolerance: relative, between 0 and 1.

    Raises:
        ValueError: shapes that do not fit, or such a tolerance.

    Accuracy: that of float32. Sources: Mei and others 2011, "On building an accurate stereo matching system on graphics
    hardware", for votes of a region; Barath and others 2019, MAGSAC, for sums over tolerances; Cleveland 1979 for local
    regression.
    """
    plane = np.ascontiguousarray(np.where(known, np.moveaxis(planes.plane, 2, 0), np.float32(0)))
    fitted, cost = np.empty(plane.shape, np.float32), np.empty(planes.cost.shape, np.float32)
    _core.fit_surfaces(grey, plane, planes.cost, tolerance, fitted, cost)
    changed = fitted[0] > 0
    planes.plane[changed] = np.moveaxis(fitted, 0, 2)[changed]
    planes.cost[changed] = cost[changed]


@dataclass(frozen=True)
class ShadedComparison:
    """Comparison of N boxes of a plain region with another photograph, to which a plane maps them.

    `boxes`: number of boxes visible in both photographs, 0 if there are too few. `shown` (N,) bool: which ones. `left`
    (N,): residuals of their grey values after fitting an offset, a gain and its bend, 0 for the others.
    `left_variance`: weighted variance of the residuals; `variance`: variance of the values themselves; both in squared
    grey levels. `information` (3, 3) and `downhill` (3,): Gauss-Newton equations for the plane's parameters.
    """

    boxes: int
    shown: np.ndarray
    left: np.ndarray
    left_variance: float
    variance: float
    information: np.ndarray
    downhill: np.ndarray


def compare_shading(
    rays: np.ndarray,
    value: np.ndarray,
    plane: np.ndarray,
    moves: np.ndarray,
    own: Camera,
    other: Camera,
    means: np.ndarray,
    plain: np.ndarray,
    least: int,
) -> ShadedComparison:
    """Compare boxes of a photograph with another photograph along a plane.

    Residuals beyond two standard deviations are down-weighted (Huber). The gain of the other photograph is limited to
    the range from 0.7 to 1.4; it may bend with brightness, to model tone curves.

    Args:
        rays: (N, 3) float64 with depth 1 in the camera `own`.
        value: (N,) float64 mean grey values of the boxes.
        plane: (3,) with ray . plane = inverse depth.
        moves: (3, 3) change of the plane by each of three parameters, in columns.
        means: (H, W, 3) float32 of the other photograph: means of the boxes around its pixels, and their slopes per
            column and per row.
        plain: (H, W) bool, where such a box contains no edge.
        least: smallest number of boxes for a comparison.

    Raises:
        ValueError: shapes that do not fit.

    Accuracy: float64; positions in the other photograph are interpolated bilinearly.
    """
    shown, left = np.empty(len(value), np.uint8), np.empty(len(value))
    information, downhill = np.empty((3, 3)), np.empty(3)
    turn = other.rotation @ own.rotation.T
    shift = other.world_to_camera[:3, 3] - turn @ own.world_to_camera[:3, 3]
    boxes, left_variance, variance = _core.compare_shading(
        rays,
        value,
        plane.tolist(),
        np.ascontiguousarray(turn),
        shift.tolist(),
        [other.fx, other.fy, other.cx, other.cy],
        means,
        plain.view(np.uint8),
        np.ascontiguousarray(moves),
        least,
        shown,
        left,
        information,
        downhill,
    )
    return ShadedComparison(boxes, shown.view(bool), left, left_variance, variance, information, downhill)


def vote_for_cells(
    point: np.ndarray,
    corner: np.ndarray,
    neighbor: np.ndarray,
    start: int,
    rays: np.ndarray,
    empty: float,
    full: float,
    votes: np.ndarray,
) -> None:
    """Add the votes of rays from one point for the Delaunay tetrahedra that they cross.

    Every cell that contains a part of a ray before the share `empty` of its length gets one vote more; the cell at the
    share `full` gets one less, if `full` is not 0.

    Args:
        point: (P, 3) float64.
        corner, neighbor: (C, 4) int32 of a Delaunay triangulation: indices of the corners of the cells, and of the
            cells behind the faces opposite to them, -1 outside.
        start: index of the point where all rays start, a corner of a cell; otherwise there are no votes.
        rays: (R, 3) float64, from the start to their ends.
        votes: (C + 1,) int64, of the cells and of the space outside.

    Raises:
        ValueError: shapes that do not fit, or indices out of range.

    Accuracy: float64; a cell that a ray only touches gets no vote. Cells without volume may end the traversal of a ray.
    """
    around = np.flatnonzero((corner == start).any(1)).astype(np.int32)
    _core.vote_for_cells(point, corner, neighbor, start, around, rays, empty, full, votes)


def _between(one: Camera, other: Camera) -> tuple[list[float], list[float]]:
    """Return 9 numbers A and 3 numbers b such that A (x, y, 1) + b w is the homogeneous pixel position in `other` of
    pixel (x, y) of `one` at inverse depth w. The centre of the first pixel is (0, 0)."""
    pose = other.world_to_camera @ np.linalg.inv(one.world_to_camera)
    centered = [camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]] for camera in (one, other)]
    to = centered[1] @ pose[:3, :3] @ np.linalg.inv(centered[0])
    return to.reshape(-1).tolist(), (centered[1] @ pose[:3, 3]).tolist()
