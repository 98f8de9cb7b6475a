"""Constrain planes fitted to shading by confirmed depths along the edges of their regions, and by right angles.

Lighting that differs from the model turns planes by some degrees. Points along edges fix the normal of a plane better:
shading may turn planes by edges by at most SAME_ANGLE, and right angles by at most NEARLY.
"""

from __future__ import annotations

from collections.abc import Container, Sequence

import numpy as np
from scipy.ndimage import binary_dilation

from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.planes.plain_regions import RING, SAME_ANGLE, TOLERANCE, rays_of, to_world
from linprim_geo.stereo.planes.right_angles import NEARLY, RIGHT, angles_to, frame_of, orthogonalised
from linprim_geo.stereo.planes.shading import BOX, Fit, ShadedRegion, Shading, evaluate, plane_moves

# The most boxes of a region that are compared.
MOST_BOXES = 800
# Two planes carry shading equally well if their residuals, or the numbers of boxes that they carry, differ by at most
# this factor.
EQUAL_RATIO = 1.1
# The error of the plane of a single region, as a share of its distance.
ALIKE_DEPTH = 5 * CONFIRMED_DEPTH
# Confirmed depths along the edges of regions constrain a plane if their residual, as a share of the depth, is below
# NEAR; the threshold shrinks by NARROWER per step, down to TOLERANCE. HOLDING_STEPS is the number of steps. Half of
# TOLERANCE is taken as their standard deviation; as their errors are correlated, they count as at most INDEPENDENT
# points.
NEAR, NARROWER, HOLDING_STEPS, INDEPENDENT = 2 * TOLERANCE, 0.8, 6, 200
# The largest residual of shading, as a multiple of the unconstrained plane's, of a plane that other evidence supports,
# such as the frame of a room or points along edges: lighting differs from the model, and nine in ten true walls of a
# room leave at most that much (DECISIONS 116); and of planes moved to other right angles or to lines.
SUPPORTED_RATIO, MOVED_RATIO = 1.5, 1.03


