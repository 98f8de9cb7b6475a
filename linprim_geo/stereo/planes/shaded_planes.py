"""Planes of painted walls without texture, by photo-consistency of their shading.

A plane is fitted to each plain region of each photograph of which stereo knows little (`shading.py`). Regions of
several photographs with similar planes are fitted together, also to confirmed depths along their edges. Each region
then gets one of the planes that explain ("carry") its shading as well as its own plane does. Walls without shading and
curved surfaces get none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.ndimage import binary_dilation

from linprim_geo.geometry.camera import Camera
from linprim_geo.points.initial_points import in_image
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.planes.common_surfaces import SurfaceSupport
from linprim_geo.stereo.planes.constrained_planes import (
    ALIKE_DEPTH,
    EQUAL_RATIO,
    MOST_BOXES,
    SUPPORTED_RATIO,
    ConstrainedPlanes,
)
from linprim_geo.stereo.planes.enclosing_planes import AGREEING, SURE_SHARE
from linprim_geo.stereo.planes.meeting_lines import is_same, on_meeting_lines
from linprim_geo.stereo.planes.plain_regions import (
    BEHIND,
    SAME_ANGLE,
    TOLERANCE,
    has_wide_baseline,
    in_camera,
    in_world,
    rays_of,
    to_world,
)
from linprim_geo.stereo.planes.right_angles import NEARLY, RIGHT, off_frame
from linprim_geo.stereo.planes.shaded_areas import ShadedArea, best_first, preferred_by_edges
from linprim_geo.stereo.planes.shading import (
    BOX,
    LEAST_BOXES,
    SHOWN_SHARE,
    SURE_DEPTHS,
    Fit,
    FittedRegion,
    ShadedRegion,
    Shading,
    around_boxes,
    depth_deviation,
    evaluate,
    fit_plane,
    shaded_regions,
    starting_planes,
    unexplained,
)
from linprim_geo.stereo.vignetting import vignetting

# The most and the fewest views with which a region is compared.
MOST_VIEWS, LEAST_VIEWS = 8, 3
# Boxes of a region compared in the first steps from each start (later MOST_BOXES), and the number of these steps.
FIRST_BOXES, FIRST_STEPS = 200, 6
# A plane carries a region's shading if its residual is at most the share MOST_RESIDUAL_SHARE of the region's deviation;
# a plane of other regions if at most OTHERS_SHARE and EQUAL_RATIO times that of the region's own plane, or
# SUPPORTED_RATIO times where it is near that one: glossy paint causes as much.
MOST_RESIDUAL_SHARE, OTHERS_SHARE = 0.2, 0.25
# Noise leaves a smoothed residual of one deviation; more shows another surface. At least FLAT_SHARE of a flat region is
# below MOST_LEFT: tone curves and vignetting leave more at its ends (DECISIONS 57).
MOST_LEFT, FLAT_SHARE = 1.3, 0.75
# The depth of a region's own plane is known to this share or better; several regions together know it better.
CERTAIN = 2 * CONFIRMED_DEPTH
# Planes of regions are fitted together if their normals differ by at most this angle, and their depths by ALIKE_DEPTH.
ALIKE_ANGLE = 4 * SAME_ANGLE
# The background is so many times as far as the depth of a region.
FAR = 1e4
# The angle (radians) at which a plane errs by TOLERANCE at a width of half its distance. A plane by points that is off
# the room's frame by more is askew.
TOLERANCE_ANGLE = 2 * TOLERANCE
# A plane carries a region if it explains the shading around half of its boxes.
CARRIED_SHARE = 0.5


class ShadedPlanes:
    """`planes` (K, 4) of the world that carry the shading of plain regions in several views, the given ones first.

    `standing` (K,) bool marks walls set on the line where they meet a floor or another wall. `hanging` (K,) bool marks
    planes by points that are on objects in front of such a wall, which is among the others.

    Args:
        maps: depth maps of all views.
        depths: (H, W) confirmed depth of each view, NaN elsewhere.
        rendered: (H, W) rendered depth of each view, 0 where none.
        by_points: (K, 4) planes with confirmed points all over; they are not changed.
        by_edges: (K, 4) planes fitted to points along edges. Shading refines them; those along the frame are kept
            unrefined, too.
        frame: (3, 3) of the room (`right_angles.frame_of`), None if it has none.
    """

    def __init__(
        self,
        maps: Sequence[DepthMap],
        depths: Sequence[np.ndarray],
        rendered: Sequence[np.ndarray],
        by_points: np.ndarray,
        by_edges: np.ndarray,
        frame: np.ndarray | None,
    ):
        self.cameras = [found.camera for found in maps]
        law = vignetting(self.cameras, [found.grey for found in maps], depths)
        self.shadings = [Shading.of(found, law) for found in maps]
        self.small_cameras = [shading.camera for shading in self.shadings]
        self.given, self.by_points = np.concatenate([by_points, by_edges]), len(by_points)
        self.given_count, self.frame = len(self.given), frame
        self.depths = [shading.small(depth) for shading, depth in zip(self.shadings, depths, strict=True)]
        self.shown: list[list[ShadedRegion]] = []
        self.regions: list[list[FittedRegion]] = []
        for view, shading in enumerate(self.shadings):
            small = shading.small(rendered[view])
            own = shaded_regions(view, shading, np.isfinite(self.depths[view]))
            started = [found for region in own if (found := self._started(region, small)) is not None]
            fitted = [self._fitted(region, starts) for region, starts in started]
            self.shown.append([region for region, _ in started])
            self.regions.append([one for one in fitted if one is not None])
        self.planes = self._common([one for own in self.regions for one in own if one.fit is not None])
        carried = self._take_originals(self._all_carriers())
        held = ConstrainedPlanes(self.shadings, self.depths, carried)
        off, from_edges = off_frame(self.frame, self.planes[:, :3]), set(range(self.by_points, self.given_count))
        along = {k for k in from_edges if off[k] < RIGHT}
        # Edges fix a plane along the frame well, but the region may be on another nearly flush with it.
        twice = [k for k in sorted(along) if carried[k]]
        from_edges.update(range(len(self.planes), len(self.planes) + len(twice)))
        self.planes = np.concatenate([self.planes, self.planes[twice]])
        carried += [carried[k] for k in twice]
        staying = along.union(range(self.by_points))
        planes = held.at_right_angles(held.by_depths(self.planes, staying, from_edges), staying, frame, from_edges)
        standing = held.still_carrying(on_meeting_lines(planes, self.by_points, maps, depths), planes)
        self.standing = np.isin(np.arange(len(planes)), list(standing))
        self.hanging = np.array([any(is_same(plane, planes[k]) for k in standing) for plane in planes], bool)
        self.hanging[self.by_points :] = False
        for number, plane in standing.items():
            planes[number] = plane
        self.planes = held.at_right_angles(planes, {*staying, *standing}, frame, from_edges)

    def _camera(self, region: ShadedRegion) -> Camera:
        return self.small_cameras[region.view]

    def _started(self, region: ShadedRegion, rendered: np.ndarray) -> tuple[ShadedRegion, list[np.ndarray]] | None:
        """Return a region with its depth and the views that show it, and planes to start from. None if noise hides its
        shading, or too few views show it."""
        # Below this variance, too large a share is noise.
        if np.var(region.value) < 2 * self.shadings[region.view].noise / OTHERS_SHARE**2:
            return None
        starts = starting_planes(region, self.depths[region.view], rendered)
        if not starts:
            return None
        depth = 1 / np.median(region.rays @ starts[0])
        region = replace(region, depth=abs(float(depth)))
        region = replace(region, others=self._others(region))
        return (region, starts) if len(region.others) >= LEAST_VIEWS else None

    def _fitted(self, region: ShadedRegion, starts: Sequence[np.ndarray]) -> FittedRegion | None:
        """Fit the region's own plane; None if too few views show it with any plane, or it is a background."""
        camera = self._camera(region)
        few = [region.some(FIRST_BOXES)]
        tried = [fit_plane(in_world(camera, start), few, self.shadings, FIRST_STEPS) for start in starts]
        found = [fit for fit in tried if fit is not None and fit.views >= LEAST_VIEWS]
        if not found:
            return None
        fit = fit_plane(min(found, key=lambda fit: fit.left_share).plane, [region.some(MOST_BOXES)], self.shadings)
        if fit is None or fit.views < LEAST_VIEWS or self._is_far(region, fit):
            return None
        left = unexplained(region, in_camera(camera, fit.plane[None])[0], self.shadings)
        flat = np.count_nonzero(left <= MOST_LEFT) >= FLAT_SHARE * np.isfinite(left).sum()
        most = min(EQUAL_RATIO * fit.left_share, OTHERS_SHARE) if flat else OTHERS_SHARE
        return FittedRegion(region, most, fit if flat and self._certain(region, fit) else None)

    def _is_far(self, region: ShadedRegion, fit: Fit) -> bool:
        """Return whether a plane without parallax carries a region's shading as well as the fit: a sky."""
        far = self._far(region.some(MOST_BOXES))
        return far is not None and far.left < EQUAL_RATIO * fit.left

    def _far(self, region: ShadedRegion, least: int = LEAST_VIEWS) -> Fit | None:
        """Evaluate a plane at infinity on the shading of a region; None if too few views show it."""
        plane = in_world(self._camera(region), np.array([0, 0, 1 / (FAR * region.depth)]))
        far = evaluate(plane, [region], self.shadings)
        return far if far is not None and far.views >= least else None

    def is_background(self, view: int) -> np.ndarray:
        """(H, W) bool: regions of a view whose shading a background carries better than any movable plane."""
        background = self._nowhere(view)
        for region in self.shown[view]:
            few = region.some(FIRST_BOXES)
            far = self._far(self._in_all_views(few))
            if far is None or far.left_share > MOST_RESIDUAL_SHARE:
                continue
            fits = (evaluate(plane, [few], self.shadings) for plane in self.planes[self.by_points :])
            if all(fit is None or fit.left_share > EQUAL_RATIO * far.left_share for fit in fits):
                self._mark(background, region)
        return background

    def is_wall(self, view: int, asked: np.ndarray) -> np.ndarray:
        """Return (H, W) bool: regions of a view with a pixel `asked` (H, W) whose shading a plane carries clearly
        better than a background. Where no other view looks past the planes in that direction, none is marked."""
        wall, small = self._nowhere(view), self.shadings[view].small(asked)
        for region in self.shown[view]:
            if not small[region.row, region.column].any():
                continue
            few = region.some(FIRST_BOXES)
            far = self._far(self._in_all_views(few), least=1)
            most = 0.0 if far is None else min(MOST_RESIDUAL_SHARE, far.left_share / SUPPORTED_RATIO)
            if most > 0 and any(fit.left_share < most for fit in self._fits(few)):
                self._mark(wall, region)
        return wall

    def _fits(self, region: ShadedRegion) -> Iterator[Fit]:
        """Yield the fit to a region's shading of each plane that all its rays meet, if enough views show it."""
        for plane, local in zip(self.planes, in_camera(self._camera(region), self.planes), strict=True):
            if (region.rays @ local > 0).all():
                fit = evaluate(plane, [region], self.shadings)
                if fit is not None and fit.views >= LEAST_VIEWS:
                    yield fit

    def _in_all_views(self, region: ShadedRegion) -> ShadedRegion:
        """Compare a region with all other views: those that show it at its depth may not show it at infinity."""
        return replace(region, others=tuple(k for k in range(len(self.shadings)) if k != region.view))

    def _nowhere(self, view: int) -> np.ndarray:
        """Return (H, W) bool of a view, all false."""
        camera = self.cameras[view]
        return np.zeros((camera.height, camera.width), bool)

    def _mark(self, marked: np.ndarray, region: ShadedRegion) -> None:
        """Set the pixels of a region in a mask (H, W) of its view."""
        shading = self.shadings[region.view]
        around = binary_dilation(shading.area_of(region), iterations=BOX)
        row, column = np.nonzero(around.repeat(shading.factor, 0).repeat(shading.factor, 1))
        marked[row, column] = True

    def _certain(self, region: ShadedRegion, fit: Fit) -> bool:
        """Return whether a fit carries a region's shading with a small error of depth, and is not contradicted."""
        camera = self._camera(region)
        if fit.left_share > MOST_RESIDUAL_SHARE or depth_deviation(fit, region, camera) > CERTAIN:
            return False
        inverse = region.rays @ in_camera(camera, fit.plane[None])[0]
        return bool((inverse > 0).all()) and not self._contradicted(region, inverse)

    def _others(self, region: ShadedRegion) -> tuple[int, ...]:
        """Return the views that show a region, from near and from far positions."""
        camera = self._camera(region)
        points, shown = to_world(camera, region.some(LEAST_BOXES).rays * region.depth), []
        for view, shading in enumerate(self.shadings):
            if view != region.view and in_image(shading.camera, points)[0].mean() > SHOWN_SHARE:
                shown.append(view)
        shown.sort(key=lambda view: float(np.linalg.norm(self.shadings[view].camera.center - camera.center)))
        picked = np.linspace(0, len(shown) - 1, min(len(shown), MOST_VIEWS)).round().astype(int)
        return tuple(shown[k] for k in picked)

    def _contradicted(self, region: ShadedRegion, inverse: np.ndarray) -> bool:
        """Return whether sure depths of a region disagree with (N,) `inverse` depths, NaN where unknown."""
        sure = self.depths[region.view][region.row, region.column]
        known = np.isfinite(sure) & np.isfinite(inverse)
        agree = np.abs(inverse[known] * sure[known] - 1) < 3 * CONFIRMED_DEPTH
        return len(agree) >= max(SURE_DEPTHS, SURE_SHARE * len(sure)) and agree.mean() < AGREEING

    def _common(self, fitted: list[FittedRegion]) -> np.ndarray:
        """Return the given planes, and those fitted to regions of several views that none of the given ones carries."""
        planes = list(self.given)
        fitted = [one for one in fitted if not any(self._carries(plane, one) for plane in planes)]
        boxes = np.array([len(one.region.row) for one in fitted])
        alike, left = self._alike(fitted), np.ones(len(fitted), bool)
        while left.any():
            group = alike[np.argmax((alike & left) @ boxes * left)] & left
            plane, carried = _plane(fitted[np.argmax(boxes * group)]), group
            for _ in range(2):
                together = [fitted[k].region.some(MOST_BOXES) for k in np.flatnonzero(carried)]
                fit = fit_plane(plane, together, self.shadings) if together else None
                plane = plane if fit is None else fit.plane
                carried = np.zeros_like(left)
                carried[[k for k in np.flatnonzero(left) if self._carries(plane, fitted[k])]] = True
            if self._of_several_views(plane, [fitted[k].region for k in np.flatnonzero(carried)]):
                planes.append(plane)
            left &= ~(carried | group)
        return np.array(planes).reshape(-1, 4)

    def _alike(self, fitted: list[FittedRegion]) -> np.ndarray:
        """Return (N, N) bool: which regions have similar planes; each is similar to itself."""
        planes = np.array([_plane(one) for one in fitted]).reshape(-1, 4)
        alike = np.abs(planes[:, :3] @ planes[:, :3].T) > np.cos(ALIKE_ANGLE)
        for k, one in enumerate(fitted):
            inverse = one.region.some(LEAST_BOXES).rays @ in_camera(self._camera(one.region), planes).T
            alike[k] &= np.median(np.abs(inverse / inverse[:, [k]] - 1), axis=0) < ALIKE_DEPTH
        return alike

    def _of_several_views(self, plane: np.ndarray, regions: Sequence[ShadedRegion]) -> bool:
        """Return whether regions of enough views lie on a plane, and views from different directions were compared."""
        finding = {region.view for region in regions}
        if len(finding) < LEAST_VIEWS:
            return False
        middles = []
        for region in regions:
            camera, ray = self._camera(region), np.median(region.rays, axis=0)
            middles.append(to_world(camera, ray / (ray @ in_camera(camera, plane[None])[0])))
        views = np.array(sorted(finding.union(*(region.others for region in regions))))
        return has_wide_baseline(self.small_cameras, views, np.mean(middles, axis=0))

    def _carries(self, plane: np.ndarray, one: FittedRegion) -> bool:
        """Return whether a plane leaves hardly more of a region's shading than its own one, of as many boxes."""
        if (one.region.rays @ in_camera(self._camera(one.region), plane[None])[0] <= 0).any():
            return False
        found, own = evaluate(plane, [one.region.some(MOST_BOXES)], self.shadings), one.fit
        if found is None or own is None:
            return False
        return found.boxes > 0.7 * own.boxes and found.left < EQUAL_RATIO * own.left

    def _carriers(self, one: FittedRegion) -> dict[int, np.ndarray]:
        """Return the planes that carry a region's shading, each with (N,) bool: around which of its boxes."""
        region, carriers = one.region, {}
        for k, plane in enumerate(in_camera(self._camera(region), self.planes)):
            inverse = region.rays @ plane
            if (inverse <= 0).any() or self._contradicted(region, inverse):
                continue
            fit = evaluate(self.planes[k], [region.some(MOST_BOXES)], self.shadings)
            if fit is None or fit.views < LEAST_VIEWS or fit.left_share > self._may_leave(one, inverse):
                continue
            carried = unexplained(region, plane, self.shadings) <= MOST_LEFT
            if carried.mean() >= CARRIED_SHARE:
                carriers[k] = carried
        return carriers

    def _may_leave(self, one: FittedRegion, inverse: np.ndarray) -> float:
        """Return the largest residual that a plane with (N,) `inverse` depths may leave of a region, as a share of its
        deviation: as much as true planes do if the plane is near the region's own, within the accuracy of shading."""
        if one.fit is None:
            return one.most_left
        own = one.region.rays @ in_camera(self._camera(one.region), one.fit.plane[None])[0]
        near = np.median(np.abs(inverse / own - 1)) < ALIKE_DEPTH
        return min(SUPPORTED_RATIO * one.fit.left_share, OTHERS_SHARE) if near else one.most_left

    def _all_carriers(self) -> list[list[dict[int, np.ndarray]]]:
        """Return `_carriers` of the regions of each view."""
        return [[self._carriers(one) for one in own] for own in self.regions]

    def _take_originals(self, carriers: Sequence[Sequence[dict[int, np.ndarray]]]) -> list[list[ShadedRegion]]:
        """Remove duplicate planes: those of whose boxes another one carries most. Return the regions that each kept
        plane carries, none where they are of too few views.

        A plane by edges that is the same as one by points is set to it and then not changed, as if it carried no
        region, unless that one is askew. Two planes by edges are duplicates only if they are as near as points tell, as
        faint shading may be carried by both. Planes by edges take precedence over those of shading alone.
        """
        count = len(self.planes)
        shared, carried = np.zeros((count, count)), [list[ShadedRegion]() for _ in range(count)]
        for own, of_view in zip(self.regions, carriers, strict=True):
            for one, of_region in zip(own, of_view, strict=True):
                for k, boxes in of_region.items():
                    carried[k].append(one.region)
                    for j, others in of_region.items():
                        shared[j, k] += np.count_nonzero(boxes & others)
        off, kept = off_frame(self.frame, self.planes[:, :3]), list[int]()
        by_points = [k for k in range(self.by_points) if not TOLERANCE_ANGLE < off[k] < NEARLY]
        for k in sorted(range(self.by_points, count), key=lambda k: (k >= self.given_count, -shared[k, k])):
            same = next((j for j in by_points if self._same(j, k, carried[k], TOLERANCE)), None)
            if same is not None:
                self.planes[k] = np.sign(self.planes[same, :3] @ self.planes[k, :3]) * self.planes[same]
                carried[k] = []
            copied = [j for j in kept if shared[j, k] > CARRIED_SHARE * shared[k, k]]
            if same is not None or not any(self._same(j, k, carried[k], self._most_apart(j, k, off)) for j in copied):
                kept.append(k)
        kept = sorted([*range(self.by_points), *kept])
        self.planes, self.given_count = self.planes[kept], sum(k < self.given_count for k in kept)
        return [carried[k] if self._of_several_views(self.planes[at], carried[k]) else [] for at, k in enumerate(kept)]

    def _most_apart(self, first: int, second: int, off: np.ndarray) -> float:
        """Return the share of the depth by which duplicates may differ, by (K,) angles `off` the frame."""
        by_edges = TOLERANCE if off[[first, second]].max() < RIGHT else BEHIND * TOLERANCE
        return by_edges if max(first, second) < self.given_count else ALIKE_DEPTH

    def _same(self, first: int, second: int, regions: Sequence[ShadedRegion], tolerance: float) -> bool:
        """Return whether two planes have nearly the same normal and, over the regions, median inverse depth up to a
        `tolerance`. Planes known to TOLERANCE are also known to TOLERANCE_ANGLE, others to ALIKE_ANGLE."""
        planes, most_angle = self.planes[[first, second]], TOLERANCE_ANGLE if tolerance == TOLERANCE else ALIKE_ANGLE
        if not regions or abs(planes[0, :3] @ planes[1, :3]) < np.cos(most_angle):
            return False
        inverse = [region.some(LEAST_BOXES).rays @ in_camera(self._camera(region), planes).T for region in regions]
        one, other = np.concatenate(inverse).T
        return bool(np.median(np.abs(one / other - 1)) < tolerance)

    def areas(self, along_edges: Sequence[np.ndarray]) -> list[list[ShadedArea]]:
        """Return for every view the areas in which one plane each carries a region's shading.

        Of planes that do so equally well, as of one wall, the one counts on which the region lies by points
        `along_edges` ((H, W) numbers of planes, -1 elsewhere), or else that carries most in all views. It has to be on
        a surface known to LEAST_VIEWS views, this one included, from different directions: floors continue behind
        walls. For planes with points all over, only confirmed depths of other views count, not depths supposed there.
        """
        areas = [
            [self._edge_preferred_first(of_region, along) for of_region in own]
            for own, along in zip(self.candidates, along_edges, strict=True)
        ]
        supposed = [[of_region[0] for of_region in own] for own in areas]
        # An area that no other view knows does not support those of others if its region has another that is known.
        for _ in range(2):
            surfaces, before = self._surfaces(supposed), supposed
            known = [self._known(view, own, surfaces) for view, own in enumerate(areas)]
            supposed = [
                [of_region[0] if found is None else found for of_region, found in zip(own, of_view, strict=True)]
                for own, of_view in zip(areas, known, strict=True)
            ]
            if supposed == before:
                break
        return [[found for found in of_view if found is not None] for of_view in known]

    @cached_property
    def candidates(self) -> list[list[list[ShadedArea]]]:
        """For every view and each region that a plane carries: the areas on the planes that carry about as many of its
        boxes as any does, first the plane that carries most in all views."""
        carriers, carried = self._all_carriers(), np.zeros(len(self.planes))
        for own in carriers:
            for of_region in own:
                for k, boxes in of_region.items():
                    carried[k] += np.count_nonzero(boxes)
        carried[: self.given_count] *= EQUAL_RATIO
        return [
            [
                [self._area(one.region, boxes[k], k) for k in best_first(boxes, carried)]
                for one, boxes in zip(own, of_view, strict=True)
                if boxes
            ]
            for own, of_view in zip(self.regions, carriers, strict=True)
        ]

    def _edge_preferred_first(self, areas: list[ShadedArea], along_edges: np.ndarray) -> list[ShadedArea]:
        """Return the areas of a region, first the one that points `along_edges` favour, if another."""
        from_edges = preferred_by_edges(areas[0], along_edges, self.planes, self.shadings)
        return areas if from_edges is areas[0] else [from_edges, *areas]

    def _area(self, region: ShadedRegion, boxes: np.ndarray, number: int) -> ShadedArea:
        """Return the area around those boxes of a region that a plane carries."""
        return ShadedArea(region, number, around_boxes(self.shadings[region.view].area_of(region), region, boxes))

    def depth_maps(self, areas: Sequence[Sequence[ShadedArea]]) -> list[np.ndarray]:
        """Return the (H, W) float32 depth of every view's `areas`, NaN elsewhere."""
        result = []
        for camera, shading, own in zip(self.cameras, self.shadings, areas, strict=True):
            number = self._numbers(shading, own).repeat(shading.factor, 0).repeat(shading.factor, 1)
            result.append(self._depth(camera, number))
        return result

    def _known(
        self, view: int, areas: Sequence[Sequence[ShadedArea]], surfaces: SurfaceSupport
    ) -> list[ShadedArea | None]:
        """Return for each region of a view the first of its areas on a surface that enough views know, or None."""
        camera, shading = self.small_cameras[view], self.shadings[view]
        every = [area for of_region in areas for area in of_region]
        depths = [self._depth(camera, self._numbers(shading, [area])) for area in every]
        supporting_views = surfaces.supporting_views(view, depths, [area.number < self.by_points for area in every])
        known = []
        for depth, others in zip(depths, supporting_views, strict=True):
            row, column = np.nonzero(np.isfinite(depth))
            points = to_world(camera, rays_of(camera, row, column) * depth[row, column, None])
            views = np.append(others, view)
            known.append(len(points) > 0 and has_wide_baseline(self.small_cameras, views, np.median(points, axis=0)))
        is_known = iter(known)
        of_regions = ([area for area in of_region if next(is_known)] for of_region in areas)
        return [next(iter(of_region), None) for of_region in of_regions]

    def _surfaces(self, supposed: Sequence[Sequence[ShadedArea]]) -> SurfaceSupport:
        """Return what all views know: confirmed depths, and depths of the areas that each has `supposed`."""
        views = zip(self.small_cameras, self.shadings, supposed, strict=True)
        depths = [self._depth(camera, self._numbers(shading, own)) for camera, shading, own in views]
        return SurfaceSupport(self.small_cameras, self.depths, depths)

    def _numbers(self, shading: Shading, areas: Sequence[ShadedArea]) -> np.ndarray:
        """Return (H, W) numbers of the planes of a view's areas, -1 elsewhere."""
        number = np.full(shading.plain.shape, -1)
        for area in areas:
            number[area.where] = np.maximum(number[area.where], area.number)
        return number

    def _depth(self, camera: Camera, number: np.ndarray) -> np.ndarray:
        """Return the (H, W) float32 depth of the planes with these numbers (H, W), NaN for -1."""
        depth = np.full((camera.height, camera.width), np.nan, np.float32)
        row, column = np.nonzero(number >= 0)
        planes = in_camera(camera, self.planes)[number[row, column]]
        inverse = np.einsum("nc,nc->n", rays_of(camera, row, column), planes)
        depth[row, column] = 1 / np.where(inverse > 0, inverse, np.nan)
        return depth


def _plane(one: FittedRegion) -> np.ndarray:
    assert one.fit is not None
    return one.fit.plane
