"""Add initial points where features found none, such as plain walls and objects that structure from motion missed.

Density control only splits existing primitives, so a surface without initial points stays open or is covered by
primitives that drift in front of it. Depths come from the surrounding points (inverse depth is linear on a plane);
where these are too sparse or differ too much, from patches that match in other views. Both are checked against all
photographs. Where neither works, points start at the far end of the scene, because nearer ones would be floaters; on
masked objects they start at the depth of the nearest points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from linprim_geo.capture.types import PointCloud, Scene
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.sampling import sample_bilinear
from linprim_geo.points.colors_at_infinity import ColorsAtInfinity
from linprim_geo.points.initial_points import SmallView, evenly_spread_views, in_image

# Side of an image cell that should hold a point, as a share of the image's longer side. This makes about 1,400 cells in
# a 4:3 image, fewer than the primitives that a view ends up with, so points found by features are rarely doubled. Cells
# are larger for depths from colours, which are coarser because patches are matched.
CELL, PATCH_CELL = 12 / 512, 18 / 512
# Largest number of views used; more add little.
MOST_VIEWS = 100
# A triangle of three neighbouring points is taken for a surface if their depths differ by at most this factor ...
_MAX_DEPTH_RATIO = 1.15
# ... and shows that the space in front of it is free if its sides are no longer than this many cells.
_TRUSTED_CELLS = 2.0
# Relative difference up to which inverse depths agree. Interpolated points miss a surface by less than half of this in
# 90 of 100 cases.
_TOLERANCE = 0.05
# A point that some views see through, to a surface behind it, is dropped unless this many times as many views confirm
# it.
_CONFIRMATIONS = 4
# A point is occluded in a view if at least _HIDDEN_BY of its _NEIGHBOURS nearest points in the image, within two cells,
# are nearer to the camera by the factor _HIDDEN_RATIO.
_HIDDEN_RATIO, _HIDDEN_BY, _NEIGHBOURS = 1.15, 2, 8
_MIN_POINTS = 8
# Smallest, best and largest angle in degrees between a view and its source views; source views must also look in a
# similar direction (_MIN_AXIS_COSINE). There are at most _SOURCES; a point may be occluded in fewer than half of them.
_ANGLES = (4.0, 12.0, 40.0)
_MIN_AXIS_COSINE = 0.7
_SOURCES = 6
# A patch has _PATCH by _PATCH samples, _PATCH_STEP pixels of a reduced photograph (512 on its longer side) apart.
_PATCH, _PATCH_STEP = 5, 3
# Two patches match if their mean colour difference, of 255, is below this: noise and interpolation of sub-pixel detail.
_SAME_COLOR = 6.0
# Smallest difference in patch error, of 255, by which one depth is better than another: three standard deviations of a
# patch's mean difference at a pixel noise of 3.
_BETTER = 1.5
# Number of depth hypotheses, evenly spaced in inverse depth over the range of the view's points, extended by the
# factors _NEARER and _FARTHER.
_DEPTHS = 64
_NEARER, _FARTHER = 2.0, 1.2
# Patches compared at once, at all their depths. Larger batches take more memory and no less time.
_AT_ONCE = 64
# Largest difference per channel, of 255, from a backdrop's colour for a pixel to belong to it.
_BACKDROP = 25.5


def fill_gaps(
    scene: Scene, seed: int, backdrop: np.ndarray | None = None, far: ColorsAtInfinity | None = None
) -> PointCloud:
    """Return the scene's points followed by new ones in the image cells of training views that contain none.

    In three rounds, views are visited in order of their number of points. Each empty cell gets a candidate at a random
    position in it. Its depth is, in the first round, interpolated between the three points around it (inverse depth is
    linear on a plane) if theirs are similar; in the second, with larger cells, the one of 64 depths at which the patch
    around it matches other views; in the third, the farthest of these depths, or on masked objects the depth of the
    nearest points. A candidate is kept if hardly any view sees surfaces through it and, in the first two rounds, if its
    patch matches in other views. Masked background and pixels with the colour of a plain backdrop get no points.
    Colours come from the photograph.

    Args:
        scene: with points; held-out views are not used.
        seed: for the positions in the cells.
        backdrop: (3,) colour in [0, 1] of a plain backdrop, or None.
        far: colours at infinity of an open scene. Then only the first round is run, and a candidate is dropped if
            infinity explains the photographs better: matching a patch over all depths would find one for the background
            too.

    Returns: the cloud, without errors in pixels, or the scene's own if nothing was found.
    """
    cloud = scene.points
    assert cloud is not None, "of a scene without points there is nothing to fill"
    views = [_Gaps(small_view, cloud.xyz) for small_view in evenly_spread_views(scene.train, MOST_VIEWS)]
    at_infinity = [None if far is None else far.difference(view.small_view) for view in views]
    rng = np.random.default_rng([seed, 8])
    sources_of_depth = [_between_points]
    if far is None:
        # On a masked scene, every foreground pixel belongs to the object.
        sources_of_depth += [_same_colors, _nearest_points if scene.has_alpha else _behind_all]
    found = [np.empty((0, 3))]
    colors = [np.empty((0, 3), np.uint8)]
    for source in sources_of_depth:
        if source is not _between_points:  # include the points found so far, which also extend the known free space
            views = [_Gaps(view.small_view, np.concatenate([cloud.xyz, *found])) for view in views]
        cell = CELL if source is _between_points else PATCH_CELL
        for index in np.argsort([-len(view.pixels) for view in views], kind="stable"):
            view = views[index]
            if not view.usable:
                continue
            pixels = view.empty_cells(np.concatenate(found), cell, rng)
            pixels = pixels[view.shows_something(pixels, backdrop)]
            sources = _sources(views, index)
            pixels, inverse = source(view, sources, pixels)
            finite = _not_farther(view, sources, pixels, inverse, at_infinity[index])
            pixels, inverse = pixels[finite], inverse[finite]
            points = view.points_at(pixels, inverse)
            free = _not_in_free_space(points, views, index)
            column, row = pixels[free].astype(np.int64).T
            found.append(points[free])
            colors.append(view.small_view.rgb[row, column])
    if sum(map(len, found)) == 0:
        return cloud
    return PointCloud(
        np.concatenate([cloud.xyz, *found]),
        np.concatenate([cloud.rgb, *colors]).astype(np.uint8),
    )


class _Gaps:
    """A view with the points that it sees and their Delaunay triangulation: `pixels` (P, 2) and `inverse` depths
    (P,)."""

    def __init__(self, small_view: SmallView, xyz: np.ndarray):
        self.small_view, self.camera = small_view, small_view.camera
        inside = in_image(self.camera, xyz)[0]
        self.pixels, depth = self.camera.project(xyz[inside])
        self.inverse = 1.0 / depth
        for choose in (self._nearest_of_each_place, self._not_hidden):
            chosen = choose()
            self.pixels, self.inverse = self.pixels[chosen], self.inverse[chosen]

    @property
    def longer_side(self) -> int:
        return max(self.camera.width, self.camera.height)

    @property
    def usable(self) -> bool:
        """Return whether there are triangles; points may be too few or collinear."""
        return self.triangulation is not None

    @cached_property
    def triangulation(self):
        from scipy.spatial import Delaunay, QhullError

        if len(self.pixels) < _MIN_POINTS:
            return None
        try:
            return Delaunay(self.pixels)
        except QhullError:
            return None

    @cached_property
    def ratio(self) -> np.ndarray:
        """Return (T,) the largest divided by the smallest depth of each triangle's corners."""
        corners = self.inverse[self.triangulation.simplices]
        return corners.max(1) / corners.min(1)

    @cached_property
    def trusted(self) -> np.ndarray:
        """Return (T,) whether a triangle is small enough, and its depths similar enough, to represent a surface."""
        corners = self.pixels[self.triangulation.simplices]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
        return (sides <= _TRUSTED_CELLS * CELL * self.longer_side) & (self.ratio <= _MAX_DEPTH_RATIO)

    @cached_property
    def image(self) -> np.ndarray:
        """Return (H, W, 3) uint16, the sum over 3x3 pixels, so that bilinear samples of it do not alias. It is kept in
        memory for all views."""
        from scipy.ndimage import uniform_filter

        return np.rint(9 * uniform_filter(self.small_view.rgb.astype(np.float32), (3, 3, 1), mode="nearest")).astype(
            np.uint16
        )

    def interpolate(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return, at (Q, 2) positions, the (Q,) index of the triangle, or -1, and the (Q,) interpolated inverse
        depth."""
        triangle = self.triangulation.find_simplex(pixels)
        affine = self.triangulation.transform[triangle]
        first = np.einsum("qij,qj->qi", affine[:, :2], pixels - affine[:, 2])
        weight = np.concatenate([first, 1.0 - first.sum(1, keepdims=True)], axis=1)
        inverse = (weight * self.inverse[self.triangulation.simplices[triangle]]).sum(1)
        # Degenerate triangles have no barycentric transform.
        return np.where(np.isfinite(inverse), triangle, -1), np.nan_to_num(inverse)

    def empty_cells(self, xyz: np.ndarray, cell: float, rng: np.random.Generator) -> np.ndarray:
        """Return (Q, 2) random positions, one in each cell that contains neither a visible point nor one of (N, 3)
        `xyz`."""
        size = np.array([self.camera.width, self.camera.height])
        count = np.maximum(1, np.round(size / (cell * self.longer_side))).astype(np.int64)
        taken = np.zeros((count[1], count[0]), dtype=bool)
        inside = in_image(self.camera, xyz)[0]
        for pixels in (self.pixels, self.camera.project(xyz[inside])[0]):
            column, row = np.minimum((pixels * (count / size)).astype(np.int64), count - 1).T
            taken[row, column] = True
        row, column = np.nonzero(~taken)
        return (np.stack([column, row], axis=1) + rng.random((len(row), 2))) * (size / count)

    def shows_something(self, pixels: np.ndarray, backdrop: np.ndarray | None) -> np.ndarray:
        """Return (Q,) whether the photograph shows neither masked background nor backdrop at (Q, 2) positions."""
        column, row = pixels.astype(np.int64).T
        shown = np.ones(len(pixels), dtype=bool)
        if self.small_view.foreground is not None:
            shown &= self.small_view.foreground[row, column]
        if backdrop is not None:
            shown &= np.abs(self.small_view.rgb[row, column] - 255.0 * backdrop).max(1) > _BACKDROP
        return shown

    def depths_to_try(self) -> np.ndarray:
        """Return the (D,) inverse depth hypotheses of this view."""
        far, near = np.percentile(self.inverse, [1, 99])
        return np.linspace(far / _FARTHER, near * _NEARER, _DEPTHS)

    def points_at(self, pixels: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Return (..., 3) world points at (..., 2) positions and (...) inverse depths."""
        return self.camera.center + _rays(self.camera, pixels) / inverse[..., None]

    def _nearest_of_each_place(self) -> np.ndarray:
        """Return (K,) rows of the nearest point in each cell of half size: a finer triangulation is not needed and
        takes time."""
        size = 0.5 * CELL * self.longer_side
        column, row = (self.pixels / size).astype(np.int64).T
        order = np.lexsort((-self.inverse, column, row))
        place = np.stack([row, column], axis=1)[order]
        first = np.ones(len(order), dtype=bool)
        first[1:] = (place[1:] != place[:-1]).any(1)
        return np.sort(order[first])

    def _not_hidden(self) -> np.ndarray:
        from scipy.spatial import cKDTree

        if len(self.pixels) <= _NEIGHBOURS:
            return np.ones(len(self.pixels), dtype=bool)
        distance, near = cKDTree(self.pixels).query(self.pixels, k=_NEIGHBOURS + 1)
        close = distance[:, 1:] <= _TRUSTED_CELLS * CELL * self.longer_side
        nearer = self.inverse[near[:, 1:]] > _HIDDEN_RATIO * self.inverse[:, None]
        return (close & nearer).sum(1) < _HIDDEN_BY


def _not_farther(
    view: _Gaps, sources: Sequence[_Gaps], pixels: np.ndarray, inverse: np.ndarray, at_infinity: Callable | None
) -> np.ndarray:
    """Return (Q,) whether the photographs at (Q, 2) positions match at these inverse depths about as well as at
    infinity, or infinity is unknown."""
    if at_infinity is None:
        return np.ones(len(pixels), dtype=bool)
    near = _differences(view, sources, pixels, inverse[:, None])[:, 0]
    return ~(near > at_infinity(pixels) + _BETTER)


def _between_points(view: _Gaps, sources: Sequence[_Gaps], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions, of (Q, 2), inside a triangle of points of similar depth whose patches match there, and
    their interpolated inverse depths."""
    triangle, inverse = view.interpolate(pixels)
    usable = (triangle >= 0) & (view.ratio[triangle] <= _MAX_DEPTH_RATIO)
    pixels, inverse = pixels[usable], inverse[usable]
    alike = _differences(view, sources, pixels, inverse[:, None])[:, 0] <= _SAME_COLOR
    return pixels[alike], inverse[alike]


def _same_colors(view: _Gaps, sources: Sequence[_Gaps], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions, of (Q, 2), whose patches match other views at some inverse depth, and the best one."""
    tried = view.depths_to_try()
    difference = _differences(view, sources, pixels, np.broadcast_to(tried, (len(pixels), len(tried))))
    alike = difference.min(1) <= _SAME_COLOR
    return pixels[alike], tried[difference[alike].argmin(1)]


def _nearest_points(view: _Gaps, sources: Sequence[_Gaps], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all (Q, 2) positions and, for each, the median inverse depth of the nearest points in the image."""
    from scipy.spatial import cKDTree

    _, near = cKDTree(view.pixels).query(pixels, k=_NEIGHBOURS)
    return pixels, np.median(view.inverse[near], axis=1)


def _behind_all(view: _Gaps, sources: Sequence[_Gaps], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all (Q, 2) positions, at the farthest depth hypothesis."""
    return pixels, np.full(len(pixels), view.depths_to_try()[0])


def _rays(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return (..., 3) rays in world axes, of z-depth 1, through (..., 2) positions."""
    local = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return np.concatenate([local, np.ones((*local.shape[:-1], 1))], axis=-1) @ camera.rotation


def _sources(views: Sequence[_Gaps], index: int) -> list[_Gaps]:
    """Return at most 6 source views whose angle to what this view looks at is from 4 to 40 degrees, those closest to 12
    first."""
    camera = views[index].camera
    target = camera.center + camera.rotation[2] / np.median(views[index].inverse)
    towards = np.array([view.camera.center for view in views]) - target
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), np.finfo(float).tiny)
    angle = np.degrees(np.arccos(np.clip(towards @ towards[index], -1.0, 1.0)))
    axes = np.array([view.camera.rotation[2] for view in views]) @ camera.rotation[2]
    low, best, high = _ANGLES
    fit = (angle >= low) & (angle <= high) & (axes >= _MIN_AXIS_COSINE)
    order = np.argsort(np.where(fit, np.abs(angle - best), np.inf), kind="stable")
    return [views[i] for i in order[:_SOURCES] if fit[i]]


def _differences(view: _Gaps, sources: Sequence[_Gaps], pixels: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Return (Q, D) mean colour differences, of 255, between patches of a view and of its source views, averaged over
    the half of the source views where they are smallest.

    Patches are parallel to the image plane, at (Q, 2) positions and (Q, D) inverse depths. The result is infinite where
    fewer than two source views see the patch.
    """
    if len(pixels) > _AT_ONCE:
        parts = [slice(begin, begin + _AT_ONCE) for begin in range(0, len(pixels), _AT_ONCE)]
        return np.concatenate([_differences(view, sources, pixels[part], inverse[part]) for part in parts])
    offset = (np.arange(_PATCH) - _PATCH // 2) * float(_PATCH_STEP)
    patch = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
    size = np.array([view.camera.width, view.camera.height])
    places = np.clip(pixels[:, None] + patch, 0.5, size - 0.5)  # (Q, K, 2)
    mine, _ = _sampled(view.image, places)
    rays = _rays(view.camera, places)
    result = np.full((max(len(sources), 2), *inverse.shape), np.inf)
    for number, source in enumerate(sources):
        # A point is center + ray / inverse. In the source's camera it is, up to scale, inverse * (transformed centre) +
        # rotated ray.
        start = source.camera.rotation @ view.camera.center + source.camera.world_to_camera[:3, 3]
        local = inverse[..., None, None] * start + (rays @ source.camera.rotation.T)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = local[..., 0] / local[..., 2] * source.camera.fx + source.camera.cx
            y = local[..., 1] / local[..., 2] * source.camera.fy + source.camera.cy
        x, y = (np.where(local[..., 2] > 0, value, -1.0) for value in (x, y))
        theirs, inside = _sampled(source.image, np.stack([x, y], axis=-1))
        difference = np.abs(theirs - mine[:, None]).mean((2, 3)) / 9
        result[number] = np.where(inside.all(2), difference, np.inf)
    result.sort(axis=0)
    seen = np.isfinite(result).sum(0)
    count = np.clip(seen, 1, max(2, (len(sources) + 1) // 2))
    least = np.where(np.arange(len(result))[:, None, None] < count, result, 0.0).sum(0) / count
    return np.where(seen >= 2, least, np.inf)


def _sampled(image: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (..., 3) bilinear samples at (..., 2) positions, and (...) whether they lie within the outermost pixel
    centres."""
    height, width = image.shape[:2]
    inside = np.asarray(((places >= 0.5) & (places <= [width - 0.5, height - 0.5])).all(-1))
    return sample_bilinear(image, np.where(inside[..., None], places, 0.5)), inside


def _not_in_free_space(points: np.ndarray, views: Sequence[_Gaps], own: int) -> np.ndarray:
    """Return (P,) whether few enough other views see through the points.

    A view sees through a point if its trusted triangles lie behind it. A point is kept if at least _CONFIRMATIONS times
    as many views confirm its depth.
    """
    through, confirmed = np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=np.int64)
    for index, view in enumerate(views):
        if index == own or not view.usable:
            continue
        inside = np.flatnonzero(in_image(view.camera, points)[0])
        if not len(inside):
            continue
        pixels, depth = view.camera.project(points[inside])
        triangle, surface = view.interpolate(pixels)
        trusted = (triangle >= 0) & view.trusted[triangle]
        nearer = 1.0 / (depth * np.where(trusted, surface, 1.0))
        through[inside] += trusted & (nearer > 1 + _TOLERANCE)
        confirmed[inside] += trusted & (np.abs(nearer - 1) <= _TOLERANCE)
    return _CONFIRMATIONS * through <= confirmed
