"""The training frame, from cameras and points, and random initial points for captures without points on surfaces.

Random points fill the visual hull of the masks, or the space that several cameras see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.types import PointCloud, Scene, View
from linprim_geo.geometry.camera import Camera, Similarity
from linprim_geo.geometry.region import focus_point
from linprim_geo.imaging import photos

# In the training frame the median distance of the cameras from what they look at is this; learning rates assume it.
CAMERA_DISTANCE = 3.0
# Distances below this share of the coordinates are taken for rounding errors of the poses.
_SAME_PLACE = 1e-9
# Smallest number of points in a camera's image for the camera to count in the normalisation.
_MIN_POINTS_SEEN = 8
# Approximate longer side of the reduced photographs in pixels, and the largest number of them.
_SMALL_SIZE = 512
_MOST_SMALL_VIEWS = 200
# Smallest alpha that counts as foreground; half-covered edge pixels do.
_FOREGROUND = 16
# A point stays in the visual hull if at most this share of the views show background there: masks have errors.
_MASK_ERRORS = 0.02
# A point of the visual hull must lie inside the image of at least this share of the views, and of at least two.
_HULL_MIN_SEEN = 0.3
_HULL_ROUNDS = 4
_HULL_SAMPLES = 100_000
_HULL_MAX_BATCHES = 400
# Range of depths in `frusta_points`, relative to the typical distance to what the cameras look at.
_FRUSTA_DEPTHS = (0.15, 4.0)
_FRUSTA_SEEN = 3
_FRUSTA_BATCHES = 20
_COLOR_VIEWS = 24


# A point's plane is fitted to its _PLANE_POINTS nearest points, including itself. Flatness below _THINNEST is not
# trusted, because points have errors.
_PLANE_POINTS = 10
_THINNEST = 0.1


@dataclass(frozen=True)
class VolumePoints(PointCloud):
    """Points that mark the space where surfaces may be, not points on surfaces."""


def local_planes(xyz: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Fit a plane to each of (P, 3) points and its 9 nearest.

    Returns: (P, 4) unit quaternions (w, x, y, z) whose third axis is the plane's normal, with a random rotation about
    it, and (P,) the flatness. Flatness is the root of the smallest divided by the middle eigenvalue of the covariance:
    0.1 (and not less) for a plane, about 0.6 for points throughout a volume, and 1 for fewer than 4 points.
    """
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng([seed, 7])
    count = min(_PLANE_POINTS, len(xyz))
    if count < 4:
        rotation = rng.normal(size=(len(xyz), 4))
        return rotation / np.linalg.norm(rotation, axis=1, keepdims=True), np.ones(len(xyz))
    near = xyz[cKDTree(xyz).query(xyz, k=count)[1]]
    near = near - near.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", near, near))
    spread = np.maximum(spread, 0.0)
    middle = np.maximum(spread[:, 1], np.finfo(float).tiny)
    flat = np.clip(np.sqrt(spread[:, 0] / middle), _THINNEST, 1.0)
    normal, across = axes[:, :, 0], axes[:, :, 1]
    turn = rng.uniform(0.0, 2.0 * np.pi, (len(xyz), 1))
    first = np.cos(turn) * across + np.sin(turn) * np.cross(normal, across)
    frame = np.stack([first, np.cross(normal, first), normal], axis=2)
    return np.roll(Rotation.from_matrix(frame).as_quat(), 1, axis=1), flat


def scene_normalization(scene: Scene) -> Similarity:
    """Return the similarity to the training frame, where the scene is centred on the origin and the median camera
    distance is 3.

    If there are points, a camera looks at the median position of those in its image, at their median depth. Otherwise
    all cameras look at the point closest to all optical axes (least squares without outliers), if there is one. For
    cameras without points that look outward or in parallel, their own centre and spread are used.

    Raises:
        LinprimError: all cameras are in one place and there are no points.
    """
    target, distance = scene_center_and_distance(scene)
    size = max(np.abs(view.camera.center).max() for view in scene.train)
    if not distance > _SAME_PLACE * size:
        raise LinprimError(
            f"{scene.root}: all cameras are in one place and there are no points, wanted one or the other"
        )
    x, y, z = (float(value) for value in target)
    return Similarity(CAMERA_DISTANCE / distance, (x, y, z))


