"""Merges seven sources of depth into the depth maps that are fused, with a weight each.

The sources are: stereo depths that neighbouring views confirm; planes of textureless regions; a surface that spans the
gaps between these; floors and walls that enclose the scene; thin things, and things known by their outlines, as the
primitives render them; and everywhere else the rendered depths, weighted down by how much they deviate from confirmed
ones. Parts of the fused surface that stereo and planes of several views do not support are removed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from linprim_geo.base.progress import Progress
from linprim_geo.capture.types import View
from linprim_geo.geometry.mesh import Mesh, face_areas, face_components, select_faces
from linprim_geo.points.initial_points import in_image
from linprim_geo.stereo.depth_maps import SURE, DepthMap, depth_maps
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.planes.common_surfaces import ON_IT
from linprim_geo.stereo.planes.enclosing_planes import (
    EnclosingPlane,
    enclosing_depths,
    enclosing_planes,
    known_on_planes,
    region_depths,
)
from linprim_geo.stereo.planes.framed_planes import framed_planes_of_points, planes_by_edges
from linprim_geo.stereo.planes.plain_regions import (
    TOLERANCE,
    PlainRegion,
    regions_of_views,
)
from linprim_geo.stereo.planes.point_planes import SurfacePoints, point_plane_depth
from linprim_geo.stereo.planes.region_planes import RegionDepths, beside_edges, region_plane_depths
from linprim_geo.stereo.planes.room_corners import with_corner_walls
from linprim_geo.stereo.planes.seen_through import FreeSpaceTest
from linprim_geo.stereo.planes.shaded_planes import ShadedPlanes
from linprim_geo.stereo.planes.shown_colours import ShownColours
from linprim_geo.stereo.visibility.far_parts import far_parts
from linprim_geo.stereo.visibility.lone_backgrounds import lone_backgrounds
from linprim_geo.stereo.visibility.silhouette_bounded import silhouette_bounded
from linprim_geo.stereo.visibility.textured_backgrounds import textured_backgrounds
from linprim_geo.stereo.visibility.thin_things import RenderedView, thin_things
from linprim_geo.stereo.visibility.visibility_cut import plane_normals, points_per_view, spanned_depths
from linprim_geo.surface.finish.small_holes import without_small_holes
from linprim_geo.surface.fusion.tsdf_field import DepthFrame
from linprim_geo.surface.mesh_views import MeshViews
from linprim_geo.surface.single_view import mesh_is_closed

# Weight of a depth that other views have, too, but that is not confirmed (`DepthMap.is_confirmed`); a confirmed one has
# 1.
DOUBTFUL_WEIGHT = 0.1
# A piece of surface is supported if at least this many views have depths on this share of its area. True pieces have
# 0.3 to 0.9, false ones 0.1 at most.
SUPPORTING_VIEWS, SUPPORTED_SHARE = 2, 0.25
# Every how many rows and columns the coverage of pixels by a surface is sampled.
SAMPLED = 4
# Rounds of assigning planes and removing depths that other views see through. A third changes hardly anything.
ROUNDS = 2
# Points of the rendered surface by which stereo finds pairs of views.
POINTS = 20_000


class MergedFrames(Sequence):
    """The `rendered` frames of views, in which confirmed stereo depths up to `limit`, and depths of planes where there
    is no texture, replace the rendered ones.

    `weight` is the weight of the remaining rendered depths: the squared deviation of confirmed depths from those of
    their neighbours over that of rendered ones from confirmed ones, 1 at most. Shares of pixels, for the statistics:
    `confirmed` with confirmed depths, before those that other views see through are removed; `doubtful` with less
    probable depths; `flat` on one of the `planes` (K, 4); `spanned` without texture between all these; `enclosed` whose
    rays end at a floor or wall, because nothing else is known or a doubtful depth is near it; `thin` on thin things in
    front of what is known; `outlined` on things known by their outlines. `sharp` (H, W) bool of every view marks
    rendered depths of a surface rather than fog; None: all. Sharp ones stay where nothing is known, and thin and
    outlined things are among them.
    """

    def __init__(
        self,
        rendered: Sequence[DepthFrame],
        views: Sequence[View],
        limit: float,
        *,
        sharp: Iterable[np.ndarray] | None = None,
        quiet: bool = True,
    ):
        self.limit = limit
        maps = depth_maps(views, pairing_points(rendered), hiding=(frame.depth for frame in rendered), quiet=quiet)
        progress = Progress("merging", 5, quiet=quiet)
        progress.stage(0, "planes")
        self.cameras = [found.camera for found in maps]
        confirmed = [found.is_confirmed() for found in maps]
        self.depths = [_depth_where(found, own) for found, own in zip(maps, confirmed, strict=True)]
        self.doubtful_depths = [
            _depth_where(found, ~own & (found.confirming > 0)) for found, own in zip(maps, confirmed, strict=True)
        ]
        measured = [_first_known(pair) for pair in zip(self.depths, self.doubtful_depths, strict=True)]
        self.confirmed, self.doubtful = _share_known(self.depths), _share_known(self.doubtful_depths)
        deviations = Deviations()
        for found, depth, frame in zip(maps, self.depths, rendered, strict=True):
            deviations.add(found, depth, frame)
        self.weight = deviations.weight()
        rendered_depths, free = map(
            list, zip(*((frame.depth, _background_of(frame)) for frame in rendered), strict=True)
        )
        seen = list(self.depths)
        masked = any(view.has_alpha for view in views)  # then masks say what is background
        regions, backgrounds, plain_walls = self._take_planes(maps, rendered_depths, () if masked else free)
        walls = [np.ones_like(own) for own in free] if masked else plain_walls
        no_walls = [own & ~wall for own, wall in zip(free, walls, strict=True)]
        backgrounds = far_parts(maps, no_walls, self._known(), rendered_depths, backgrounds)
        self.rendered = [_seen_past(*each) for each in zip(rendered, backgrounds, strict=True)]
        if not masked:
            self._clear_background(plain_walls)
        progress.stage(1, "gaps between planes")
        self.shown = [frame.depth[::SAMPLED, ::SAMPLED] > 0 for frame in self.rendered]
        known = self._known()
        points = self._points(maps, known)
        self._span_gaps(maps, known, points, rendered_depths, backgrounds)
        are_sharp = [depth > 0 for depth in rendered_depths] if sharp is None else list(sharp)
        progress.stage(2, "floors and walls")
        walls, planes = self._walls(maps, seen, points)
        self._enclose(walls, known, are_sharp, regions, backgrounds)
        # Depths that stereo has measured on enclosing planes, among their points, are not background where hardly any
        # view looks.
        self._clear_background(known_on_planes(self.cameras, planes, measured))
        progress.stage(3, "thin things")
        self._keep_things(views, maps, rendered_depths, are_sharp)
        progress.stage(4, "backgrounds")
        if not masked:
            self._end_backgrounds(maps)
        progress.clear()

    def _take_planes(
        self, maps: Sequence[DepthMap], rendered: Sequence[np.ndarray], free: Sequence[np.ndarray]
    ) -> tuple[list[list[PlainRegion]], list[np.ndarray], list[np.ndarray]]:
        """Find planes by points, by edges and by shading, from confident depths, and assign pixels to them; snap
        confirmed depths to their plane.

        Planes by points are the most accurate, except where another plane of a region's edges stands: points err beside
        edges. Planes by edges replace those by shading where they explain the shading as well; else the nearer plane
        hides the other. Confirmed depths beside edges of textureless regions become doubtful where they are on no
        plane.

        Returns: the textureless regions of every view, and (H, W) bool per view: those that are background by their
            shading, and those with `free` (H, W) rays that are walls by it, if `free` is given.
        """
        sure = [_depth_where(found, found.is_confirmed(SURE)) for found in maps]
        regions = regions_of_views(maps, sure)
        by_points, frame = framed_planes_of_points(maps, sure)
        every = [region for own in regions for region in own]
        by_edges = planes_by_edges(self.cameras, every, frame)
        shaded = ShadedPlanes(maps, sure, rendered, by_points, by_edges, frame)
        self.planes, self.standing = shaded.planes[~shaded.hanging], shaded.standing[~shaded.hanging]
        on_points = [point_plane_depth(found, own, by_points) for found, own in zip(maps, sure, strict=True)]
        backgrounds = [shaded.is_background(view) for view in range(len(maps))]
        self.on_planes: list[np.ndarray] = []
        beside = [beside_edges(found.grey.shape, own) for found, own in zip(maps, regions, strict=True)]
        colours = ShownColours(maps, sure)
        # False depths in front of a wall contradict the wall's plane: once they are removed, more pixels get planes.
        for _ in range(ROUNDS):
            along_edges = region_plane_depths(self.cameras, regions, shaded.planes, sure, self.depths, colours)
            self._clear_refused(along_edges, sure, on_points)
            along_edges = [found.without(taken) for found, taken in zip(along_edges, backgrounds, strict=True)]
            by_shading = shaded.depth_maps(shaded.areas([found.number for found in along_edges]))
            self._lay_planes(sure, on_points, by_shading, along_edges)
            self._clear_air(beside, sure, on_points)
        for view, found in enumerate(along_edges):
            doubted = np.where(found.doubted, found.depth, np.float32(np.nan))
            # Beside it stereo has matched only the edge, which may be the edge of another surface.
            lone = np.where(beside[view] & np.isnan(self.on_planes[view]), self.depths[view], np.float32(np.nan))
            self.doubtful_depths[view] = _first_known((lone, self.doubtful_depths[view], doubted))
            self.depths[view] = np.where(np.isfinite(lone), np.float32(np.nan), self.depths[view])
        self.flat = _share_known(self.on_planes)
        return regions, backgrounds, [shaded.is_wall(view, asked) for view, asked in enumerate(free)]

    def _lay_planes(
        self,
        sure: Sequence[np.ndarray],
        on_points: Sequence[np.ndarray],
        by_shading: Sequence[np.ndarray],
        along_edges: Sequence[RegionDepths],
    ) -> None:
        """Set the depths on planes of every view, from (H, W) depths `on_points` and `by_shading`, NaN elsewhere, and
        `along_edges` of textureless regions; snap confirmed depths to them. `sure` depths snap to planes of regions
        only where these say so."""
        self.on_planes = []
        of_views = zip(sure, on_points, by_shading, along_edges, strict=True)
        for view, (known, on_plane, shaded, region) in enumerate(of_views):
            depth = self.depths[view]
            other = np.abs(on_plane / region.depth - 1) > TOLERANCE
            on_plane = np.where(region.stands & ~region.doubted & other, region.depth, on_plane)
            laid = np.where(region.doubted, np.float32(np.nan), region.depth)
            self.on_planes.append(_first_known((on_plane, np.fmin(laid, shaded))))
            of_sure = _first_known((on_plane, np.where(region.moved, region.depth, np.float32(np.nan))))
            target = np.where(np.isfinite(known), of_sure, self.on_planes[view])
            self.depths[view] = np.where(np.isfinite(depth) & np.isfinite(target), target, depth)

    def _clear_air(self, beside: Sequence[np.ndarray], *others: Sequence[np.ndarray]) -> None:
        """Remove depths `beside` (H, W) edges of textureless regions that other views see through, from confirmed,
        planar and doubtful depths and from `others`."""
        views = FreeSpaceTest(self.cameras, self._known())
        for depths in (self.depths, self.on_planes, self.doubtful_depths, *others):
            views.clear(depths, beside)

    def _clear_refused(self, along_edges: Sequence[RegionDepths], *others: Sequence[np.ndarray]) -> None:
        """Remove measured depths, and those in `others`, on planes that the photographs contradict in textureless
        regions: they are those of edges beside."""
        for depths in (self.depths, self.doubtful_depths, *others):
            for camera, found, depth in zip(self.cameras, along_edges, depths, strict=True):
                depth[found.refuses(camera, depth)] = np.nan

    def _known(self) -> list[np.ndarray]:
        """Return (H, W) the depths that are confirmed or on a plane, of every view, NaN elsewhere."""
        return [_first_known(pair) for pair in zip(self.depths, self.on_planes, strict=True)]

    def _points(self, maps: Sequence[DepthMap], known: Sequence[np.ndarray]) -> SurfacePoints:
        """Sample equally many points of the `known` depths of every view."""
        count, rng = points_per_view(self.cameras), np.random.default_rng(0)
        points = []
        for view, (found, depth) in enumerate(zip(maps, known, strict=True)):
            confirmed = np.isfinite(self.depths[view])[..., None]
            normal = np.where(confirmed, found.normal, plane_normals(found.camera, depth))
            points.append(SurfacePoints.of_view(view, found.camera, depth, normal, count, rng))
        return SurfacePoints.together(points)

    def _span_gaps(
        self,
        maps: Sequence[DepthMap],
        known: Sequence[np.ndarray],
        points: SurfacePoints,
        rendered: Sequence[np.ndarray],
        backgrounds: Sequence[np.ndarray],
    ) -> None:
        """Add depths of the surface that spans the `points` of `known` depths to the doubtful ones, except in
        background and at edges of the photographs, where rendered depths are finer."""
        spanned = spanned_depths(self.cameras, known, points, rendered)
        for view, (found, depth, background) in enumerate(zip(maps, spanned, backgrounds, strict=True)):
            depth[background | found.edges] = np.nan
            self.doubtful_depths[view] = _first_known((self.doubtful_depths[view], depth))
        self.spanned = _share_known(spanned)

    def _walls(
        self, maps: Sequence[DepthMap], seen: Sequence[np.ndarray], known: SurfacePoints
    ) -> tuple[list[EnclosingPlane], list[EnclosingPlane]]:
        """Return the planes that enclose what is `known`, with walls added that meet them in corners, and without
        these. The planes and the ends of walls are found from the `seen` (H, W) depths, as planes of textureless
        regions reach to edges that may belong to other things."""
        points = self._points(maps, seen)
        planes = enclosing_planes(self.cameras, self.planes, points, self.standing, known)
        return with_corner_walls(maps, seen, self._backgrounds(), planes, points), planes

    def _enclose(
        self,
        walls: Sequence[EnclosingPlane],
        known: Sequence[np.ndarray],
        sharp: Sequence[np.ndarray],
        regions: Sequence[Sequence[PlainRegion]],
        backgrounds: Sequence[np.ndarray],
    ) -> None:
        """Add depths of the `walls` that enclose what is `known` to the doubtful ones: where the rendered depth is not
        `sharp` (H, W), or is near a wall, or in textureless `regions` that lie on walls, but not in background.
        Doubtful depths stay if they are in front of a wall by more than their error, except in such regions."""
        wanted, shown = [], []
        for view, (frame, depth, background) in enumerate(zip(self.rendered, known, backgrounds, strict=True)):
            wanted.append((frame.depth > 0) & ~(background | np.isfinite(depth)))
            on_wall = region_depths(frame.camera, walls, depth, regions[view])
            shown.append(np.where(sharp[view] & ~np.isfinite(on_wall), frame.depth, np.nan))
            self.doubtful_depths[view] = _first_known((on_wall, self.doubtful_depths[view]))
        enclosed = enclosing_depths(self.cameras, walls, known, wanted, shown, self.doubtful_depths)
        enclosed = [
            np.where(doubtful < (1 - ON_IT) * depth, np.nan, depth)
            for doubtful, depth in zip(self.doubtful_depths, enclosed, strict=True)
        ]
        self.doubtful_depths = [_first_known(pair) for pair in zip(enclosed, self.doubtful_depths, strict=True)]
        self.enclosed = _share_known(enclosed)

    def _keep_things(
        self,
        views: Sequence[View],
        maps: Sequence[DepthMap],
        rendered: Sequence[np.ndarray],
        sharp: Sequence[np.ndarray],
    ) -> None:
        """Replace depths by the rendered ones of thin things in front of a wall, and of things known by their outlines,
        and treat these as confirmed. Where a confirmed depth is the same within its error it stays, as it is finer."""
        known = map(_first_known, zip(self.depths, self.on_planes, self.doubtful_depths, strict=True))
        seen = [
            RenderedView(found.camera, view.load().rgb, found.noise, depth, is_sharp, behind)
            for view, found, depth, is_sharp, behind in zip(views, maps, rendered, sharp, known, strict=True)
        ]
        thin, outlined = thin_things(seen), silhouette_bounded(seen)
        for view, thing in enumerate(map(np.logical_or, thin, outlined)):
            thing &= ~(np.abs(rendered[view] / self.depths[view] - 1) < CONFIRMED_DEPTH)
            self.depths[view] = np.where(thing, rendered[view], self.depths[view])
            for others in (self.on_planes, self.doubtful_depths):
                others[view] = np.where(thing, np.float32(np.nan), others[view])
        self.thin, self.outlined = (float(np.mean([thing.mean() for thing in things])) for things in (thin, outlined))

    def _end_backgrounds(self, maps: Sequence[DepthMap]) -> None:
        """Remove background at confirmed surfaces that no other view looks past, and at those with texture."""
        self._clear_background(lone_backgrounds(self.cameras, self._backgrounds(), self.depths))
        self._clear_background(textured_backgrounds(maps, self._backgrounds(), self.depths))

    def _backgrounds(self) -> list[np.ndarray]:
        return [_background_of(frame) for frame in self.rendered]

    def _clear_background(self, surfaces: Sequence[np.ndarray]) -> None:
        """Remove these pixels (H, W) of every view from the background: their rays end at a surface."""
        self.rendered = [
            frame if frame.background is None else replace(frame, background=frame.background & ~surface)
            for frame, surface in zip(self.rendered, surfaces, strict=True)
        ]

    def covered(self, mesh: Mesh) -> float:
        """Return the share of pixels with a rendered depth whose rays hit a mesh, of every SAMPLED-th row
        and column."""
        caster, shown, hit = MeshViews(mesh.vertices, mesh.faces), 0, 0
        for camera, sampled in zip(self.cameras, self.shown, strict=True):
            row, column = (x * SAMPLED for x in np.nonzero(sampled))
            shown += len(row)
            hit += np.count_nonzero(caster.first_hits(camera)[1][row, column] >= 0)
        return hit / max(shown, 1)

    def about(self) -> dict:
        """Return the numbers for the statistics."""
        return {
            "confirmed": self.confirmed,
            "doubtful": self.doubtful,
            "rendered_weight": self.weight,
            "flat": self.flat,
            "spanned": self.spanned,
            "enclosed": self.enclosed,
            "thin": self.thin,
            "outlined": self.outlined,
            "planes": len(self.planes),
            "depth_limit": self.limit,
        }

    def __len__(self) -> int:
        return len(self.rendered)

    def __getitem__(self, index):
        return self._merged(
            self.rendered[index], self.doubtful_depths[index], self.on_planes[index], self.depths[index]
        )

    def __iter__(self) -> Iterator[DepthFrame]:
        return map(self._merged, self.rendered, self.doubtful_depths, self.on_planes, self.depths)

    def _merged(
        self, frame: DepthFrame, doubtful: np.ndarray, on_plane: np.ndarray, confirmed: np.ndarray
    ) -> DepthFrame:
        depth, weight = frame.depth, np.full(frame.depth.shape, self.weight, np.float32)
        known = np.zeros(depth.shape, bool)
        for source, own_weight in ((doubtful, DOUBTFUL_WEIGHT), (on_plane, 1), (confirmed, 1)):
            better = self._fused(frame, source)
            depth, weight = np.where(better, source, depth), np.where(better, np.float32(own_weight), weight)
            known |= better
        clamped = None if frame.clamped is None else frame.clamped & ~known
        return DepthFrame(
            frame.camera,
            depth.astype(np.float32),
            background=frame.background,
            confidence=weight,
            clamped=clamped,
        )

    def _fused(self, frame: DepthFrame, source: np.ndarray) -> np.ndarray:
        """Return (H, W) bool: where depths of a source are fused."""
        known = source <= self.limit  # not where it is NaN
        # Beside an outline stereo windows match background as a part of the foreground.
        return known if frame.background is None else known & ~frame.background

    def supporting(self, points: np.ndarray, *, doubtful: bool = False) -> np.ndarray:
        """Return (P,) how many views fuse a depth that is confirmed or on a plane at these world points; with
        `doubtful`, doubtful depths count, too."""
        views = np.zeros(len(points), int)
        for frame, *sources in zip(self.rendered, self.depths, self.on_planes, self.doubtful_depths, strict=True):
            depth = _first_known(sources if doubtful else sources[:2])
            depth = np.where(self._fused(frame, depth), depth, np.nan)
            inside, row, column = in_image(frame.camera, points)
            along = frame.camera.project(points)[1]
            views += inside & (np.abs(depth[row, column] / along - 1) < CONFIRMED_DEPTH)
        return views

    def supported(self, mesh: Mesh, share: float, band: float) -> tuple[Mesh, float]:
        """Return the mesh without parts that views do not support, and the share of its area that is removed.

        Parts stay within half the `band`, in which depths vote, of vertices at which SUPPORTING_VIEWS have depths, even
        doubtful ones: elsewhere only rendered depths locate the surface, which without texture they cannot. A piece
        with less than `share` of the largest one's area stays only if SUPPORTED_SHARE of it has depths that are not
        doubtful, and if it is larger than the square of the `band`, as noise in the depths makes pieces that wide. A
        closed surface loses only whole pieces.
        """
        area = face_areas(mesh).sum()
        views = self.supporting(mesh.vertices, doubtful=True)
        left = mesh if mesh_is_closed(mesh) else _near(mesh, views >= SUPPORTING_VIEWS, band / 2)
        left = self._supported_pieces(left, share, band**2)
        return left, float(1 - face_areas(left).sum() / area) if area else 0.0

    def without_small_holes(self, mesh: Mesh) -> tuple[Mesh, int]:
        """Return the mesh with small holes closed that no view sees through, by depths that are confirmed or on a plane
        and by free rays, and the number of holes."""
        return without_small_holes(mesh, self.cameras, self._known(), self._backgrounds())

    def _supported_pieces(self, mesh: Mesh, share: float, least_area: float) -> Mesh:
        count, label = face_components(mesh)
        area = face_areas(mesh)
        of_piece = np.bincount(label, weights=area, minlength=count)
        keep = of_piece >= share * of_piece.max(initial=0)
        rows = np.flatnonzero((~keep & (of_piece >= least_area))[label])
        corners, faces = np.unique(mesh.faces[rows], return_inverse=True)
        supported = (self.supporting(mesh.vertices[corners]) >= SUPPORTING_VIEWS)[faces.reshape(-1, 3)].mean(1)
        of_supported = np.bincount(label[rows], weights=area[rows] * supported, minlength=count)
        return select_faces(mesh, (keep | (of_supported > SUPPORTED_SHARE * of_piece))[label])


def _near(mesh: Mesh, supported: np.ndarray, reach: float) -> Mesh:
    """Return the faces with a vertex at most `reach` from one of the `supported` (V,) vertices."""
    from scipy.spatial import cKDTree

    if not supported.any():
        return select_faces(mesh, np.zeros(len(mesh.faces), bool))
    distance = cKDTree(mesh.vertices[supported]).query(mesh.vertices[~supported], distance_upper_bound=reach)[0]
    near = supported.copy()
    near[~supported] = np.isfinite(distance)
    return select_faces(mesh, near[mesh.faces].any(1))


def pairing_points(rendered: Sequence[DepthFrame]) -> np.ndarray:
    """Return (P, 3) points of rendered surfaces by which stereo finds pairs of views, about POINTS, evenly over the
    frames."""
    surfaces = (frame.surface()[0] for frame in rendered)
    return np.concatenate([points[:: max(1, len(points) // max(1, POINTS // len(rendered)))] for points in surfaces])


def _seen_past(frame: DepthFrame, background: np.ndarray) -> DepthFrame:
    """Return the frame with free rays in (H, W) `background`."""
    if frame.background is None or not background.any():
        return frame
    return replace(
        frame,
        depth=np.where(background, np.float32(0), frame.depth),
        background=frame.background | background,
        clamped=None if frame.clamped is None else frame.clamped & ~background,
    )


def _background_of(frame: DepthFrame) -> np.ndarray:
    """Return the (H, W) bool background, False everywhere if the frame has none."""
    return np.zeros(frame.depth.shape, bool) if frame.background is None else frame.background


def _depth_where(found: DepthMap, taken: np.ndarray) -> np.ndarray:
    """Return the (H, W) depth where `taken`, NaN elsewhere."""
    return np.where(taken, found.depth, np.float32(np.nan))


def _first_known(depths: Sequence[np.ndarray]) -> np.ndarray:
    """Return (H, W) the first of several depths that is not NaN."""
    result = depths[0]
    for depth in depths[1:]:
        result = np.where(np.isfinite(result), result, depth)
    return result


def _share_known(depths: Sequence[np.ndarray]) -> float:
    return float(np.mean([np.isfinite(depth).mean() for depth in depths]))


class Deviations:
    """Relative deviations of confirmed depths from those of their neighbours, and of rendered depths from confirmed
    ones."""

    def __init__(self) -> None:
        self.stereo, self.rendered = [np.zeros(0, np.float32)], [np.zeros(0, np.float32)]

    def add(self, found: DepthMap, depth: np.ndarray, frame: DepthFrame) -> None:
        """Add those of a view, whose `depth` is NaN where it is not confirmed."""
        both = np.isfinite(depth) & (frame.depth > 0)
        self.stereo.append(found.deviation[both])
        self.rendered.append(np.abs(frame.depth[both] / depth[both] - 1))

    def weight(self) -> float:
        """Return the weight of rendered depths, see `MergedFrames`."""
        stereo, rendered = np.concatenate(self.stereo), np.concatenate(self.rendered)
        if not len(stereo):
            return 1.0
        # The difference of two equally accurate depths is larger than the error of one by sqrt(2).
        ratio = np.median(stereo) / np.sqrt(2) / max(float(np.median(rendered)), 1e-15)
        return float(min(1.0, ratio**2))
