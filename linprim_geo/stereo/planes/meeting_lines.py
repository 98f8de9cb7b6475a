"""Correct walls by the lines along which they meet the floor and each other.

Shading leaves the angle of a plain wall open by degrees, and points on objects that hang on a wall give a plane in
front of it. A floor with texture is known exactly as a rule. Of the candidate lines on it near its intersection with a
wall, the one that views from different directions show most clearly is taken. The wall is set on that line, at right
angles to the floor. A wall whose foot is hidden is set on the line along which it meets another corrected wall. A
leaning plane, such as a slope under a roof, is fitted to the lines along which it meets several of these.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.planes.edge_images import BLUR, BY_CHANCE, LEAST_PIXELS, SHOWN, EdgeImages, by_chance
from linprim_geo.stereo.planes.enclosing_planes import BEYOND, ScenePoints
from linprim_geo.stereo.planes.plain_regions import SAME_ANGLE, has_wide_baseline
from linprim_geo.stereo.planes.point_planes import confirmed_points
from linprim_geo.stereo.planes.right_angles import MOST_ANGLE_ERROR, NEARLY, at_right_angles

# A line is searched within this share of its distance around the intersection of the planes: the error of planes of
# shading. If the wall has points all over, the line is known to CONFIRMED_DEPTH, even if these are on objects that hang
# on it.
REACH = 5 * CONFIRMED_DEPTH
# Candidate lines are one blur of the photographs apart at their ends, with at most MOST_STEPS to either side; each is
# sampled at SAMPLES points.
MOST_STEPS, SAMPLES = 20, 128
# A line of which a view shows less than this share of what it shows of another one is occluded: what shows through gaps
# is the upper edge of a skirting board, or the like.
LEAST_SHOWN = 0.5
# The strongest edges are searched up to AROUND steps around the line, in steps of 1 / FINER pixel, and a line is fitted
# to them. This is done in ROUNDS, as an error of the first line cuts off edges.
AROUND, FINER, ROUNDS = 2, 4, 2
# Iterations of a reweighted fit, in which each edge has less weight the farther it is from the line.
FITS = 20


def on_meeting_lines(
    planes: np.ndarray, by_points: int, maps: Sequence[DepthMap], known: Sequence[np.ndarray]
) -> dict[int, np.ndarray]:
    """Return those of (K, 4) planes n . x = d, by their number, that photographs show to be walls on a line, corrected:
    on a floor, or else at a wall that is.

    Args:
        by_points: the number of leading planes with points all over. They are not changed; duplicates of them among the
            others may be.
        known: (H, W) confirmed depth of every view, NaN elsewhere.
    """
    points, _ = confirmed_points(maps, known)
    seen = ScenePoints([found.camera for found in maps], points)
    floors = floors_of([seen.facing(plane) for plane in planes[:by_points]], seen) if len(points) else []
    if not floors:
        return {}
    edges, found = EdgeImages(maps, known), dict[int, np.ndarray]()
    walls = {number: seen.facing(planes[number]) for number in range(by_points, len(planes))}
    walls = {number: wall for number, wall in walls.items() if seen.is_before_all(wall)}
    has_points = {k: any(is_same(wall, plane) for plane in planes[:by_points]) for k, wall in walls.items()}
    for floor in floors:
        for number in sorted(walls.keys() - found.keys()):
            wall = walls[number]
            near = _foot(wall, floor, seen) if at_right_angles(wall, floor) else None
            if near is not None:
                line = _line_of_wall(wall, floor, near, edges, has_points[number])
                if line is not None:
                    found[number] = _through(line, np.cross(line[1] - line[0], floor[:3]), wall)
    up = floors[0]
    for base in list(found.values()):
        for number in sorted(walls.keys() - found.keys()):
            wall = walls[number]
            if at_right_angles(wall, base) and at_right_angles(wall, up):
                line = _line_of_wall(wall, base, _corner(wall, base, up, seen), edges, has_points[number])
                if line is not None:
                    found[number] = _through(line, np.cross(up[:3], base[:3]), wall)
    standing = [*floors, *found.values()]
    for number in sorted(walls.keys() - found.keys()):
        # Planes that are nearly upright or level do not lean.
        if has_points[number] or at_right_angles(walls[number], up) or abs(walls[number][:3] @ up[:3]) > np.cos(NEARLY):
            continue
        leaning = _leaning(walls[number], standing, seen, edges)
        if leaning is not None:
            found[number] = leaning
    return {k: plane if plane[:3] @ planes[k, :3] > 0 else -plane for k, plane in found.items()}


def is_same(plane: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two planes (4,) are equal, up to the sign of their normals."""
    return np.allclose(plane, other) or np.allclose(plane, -other)


