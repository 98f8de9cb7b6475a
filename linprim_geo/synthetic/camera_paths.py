"""Camera poses for synthetic captures: rings, spheres and hand-held arcs around an object, walks through a room, and
camera positions inside a room."""

from __future__ import annotations

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.raycast import RayCaster

RING_ELEVATIONS_DEG = (-38.0, 6.0, 42.0)
"""Elevations of the rings of `orbit`: below, level and above, so that all sides of an object are visible."""

FIT_MARGIN = 0.04
"""Margin around the object on each side of the image, as a share of its width or height."""

GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))

ARC_DEG = 300.0
"""Default range of azimuths of the path `arc`."""

ARC_ELEVATIONS_DEG = (12.0, 45.0)
ARC_DISTANCE = 0.1
ARC_AIM = 0.06
ARC_ROLL_DEG = 2.0
"""Hand-held arc: lowest and highest elevation; largest deviation of the distance from its mean, and of the aim from the
object's centre, both in units of the mean distance; largest roll."""

ARC_JITTER = 0.15
"""Share of these deviations that is independent between views; the rest changes slowly along the arc."""

WALK_EYES = (1.2, 1.7)
"""Lowest and highest camera above the floor on the path `walk`, metres."""

WALK_STEP, WALK_TURN_DEG = 0.4, 20.0
"""Metres and degrees of turning that count as equally long on the path `walk`."""

CLEARANCE = 0.03
NEAR = 0.08
OPEN = 0.12
"""Conditions on cameras inside a room, in units of `room_size`: every surface is at least CLEARANCE away, at most a
fifth of a view is nearer than NEAR, and half of all directions see at least OPEN, which excludes cameras in
cupboards."""

LONGEST = 1.6
"""Limits `room_size` in long rooms such as streets: the largest ratio of the diagonal to that of the two shorter
sides."""

ROUNDS = 12
"""Largest number of batches of random positions: enough for rooms with a tenth of free space."""


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray | None = None) -> np.ndarray:
    """Return the (4, 4) world-to-camera pose at `position` that looks at `target`, with `up` (default z) upwards in the
    image."""
    forward = np.asarray(target, dtype=np.float64) - position
    forward = forward / np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, dtype=np.float64)
    if abs(forward @ up) > 0.999 * np.linalg.norm(up):
        up = np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ position
    return pose


def fibonacci_directions(count: int, low: float = -1.0, high: float = 1.0, turn: float = 0.0) -> np.ndarray:
    """Return (count, 3) unit vectors, evenly spread over the zone of the sphere with z between `low` and `high`."""
    index = np.arange(count)
    z = high - (high - low) * (index + 0.5) / count
    angle = GOLDEN_ANGLE * index + turn
    radius = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def around(path: str, views: int, center: np.ndarray, distance: float, *, held_out: bool = False) -> list[np.ndarray]:
    """Return (4, 4) world-to-camera poses that look at `center` from `distance`.

    `orbit`: three rings; `hemisphere`: evenly over the directions at elevations from 5 to 85 degrees; `sphere`: over
    all directions. With `held_out`, poses lie between those, at other elevations and azimuths.
    """
    if path == "orbit":
        rings = np.deg2rad(RING_ELEVATIONS_DEG)
        if held_out:
            rings = 0.5 * (rings[:-1] + rings[1:])
        index = np.arange(views)
        elevation = rings[index % len(rings)]
        per_ring = -(-views // len(rings))
        stagger = (index % len(rings)) / len(rings) + (0.37 if held_out else 0.0)
        azimuth = 2.0 * np.pi * (index // len(rings) + stagger) / per_ring
        directions = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)],
            axis=1,
        )
    elif path in ("hemisphere", "sphere"):
        low, high = (np.sin(np.deg2rad((5.0, 85.0)))) if path == "hemisphere" else (-1.0, 1.0)
        directions = fibonacci_directions(views, low, high, turn=1.3 if held_out else 0.0)
    else:
        raise LinprimError(f"path {path!r} does not go around an object, orbit, hemisphere or sphere is wanted")
    return [look_at(center + distance * direction, center) for direction in directions]


