"""Photo-consistency of planes by shading alone: how well a plane explains a plain wall in several photographs.

A plain wall has no texture to match, but its brightness varies gradually. Means over boxes of pixels show this
variation far above the noise, and only the right plane makes it agree in all photographs. Gauss-Newton steps on the
differences of box means find the plane. Each pair of photographs has its own gain, offset and noise, as paint is glossy
at grazing angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter, label, median_filter, uniform_filter

from linprim_geo.geometry.boxes import smaller
from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels.stereo_ops import ShadedComparison, compare_shading
from linprim_geo.stereo.depth_maps import DepthMap, block_means
from linprim_geo.stereo.edges import edges_of
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.noise import plainest
from linprim_geo.stereo.planes.plain_regions import in_camera, rays_of
from linprim_geo.stereo.vignetting import falloff

# The longest side of a photograph in pixels; larger ones are averaged down.
MOST_SIDE = 800
# The side of a box, the step from one box to the next, and the sigma of the smoothing of slopes, in pixels.
BOX, STRIDE, SLOPE_SIGMA = 9, 4, 8.0
# Besides the edges of `edges_of`, an edge is where the slope of grey, smoothed by EDGE_SIGMA pixels, differs from the
# median of MEDIAN by MEDIAN boxes around by more than EDGE_SLOPE deviations of its noise.
EDGE_SIGMA, EDGE_SLOPE, MEDIAN = 2.0, 6.0, 9
# The tenth percentile of the length of a slope whose two components have a deviation of 1: sqrt(-2 ln 0.9).
LEAST_SLOPE = 0.459
# The fewest boxes of a region, and the largest share of them that stereo may have confirmed.
LEAST_BOXES, KNOWN_SHARE = 60, 0.5
# The fewest confirmed depths by which a region is judged.
SURE_DEPTHS = 30
# The least share of a region's boxes that another view has to show.
SHOWN_SHARE = 0.3
# The most steps of a fit, the largest step, and the step below which a fit has converged, in radians and in depths.
STEPS, FIRST_STEP, LAST_STEP = 20, 0.3, 5e-4
# Variance that JPEG adds to differences of box means, as it rounds the means of its blocks to thirds of a grey level.
ROUNDING = 0.1
# Differences are smoothed over SMOOTH by SMOOTH boxes before they are compared with the noise.
SMOOTH = 5


@dataclass(frozen=True)
class Shading:
    """Box means of a photograph. If a side is longer than MOST_SIDE, `factor` by `factor` pixels are averaged first,
    and all else refers to the small photograph, `camera` too.

    `means` (H, W, 3) float32 holds the mean of the box around each pixel and its slopes per column and per row,
    smoothed over plain pixels around; `plain` (H, W) bool is true where the box has no edge; `noise` is the variance of
    a mean.
    """

    camera: Camera
    means: np.ndarray
    plain: np.ndarray
    noise: float
    factor: int

    @classmethod
    def of(cls, found: DepthMap, law: np.ndarray | None = None) -> Shading:
        """Compute it for a photograph, corrected for vignetting by `law` (`vignetting.vignetting`)."""
        factor = -(-max(found.grey.shape) // MOST_SIDE)
        grey, camera = block_means(found.grey.astype(np.float32), factor), smaller(found.camera, factor)
        if law is not None and law.any():
            grey = (grey / falloff(camera, law)).astype(np.float32)
        noise = found.noise / factor**2
        slope = np.hypot(*(_beyond_shading(one) for one in np.gradient(gaussian_filter(grey, EDGE_SIGMA))))
        # The variance of the derivative of white noise after a Gaussian is the variance of the noise over 8 pi sigma^4.
        # Where the noise of neighbours is correlated, the plainest parts tell more, see `edges_of`.
        deviation = max(np.sqrt(noise / (8 * np.pi * EDGE_SIGMA**4)), plainest(slope, grey) / LEAST_SLOPE)
        edge = edges_of(grey, noise, found.most_noise) | (slope > EDGE_SLOPE * deviation)
        plain = uniform_filter((~edge).astype(np.float32), BOX, mode="constant") > 1 - 0.5 / BOX**2
        mean = uniform_filter(grey, BOX, mode="nearest")
        # Slopes are smoothed over plain pixels far around: their noise would make the steps of a fit too small.
        share = gaussian_filter(plain.astype(np.float32), SLOPE_SIGMA)
        smooth = gaussian_filter(np.where(plain, mean, 0), SLOPE_SIGMA) / np.maximum(share, 1e-6)
        by_row, by_column = np.gradient(smooth)
        means = np.stack([mean, by_column, by_row], -1)
        return cls(camera, means, plain, max(noise / BOX**2, _noise_of_boxes(mean, plain)), factor)

    @cached_property
    def labels(self) -> np.ndarray:
        """(H, W) number of the connected plain area of each pixel, from 1; 0 elsewhere."""
        return label(self.plain)[0]

    def area_of(self, region: ShadedRegion) -> np.ndarray:
        """Return (H, W) bool: the plain area in which the boxes of a region have their centres."""
        return self.labels == self.labels[region.row[0], region.column[0]]

    def small(self, image: np.ndarray) -> np.ndarray:
        """Return every `factor`-th pixel of an image of the photograph's full size."""
        height, width = self.plain.shape
        return image[self.factor // 2 :: self.factor, self.factor // 2 :: self.factor][:height, :width]


def _noise_of_boxes(mean: np.ndarray, plain: np.ndarray) -> float:
    """Return the variance of the noise of plain boxes' means, by second differences along both axes of adjacent boxes,
    from which shading cancels (`noise.noise_of`); 0 if there are few boxes."""
    mean, plain = mean[::BOX, ::BOX], plain[::BOX, ::BOX]
    across, known = mean[:, :-2] - 2 * mean[:, 1:-1] + mean[:, 2:], plain[:, :-2] & plain[:, 1:-1] & plain[:, 2:]
    both, known = across[:-2] - 2 * across[1:-1] + across[2:], known[:-2] & known[1:-1] & known[2:]
    if np.count_nonzero(known) < LEAST_BOXES:
        return 0.0
    return float(np.median(np.abs(both[known])) / 0.6745) ** 2 / 36


def _beyond_shading(slope: np.ndarray) -> np.ndarray:
    """Return slopes along an axis less the median of those around, which is that of shading and which edges do not
    change."""
    usual = median_filter(slope[::STRIDE, ::STRIDE], MEDIAN, mode="nearest")
    return slope - usual.repeat(STRIDE, 0).repeat(STRIDE, 1)[: slope.shape[0], : slope.shape[1]]


@dataclass(frozen=True)
class ShadedRegion:
    """A plain region of view number `view`, sampled by N boxes: their centres `row` and `column` (N,), `rays` (N, 3) of
    depth 1 and `value` (N,), the mean grey. `depth` is approximate; `others` are the views with which it is
    compared."""

    view: int
    row: np.ndarray
    column: np.ndarray
    rays: np.ndarray
    value: np.ndarray
    depth: float = 1.0
    others: tuple[int, ...] = ()

    def some(self, count: int) -> ShadedRegion:
        """Return the region with at most `count` of its boxes, evenly spaced."""
        step = -(-len(self.row) // count)
        parts = {name: getattr(self, name)[::step] for name in ("row", "column", "rays", "value")}
        return replace(self, **parts)


def shaded_regions(view: int, shading: Shading, confirmed: np.ndarray) -> list[ShadedRegion]:
    """Return the regions of a view; `confirmed` (H, W) bool is true where stereo has a sure depth."""
    grid = shading.labels[::STRIDE, ::STRIDE]
    row, column = (x * STRIDE for x in np.nonzero(grid))
    grid = grid[grid > 0]
    boxes = np.bincount(grid)
    known = np.bincount(grid, weights=confirmed[row, column])
    camera, regions = shading.camera, []
    for k in np.flatnonzero((boxes >= LEAST_BOXES) & (known <= KNOWN_SHARE * boxes)):
        y, x = row[grid == k], column[grid == k]
        regions.append(ShadedRegion(view, y, x, rays_of(camera, y, x), shading.means[y, x, 0].astype(np.float64)))
    return regions


def compare(
    region: ShadedRegion, plane: np.ndarray, own: Shading, other: Shading, moves: np.ndarray | None = None
) -> ShadedComparison | None:
    """Compare the boxes of a region with another view by a plane (3,), ray . plane = inverse depth; `moves` (3, 3) are
    the derivatives of the plane by the parameters. None if the other view shows too little."""
    found = compare_shading(
        region.rays,
        region.value,
        plane,
        np.zeros((3, 3)) if moves is None else moves,
        own.camera,
        other.camera,
        other.means,
        other.plain,
        max(LEAST_BOXES, int(np.ceil(SHOWN_SHARE * len(region.value)))),
    )
    return found if found.boxes else None


def around_boxes(inside: np.ndarray, region: ShadedRegion, carried: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: the pixels around those boxes of a region that are `carried` (N,); `inside` (H, W) is true at
    the centres of all boxes."""
    height, width = inside.shape
    grid = np.zeros((-(-height // STRIDE), -(-width // STRIDE)), bool)
    grid[region.row[carried] // STRIDE, region.column[carried] // STRIDE] = True
    wide = binary_dilation(grid, np.ones((3, 3))).repeat(STRIDE, 0).repeat(STRIDE, 1)[:height, :width]
    return binary_dilation(inside, iterations=BOX // 2) & wide


def starting_planes(region: ShadedRegion, depth: np.ndarray, rendered: np.ndarray) -> list[np.ndarray]:
    """Return planes (3,) to start from: one fitted to rendered depths, and some parallel to the image at confirmed
    depths around."""
    starts, inside = [], rendered[region.row, region.column]
    known = inside > 0
    if np.count_nonzero(known) >= LEAST_BOXES:
        rays, inverse = region.rays[known], 1 / inside[known].astype(np.float64)
        weight = np.ones(len(inverse))
        for _ in range(5):  # reweighted towards the least sum of absolute residuals
            plane = np.linalg.lstsq(rays * weight[:, None], inverse * weight, rcond=None)[0]
            weight = np.maximum(np.abs(rays @ plane / inverse - 1), 2 * CONFIRMED_DEPTH) ** -0.5
        starts.append(plane)
    grid = np.zeros(depth[::STRIDE, ::STRIDE].shape, bool)
    grid[region.row // STRIDE, region.column // STRIDE] = True
    around = depth[::STRIDE, ::STRIDE][binary_dilation(grid, iterations=BOX // STRIDE + 2)]
    around = around[np.isfinite(around)]
    if len(around) >= SURE_DEPTHS:
        starts += [np.array([0, 0, 1 / np.quantile(around, share)]) for share in (0.5, 0.9)]
    return starts


@dataclass(frozen=True)
class Fit:
    """How a plane (4,), n . x = d of the world, carries the shading of regions.

    `left` is the residual and `deviation` the deviation of box means, in grey levels, geometric means over pairs of
    views. `information` (3, 3) and `downhill` (3,) are the matrix and the right side of the normal equations for two
    turns and a shift in depths. `boxes` is the number of boxes compared, and `views` the mean number of views compared
    with each region.
    """

    plane: np.ndarray
    left: float
    deviation: float
    information: np.ndarray
    downhill: np.ndarray
    boxes: int
    views: float

    @property
    def left_share(self) -> float:
        """The residual as a share of the deviation."""
        return self.left / self.deviation


@dataclass(frozen=True)
class FittedRegion:
    """A region, the largest residual that a plane carrying it may have as a share of its deviation, and the fit of its
    own plane, None unless that carries it and is certain."""

    region: ShadedRegion
    most_left: float
    fit: Fit | None


def evaluate(plane: np.ndarray, regions: Sequence[ShadedRegion], shadings: Sequence[Shading]) -> Fit | None:
    """Evaluate a plane on the shading of regions; None if no other view shows them."""
    information, downhill = np.zeros((3, 3)), np.zeros(3)
    left, deviation, boxes, views = 0.0, 0.0, 0, 0
    scale = _scale(regions)
    for region in regions:
        local, moves = _with_moves(shadings[region.view].camera, plane, scale)
        for other in region.others:
            found = compare(region, local, shadings[region.view], shadings[other], moves)
            if found is None:
                continue
            information += found.information
            downhill += found.downhill
            left += found.boxes * np.log(found.left_variance) / 2
            deviation += found.boxes * np.log(found.variance + 1e-4) / 2
            boxes, views = boxes + found.boxes, views + 1
    if not boxes:
        return None
    left, deviation = float(np.exp(left / boxes)), float(np.exp(deviation / boxes))
    return Fit(plane, left, deviation, information, downhill, boxes, views / len(regions))


def fit_plane(
    plane: np.ndarray, regions: Sequence[ShadedRegion], shadings: Sequence[Shading], steps: int = STEPS
) -> Fit | None:
    """Return the best plane near one, by Levenberg-Marquardt steps; None if no other view shows the regions."""
    best, damping = evaluate(plane, regions, shadings), 1e-3
    if best is None:
        return None
    for _ in range(steps):
        diagonal = np.diag(best.information)
        damped = best.information + np.diag(damping * diagonal + 1e-9 * diagonal.sum() + 1e-12)
        step = np.linalg.solve(damped, best.downhill)
        step *= min(1, FIRST_STEP / max(np.abs(step).max(), 1e-12))
        moved = best.plane + step @ plane_moves(best.plane, regions)
        tried = evaluate(moved / np.linalg.norm(moved[:3]), regions, shadings)
        # The residual varies slightly as boxes enter and leave other views. A smaller one of far fewer boxes is no
        # better.
        if tried is not None and tried.left < 1.001 * best.left and tried.boxes > 0.7 * best.boxes:
            best, damping = tried, max(damping / 5, 1e-6)
            if np.abs(step).max() < LAST_STEP:
                break
        elif (damping := 10 * damping) > 1e3:
            break
    return best


def _scale(regions: Sequence[ShadedRegion]) -> float:
    """Return the median depth of regions."""
    return float(np.median([region.depth for region in regions]))


def plane_moves(plane: np.ndarray, regions: Sequence[ShadedRegion]) -> np.ndarray:
    """Return the (3, 4) derivatives of a plane of regions by two turns and a shift in depths."""
    return _moves(plane, _scale(regions))


def _moves(plane: np.ndarray, scale: float) -> np.ndarray:
    first = np.cross(plane[:3], np.eye(3)[np.argmin(np.abs(plane[:3]))])
    first /= np.linalg.norm(first)
    return np.array([[*first, 0], [*np.cross(plane[:3], first), 0], [0, 0, 0, scale]])


def _with_moves(camera: Camera, plane: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a plane in a camera's frame (3,), and its (3, 3) derivatives by `_moves`."""
    step = 1e-5
    planes = in_camera(camera, np.vstack([plane, plane + step * _moves(plane, scale)]))
    return planes[0], ((planes[1:] - planes[0]) / step).T


def depth_deviation(fit: Fit, region: ShadedRegion, camera: Camera) -> float:
    """Return the relative standard deviation of a region's depth that noise causes in a fit to it alone."""
    local, moves = _with_moves(camera, fit.plane, _scale([region]))
    # Boxes overlap; only this share of them is independent.
    covariance = np.linalg.pinv(fit.information * (STRIDE / BOX) ** 2, hermitian=True)
    variance = np.einsum("ni,ij,nj->n", region.rays, moves @ covariance @ moves.T, region.rays)
    return float(np.median(np.sqrt(np.maximum(variance, 0)) / np.abs(region.rays @ local)))


def unexplained(region: ShadedRegion, plane: np.ndarray, shadings: Sequence[Shading]) -> np.ndarray:
    """Return (N,) smoothed residuals of a plane (3,) of the view around the boxes of a region, in deviations of the
    noise; NaN where no other view shows them."""
    row, column = ((x - x.min()) // STRIDE for x in (region.row, region.column))
    shape = (row.max() + 1, column.max() + 1)
    square, count = np.zeros(len(row)), np.zeros(len(row))
    # The side in pixels of the area covered by SMOOTH by SMOOTH boxes.
    side = (SMOOTH - 1) * STRIDE + BOX
    for other in region.others:
        found = compare(region, plane, shadings[region.view], shadings[other])
        if found is None:
            continue
        left, share = np.zeros(shape), np.zeros(shape)
        left[row, column] = found.left
        share[row[found.shown], column[found.shown]] = 1
        left, share = (uniform_filter(x, SMOOTH, mode="constant")[row, column] for x in (left, share))
        left, share = left[found.shown], share[found.shown]
        noise = (shadings[region.view].noise + shadings[other].noise) * BOX**2 / (side**2 * share)
        square[found.shown] += (left / share) ** 2 / (noise + ROUNDING)
        count += found.shown
    return np.sqrt(square / np.where(count > 0, count, np.nan))