def floors_of(planes: Sequence[np.ndarray], seen: ScenePoints) -> list[np.ndarray]:
    """Return those planes with points all over, their normals towards the cameras, that are floors: level, with nothing
    below. The one with the most points comes first. A floor nearly parallel to a level plane with more points gets its
    normal: the floor below a table, which few views show, may be askew."""
    level = sorted(filter(seen.is_level, planes), key=lambda plane: -np.count_nonzero(seen.on(plane)))
    floors: list[np.ndarray] = []
    for plane in level:
        if seen.is_before_all(plane):
            normal = next(other[:3] for other in level if other[:3] @ plane[:3] > np.cos(NEARLY))
            own = seen.points.on(plane[None], CONFIRMED_DEPTH)[:, 0]
            floors.append(np.append(normal, np.median(seen.points.position[own] @ normal)))
    return floors


def meeting_of(wall: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a point (3,) on both planes, and the unit direction (3,) of their intersection."""
    along = np.cross(base[:3], wall[:3])
    along /= np.linalg.norm(along)
    return np.linalg.solve(np.stack([base[:3], wall[:3], along]), [base[3], wall[3], 0.0]), along


def _foot(wall: np.ndarray, floor: np.ndarray, seen: ScenePoints) -> np.ndarray | None:
    """Return the (2, 3) ends of the line along which a wall meets a floor, as far as points of the floor are near it,
    or None."""
    meeting, along = meeting_of(wall, floor)
    on_floor = seen.points.position[seen.points.on(floor[None], CONFIRMED_DEPTH)[:, 0]]
    apart = np.abs((on_floor - meeting) @ np.cross(along, floor[:3]))
    beside = on_floor[apart < REACH * np.linalg.norm(seen.centers.mean(0) - meeting)]
    if len(beside) < LEAST_PIXELS:
        return None
    return meeting + along * np.quantile(beside @ along, [BEYOND, 1 - BEYOND])[:, None]


def _corner(wall: np.ndarray, base: np.ndarray, floor: np.ndarray, seen: ScenePoints) -> np.ndarray:
    """Return the (2, 3) ends of the line along which two walls meet, from the floor up to the highest camera."""
    meeting, along = meeting_of(wall, base)
    levels = np.array([floor[3], (seen.centers @ floor[:3]).max()])
    return meeting + along * ((levels - meeting @ floor[:3]) / (along @ floor[:3]))[:, None]


def _line_of_wall(
    wall: np.ndarray, base: np.ndarray, near: np.ndarray, edges: EdgeImages, has_points: bool
) -> np.ndarray | None:
    """Return the `clearest_line`. For a wall that `has_points` all over, reject lines in front of these: the points may
    be on objects that hang on the wall, but a line in front of them is a skirting board, or the edge of a rug."""
    line = clearest_line(wall, base, near, edges, CONFIRMED_DEPTH if has_points else REACH)
    if line is not None and has_points and line.mean(0) @ wall[:3] > wall[3]:
        return None
    return line


def _through(line: np.ndarray, normal: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """Return the plane (4,) with this normal through the middle of a line's (2, 3) ends, on the side of a wall's
    normal."""
    normal = normal / (np.linalg.norm(normal) * np.sign(normal @ wall[:3]))
    return np.append(normal, normal @ line.mean(0))


def _leaning(
    wall: np.ndarray, standing: Sequence[np.ndarray], seen: ScenePoints, edges: EdgeImages
) -> np.ndarray | None:
    """Fit a plane (4,) to the lines along which a wall meets `standing` planes, without outliers. None if the wall
    already holds these lines, or if they do not determine its normal."""
    lines = list[np.ndarray]()
    for base in standing:
        apart = np.arccos(min(1.0, abs(wall[:3] @ base[:3])))
        near = _foot(wall, base, seen) if apart > MOST_ANGLE_ERROR else None
        line = clearest_line(wall, base, near, edges) if near is not None else None
        if line is not None:
            lines.append(line)
    if len(lines) < 2:
        return None
    steps = ((np.arange(SAMPLES) + 0.5) / SAMPLES)[:, None]
    places = np.stack([line[0] + steps * (line[1] - line[0]) for line in lines])
    away = np.linalg.norm(seen.centers.mean(0) - places.mean(1), axis=1)
    length = np.linalg.norm([line[1] - line[0] for line in lines], axis=1)
    plane, weight = wall, length
    for _ in range(FITS):
        middle, _, axes = _spread(places, weight)
        normal = axes[:, 0] * np.sign(axes[:, 0] @ wall[:3])
        plane = np.append(normal, normal @ middle)
        weight = length / np.maximum(CONFIRMED_DEPTH / FINER, _off(plane, places) / away)
    on_it = _off(plane, places) < CONFIRMED_DEPTH * away
    if not on_it.any() or (_off(wall, places) < CONFIRMED_DEPTH * away)[on_it].all():
        return None
    # The normal is as certain as the lines are spread along the narrower side.
    middle, variance, _ = _spread(places[on_it], length[on_it])
    wide = np.sqrt(max(variance[1], 0)) * np.tan(SAME_ANGLE) > BLUR * edges.pixel_at(middle)
    return plane if wide and plane[:3] @ wall[:3] > np.cos(MOST_ANGLE_ERROR) else None


def _off(plane: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return (N,) mean distances of points (N, P, 3) from a plane."""
    return np.abs(places @ plane[:3] - plane[3]).mean(1)


def _spread(places: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the weighted mean (3,) of N sets of points (N, P, 3) with `weight` (N,), and their principal axes:
    ascending variances (3,) and columns (3, 3)."""
    share = (weight / weight.sum()).repeat(places.shape[1]) / places.shape[1]
    points = places.reshape(-1, 3)
    middle = share @ points
    variance, axes = np.linalg.eigh((points - middle).T @ ((points - middle) * share[:, None]))
    return middle, variance, axes


def clearest_line(
    wall: np.ndarray, base: np.ndarray, near: np.ndarray, edges: EdgeImages, reach: float = REACH
) -> np.ndarray | None:
    """Return the (2, 3) ends of the line on a base that photographs show most clearly around the line `near` (2, 3)
    along which a wall meets it. None if they show none, or if it is farther away than the share `reach` of its
    distance."""
    inward = wall[:3] - base[:3] * (wall[:3] @ base[:3])
    inward /= np.linalg.norm(inward)
    middle = near.mean(0)
    distance = float(np.median([np.linalg.norm(camera.center - middle) for camera in edges.cameras]))
    pixel = edges.pixel_at(middle)
    apart = max(BLUR * pixel, REACH * distance / MOST_STEPS)
    steps = np.arange(-REACH * distance, REACH * distance + apart / 2, apart)
    moved = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    starts, ends = (end + moved[:, [k]] * inward for k, end in enumerate(near))
    shares = edges.shares(starts, ends - starts, (np.arange(SAMPLES) + 0.5) / SAMPLES, 1, LEAST_SHOWN)
    chance = by_chance(shares)[:, 0]
    best = int(chance.argmin())
    if chance[best] + np.log(len(chance)) > np.log(BY_CHANCE):
        return None
    if np.abs(moved[best]).max() > min(reach * distance, steps[-1] - apart / 2):
        return None
    showing = np.flatnonzero(shares[:, best, 0] <= SHOWN)
    line = np.stack([starts[best], ends[best]])
    if not has_wide_baseline(edges.cameras, showing, line.mean(0)):
        return None
    for _ in range(ROUNDS):
        fitted = _fitted_line(line, inward, apart, pixel, edges)
        if fitted is None:
            return None
        line = fitted
    return line


def _fitted_line(
    line: np.ndarray, inward: np.ndarray, apart: float, pixel: float, edges: EdgeImages
) -> np.ndarray | None:
    """Fit a line to the strongest edges of photographs around one. Return its (2, 3) ends, or None if there are too few
    edges."""
    across = np.arange(-AROUND * apart, AROUND * apart, pixel / FINER)
    along = (np.arange(2 * SAMPLES) + 0.5) / (2 * SAMPLES)
    lines = line[0] + across[:, None] * inward
    places, off = list[np.ndarray](), list[np.ndarray]()
    for changes in edges.changes(lines, (line[1] - line[0])[None], along):
        if changes is None:
            continue
        shown = np.isfinite(changes[0]).all(0)
        if not shown.any():
            continue
        change = changes[0][:, shown]
        change *= np.sign(np.median(change[len(across) // 2]))
        strongest = change.argmax(0)
        taken = (strongest > 0) & (strongest < len(across) - 1)
        places.append(along[shown][taken])
        off.append(across[strongest[taken]])
    at, moved = (np.concatenate(each) if each else np.zeros(0) for each in (places, off))
    if len(at) < LEAST_PIXELS or np.ptp(at) == 0:
        return None
    ends, weight = np.stack([1 - at, at], axis=1), np.ones(len(at))
    for _ in range(FITS):
        found = np.linalg.solve((ends * weight[:, None]).T @ ends, (ends * weight[:, None]).T @ moved)
        residual = np.abs(moved - ends @ found)
        weight = 1 / np.maximum(1, residual / max(float(np.median(residual)), pixel / FINER))
    return line + found[:, None] * inward
