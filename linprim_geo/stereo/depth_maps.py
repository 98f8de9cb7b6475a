"""Compute depth, normals and confidence of every photograph by PatchMatch stereo.

Each photograph is matched with a few source views that show the same points with a baseline: at half the size from
random planes, at full size, and twice more with geometric consistency to the depths found in these views. Then surfaces
are fitted around each pixel, within the edges of the photograph. A depth counts as confirmed where other views have the
same surface.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import available_memory
from linprim_geo.base.progress import Progress
from linprim_geo.capture.types import View
from linprim_geo.geometry.boxes import smaller
from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels.stereo_ops import DepthPlanes, StereoImage, fit_surfaces, patch_match
from linprim_geo.points.view_pairs import CONFIRMING, source_views, visible_pixels
from linprim_geo.stereo.confidence import MATCHED_WEIGHTS, MOST_COST, RIGHT, WEIGHTS, evidence, probability
from linprim_geo.stereo.edges import GREY, colour_edges, colours_of, edges_of
from linprim_geo.stereo.evidence import ViewConsistency, compare_depths
from linprim_geo.stereo.noise import noise_of, shared_noise

# The most source views with which a photograph is matched: as many as the core takes.
MOST_SOURCES = 8
# Sweeps at half the size, at full size, and in each of the passes with geometric consistency.
COARSE_SWEEPS, FINE_SWEEPS, GEOMETRIC_SWEEPS = 3, 1, (1, 1)
# The nearest depth searched is the quantile NEAREST_SHARE of the depths of the points that a view shows, divided by
# NEARER.
NEAREST_SHARE, NEARER = 0.01, 1.5
# Bytes per pixel of all views that are in memory at once: planes 17, images 7, depths of the last pass 4, maps 27.
PIXEL_BYTES = 55
# The largest share of the free memory that is used.
MEMORY_SHARE = 0.5
# Mask pixels of less alpha than this are background, without depth.
FOREGROUND = 128
# The smallest side of a photograph in pixels: at half the size it still holds a window.
SMALLEST = 24
# A depth is confirmed if at least CONFIRMING other views confirm it and its confidence is at least CONFIDENT; it is
# sure if its confidence is at least SURE.
CONFIDENT, SURE = 0.7, 0.9


@dataclass(frozen=True)
class DepthMap:
    """The result of stereo for one photograph.

    `depth` (H, W) float32 along the optical axis in the scene's unit, NaN where unknown; `normal` (H, W, 3) float32 in
    the world, towards the camera; `confidence` (H, W) float32, the probability that the depth is right within 1 %, 0
    where it is unknown; `confirming` (H, W) uint8, how many other views confirm the depth; `deviation` (H, W) float32,
    the least relative difference to the depth of another view, infinite where none has one. `grey` (H, W) uint8 is the
    image that was matched, `noise` the variance of its noise and `most_noise` an upper bound of that from other views
    (`shared_noise`); `colours` (2, H // 2, W // 2) float32 are its colour differences (`edges.colours_of`), None if
    unknown.
    """

    camera: Camera
    depth: np.ndarray
    normal: np.ndarray
    confidence: np.ndarray
    confirming: np.ndarray
    deviation: np.ndarray
    grey: np.ndarray
    noise: float
    most_noise: float = np.inf
    colours: np.ndarray | None = None

    @cached_property
    def edges(self) -> np.ndarray:
        """(H, W) bool: pixels on or beside an edge of grey."""
        return edges_of(self.grey, self.noise, self.most_noise)

    def all_edges(self) -> np.ndarray:
        """Return (H, W) bool: pixels on or beside an edge of grey or colour. JPEG makes edges of colour alone wider."""
        return self.edges if self.colours is None else self.edges | colour_edges(self.colours, self.grey.shape)

    def is_confirmed(self, probability: float = CONFIDENT) -> np.ndarray:
        """Return (H, W) bool: depths confirmed by CONFIRMING other views whose confidence is at least `probability`."""
        return (self.confirming >= CONFIRMING) & (self.confidence >= probability)


def depth_maps(
    views: Sequence[View],
    points: np.ndarray,
    *,
    hiding: Iterable[np.ndarray] | None = None,
    fit: bool = True,
    seed: int = 0,
    quiet: bool = True,
) -> list[DepthMap]:
    """Return the depth maps of all views, in their order.

    Args:
        views: photographs with poses.
        points: (P, 3) of the scene, to select source views and the range of depths.
        hiding: (H, W) depths of the views that occlude points behind them, 0 where unknown.
        fit: whether surfaces are fitted within edges. Training uses small copies without: DECISIONS 71.

    Raises:
        LinprimError: no two views see the same points; photographs are too small for a window, or all of them together
            too large for the free memory.
    """
    cameras = [view.camera for view in views]
    if any(min(camera.width, camera.height) < SMALLEST for camera in cameras):
        raise LinprimError(f"stereo needs photographs of {SMALLEST} pixels a side at least")
    wanted, free = memory_of(cameras), available_memory()
    if wanted > MEMORY_SHARE * free:
        raise LinprimError(
            f"stereo of {len(views)} photographs takes {wanted / 2**30:.1f} GiB of the {free / 2**30:.1f} that are "
            "free, wanted smaller photographs (--downscale) or fewer"
        )
    pairs = source_views(cameras, points, MOST_SOURCES, hiding)
    if not any(pairs):
        raise LinprimError(
            "no two photographs show the same points from directions that differ: stereo needs such pairs"
        )
    full, colours = [], []
    for view in views:
        rgb = view.load().rgb
        full.append(StereoImage.of(view.camera, grey_of(rgb)))
        colours.append(colours_of(rgb))
    half = [halved(image) for image in full]
    noises = [noise_of(image.grey) for image in full]
    ranges = [inverse_range(camera, points) for camera in cameras]
    progress = Progress("stereo", len(views) * (1 + len(GEOMETRIC_SWEEPS)), quiet=quiet)
    found: list[DepthPlanes | None] = []
    for k, sources in enumerate(pairs):
        progress.update(k)
        if not sources:
            found.append(None)
            continue
        images, halves = ([each[j] for j in (k, *sources)] for each in (full, half))
        planes = photometric_planes(images, halves, ranges[k], noises[k], seed * len(views) + k)
        found.append(planes)
    most = _most_noise(full, found, pairs)
    noises = [min(each) for each in zip(noises, most, strict=True)]
    for turn in range(len(GEOMETRIC_SWEEPS)):
        # Depths before this pass, so that the order of the views does not matter.
        depths = {k: planes.plane[..., 0].copy() for k, planes in enumerate(found) if planes is not None}
        for k, planes in enumerate(found):
            progress.update((1 + turn) * len(views) + k)
            sources = [j for j in pairs[k] if j in depths]
            if planes is None or not sources:
                continue
            images, theirs = [full[j] for j in (k, *sources)], [depths[j] for j in sources]
            geometric_planes(images, planes, theirs, ranges[k], noises[k], turn, seed * len(views) + k)
    for image, planes in zip(full, found, strict=True):
        if fit and planes is not None:
            fit_within_edges(image, planes)
    weights = WEIGHTS if fit else MATCHED_WEIGHTS
    result = (
        _depth_map(full[k], noises[k], most[k], planes, [(cameras[j], found[j]) for j in pairs[k]], weights)
        for k, planes in enumerate(found)
    )
    return [replace(of_view, colours=own) for of_view, own in zip(result, colours, strict=True)]


def memory_of(cameras: Sequence[Camera]) -> int:
    """Return the bytes of memory that depth maps of all views take at once."""
    return PIXEL_BYTES * sum(camera.width * camera.height for camera in cameras)


def photometric_planes(
    images: Sequence[StereoImage],
    halves: Sequence[StereoImage],
    inverse_depths: tuple[float, float],
    noise: float,
    seed: int,
) -> DepthPlanes:
    """Return the depth planes of the first of `images` by photo-consistency with the others; `halves` are the same
    images at half the size."""
    coarse = DepthPlanes.unknown(*halves[0].grey.shape)
    patch_match(halves[0], list(halves[1:]), coarse, inverse_depths, noise / 4, COARSE_SWEEPS, seed=seed)
    planes = _doubled(coarse, images[0].grey.shape)
    others = list(images[1:])
    patch_match(images[0], others, planes, inverse_depths, noise, FINE_SWEEPS, first=COARSE_SWEEPS, seed=seed)
    return planes


def geometric_planes(
    images: Sequence[StereoImage],
    planes: DepthPlanes,
    source_depths: list[np.ndarray],
    inverse_depths: tuple[float, float],
    noise: float,
    turn: int,
    seed: int,
) -> None:
    """Improve the depth planes of the first of `images` in place, with geometric consistency to the inverse depths of
    the others. `turn` is the index into GEOMETRIC_SWEEPS."""
    patch_match(
        images[0],
        list(images[1:]),
        planes,
        inverse_depths,
        noise,
        GEOMETRIC_SWEEPS[turn],
        first=COARSE_SWEEPS + FINE_SWEEPS + turn,
        seed=seed,
        source_depths=source_depths,
    )


def fit_within_edges(image: StereoImage, planes: DepthPlanes, alpha: np.ndarray | None = None) -> None:
    """Move depth planes in place to surfaces fitted around each pixel, within the edges of the photograph. Only the
    foreground of `alpha` (H, W) is fitted."""
    known = are_known(planes.plane[..., 0], planes.cost)
    fit_surfaces(image.grey, planes, known if alpha is None else known & (alpha >= FOREGROUND), RIGHT)


def are_known(inverse: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: which inverse depths are positive with a matching cost below MOST_COST."""
    return (inverse > 0) & (cost < MOST_COST)


def grey_of(rgb: np.ndarray) -> np.ndarray:
    """Return the (H, W) uint8 luminance of a photograph (H, W, 3)."""
    return np.rint(rgb @ np.array(GREY, np.float32)).astype(np.uint8)


def halved(image: StereoImage) -> StereoImage:
    """Return the image at half the size, in means of 2 by 2 pixels."""
    return StereoImage.of(smaller(image.camera, 2), np.rint(block_means(image.grey, 2)).astype(np.uint8))


def block_means(grey: np.ndarray, factor: int) -> np.ndarray:
    """Return the (H // factor, W // factor) means of blocks of `factor` by `factor` of (H, W) values."""
    height, width = (size // factor for size in grey.shape)
    return grey[: factor * height, : factor * width].reshape(height, factor, width, factor).mean((1, 3))


def _doubled(planes: DepthPlanes, shape: tuple[int, int]) -> DepthPlanes:
    """Upsample the depth planes of an image of half the size to shape (H, W)."""
    rows, columns = (
        np.minimum(np.arange(size) // 2, coarse - 1) for size, coarse in zip(shape, planes.cost.shape, strict=True)
    )
    found = planes.plane[np.ix_(rows, columns)].copy()
    found[..., 1:] /= 2
    # Offset from the centre of the coarse pixel to that of the fine one, in fine pixels.
    right, down = (np.arange(size) - 2 * index - 0.5 for size, index in ((shape[1], columns), (shape[0], rows)))
    found[..., 0] += found[..., 1] * right + found[..., 2] * down[:, None]
    found[..., 0] = np.maximum(found[..., 0], 0)
    return DepthPlanes(found, planes.cost[np.ix_(rows, columns)].copy(), planes.chosen[np.ix_(rows, columns)].copy())


def inverse_range(camera: Camera, points: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest inverse depth that is searched; the least is 0, at infinity."""
    depth = visible_pixels(camera, points)[2]
    # A camera that sees none of the points has no source view either: its range is not used.
    return 0.0, NEARER / float(np.quantile(depth, NEAREST_SHARE)) if len(depth) else 1.0


def depth_and_normal(camera: Camera, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert `DepthPlanes.plane` (H, W, 3) to (H, W) float64 depth, infinite where the inverse depth is 0, and (H, W,
    3) unit normals in the world, towards the camera."""
    inverse, slope_x, slope_y = (plane[..., k].astype(np.float64) for k in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = 1 / inverse
    column, row = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    # n . X = 1 for X = ray / inverse: n . ray = inverse along the image.
    normal = np.stack(
        [
            slope_x * camera.fx,
            slope_y * camera.fy,
            inverse - slope_x * (column - camera.cx) - slope_y * (row - camera.cy),
        ],
        axis=-1,
    )
    return depth, -(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)) @ camera.rotation


def inverse_planes(camera: Camera, depth: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return (3, H, W) float32: the inverse depth and its slopes, given (H, W) depth and (H, W, 3) normals in the
    camera's axes."""
    distance = depth * (normal * camera.ray_grid()).sum(-1)  # n . X = distance: inverse depth = n . ray / distance
    slopes = [normal[..., 0] / (camera.fx * distance), normal[..., 1] / (camera.fy * distance)]
    return np.stack([1 / depth, *slopes]).astype(np.float32)


def _most_noise(
    images: Sequence[StereoImage], found: Sequence[DepthPlanes | None], pairs: Sequence[Sequence[int]]
) -> list[float]:
    """Return the `shared_noise` of images, by the depths found so far and the source views of each."""
    depths = [_known_depth(image, planes) for image, planes in zip(images, found, strict=True)]
    return shared_noise([image.camera for image in images], [image.grey for image in images], depths, pairs)


def _known_depth(image: StereoImage, planes: DepthPlanes | None) -> np.ndarray:
    """Return the (H, W) depth of an image, NaN where unknown."""
    if planes is None:
        return np.full(image.grey.shape, np.nan, np.float32)
    inverse = planes.plane[..., 0]
    with np.errstate(divide="ignore"):
        return np.where(are_known(inverse, planes.cost), 1 / inverse, np.float32(np.nan))


def _depth_map(
    image: StereoImage,
    noise: float,
    most_noise: float,
    planes: DepthPlanes | None,
    others: list[tuple[Camera, DepthPlanes | None]],
    weights: np.ndarray,
) -> DepthMap:
    """Return the depth map of an image from its depth planes, judged by those of the source views, `others`."""
    camera, shape = image.camera, image.grey.shape
    if planes is None:
        unknown, infinite = np.full(shape, np.nan, np.float32), np.full(shape, np.inf, np.float32)
        normal, none = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
        return DepthMap(camera, unknown, normal, none, none.astype(np.uint8), infinite, image.grey, noise, most_noise)
    depth, normal = depth_and_normal(camera, planes.plane)
    known = are_known(planes.plane[..., 0], planes.cost)
    depth = np.where(known, depth, np.nan)
    confirming, deviation = np.zeros(shape, np.uint8), np.full(shape, np.inf, np.float32)

    def comparisons() -> Iterator[ViewConsistency]:  # one at a time is in memory
        for other, theirs in others:
            if theirs is not None:
                found = compare_depths(camera, depth, other, np.moveaxis(theirs.plane, 2, 0))
                np.add(confirming, found.confirms, out=confirming)
                np.fmin(deviation, np.abs(found.depth_difference), out=deviation)
                yield found

    found = evidence(image.grey, np.moveaxis(planes.plane, 2, 0), planes.cost, known, comparisons())
    confidence = probability(found, weights)
    return DepthMap(
        camera,
        depth.astype(np.float32),
        normal.astype(np.float32),
        np.where(known, confidence, np.float32(0)),
        confirming,
        deviation,
        image.grey,
        noise,
        most_noise,
    )