class ConstrainedPlanes:
    """Constrains planes that carry the shading of regions.

    Args:
        shadings: of every view.
        depths: (H, W) confirmed depth of every view, of the size of its shading, NaN elsewhere.
        carried: the regions that each plane carries.
    """

    def __init__(
        self,
        shadings: Sequence[Shading],
        depths: Sequence[np.ndarray],
        carried: Sequence[Sequence[ShadedRegion]],
    ):
        self.shadings, self.depths, self.carried = shadings, depths, carried

    def by_depths(self, planes: np.ndarray, staying: Container[int], from_edges: Container[int] = ()) -> np.ndarray:
        """Return the planes, each constrained by the confirmed depths along the edges of its regions, except those
        `staying`. Planes known from points along edges, `from_edges`, turn by at most SAME_ANGLE or are not changed."""
        result = planes.copy()
        for k, plane in enumerate(planes):
            held = plane if k in staying else self._held_plane(plane, self.carried[k])
            if k not in from_edges or _turns(held, plane) <= SAME_ANGLE:
                result[k] = held
        return result

    def at_right_angles(
        self,
        planes: np.ndarray,
        staying: Container[int],
        frame: np.ndarray | None = None,
        from_edges: Container[int] = (),
    ) -> np.ndarray:
        """Turn planes to right angles with each other, or to the `frame` (3, 3) of the room (default: of those
        `staying`), if the turned plane carries the shading of its regions as well as true walls do. Then shift each to
        where most confirmed depths along the edges of its regions are. Those `staying` are not changed, nor those known
        from points along edges, `from_edges`, that would turn by more than NEARLY."""
        few = [[region.some(MOST_BOXES) for region in regions] for regions in self.carried]
        fits = [
            evaluate(plane, few[k], self.shadings) if few[k] and k not in staying else None
            for k, plane in enumerate(planes)
        ]
        # Planes by edges that carry no shading are not used as a reference.
        rows = [k for k, fit in enumerate(fits) if k in staying or fit is not None]
        known = [None if (fit := fits[k]) is None else fit.information for k in rows]
        if frame is None:
            frame = frame_of(planes[[k for k in rows if k in staying], :3])
        turned = planes.copy()
        turned[rows] = orthogonalised(planes[rows], known, lambda row, plane: plane_moves(plane, few[rows[row]]), frame)
        for k, fit in enumerate(fits):
            if fit is None or (turned[k] == planes[k]).all():
                continue
            if k in from_edges and _turns(turned[k], planes[k]) > NEARLY:
                continue
            framed = frame is not None and angles_to(frame, turned[[k], :3])[0] < RIGHT
            for plane in (self._shifted(turned[k], self.carried[k]), turned[k]):
                if self._leaves_as_little(plane, few[k], fit, SUPPORTED_RATIO if framed else MOVED_RATIO):
                    planes[k] = plane
                    break
        return planes

    def still_carrying(self, moved: dict[int, np.ndarray], planes: np.ndarray) -> dict[int, np.ndarray]:
        """Return those `moved` planes, by their number, that carry the shading of their regions nearly as well as the
        original planes, or have no regions."""
        result = {}
        for k, plane in moved.items():
            few = [region.some(MOST_BOXES) for region in self.carried[k]]
            fit = evaluate(planes[k], few, self.shadings) if few else None
            if fit is None or self._leaves_as_little(plane, few, fit, MOVED_RATIO):
                result[k] = plane
        return result

    def _leaves_as_little(self, plane: np.ndarray, regions: Sequence[ShadedRegion], fit: Fit, times: float) -> bool:
        """Return whether a plane's residual on regions is less than `times` that of a fit to them, over enough
        boxes."""
        tried = evaluate(plane, regions, self.shadings)
        return tried is not None and tried.left < times * fit.left and tried.boxes > 0.7 * fit.boxes

    def _shifted(self, plane: np.ndarray, regions: Sequence[ShadedRegion]) -> np.ndarray:
        """Shift a plane along its normal to where most confirmed depths along the edges of regions are."""
        points, centers = self._points_along(regions)
        return shifted(plane, points, points - centers)

    def _held_plane(self, plane: np.ndarray, regions: Sequence[ShadedRegion]) -> np.ndarray:
        """Fit a plane to the shading of regions and to the confirmed depths near it along their edges, where a wall
        meets other walls and the floor. Return the plane unchanged if the two contradict each other."""
        few = [region.some(MOST_BOXES) for region in regions]
        first = evaluate(plane, few, self.shadings) if few else None
        if first is None:
            return plane
        fit = first
        points, centers = self._points_along(regions)
        for k in range(HOLDING_STEPS):
            normal, moves = fit.plane[:3], plane_moves(fit.plane, few)
            with np.errstate(divide="ignore", invalid="ignore"):
                along = (points - centers) @ normal
                off = (points @ normal - fit.plane[3]) / along
            near: np.ndarray = np.abs(off) < max(NEAR * NARROWER**k, TOLERANCE)
            slope = (points[near] @ moves[:, :3].T - moves[:, 3]) / along[near, None]
            weight = INDEPENDENT / max(INDEPENDENT, int(near.sum())) / (TOLERANCE / 2) ** 2
            information = fit.information + weight * slope.T @ slope
            step = np.linalg.pinv(information, hermitian=True) @ (fit.downhill - weight * slope.T @ off[near])
            moved = fit.plane + step @ moves
            tried = evaluate(moved / np.linalg.norm(moved[:3]), few, self.shadings)
            if tried is None or tried.left > EQUAL_RATIO * first.left or tried.boxes < 0.7 * first.boxes:
                return plane
            fit = tried
        return fit.plane

    def _points_along(self, regions: Sequence[ShadedRegion]) -> tuple[np.ndarray, np.ndarray]:
        """Return (P, 3) points of the world at confirmed depths along the edges of regions, and (P, 3) centres of the
        cameras that see them."""
        points, centers = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for region in regions:
            camera, depth = self.shadings[region.view].camera, self.depths[region.view]
            around = binary_dilation(self.shadings[region.view].area_of(region), iterations=BOX // 2 + RING)
            row, column = np.nonzero(around & np.isfinite(depth))
            points.append(to_world(camera, rays_of(camera, row, column) * depth[row, column, None]))
            centers.append(np.broadcast_to(camera.center, points[-1].shape))
        return np.concatenate(points), np.concatenate(centers)


def shifted(plane: np.ndarray, points: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Shift a plane along its normal to where most of (P, 3) points are, given the (P, 3) vectors to them from the
    cameras that see them. Return it unchanged if no point is near."""
    off = plane_residuals(plane, points, vectors)
    near = np.abs(off) < ALIKE_DEPTH
    if not near.any():
        return plane
    return plane + np.append(np.zeros(3), _commonest(off[near]) * np.median(vectors[near] @ plane[:3]))


def plane_residuals(plane: np.ndarray, points: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return (P,) signed distances of (P, 3) points behind a plane, as shares of the normal components of the (P, 3)
    vectors to them from cameras."""
    with np.errstate(divide="ignore", invalid="ignore"):  # rays parallel to the plane
        return (points @ plane[:3] - plane[3]) / (vectors @ plane[:3])


def _turns(plane: np.ndarray, before: np.ndarray) -> float:
    """Return the angle in radians between two planes."""
    return float(np.arccos(min(1.0, abs(plane[:3] @ before[:3]))))


def _commonest(off: np.ndarray) -> float:
    """Return the position with the most of (P,) values within half of TOLERANCE."""
    places = np.arange(-ALIKE_DEPTH, ALIKE_DEPTH, TOLERANCE / 10)
    ordered = np.sort(off)
    count = np.searchsorted(ordered, places + TOLERANCE / 2) - np.searchsorted(ordered, places - TOLERANCE / 2)
    return float(places[np.argmax(count)])