def scene_center_and_distance(scene: Scene) -> tuple[np.ndarray, float]:
    """Return the (3,) centre of what the training cameras look at, and their median distance to it, in the data set's
    frame."""
    cameras = [view.camera for view in scene.train]
    if scene.points is not None:
        found = _looked_at_points(cameras, scene.points.xyz)
        if found is not None:
            return found
    centers = np.array([camera.center for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    focus = focus_point(centers, axes)
    if focus is not None:
        return focus, float(np.median(((focus - centers) * axes).sum(axis=1)))
    center = np.median(centers, axis=0)
    return center, float(np.median(np.linalg.norm(centers - center, axis=1)))


def visual_hull_points(scene: Scene, count: int, seed: int) -> VolumePoints:
    """Return `count` points distributed uniformly in the visual hull of the training views' masks, coloured from the
    images.

    A point is carved away if more than 2 % of the views see background there. Outside an image is background if the
    foreground touches none of its borders, else unknown. Points are drawn from a box: it starts as the cube around what
    the cameras look at that reaches to the farthest camera, and shrinks to what is left, with masks grown by a few
    pixels so that no thin part is lost. A colour is the mean over views, without regard to occlusion.

    Raises:
        LinprimError: the views have no masks, or nothing is left.
    """
    if not scene.has_alpha:
        raise LinprimError(f"{scene.root}: the images have no alpha channel and no masks, wanted one for a visual hull")
    rng = np.random.default_rng(seed)
    small_views = evenly_spread_views(scene.train, _MOST_SMALL_VIEWS)
    box = _hull_box(scene, small_views, rng)
    kept, total, batches = [], 0, 0
    while total < count and batches < _HULL_MAX_BATCHES:
        points = rng.uniform(box[0], box[1], (_HULL_SAMPLES, 3))
        kept.append(points[_inside_hull(points, small_views, grow=0)])
        total += len(kept[-1])
        batches += 1
        if batches == 20 and not total:
            break
    if not total:
        raise LinprimError(
            f"{scene.root}: no point is foreground in the masks of all {len(small_views)} training views,"
            " wanted masks that fit the cameras"
        )
    xyz = np.concatenate(kept)[:count]
    if len(xyz) < count:  # very thin hull: repeat the points that were found
        xyz = xyz[rng.integers(0, len(xyz), count)]
    return VolumePoints(xyz, _colors(xyz, small_views))


def frusta_points(scene: Scene, count: int, seed: int) -> VolumePoints:
    """Return `count` random points in the space that several training cameras see, with mean colours. This is the last
    resort.

    They are drawn along random pixels of random cameras, with log-uniform depth from 0.15 to 4 times the distance to
    what the cameras look at. Points that three cameras see are kept; if they are too few, points that fewer cameras see
    fill up.

    Raises:
        LinprimError: the scale is unknown, as in `scene_normalization`.
    """
    rng = np.random.default_rng(seed)
    distance = CAMERA_DISTANCE / scene_normalization(scene).scale
    cameras = [view.camera for view in scene.train]
    low, high = np.log(_FRUSTA_DEPTHS[0] * distance), np.log(_FRUSTA_DEPTHS[1] * distance)
    found: list[list[np.ndarray]] = [[] for _ in range(_FRUSTA_SEEN)]  # index: number of cameras that see them, - 1
    for _ in range(_FRUSTA_BATCHES):
        points = _along_pixels(cameras, 2 * count, low, high, rng)
        seen = np.zeros(len(points), dtype=np.int64)
        for camera in cameras:
            seen += in_image(camera, points)[0]
        for number in range(_FRUSTA_SEEN):
            exact = seen == number + 1 if number + 1 < _FRUSTA_SEEN else seen >= _FRUSTA_SEEN
            found[number].append(points[exact])
        if sum(len(points) for points in found[-1]) >= count:
            break
    xyz = np.concatenate([np.concatenate(points) for points in reversed(found)])[:count]
    return VolumePoints(xyz, _colors(xyz, evenly_spread_views(scene.train, _COLOR_VIEWS)))


class SmallView:
    """A training view reduced to the resolution needed to choose points: camera and photograph.

    `rgb` (h, w, 3) uint8; `foreground` (h, w) bool, None without alpha; `open`: whether the foreground touches the
    border of the image.
    """

    def __init__(self, view: View):
        photo = view.load()
        factor = max(1, max(view.camera.width, view.camera.height) // _SMALL_SIZE)
        self.rgb, alpha = photos.box_downscale(photo.rgb, photo.alpha, factor)
        height, width = self.rgb.shape[:2]
        c = view.camera
        self.camera = Camera(
            width, height, c.fx / factor, c.fy / factor, c.cx / factor, c.cy / factor, c.world_to_camera
        )
        self.foreground = None if alpha is None else alpha >= _FOREGROUND
        self.open = False
        if self.foreground is not None:
            edges = self.foreground[[0, -1]].any() or self.foreground[:, [0, -1]].any()
            self.open = bool(edges)


def evenly_spread_views(views: Sequence[View], limit: int) -> list[SmallView]:
    """Return reduced copies of at most `limit` views, evenly spread over their order.

    Raises:
        LinprimError: a photograph cannot be read.
    """
    chosen = np.unique(np.linspace(0, len(views) - 1, min(limit, len(views))).round().astype(int))
    return [SmallView(views[i]) for i in chosen]


def _hull_box(scene: Scene, small_views: Sequence[SmallView], rng: np.random.Generator) -> np.ndarray:
    """Return (2, 3) corners of a box around the visual hull, refined in several rounds."""
    cameras = [small_view.camera for small_view in small_views]
    center, distance = scene_center_and_distance(scene)
    half = max(np.linalg.norm(camera.center - center) for camera in cameras)
    half = max(half, distance)
    box = np.stack([center - half, center + half])
    for _ in range(_HULL_ROUNDS):
        points = rng.uniform(box[0], box[1], (_HULL_SAMPLES, 3))
        # Mean distance between samples: masks are grown by what may lie between two of them.
        spacing = (np.prod(box[1] - box[0]) / _HULL_SAMPLES) ** (1 / 3)
        grow = [int(np.ceil(spacing * camera.fx / distance)) for camera in cameras]
        grow = [
            min(max(value, 1), max(small_view.rgb.shape[:2]) // 8)
            for value, small_view in zip(grow, small_views, strict=True)
        ]
        inside = points[_inside_hull(points, small_views, grow)]
        if not len(inside):
            break
        box_new = np.stack([inside.min(axis=0) - spacing, inside.max(axis=0) + spacing])
        box = np.stack([np.maximum(box[0], box_new[0]), np.minimum(box[1], box_new[1])])
    return box


def _inside_hull(points: np.ndarray, small_views: Sequence[SmallView], grow: int | Sequence[int]) -> np.ndarray:
    """Return (P,) whether enough views see the points and hardly any shows background there."""
    allowed = int(_MASK_ERRORS * len(small_views))
    needed = max(2, int(np.ceil(_HULL_MIN_SEEN * len(small_views))))
    alive = np.arange(len(points))
    against, seen = np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=np.int64)
    grow = [grow] * len(small_views) if isinstance(grow, int) else grow
    for small_view, radius in zip(small_views, grow, strict=True):
        assert small_view.foreground is not None, "a visual hull is made of masks"
        mask = _grown(small_view.foreground, radius)
        inside, row, column = in_image(small_view.camera, points[alive])
        background = np.zeros(len(alive), dtype=bool) if small_view.open else ~inside
        background[inside] = ~mask[row[inside], column[inside]]
        against[alive] += background
        seen[alive] += inside
        alive = alive[against[alive] <= allowed]
        if not len(alive):
            break
    result = np.zeros(len(points), dtype=bool)
    result[alive] = seen[alive] >= needed
    return result


def _grown(mask: np.ndarray, radius: int) -> np.ndarray:
    """Return the mask dilated by `radius` pixels (a square)."""
    if radius == 0:
        return mask
    from scipy.ndimage import maximum_filter

    return maximum_filter(mask, size=2 * radius + 1, mode="nearest")


def in_image(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (P,) whether points are in front of the camera and in its image, and their (P,) rows and (P,) columns,
    which are valid only there."""
    pixels, depth = camera.project(points)
    inside = camera.shows(pixels, depth)
    cells = np.where(inside[:, None], pixels, 0.0).astype(np.int64)
    return inside, cells[:, 1], cells[:, 0]


def _along_pixels(cameras: Sequence[Camera], count: int, low: float, high: float, rng) -> np.ndarray:
    """Return (count, 3) points on rays through random pixels of random cameras, with ln(depth) uniform in [low,
    high]."""
    which = rng.integers(0, len(cameras), count)
    position, depth = rng.uniform(0, 1, (count, 2)), np.exp(rng.uniform(low, high, count))
    points = np.empty((count, 3))
    for index, camera in enumerate(cameras):
        mine = which == index
        x = (position[mine, 0] * camera.width - camera.cx) / camera.fx
        y = (position[mine, 1] * camera.height - camera.cy) / camera.fy
        rays = np.stack([x, y, np.ones(len(x))], axis=1) @ camera.rotation
        points[mine] = camera.center + depth[mine, None] * rays
    return points


def _colors(points: np.ndarray, small_views: Sequence[SmallView]) -> np.ndarray:
    """Return (P, 3) uint8 mean colours of the foreground pixels that the points project to, or the images' mean colour
    if there are none."""
    total, weight = np.zeros((len(points), 3)), np.zeros(len(points))
    step = max(1, len(small_views) // _COLOR_VIEWS)
    for small_view in small_views[::step]:
        inside, row, column = in_image(small_view.camera, points)
        if small_view.foreground is not None:
            inside[inside] = small_view.foreground[row[inside], column[inside]]
        total[inside] += small_view.rgb[row[inside], column[inside]]
        weight[inside] += 1.0
    shown = [
        small_view.rgb.reshape(-1, 3) if small_view.foreground is None else small_view.rgb[small_view.foreground]
        for small_view in small_views
    ]
    usual = np.mean([pixels.mean(axis=0) for pixels in shown if len(pixels)] or [np.full(3, 128.0)], axis=0)
    mean = np.where(weight[:, None] > 0, total / np.maximum(weight, 1.0)[:, None], usual)
    return np.clip(mean + 0.5, 0, 255).astype(np.uint8)


def _looked_at_points(cameras: Sequence[Camera], xyz: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return the median, over cameras, of the median position and depth of the points in each image; None if too few
    cameras see points."""
    targets, depths = [], []
    for camera in cameras:
        inside = in_image(camera, xyz)[0]
        if inside.sum() < _MIN_POINTS_SEEN:
            continue
        seen = xyz[inside]
        targets.append(np.median(seen, axis=0))
        depths.append(np.median((seen - camera.center) @ camera.rotation[2]))
    if len(targets) < max(2, len(cameras) // 4):
        return None
    return np.median(np.array(targets), axis=0), float(np.median(depths))
