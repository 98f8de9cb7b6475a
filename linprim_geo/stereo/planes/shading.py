"""Photo-consistency of planes on shading alone: how well a plane explains a plain wall in several photographs.

A plain wall has no texture to match, but light falls off along it. Averaged over boxes of pixels that is far above the
noise, and only the right plane makes it agree in all photographs. Gauss-Newton steps on the differences of box means
find the plane; each pair of photographs has a gain, an offset and a noise of its own, as paint shines from aside.
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

# Larger photographs are averaged down.
MOST_SIDE = 800
# The side of a box, the way from one to the next, and the smoothing of slopes, in pixels.
BOX, STRIDE, SLOPE_SIGMA = 9, 4, 8.0
# Besides where `edges_of` finds one, an edge is where the slope, smoothed by EDGE_SIGMA pixels, differs by so many
# deviations of its noise from the median of MEDIAN boxes a side around.
EDGE_SIGMA, EDGE_SLOPE, MEDIAN = 2.0, 6.0, 9
# The tenth percentile of the length of a slope both of whose parts have a deviation of 1: sqrt(-2 ln 0.9).
LEAST_SLOPE = 0.459
# A region has so many boxes, and stereo confirms no more than this share of them.
LEAST_BOXES, KNOWN_SHARE = 60, 0.5
# So many confirmed depths say something of a region.
SURE_DEPTHS = 30
# Another view shows at least this share of a region's boxes.
SHOWN_SHARE = 0.3
# Steps of a fit at most, the first one's size at most and the last one's, in radians and in depths.
STEPS, FIRST_STEP, LAST_STEP = 20, 0.3, 5e-4
# Variance that JPEG adds to differences of box means: it rounds means of its blocks to thirds of a grey level.
ROUNDING = 0.1
# Differences are smoothed over so many boxes a side before they are compared with the noise.
SMOOTH = 5


@dataclass(frozen=True)
class Shading:
    """Box means of a photograph, of which `factor` by `factor` pixels are averaged first if a side is longer than
    MOST_SIDE; all else is of the small photograph.

    `means` (H, W, 3) float32 has the mean and its slopes per column and per row, of plain pixels around; `plain` (H, W)
    says where the box has no edge; `noise` is the variance of a mean.
    """

    camera: Camera
    means: np.ndarray
    plain: np.ndarray
    noise: float
    factor: int

    @classmethod
    def of(cls, found: DepthMap, law: np.ndarray | None = None) -> Shading:
        """Of a photograph whose corners are darker as `law` says (`vignetting.vignetting`)."""
        factor = -(-max(found.grey.shape) // MOST_SIDE)
        grey, camera = block_means(found.grey.astype(np.float32), factor), smaller(found.camera, factor)
        if law is not None and law.any():
            grey = (grey / falloff(camera, law)).astype(np.float32)
        noise = found.noise / factor**2
        slope = np.hypot(*(_beyond_shading(one) for one in np.gradient(gaussian_filter(grey, EDGE_SIGMA))))
        # The variance of the derivative of white noise behind a Gaussian is that of the noise over 8 pi sigma^4. Where
        # neighbours have noise in common the plainest parts tell more, see `edges_of`.
        deviation = max(np.sqrt(noise / (8 * np.pi * EDGE_SIGMA**4)), plainest(slope, grey) / LEAST_SLOPE)
        edge = edges_of(grey, noise, found.most_noise) | (slope > EDGE_SLOPE * deviation)
        plain = uniform_filter((~edge).astype(np.float32), BOX, mode="constant") > 1 - 0.5 / BOX**2
        mean = uniform_filter(grey, BOX, mode="nearest")
        # Of plain pixels far around: noise of the slopes would make the steps of a fit too small.
        share = gaussian_filter(plain.astype(np.float32), SLOPE_SIGMA)
        smooth = gaussian_filter(np.where(plain, mean, 0), SLOPE_SIGMA) / np.maximum(share, 1e-6)
        by_row, by_column = np.gradient(smooth)
        means = np.stack([mean, by_column, by_row], -1)
        return cls(camera, means, plain, max(noise / BOX**2, _noise_of_boxes(mean, plain)), factor)

    @cached_property
    def labels(self) -> np.ndarray:
        """(H, W) the number of the plain area that a pixel is in, from 1, else 0."""
        return label(self.plain)[0]

    def area_of(self, region: ShadedRegion) -> np.ndarray:
        """(H, W) bool where the boxes of a region have their middles."""
        return self.labels == self.labels[region.row[0], region.column[0]]

    def small(self, image: np.ndarray) -> np.ndarray:
        """Every `factor`-th pixel of an image of the photograph's size."""
        height, width = self.plain.shape
        return image[self.factor // 2 :: self.factor, self.factor // 2 :: self.factor][:height, :width]


def _noise_of_boxes(mean: np.ndarray, plain: np.ndarray) -> float:
    """Variance of the means of plain boxes: by second differences of boxes side by side across both directions, which
    shading cancels from (`depth_maps.noise_of`); 0 where there are few."""
    mean, plain = mean[::BOX, ::BOX], plain[::BOX, ::BOX]
    across, known = mean[:, :-2] - 2 * mean[:, 1:-1] + mean[:, 2:], plain[:, :-2] & plain[:, 1:-1] & plain[:, 2:]
    both, known = across[:-2] - 2 * across[1:-1] + across[2:], known[:-2] & known[1:-1] & known[2:]
    if np.count_nonzero(known) < LEAST_BOXES:
        return 0.0
    return float(np.median(np.abs(both[known])) / 0.6745) ** 2 / 36


def _beyond_shading(slope: np.ndarray) -> np.ndarray:
    """Slopes along an axis less the median of those around, which shading has and edges do not change."""
    usual = median_filter(slope[::STRIDE, ::STRIDE], MEDIAN, mode="nearest")
    return slope - usual.repeat(STRIDE, 0).repeat(STRIDE, 1)[: slope.shape[0], : slope.shape[1]]


@dataclass(frozen=True)
class ShadedRegion:
    """Boxes of view `view` between edges: `row`, `column` (N,), `rays` (N, 3) of depth 1 and `value` (N,); about their
    `depth`, and the views `others` that they are compared with."""

    view: int
    row: np.ndarray
    column: np.ndarray
    rays: np.ndarray
    value: np.ndarray
    depth: float = 1.0
    others: tuple[int, ...] = ()

    def some(self, count: int) -> ShadedRegion:
        step = -(-len(self.row) // count)
        parts = {name: getattr(self, name)[::step] for name in ("row", "column", "rays", "value")}
        return replace(self, **parts)


def shaded_regions(view: int, shading: Shading, confirmed: np.ndarray) -> list[ShadedRegion]:
    """Those of a view whose `confirmed` (H, W) bool says where stereo is sure."""
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
    """Boxes of a region in another view by a plane (3,) with ray . plane = inverse depth, which (3, 3) `moves` change;
    None where the other view shows too little."""
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
    """(H, W) bool around those boxes of a region that are carried; `inside` (H, W) has the middles of all."""
    height, width = inside.shape
    grid = np.zeros((-(-height // STRIDE), -(-width // STRIDE)), bool)
    grid[region.row[carried] // STRIDE, region.column[carried] // STRIDE] = True
    wide = binary_dilation(grid, np.ones((3, 3))).repeat(STRIDE, 0).repeat(STRIDE, 1)[:height, :width]
    return binary_dilation(inside, iterations=BOX // 2) & wide


def starting_planes(region: ShadedRegion, depth: np.ndarray, rendered: np.ndarray) -> list[np.ndarray]:
    """Planes (3,) to start from: through rendered depths, and parallel to the image at confirmed depths around."""
    starts, inside = [], rendered[region.row, region.column]
    known = inside > 0
    if np.count_nonzero(known) >= LEAST_BOXES:
        rays, inverse = region.rays[known], 1 / inside[known].astype(np.float64)
        weight = np.ones(len(inverse))
        for _ in range(5):  # towards the least sum of absolute differences
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
    """A plane (4,) of the world, n . x = d, and how it carries shading: `left` and `deviation` of the box means in grey
    levels, geometric means over pairs of views; the (3, 3) `information` and (3,) `downhill` by turning about two axes
    and shifting in depths; how many `boxes` were compared, and with how many views each region."""

    plane: np.ndarray
    left: float
    deviation: float
    information: np.ndarray
    downhill: np.ndarray
    boxes: int
    views: float

    @property
    def left_share(self) -> float:
        return self.left / self.deviation


def evaluate(plane: np.ndarray, regions: Sequence[ShadedRegion], shadings: Sequence[Shading]) -> Fit | None:
    """How a plane carries the shading of regions; None where no view shows them."""
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
    """The best plane near one, by Levenberg's and Marquardt's steps; None where no view shows the regions."""
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
        # What is left varies a little as boxes come and go; far fewer boxes, of which less is left, are no better.
        if tried is not None and tried.left < 1.001 * best.left and tried.boxes > 0.7 * best.boxes:
            best, damping = tried, max(damping / 5, 1e-6)
            if np.abs(step).max() < LAST_STEP:
                break
        elif (damping := 10 * damping) > 1e3:
            break
    return best


def _scale(regions: Sequence[ShadedRegion]) -> float:
    return float(np.median([region.depth for region in regions]))


def plane_moves(plane: np.ndarray, regions: Sequence[ShadedRegion]) -> np.ndarray:
    """(3, 4) how a plane of regions changes, turned about two axes and shifted in depths."""
    return _moves(plane, _scale(regions))


def _moves(plane: np.ndarray, scale: float) -> np.ndarray:
    first = np.cross(plane[:3], np.eye(3)[np.argmin(np.abs(plane[:3]))])
    first /= np.linalg.norm(first)
    return np.array([[*first, 0], [*np.cross(plane[:3], first), 0], [0, 0, 0, scale]])


def _with_moves(camera: Camera, plane: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """A plane in a camera's frame (3,), and (3, 3) how it changes by `_moves`."""
    step = 1e-5
    planes = in_camera(camera, np.vstack([plane, plane + step * _moves(plane, scale)]))
    return planes[0], ((planes[1:] - planes[0]) / step).T


def depth_deviation(fit: Fit, region: ShadedRegion, camera: Camera) -> float:
    """Of a region's depth by a fit to it alone, as a share, by noise alone."""
    local, moves = _with_moves(camera, fit.plane, _scale([region]))
    # Boxes overlap: so many of them are independent.
    covariance = np.linalg.pinv(fit.information * (STRIDE / BOX) ** 2, hermitian=True)
    variance = np.einsum("ni,ij,nj->n", region.rays, moves @ covariance @ moves.T, region.rays)
    return float(np.median(np.sqrt(np.maximum(variance, 0)) / np.abs(region.rays @ local)))


def unexplained(region: ShadedRegion, plane: np.ndarray, shadings: Sequence[Shading]) -> np.ndarray:
    """(N,) what a plane (3,) of the view leaves around the boxes of a region, in deviations of the noise; NaN where no
    view shows them."""
    row, column = ((x - x.min()) // STRIDE for x in (region.row, region.column))
    shape = (row.max() + 1, column.max() + 1)
    square, count = np.zeros(len(row)), np.zeros(len(row))
    # The boxes of a square of SMOOTH a side cover this one.
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
