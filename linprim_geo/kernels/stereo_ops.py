"""The core's PatchMatch stereo, a plane of inverse depth for every pixel of a photograph, and its comparison of plain
regions by their shading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linprim_geo import _core
from linprim_geo.geometry.camera import Camera


@dataclass(frozen=True)
class StereoImage:
    """A photograph as stereo takes it: `camera`, `grey` (H, W) uint8, and `quads` (H, W) uint32, which hold the grey
    values of 2 by 2 pixels."""

    camera: Camera
    grey: np.ndarray
    quads: np.ndarray

    @classmethod
    def of(cls, camera: Camera, grey: np.ndarray) -> StereoImage:
        """Of (H, W) uint8 grey values. Pixels beyond the right and lower border are those at it."""
        padded = np.pad(grey, ((0, 1), (0, 1)), mode="edge").astype(np.uint32)
        quads = padded[:-1, :-1] | padded[:-1, 1:] << 8 | padded[1:, :-1] << 16 | padded[1:, 1:] << 24
        return cls(camera, np.ascontiguousarray(grey), np.ascontiguousarray(quads))


@dataclass
class DepthPlanes:
    """Planes of a photograph's pixels: `plane` (H, W, 3) float32 inverse depth and how it changes per column and row,
    `cost` (H, W) float32 from 0 (all agree) to 2, `chosen` (H, W) uint8 with a bit for each source that agrees."""

    plane: np.ndarray
    cost: np.ndarray
    chosen: np.ndarray

    @classmethod
    def unknown(cls, height: int, width: int) -> DepthPlanes:
        """Planes of NaN: `patch_match` begins with random ones there."""
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
    """Improves the planes of an image in place: their cost is found anew, then `iterations` red-black sweeps.

    The cost of a plane in a source is 1 minus the normalised cross correlation of windows of 11 by 11 pixels, with
    bilateral weights and `noise` added to both variances, so that windows without texture agree and disagree by
    nothing; a plane maps a window by its derivative at the middle. With `source_depths` 0.1 is added for every pixel
    that a point misses its own by when it comes back from the surface there, up to 0.4.

    Args:
        sources: 1 to 8 photographs to compare with.
        inverse_depths: least (0: infinity) and largest.
        noise: variance of grey values.
        first: number of the first sweep; steps get smaller and views are chosen more strictly with it.
        source_depths: (H, W) float32 inverse depths of each source, NaN where unknown.

    Raises:
        ValueError: shapes or dtypes that do not fit.

    Results depend on the seed, not on the number of threads; the last bits also on the instruction set.
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
    """(H, W) float32 share of the pixels that belong to each that go on with its surface; 0 where there is no plane.

    A cross belongs to a pixel: up to 10 pixels up and down with grey values within 25 of its own and, from each of
    these, up to 10 to the left and to the right within 25 of that one. One goes on with the surface if its inverse
    depth is what the plane of the pixel has there, or the pixel's what its plane has at the pixel, up to the share
    `tolerance`.

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
    """Fits a surface of inverse depth around every pixel, and moves the pixel's plane in place to the tangent plane
    there.

    A pixel starts from its own plane or that of every fifth pixel each way of its cross (see `support`): the one on
    which the most of the cross lies, in the sum over what lies there within `tolerance`, 1/2, 1/4 and 1/8 of it. More
    than half has to lie there within `tolerance`; without such a plane the pixel keeps its own. A surface of second
    order is fitted in two rounds to what lies on it in the 21x21 pixels around, within the narrowest of the tolerances
    that more than half of the cross keeps. The pixel keeps the plane that it starts from if there are fewer than 12
    pixels to fit, or if it would move by more than `tolerance`. One that starts from a plane farther than that from its
    own takes the mean `cost` of those on it: it may be one without a match of its own. `chosen` stays as it was.

    Args:
        grey: (H, W) uint8.
        known: (H, W) bool, which planes count.
        tolerance: between 0 and 1.

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
    """N boxes of a plain region as a plane carries them into another photograph.

    `boxes` are shown by both, 0 if these are too few; `shown` (N,) bool says which, and `left` (N,) what is left of
    their values after an offset, a gain and its bend, 0 of the others. `left_variance` is the weighted variance of
    that, `variance` that of the values themselves, in squared grey levels. `information` (3, 3) and `downhill` (3,) are
    Gauss-Newton's equations for the plane's parameters.
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
    """Compares boxes of a photograph with another one along a plane.

    Differences lose weight beyond two deviations (Huber). The gain of the other photograph is between 0.7 and 1.4 and
    may bend with brightness, as tone curves make it.

    Args:
        rays: (N, 3) float64 of depth 1 in the camera `own`.
        value: (N,) float64 mean grey values of the boxes.
        plane: (3,) with ray . plane = inverse depth.
        moves: (3, 3) how the plane changes by each of three parameters, in columns.
        means: (H, W, 3) float32 of the other photograph: means of the boxes around its pixels, and their slopes per
            column and per row.
        plain: (H, W) bool, where such a box has no edge.
        least: fewer boxes than this are none.

    Raises:
        ValueError: shapes that do not fit.

    Accuracy: float64; places in the other photograph are interpolated bilinearly.
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
    """Adds the votes of rays from one of the points for the tetrahedra that they cross.

    Every cell that has a part of a ray before the share `empty` of its length has one vote more, and the cell at the
    share `full` one less, if `full` is not 0.

    Args:
        point: (P, 3) float64.
        corner, neighbor: (C, 4) int32 of a Delaunay triangulation: rows of the corners of the cells, and the cells
            behind the faces opposite to them, -1 outside.
        start: the point where all rays start, a corner of a cell; else there are no votes.
        rays: (R, 3) float64, from the start to their ends.
        votes: (C + 1,) int64, of the cells and of the space outside.

    Raises:
        ValueError: shapes that do not fit, or rows that are not there.

    Accuracy: float64; what a ray only touches has no vote of it. Cells without volume may end a ray's walk.
    """
    around = np.flatnonzero((corner == start).any(1)).astype(np.int32)
    _core.vote_for_cells(point, corner, neighbor, start, around, rays, empty, full, votes)


def _between(one: Camera, other: Camera) -> tuple[list[float], list[float]]:
    """The 9 numbers A and 3 numbers b with A (x, y, 1) + b w the homogeneous pixel in `other` of the pixel (x, y) of
    `one` at inverse depth w; the middle of the first pixel is (0, 0)."""
    pose = other.world_to_camera @ np.linalg.inv(one.world_to_camera)
    centered = [camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]] for camera in (one, other)]
    to = centered[1] @ pose[:3, :3] @ np.linalg.inv(centered[0])
    return to.reshape(-1).tolist(), (centered[1] @ pose[:3, 3]).tolist()
