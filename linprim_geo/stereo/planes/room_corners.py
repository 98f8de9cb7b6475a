"""Find plain walls by the edges in which they meet each other and the floor.

The line along which a floor ends does not tell what is there: a wall, or nothing, as at the end of a table. In the
corner of a room, however, two walls meet in an edge at right angles to the floor. Photographs show that edge even
between plain walls, as they are lit from different sides. Such edges are searched around the corners of known floors
(`edge_images.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.points.view_pairs import visible_pixels
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.planes.edge_images import BLUR, BY_CHANCE, SHOWN, EdgeImages, by_chance
from linprim_geo.stereo.planes.enclosing_planes import CELLS, FILLED, MARGIN, EnclosingPlane, ScenePoints
from linprim_geo.stereo.planes.floor_sides import FloorSide, inner_sides, outer_sides
from linprim_geo.stereo.planes.meeting_lines import clearest_line, meeting_of
from linprim_geo.stereo.planes.plain_regions import SAME_ANGLE, has_wide_baseline
from linprim_geo.stereo.planes.point_planes import SurfacePoints
from linprim_geo.stereo.planes.right_angles import at_right_angles

# A corner is searched within this share of the longer side of a floor's rectangle around the rectangle's corner: its
# ends are known to END_MARGIN, and windows of stereo reach beyond an edge.
REACH = 0.05
# Candidate places are one blur of the photographs apart, with at most MOST_STEPS to either side. Around the best one
# they are FINER times as dense.
MOST_STEPS, FINER = 20, 5
# The number of candidate heights of an edge, evenly spaced up to the longer side of its floor; samples along the edge
# between two of these; and the least height as a share of the median height of the cameras: a table's edges are lower.
HEIGHTS, SAMPLES, LOWEST = 16, 8, 0.5
STEPS = (np.arange(HEIGHTS * SAMPLES) + 0.5) / (HEIGHTS * SAMPLES)
# An edge continues upwards while chance alone would show one in its next part in at most this share of cases.
GOES_ON = 0.05
# Candidate directions of a wall, within SAME_ANGLE to either side.
DIRECTIONS = 61
# Behind a wall a floor has less than this share of the points in front of it, in strips of equal width.
BEHIND_SHARE = 0.1
# A wall is sampled at PLACES by PLACES points. It is rejected if more than MOST_BACKGROUND of the views of them see a
# background there.
PLACES, MOST_BACKGROUND = 16, 0.5


@dataclass(frozen=True)
class Corner:
    """An edge that stands on a floor: its `place` (2,) along the floor's axes, and its `height` along the floor's
    normal."""

    place: np.ndarray
    height: float


def with_corner_walls(
    maps: Sequence[DepthMap],
    known: Sequence[np.ndarray],
    backgrounds: Sequence[np.ndarray],
    enclosing: Sequence[EnclosingPlane],
    points: SurfacePoints,
) -> list[EnclosingPlane]:
    """Return the `enclosing` planes, and plain walls that rise from those of them that are floors.

    Walls rise on the sides of a floor's rectangle, and where the floor ends within it, in a room that is not convex. A
    wall needs an edge at either end; or one edge, and another along the floor; or one edge at which it meets such a
    wall or a known one. It is as high as its edges and reaches from one to the other, or to the end of its floor. The
    floor has to be known along at least half of the wall and end there. A known plane that holds all of the wall is
    extended by it. Planes that close the scene are kept only if they meet another along an edge, and are moved there.

    Args:
        known: (H, W) depth of every view, NaN where unknown.
        backgrounds: (H, W) bool of every view.
        points: at known depths.
    """
    cameras = [found.camera for found in maps]
    seen = ScenePoints(cameras, points)
    if not any(plane.closes or seen.is_level(plane.normal) for plane in enclosing):
        return list(enclosing)
    edges = EdgeImages(maps, known)
    own = [plane for plane in enclosing if not plane.closes]
    shown = (set_on_edge(plane, own, edges) for plane in enclosing if plane.closes)
    planes = own + [plane for plane in shown if plane is not None]
    floors = [plane for plane in planes if seen.is_level(plane.normal)]
    for floor in floors:
        for wall, same in _walls_on(floor, planes, edges, seen):
            if _is_seen_past(wall, cameras, known, backgrounds):
                continue
            if same is None:
                planes.append(wall)
            elif seen.are_on(wall.corners(), planes[same]):
                planes[same] = planes[same].with_place_for(wall.corners())
    return planes


def set_on_edge(plane: EnclosingPlane, others: Sequence[EnclosingPlane], edges: EdgeImages) -> EnclosingPlane | None:
    """Shift a plane that closes the scene to an edge along which it meets one of `others` at right angles in
    photographs; of several the nearest. None if they show none."""
    offsets = []
    for base in others:
        if not at_right_angles(plane.normal, base.normal):
            continue
        meeting, along = meeting_of(plane.as_vector(), base.as_vector())
        ends = base.corners() @ along
        near = meeting + along * np.array([ends.min(), ends.max()])[:, None]
        line = clearest_line(plane.as_vector(), base.as_vector(), near, edges)
        if line is not None:
            offsets.append(float(plane.normal @ line.mean(0)))
    if not offsets:
        return None
    return replace(plane, offset=min(offsets, key=lambda offset: abs(offset - plane.offset)))


@dataclass(frozen=True)
class _Rising:
    """A candidate wall on a side of a floor, the index of the known plane that it is or None, the (2,) places of its
    corners, and whether photographs show enough of it to accept it by itself."""

    wall: EnclosingPlane
    same: int | None
    corners: list[np.ndarray]
    sure: bool

    def meets(self, places: Sequence[np.ndarray], near: float) -> bool:
        """Return whether a corner of the wall is within `near` of one of `places`."""
        return any(np.linalg.norm(own - other) < near for own in self.corners for other in places)


def _walls_on(
    floor: EnclosingPlane, others: Sequence[EnclosingPlane], edges: EdgeImages, seen: ScenePoints
) -> list[tuple[EnclosingPlane, int | None]]:
    """Find walls on the sides of the rectangle around a floor's own points, and where the floor ends within. Return
    each with the index of the one of `others` that it is, or None."""
    lowest = LOWEST * float(np.median(seen.centers @ floor.normal - floor.offset))
    on_floor = seen.points.on(floor.as_vector()[None], CONFIRMED_DEPTH)[:, 0]
    places, margin = seen.points.position[on_floor] @ floor.axes.T, MARGIN * seen.distance[on_floor]
    near = REACH * _longer_side(floor)
    corner_at: dict[tuple[float, ...], Corner | None] = {}
    found, at_sure = list[_Rising](), list[np.ndarray]()
    for side in [*outer_sides(floor.own), *inner_sides(floor.own, places)]:
        for end in (side.low, side.high):
            if tuple(end) not in corner_at:
                corner_at[tuple(end)] = find_corner(floor, end, lowest, edges)
        ends = [corner_at[tuple(end)] for end in (side.low, side.high)]
        line = _line(floor, side, ends, edges)
        if line is None:
            continue
        inward = floor.axes[side.across] if side.end == 0 else -floor.axes[side.across]
        wall = _wall(floor, line, inward, max(corner.height for corner in ends if corner), side.inner)
        same = seen.which_is_there(wall, others)
        corners = [corner.place for corner in ends if corner]
        if same is not None:
            at_sure += corners
        if not _ends_at(line, inward @ floor.axes.T, places, margin, near):
            continue
        if same is not None or (not seen.is_passed(wall) if side.inner else seen.is_before_all(wall.as_vector())):
            sure = same is not None or all(ends) or _is_shown(wall, floor, line, edges)
            at_sure += corners if sure else []
            found.append(_Rising(wall, same, corners, sure))
    return [(each.wall, each.same) for each in found if each.sure or each.meets(at_sure, near)]


def find_corner(floor: EnclosingPlane, near: np.ndarray, lowest: float, edges: EdgeImages) -> Corner | None:
    """Find the corner of a floor around a place `near` (2,) along its axes; None if photographs show no edge there that
    is as high as `lowest`."""
    longer = _longer_side(floor)
    pixel, reach = edges.pixel_at(floor.at(near)), REACH * longer
    along = longer * STEPS
    places = near + _grid(reach, max(BLUR * pixel, reach / MOST_STEPS))
    shares = edges.shares(floor.at(places), floor.normal[None], along, HEIGHTS)
    heights = longer * np.arange(1, HEIGHTS + 1) / HEIGHTS
    chance = np.where(heights >= lowest, by_chance(shares), 0)
    row, part = np.unravel_index(chance.argmin(), chance.shape)
    if chance[row, part] + np.log(chance.size) > np.log(BY_CHANCE):
        return None
    showing = np.flatnonzero(shares[:, row, part] <= SHOWN)
    if not has_wide_baseline(edges.cameras, showing, floor.at(places[row])):
        return None
    # Higher parts may show the edge less clearly, and lower the evidence for the whole, although they show it.
    while part + 1 < HEIGHTS:
        strip = along[(part + 1) * SAMPLES : (part + 2) * SAMPLES]
        if by_chance(edges.shares(floor.at(places), floor.normal[None], strip, 1))[row, 0] > np.log(GOES_ON):
            break
        part += 1
    finer = places[row] + _grid(2 * BLUR * pixel, BLUR * pixel / FINER)
    best = edges.strongest(floor.at(finer), floor.normal[None], along[: (part + 1) * SAMPLES])
    return Corner(places[row] if best is None else finer[best], float(heights[part]))


def _grid(reach: float, apart: float) -> np.ndarray:
    """Return (N, 2) grid points up to `reach` in each direction."""
    steps = np.arange(-reach, reach + apart / 2, apart)
    return np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)


def _line(
    floor: EnclosingPlane, side: FloorSide, ends: Sequence[Corner | None], edges: EdgeImages
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the (2,) ends of the wall on a side of a floor: at the corners given for its lower and its upper end, or
    where the side ends. None without corners. From a single corner the wall takes the direction in which photographs
    show the strongest edge."""
    (low, high), axis = ends, 1 - side.across
    if low and high:
        run = high.place - low.place
        along_axis = run[axis] > np.cos(2 * SAME_ANGLE) * np.linalg.norm(run)
        return (low.place, high.place) if along_axis else None
    corner = low or high
    if corner is None:
        return None
    angles = np.linspace(-SAME_ANGLE, SAME_ANGLE, DIRECTIONS)
    runs = np.zeros((DIRECTIONS, 2))
    runs[:, axis] = (side.high if low else side.low)[axis] - corner.place[axis]
    runs[:, 1 - axis] = runs[:, axis] * np.tan(angles)
    starts = np.broadcast_to(floor.at(corner.place), (DIRECTIONS, 3))
    best = edges.strongest(starts, runs @ floor.axes, STEPS)
    end = corner.place + runs[DIRECTIONS // 2 if best is None else best]
    return (corner.place, end) if low else (end, corner.place)


def _ends_at(
    line: tuple[np.ndarray, np.ndarray], inward: np.ndarray, places: np.ndarray, margin: np.ndarray, near: float
) -> bool:
    """Return whether a floor, with points at (P, 2) `places` known to a (P,) `margin`, is known along half of a line,
    in a strip of width `near`, and ends there."""
    start, run = line[0], line[1] - line[0]
    length = float(np.linalg.norm(run))
    across = np.array([-run[1], run[0]]) / length
    before = (places - start) @ (across if across @ inward > 0 else -across)
    along = (places - start) @ run / length**2
    beside = (along >= 0) & (along < 1)
    inside = beside & (before >= -margin) & (before < near)
    behind = beside & (before < -margin) & (before > -near - margin)
    cells = np.unique(np.floor(CELLS * along[inside]))
    ends = np.count_nonzero(behind) < BEHIND_SHARE * np.count_nonzero(inside)
    return bool(ends) and len(cells) >= FILLED * CELLS


def _wall(
    floor: EnclosingPlane, line: tuple[np.ndarray, np.ndarray], inward: np.ndarray, height: float, inner: bool
) -> EnclosingPlane:
    """Return the wall over a line on a floor, its normal on the side of `inward` (3,)."""
    start, end = (floor.at(place) for place in line)
    direction = (end - start) / np.linalg.norm(end - start)
    normal = np.cross(direction, floor.normal)
    normal = normal if normal @ inward > 0 else -normal
    ends = np.array([[start @ direction, floor.offset], [end @ direction, floor.offset + height]])
    axes = np.stack([direction, floor.normal])
    return EnclosingPlane(normal, float(normal @ start), axes, ends, ends, inner=inner)


def _is_shown(
    wall: EnclosingPlane, floor: EnclosingPlane, line: tuple[np.ndarray, np.ndarray], edges: EdgeImages
) -> bool:
    """Return whether photographs show an edge along the line on which a wall stands on a floor."""
    near = floor.at(np.stack(line))
    return clearest_line(wall.as_vector(), floor.as_vector(), near, edges, CONFIRMED_DEPTH) is not None


def _is_seen_past(
    wall: EnclosingPlane,
    cameras: Sequence[Camera],
    known: Sequence[np.ndarray],
    backgrounds: Sequence[np.ndarray],
) -> bool:
    """Return whether most views see a background in place of a wall."""
    steps = (np.arange(PLACES) + 0.5) / PLACES
    share = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    places = wall.at(wall.own[0] + share * np.diff(wall.own, axis=0))
    looking, past = 0, 0
    for camera, depth, background in zip(cameras, known, backgrounds, strict=True):
        _, pixels, along = visible_pixels(camera, places)
        column, row = pixels.T
        clear = ~(depth[row, column] < (1 - MARGIN) * along)
        looking += np.count_nonzero(clear)
        past += np.count_nonzero(clear & background[row, column])
    return bool(past > MOST_BACKGROUND * looking)


def _longer_side(floor: EnclosingPlane) -> float:
    """Return the length of the longer side of a floor's rectangle."""
    return float(np.diff(floor.own, axis=0).max())
