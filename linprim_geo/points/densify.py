"""Points to start from where features found none: on plain walls, and on things that structure from motion overlooked.

Growth only splits primitives that are there, so a surface without a start is either left open or covered by primitives
that drift in front of it. Two sources fill the gaps, both checked against all the photographs: the points that surround
a gap, between which inverse depth is linear on a plane, and where these are too far apart or too unlike, the depth at
which other views show the same colours. What has neither starts behind everything that is known: nearer, it would be
fog between the cameras, which those that look past it do not see. Of a masked object it starts beside the nearest
points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from linprim_geo.capture.types import PointCloud, Scene
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.sampling import sample_bilinear
from linprim_geo.points.far_colors import FarColors
from linprim_geo.points.initial_points import SmallView, evenly_spread_views, in_image

# A cell of the image, as a share of its longer side, is to hold a point: about 1,400 cells of 4:3, fewer than the
# primitives that a view ends up with, so that what is found by features is hardly ever doubled. Depths from colours are
# coarser: they match patches.
CELL, PATCH_CELL = 12 / 512, 18 / 512
# Views that take part; more say little that is new.
MOST_VIEWS = 100
# A triangle of three neighbouring points spans a surface if their depths differ by at most this factor ...
_MAX_DEPTH_RATIO = 1.15
# ... and speaks for the space in front of it if its sides are no longer than this many cells.
_TRUSTED_CELLS = 2.0
# Inverse depths that differ by less agree; interpolated points miss a surface by less than half of it in 90 of 100
# cases.
_TOLERANCE = 0.05
# A point in front of a surface that others see through it is dropped unless this many times as many views confirm it.
_CONFIRMATIONS = 4
# A point is hidden in a view if two of its 8 nearest in the image, within two cells, are nearer by this factor.
_HIDDEN_RATIO, _HIDDEN_BY, _NEIGHBOURS = 1.15, 2, 8
_MIN_POINTS = 8
# Views to compare colours with see the place from another angle, in degrees, the best of them near the middle one;
# fewer than half of them may be hidden.
_ANGLES = (4.0, 12.0, 40.0)
_MIN_AXIS_COSINE = 0.7
_SOURCES = 6
# A patch is this many by this many samples, so many pixels of a look (512 on its longer side) apart.
_PATCH, _PATCH_STEP = 5, 3
# Patches are the same if their colours differ by less on average, of 255: noise and the interpolation of what is finer
# than a pixel.
_SAME_COLOR = 6.0
# One depth explains photographs better than another by this, of 255: three standard deviations of a patch's mean
# difference where pixels have noise of 3.
_BETTER = 1.5
# Depths tried, evenly spread in inverse depth over what the view's points span, widened by the factors.
_DEPTHS = 64
_NEARER, _FARTHER = 2.0, 1.2
# Patches compared at once, at all their depths; more take memory and no less time.
_AT_ONCE = 64
# Colours this near to a backdrop's, per channel of 255, belong to it.
_BACKDROP = 25.5


def densify(scene: Scene, seed: int, backdrop: np.ndarray | None = None, far: FarColors | None = None) -> PointCloud:
    """The scene's points and, after them, new ones in the image cells of training views that hold none.

    View by view, those with most points first, every cell that neither a given nor a new point falls into gets a
    candidate, at a random place in it. Its depth is that between the three points round it (inverse depth is linear
    over a plane) if theirs agree, or else, in a second round with larger cells, the one of 64 at which the patch round
    it looks the same in other views, or else, in a third, the farthest of these, on masked objects that of the nearest
    points. A candidate is kept if it looks the same in other views, which one of the third round need not, and if
    hardly any view sees surfaces through it. Masked background, and pixels of the colour of a plain backdrop, get no
    points. Colours are those of the photograph.

    Args:
        scene: with points; held-out views are not used.
        seed: of the places in the cells.
        backdrop: (3,) colour in [0, 1] of a plain backdrop, or None.
        far: of an open scene, what its photographs show at infinity. Then only candidates between points are made, and
            kept where infinity does not explain the photographs better: a patch compared over all depths finds one for
            the background, too.

    Returns: the cloud, without errors in pixels; the scene's own if nothing was found.
    """
    cloud = scene.points
    assert cloud is not None, "of a scene without points there is nothing to fill"
    views = [_Gaps(small_view, cloud.xyz) for small_view in evenly_spread_views(scene.train, MOST_VIEWS)]
    at_infinity = [None if far is None else far.difference(view.small_view) for view in views]
    rng = np.random.default_rng([seed, 8])
    sources_of_depth = [_between_points]
    if far is None:
        # All that a mask shows is the object.
        sources_of_depth += [_same_colors, _nearest_points if scene.has_alpha else _behind_all]
    found = [np.empty((0, 3))]
    colors = [np.empty((0, 3), np.uint8)]
    for source in sources_of_depth:
        if source is not _between_points:  # by now there are more points, and more space is known to be free
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
    """A view, the points it sees, and the triangles between them: `pixels` (P, 2) and `inverse` (P,) depths."""

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
        """Whether there are triangles; points may be too few, or all on a line."""
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
        """(T,) largest by smallest depth of a triangle's corners."""
        corners = self.inverse[self.triangulation.simplices]
        return corners.max(1) / corners.min(1)

    @cached_property
    def trusted(self) -> np.ndarray:
        """(T,) whether a triangle is small and even enough to stand for a surface."""
        corners = self.pixels[self.triangulation.simplices]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
        return (sides <= _TRUSTED_CELLS * CELL * self.longer_side) & (self.ratio <= _MAX_DEPTH_RATIO)

    @cached_property
    def image(self) -> np.ndarray:
        """(H, W, 3) uint16, the sum over 3x3 pixels, so that bilinear samples of it do not alias. All views have theirs
        in memory."""
        from scipy.ndimage import uniform_filter

        return np.rint(9 * uniform_filter(self.small_view.rgb.astype(np.float32), (3, 3, 1), mode="nearest")).astype(
            np.uint16
        )

    def interpolate(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """((Q,) triangle or -1, (Q,) inverse depth inside it) at (Q, 2) positions."""
        triangle = self.triangulation.find_simplex(pixels)
        affine = self.triangulation.transform[triangle]
        first = np.einsum("qij,qj->qi", affine[:, :2], pixels - affine[:, 2])
        weight = np.concatenate([first, 1.0 - first.sum(1, keepdims=True)], axis=1)
        inverse = (weight * self.inverse[self.triangulation.simplices[triangle]]).sum(1)
        # Slivers have no transform.
        return np.where(np.isfinite(inverse), triangle, -1), np.nan_to_num(inverse)

    def empty_cells(self, xyz: np.ndarray, cell: float, rng: np.random.Generator) -> np.ndarray:
        """(Q, 2) random positions, one in each cell that neither a seen point nor one of (N, 3) `xyz` falls into."""
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
        """(Q,) whether the photograph has neither background nor backdrop at (Q, 2) positions."""
        column, row = pixels.astype(np.int64).T
        shown = np.ones(len(pixels), dtype=bool)
        if self.small_view.foreground is not None:
            shown &= self.small_view.foreground[row, column]
        if backdrop is not None:
            shown &= np.abs(self.small_view.rgb[row, column] - 255.0 * backdrop).max(1) > _BACKDROP
        return shown

    def depths_to_try(self) -> np.ndarray:
        """(D,) inverse depths."""
        far, near = np.percentile(self.inverse, [1, 99])
        return np.linspace(far / _FARTHER, near * _NEARER, _DEPTHS)

    def points_at(self, pixels: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """(..., 3) world points at (..., 2) positions and (...) inverse depths."""
        return self.camera.center + _rays(self.camera, pixels) / inverse[..., None]

    def _nearest_of_each_place(self) -> np.ndarray:
        """(K,) rows of the point nearest to the camera in each half by half cell: triangles need no more, and take
        time."""
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
    """(Q,) whether photographs at (Q, 2) positions agree at these inverse depths about as well as at infinity, as far
    as that is known."""
    if at_infinity is None:
        return np.ones(len(pixels), dtype=bool)
    near = _differences(view, sources, pixels, inverse[:, None])[:, 0]
    return ~(near > at_infinity(pixels) + _BETTER)


def _between_points(view: _Gaps, sources: Sequence[_Gaps], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those of the (Q, 2) positions that lie in a triangle of points of similar depth, and their inverse depths
    there."""
    triangle, inverse = view.interpolate(pixels)
    usable = (triangle >= 0) & (view.ratio[triangle] <= _MAX_DEPTH_RATIO)
    pixels, inverse = pixels[usable], inverse[usable]
    alike = _differences(view, sources, pixels, inverse[:, None])[:, 0] <= _SAME_COLOR
    return pixels[alike], inverse[alike]


def _same_colors(view: _Gaps, sources: Sequence[_Gaps], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those of the (Q, 2) positions that other views show alike at some inverse depth, and the one where they do
    best."""
    tried = view.depths_to_try()
    difference = _differences(view, sources, pixels, np.broadcast_to(tried, (len(pixels), len(tried))))
    alike = difference.min(1) <= _SAME_COLOR
    return pixels[alike], tried[difference[alike].argmin(1)]


def _nearest_points(view: _Gaps, sources: Sequence[_Gaps], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All of the (Q, 2) positions, and the median inverse depth of the points nearest to them in the image."""
    from scipy.spatial import cKDTree

    _, near = cKDTree(view.pixels).query(pixels, k=_NEIGHBOURS)
    return pixels, np.median(view.inverse[near], axis=1)


def _behind_all(view: _Gaps, sources: Sequence[_Gaps], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All of the (Q, 2) positions, at the farthest depth that is tried."""
    return pixels, np.full(len(pixels), view.depths_to_try()[0])


def _rays(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """(..., 3) world rays of depth 1 through (..., 2) positions."""
    local = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return np.concatenate([local, np.ones((*local.shape[:-1], 1))], axis=-1) @ camera.rotation


def _sources(views: Sequence[_Gaps], index: int) -> list[_Gaps]:
    """At most 6 other views that see what a view looks at from an angle of 4 to 40 degrees, those near 12 first."""
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
    """(Q, D) mean difference of colour, of 255, between patches of a view and of the half of the sources where it is
    least.

    Patches are parallel to the image, at (Q, 2) positions and (Q, D) inverse depths. Infinite where fewer than two
    sources see one.
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
        # A point is center + ray / inverse; in the source's camera, up to scale, inverse * (center there) + ray there.
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
    """((..., 3) bilinear samples at (..., 2) positions, (...) whether they lie within the outermost pixel centres)."""
    height, width = image.shape[:2]
    inside = np.asarray(((places >= 0.5) & (places <= [width - 0.5, height - 0.5])).all(-1))
    return sample_bilinear(image, np.where(inside[..., None], places, 0.5)), inside


def _not_in_free_space(points: np.ndarray, views: Sequence[_Gaps], own: int) -> np.ndarray:
    """(P,) whether other views' trusted triangles do not lie behind the points, or many more pass through them."""
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