def arc(
    views: int, test_views: int, center: np.ndarray, distance: float, degrees: float, seed: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return training and held-out (4, 4) world-to-camera poses of a hand-held camera that is carried around `center`.

    The azimuths of the training views are equally spaced over `degrees`. Elevation, distance, aim and roll drift slowly
    along the path within the limits above, with independent jitter. Every held-out view lies between two training
    views, at least a quarter of their spacing from both, and has its own jitter.
    """
    poses = []
    # Elevation, distance, aim along x, y and z, roll.
    for way, wander in _wandering(views, test_views, 6, np.random.default_rng([seed, 7])):
        azimuth = np.deg2rad(degrees * (way - 0.5))
        poses.append([_held(center, distance, *item) for item in zip(azimuth, wander, strict=True)])
    return poses[0], poses[1]


def _wandering(
    views: int, test_views: int, count: int, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return, for the training and the held-out views of a hand-held camera, their positions along the path, in (0, 1),
    and `count` values each in [-1, 1]: sums of two slow waves, of one to two and of two to four periods, plus
    independent jitter."""
    frequency = rng.uniform((1.0, 2.0), (2.0, 4.0), (count, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, (count, 2))
    step = (np.arange(test_views) + 0.5) / max(test_views, 1) * (views - 1)
    between = np.floor(step) + 0.25 + 0.5 * (step - np.floor(step))
    both = []
    for place in (np.arange(views, dtype=float), between):
        way = (place + 0.5) / views
        waves = np.sin(2.0 * np.pi * way[:, None, None] * frequency + phase) @ (0.65, 0.35)
        both.append((way, (1.0 - ARC_JITTER) * waves + ARC_JITTER * rng.uniform(-1.0, 1.0, waves.shape)))
    return both


def _held(center: np.ndarray, distance: float, azimuth: float, wander: np.ndarray) -> np.ndarray:
    """Return the (4, 4) world-to-camera pose of one view of `arc`; `wander` (6,) in [-1, 1] sets elevation, distance,
    aim and roll."""
    low, high = np.deg2rad(ARC_ELEVATIONS_DEG)
    elevation = 0.5 * (low + high) + 0.5 * (high - low) * wander[0]
    direction = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    # The deviation over all three axes is at most ARC_AIM.
    target = center + ARC_AIM * distance / np.sqrt(3.0) * wander[2:5]
    return _rolled(look_at(center + distance * (1.0 + ARC_DISTANCE * wander[1]) * direction, target), wander[5])


def _rolled(pose: np.ndarray, share: float) -> np.ndarray:
    """Return the pose rotated about its optical axis by a share of ARC_ROLL_DEG."""
    roll = np.deg2rad(ARC_ROLL_DEG) * share
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
    return turn @ pose


def walk(
    stations: np.ndarray, targets: np.ndarray, views: int, test_views: int, seed: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return training and held-out (4, 4) world-to-camera poses of a hand-held camera that is carried through a room.

    The path on the floor is the closed polyline `stations` (N, 3), metres. The camera looks at `targets` (N, 3), one
    for each station, interpolated in between. For several rounds, repeat the stations. The height above the floor
    (WALK_EYES), the aim and the roll drift and jitter as on an arc. Training views are equally spaced along a length in
    which WALK_STEP metres equal a turn by WALK_TURN_DEG, and the larger of both counts. So neighbours are within both
    if the path is no longer than `views` such steps. Held-out views lie between two training views as on an arc.
    """
    share = np.linspace(0.0, 1.0, 64, endpoint=False)[None, :, None]
    feet, aims = (
        (points[:, None] + share * (np.roll(points, -1, axis=0) - points)[:, None]).reshape(-1, 3)
        for points in (np.asarray(stations, dtype=np.float64), np.asarray(targets, dtype=np.float64))
    )
    feet, aims = np.concatenate([feet, feet[:1]]), np.concatenate([aims, aims[:1]])
    low, high = WALK_EYES
    ahead = aims - feet - (0.0, 0.0, 0.5 * (low + high))
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    step = np.linalg.norm(np.diff(feet, axis=0), axis=1) / WALK_STEP
    turn = np.arccos(np.clip((ahead[1:] * ahead[:-1]).sum(1), -1.0, 1.0)) / np.deg2rad(WALK_TURN_DEG)
    length = np.concatenate([[0.0], np.cumsum(np.maximum(step, turn))])
    poses = []
    # Height, aim along x, y and z, roll.
    for way, wander in _wandering(views, test_views, 5, np.random.default_rng([seed, 8])):
        eyes, looked = (
            np.stack([np.interp(way * length[-1], length, points[:, axis]) for axis in range(3)], axis=1)
            for points in (feet, aims)
        )
        eyes[:, 2] += 0.5 * (low + high) + 0.5 * (high - low) * wander[:, 0]
        reach = np.linalg.norm(looked - eyes, axis=1, keepdims=True)
        looked = looked + ARC_AIM / np.sqrt(3.0) * reach * wander[:, 1:4]
        poses.append([_rolled(look_at(*pair), roll) for *pair, roll in zip(eyes, looked, wander[:, 4], strict=True)])
    return poses[0], poses[1]


def fitting_distance(path: str, vertices: np.ndarray, center: np.ndarray, views: int, camera: Camera) -> float:
    """Return the smallest distance from `center` at which all vertices are inside all images, with a margin.

    Size and focal lengths are those of `camera`; the principal point is assumed in the middle of the image.
    """
    from scipy.spatial import ConvexHull, QhullError

    points = vertices - center
    try:
        points = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        pass  # flat meshes have no hull; all vertices are used instead
    room_x = (0.5 - FIT_MARGIN) * camera.width / camera.fx
    room_y = (0.5 - FIT_MARGIN) * camera.height / camera.fy
    needed = 1.0001 * float(np.linalg.norm(points, axis=1).max())
    for pose in around(path, views, np.zeros(3), 1.0):
        x, y, z = pose[:3, :3] @ points.T
        # |x| / (z + distance) <= room
        needed = max(needed, float((np.abs(x) / room_x - z).max()), float((np.abs(y) / room_y - z).max()))
    return needed


def inside_out(
    caster: RayCaster, views: int, test_views: int, half_angles: tuple[float, float], seed: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return training and held-out (4, 4) world-to-camera poses in the free space of a closed scene.

    Positions are at eye heights and keep a distance from every surface, which is checked by rays in all directions.
    Views are chosen greedily from many candidates: each next one sees most of the points seen least so far, so that
    the surface is covered evenly and from different positions.

    Args:
        half_angles: half the horizontal and vertical field of view, radians.

    Raises:
        LinprimError: there is no free space enclosed by surfaces, or not enough of it.
    """
    rng = np.random.default_rng(seed)
    positions, reach, probe = _free_positions(caster, max(160, 3 * (views + test_views)), rng)
    points, normals = surface_samples(caster, 3000, rng)[:2]
    candidates, sees, station = [], [], []
    tan_x, tan_y = np.tan(half_angles)
    for number, position in enumerate(positions):
        offset = points - position
        length = np.linalg.norm(offset, axis=1)
        facing = np.abs((offset * normals).sum(1)) > 0.2 * length
        # The ray ends 1 % before the point, as the point's own face would hide it.
        visible = facing & ~caster.occluded(position, offset, 0.99)
        for direction in fibonacci_directions(8, -0.6, 0.5, turn=rng.uniform(0.0, 2.0 * np.pi)):
            pose = look_at(position, position + direction)
            x, y, z = pose[:3, :3] @ probe.T
            framed = (z > 0) & (np.abs(x) < tan_x * z) & (np.abs(y) < tan_y * z)
            if framed.any() and np.mean(reach[number][framed] < NEAR * room_size(caster)) > 0.2:
                continue
            x, y, z = pose[:3, :3] @ offset.T
            candidates.append(pose)
            sees.append(visible & (z > 0) & (np.abs(x) < tan_x * z) & (np.abs(y) < tan_y * z))
            station.append(number)
    if len(candidates) < views + test_views:
        raise LinprimError(
            f"inside-out: only {len(candidates)} unobstructed views were found in the free space,"
            f" {views + test_views} are wanted; use fewer views or another path"
        )
    sees, station = np.array(sees, dtype=np.float32), np.array(station)
    free = np.ones(len(candidates), dtype=bool)
    chosen = []
    for count in (views, test_views):
        seen = np.zeros(len(points), dtype=np.float32)
        picked = []
        for _ in range(count):
            if not free.any():
                raise LinprimError(f"inside-out: free space has room for fewer than {views + test_views} views")
            gain = np.where(free, sees @ (1.0 / (1.0 + seen)), -1.0)
            best = int(np.argmax(gain))
            picked.append(candidates[best])
            seen += sees[best]
            free &= station != station[best]
        chosen.append(picked)
    return chosen[0], chosen[1]


def surface_samples(
    caster: RayCaster, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return points (N, 3) on the mesh, uniform by area, with unit normals (N, 3), faces (N,) and barycentric
    coordinates (N, 2)."""
    corners = caster.vertices[caster.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    total = np.cumsum(area)
    face = np.minimum(np.searchsorted(total, rng.uniform(0.0, total[-1], count), side="right"), len(area) - 1)
    root, v = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
    bary = np.stack([root * (1.0 - v), root * v], axis=1)
    weight = np.concatenate([1.0 - bary.sum(1, keepdims=True), bary], axis=1)
    normals = cross[face] / area[face, None]
    return np.einsum("nc,ncd->nd", weight, corners[face]), normals, face, bary


def room_size(caster: RayCaster) -> float:
    """Return the diagonal of the bounding box, but at most LONGEST times the diagonal of its two shorter sides."""
    return min(caster.diagonal, LONGEST * float(np.linalg.norm(np.sort(caster.upper - caster.lower)[:2])))


def _free_positions(caster: RayCaster, wanted: int, rng: np.random.Generator):
    """Return camera positions (P, 3), the distances (P, D) to the surface from them, and the ray directions (D, 3)."""
    probe = fibonacci_directions(192)
    extent = caster.upper - caster.lower
    low = caster.lower + extent * np.array([0.04, 0.04, 0.3])
    high = caster.upper - extent * np.array([0.04, 0.04, 0.2])
    kept, reach, size = [], [], room_size(caster)
    for _ in range(ROUNDS):
        positions = rng.uniform(low, high, (wanted, 3))
        rays = np.tile(probe, (wanted, 1))
        distance = caster.cast(np.repeat(positions, len(probe), axis=0), rays)[0].reshape(wanted, -1)
        good = distance.min(1) > CLEARANCE * size
        good &= np.median(distance, axis=1) > OPEN * size
        good &= np.isfinite(distance).mean(axis=1) > 0.9
        kept.append(positions[good])
        reach.append(distance[good])
        if sum(map(len, kept)) >= wanted:
            break
    positions, reach = np.concatenate(kept)[:wanted], np.concatenate(reach)[:wanted]
    if len(positions) == 0:
        raise LinprimError(
            "inside-out: no free space with surfaces all around it was found in the mesh;"
            " orbit or hemisphere is for objects seen from outside"
        )
    return positions, reach, probe
