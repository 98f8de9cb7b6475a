"""A truncated signed distance field on sparse voxel blocks: integrates depth maps by weighted votes, extracts a mesh.

Every pixel is a surfel, a small plane: for a plane 1/z is linear in the pixel, so its position and tilt follow in
closed form from the inverse depths around the pixel. A voxel takes its distance from the plane of the pixel that it
projects to, which is exact on flat surfaces at any angle and resolution. `VoxelBlockGrid.integrate` takes the
difference of depths at the nearest pixel instead, a staircase that grows with the angle. A distance in front of a
surface is an upper bound on the true one, so near votes weigh more; far behind its surface a view knows nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.sorting import distinct
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, merge_vertices
from linprim_geo.kernels import surface_ops

NEAR_VOXELS = 1.5
"""Votes in front of a surface weigh 1 / (1 + (distance / this)^2): the nearest surface decides."""

BEHIND_VOXELS = 0.75
"""Votes behind a surface keep their full weight up to this distance along the ray, and lose it linearly over the same
distance again. Sheets thinner than this many voxels still come out with two sides; if the noise of the depths is
larger, it roughens the surface."""

BEHIND_WEIGHT = 0.05
"""Weight that remains from there up to the truncation. It decides only where no view has a better vote."""

FREE_WEIGHT = 0.3
"""Weight of the vote "free space: this ray passes on", against 1 for a vote on the surface. It counts only where the
other votes say "behind": so it overrules a few wrong depths, but does not push surfaces away."""

FAR_FRONT_WEIGHT = 0.15
"""Least weight of a vote in front of a surface, so that free space close to it stays free."""

GRAZED_WEIGHT = 1e-3
GRAZED_VOXELS = 1.25
GRAZED_REACH = 4.0
"""Votes behind surfaces seen at grazing angles. Such a surface may have no voxel within a truncation behind it along
the ray. So votes hold up to GRAZED_REACH truncations along the ray, as long as the plane is within GRAZED_VOXELS
voxels, with a weight so small that any other vote wins."""

LEAST_COSINE = 0.05
"""Least cosine between a pixel's ray and its plane's normal (87 degrees). Planes tilted further are depth
discontinuities; such a pixel gets a plane that faces its ray."""

SLOPE_RATIO = 3.0
"""The slopes towards two opposite neighbours are averaged if they differ by at most this factor; else the flatter one
is taken."""

ZERO_GAP = 2e-3
"""Field values are kept at least this far from 0 (in truncations), so that no vertex falls onto a voxel corner, where
several would coincide. Moves the surface by at most 0.006 voxel at a truncation of 3."""

LEAST_SUPPORT = 1e-6
"""Voxels with less weight than this count as unseen; it is far below the smallest weight that a vote can have."""


@dataclass(frozen=True)
class DepthFrame:
    """One view's depth map.

    `depth` (H, W) float is z along the optical axis at the pixel centres, in scene units; 0, negative, NaN and inf mean
    no surface. `background` (H, W) bool marks pixels without surface whose ray is known to be free; the others without
    surface are unknown. `confidence` (H, W) multiplies the weight of each pixel. `clamped` (H, W) bool marks depths
    that are only lower bounds: the ray is free up to there, and the surface lies at an unknown depth beyond.
    """

    camera: Camera
    depth: np.ndarray
    background: np.ndarray | None = None
    confidence: np.ndarray | None = None
    clamped: np.ndarray | None = None

    def __post_init__(self):
        wanted = (self.camera.height, self.camera.width)
        for name in ("depth", "background", "confidence", "clamped"):
            value = getattr(self, name)
            if value is not None and np.shape(value)[:2] != wanted:
                raise LinprimError(f"depth frame: {name} is {np.shape(value)}, but its camera has {wanted} pixels")

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (P, 3) float64 world points of the pixels that see a surface, and their (P,) depths."""
        depth = np.asarray(self.depth, dtype=np.float64)
        valid = np.isfinite(depth) & (depth > 0)
        if self.clamped is not None:
            valid &= ~self.clamped
        depth = depth[valid]
        return self.camera.world_rays()[valid] * depth[:, None] + self.camera.center, depth


# Columns of a frame's table, one row per pixel, see `Surfel` in csrc/surface/fuse.h.
WEIGHT, FREE = 4, 7


def surfels(frame: DepthFrame, voxel: float, truncation: float, origin: np.ndarray) -> np.ndarray:
    """Return the (H*W, 8) float32 table of a frame: plane, weight, cosine, nearest 1/z around, weight of free votes.

    Lengths are in the unit of the frame, planes relative to the `origin`.
    """
    depth = np.ascontiguousarray(frame.depth, np.float64)

    def marked(mask: np.ndarray | None) -> np.ndarray:
        return np.zeros(depth.shape, np.uint8) if mask is None else np.ascontiguousarray(mask, bool).view(np.uint8)

    confidence = np.ones(depth.shape)
    if frame.confidence is not None:
        confidence = np.nan_to_num(np.clip(np.asarray(frame.confidence, np.float64), 0.0, None))
    pose, lens = frame.camera.pinhole()
    pose = np.column_stack([pose[:, :3], pose[:, :3] @ origin + pose[:, 3]])
    rules = (voxel, truncation, SLOPE_RATIO, LEAST_COSINE)
    return surface_ops.make_surfels(
        pose, lens, depth, marked(frame.background), marked(frame.clamped), confidence, rules
    )


def vote_rules(truncation: float, behind: float, occluded: float) -> tuple[float, ...]:
    """Return the numbers of `VoteRules` in csrc/surface/fuse.h; `truncation` and `behind` are in voxels."""
    return (
        NEAR_VOXELS / truncation,
        FAR_FRONT_WEIGHT,
        behind / truncation,
        BEHIND_WEIGHT,
        GRAZED_VOXELS / truncation,
        GRAZED_REACH,
        GRAZED_WEIGHT,
        occluded,
    )


class Grid:
    """The field on its blocks: `blocks` (B, 3) int64 of `resolution`^3 voxels that are 2^level times `voxel` long, by
    `levels` (B,). `truncation` is in voxels of the block, or, where no view votes otherwise, in those of level `reach`
    (B,). Coordinates are relative to `origin`, where block (0, 0, 0) of every level starts."""

    def __init__(self, blocks, levels, reach, origin, voxel, truncation, resolution):
        self.blocks, self.levels, self.reach = np.ascontiguousarray(blocks), levels, reach
        self.origin = origin
        self.voxel, self.truncation, self.resolution = voxel, truncation, resolution
        size = resolution**3
        self.total = np.zeros((len(blocks), size), dtype=np.float32)
        self.weight = np.zeros((len(blocks), size), dtype=np.float32)
        self.free = np.zeros((len(blocks), size), dtype=np.float32)
        self.edge = voxel * 2.0**levels
        self.corner = (blocks * resolution + 0.5) * self.edge[:, None]

    def integrate(self, frame: DepthFrame, rules: tuple[float, ...]) -> None:
        """Add the votes of one frame to every block in its frustum; `rules` are `vote_rules`."""
        camera = frame.camera
        seen = self.in_view(camera)
        project = np.empty((3, 4))
        project[:, :3] = camera.K @ camera.rotation
        project[:, 3] = camera.K @ (camera.rotation @ self.origin + camera.world_to_camera[:3, 3])
        sums = (self.total, self.weight, self.free)
        for level in distinct(self.levels[seen]):
            rows, voxel = seen[self.levels[seen] == level], self.voxel * 2.0**level
            for reach in distinct(np.append(self.reach[rows], level)):
                table = surfels(frame, voxel, self.truncation * self.voxel * 2.0**reach, self.origin)
                if reach > level:  # weak votes, which decide only where there are no others
                    table[:, WEIGHT] *= GRAZED_WEIGHT
                    table[:, FREE] = 0
                these = rows if reach == level else rows[self.reach[rows] == reach]
                grid = rules, these, self.corner, voxel, self.resolution
                surface_ops.add_votes(project, camera.width, camera.height, table, *grid, *sums)

    def in_view(self, camera: Camera) -> np.ndarray:
        """Return the blocks whose bounding sphere meets the frustum."""
        middle = 0.5 * (self.resolution - 1) * self.edge
        centers = (self.corner + middle[:, None] + self.origin) @ camera.rotation.T + camera.world_to_camera[:3, 3]
        radius = np.sqrt(3.0) * middle
        seen = centers[:, 2] > -radius
        width, height = camera.width, camera.height
        for side in (
            (camera.fx, 0.0, camera.cx),
            (-camera.fx, 0.0, width - camera.cx),
            (0.0, camera.fy, camera.cy),
            (0.0, -camera.fy, height - camera.cy),
        ):
            seen &= centers @ (np.array(side) / np.linalg.norm(side)) > -radius
        return np.flatnonzero(seen)

    def extract(self) -> Mesh:
        """Return the surface in canonical order (`canonical_in_world`); empty if the field never changes sign. Frees
        the field."""
        return canonical_in_world(self.surface(np.ones(len(self.blocks), bool)), self.origin)

    def surface(self, owned: np.ndarray) -> Mesh:
        """Run marching cubes between voxels that any view has voted on, and return the part of the surface that belongs
        to the `owned` (B,) bool blocks (`surface_ops.marching_cubes`), relative to `origin`.

        Frees the field, to have its memory for the mesh.
        """
        field, weight, free = self.total, self.weight, self.free
        self.total = self.weight = self.free = None
        known = weight + free > LEAST_SUPPORT
        # Free votes tell the side of a voxel, not its distance: they count only against "behind".
        free *= np.float32(FREE_WEIGHT)
        free[field >= 0] = 0.0
        field += free
        weight += free
        voted = weight > LEAST_SUPPORT
        np.divide(field, weight, out=field, where=voted)
        field[~voted] = 1.0
        gap = np.where(field < 0, np.float32(-ZERO_GAP), np.float32(ZERO_GAP))
        np.copyto(field, gap, where=np.abs(field) < ZERO_GAP)
        del weight, free, gap, voted
        field *= (self.truncation * 2.0**self.levels).astype(np.float32)[:, None]
        vertices, faces = surface_ops.marching_cubes(
            self.blocks, self.levels, self.resolution, field, known.view(np.uint8), owned.view(np.uint8)
        )
        return Mesh(vertices * self.voxel, faces)


def canonical_in_world(surface: Mesh, origin: np.ndarray) -> Mesh:
    """Return surfaces of `Grid.surface`, one or several merged, in canonical order (`_canonical`) and in the frame of
    the cameras."""
    if len(surface.faces) == 0:
        return surface
    mesh = _canonical(surface)
    return replace(mesh, vertices=mesh.vertices + origin)


def _canonical(mesh: Mesh) -> Mesh:
    """Sort vertices by their coordinates and faces by their vertices, and merge coincident vertices."""
    order = np.lexsort(mesh.vertices.T[::-1])
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    mesh = merge_vertices(Mesh(mesh.vertices[order], rank[mesh.faces]))
    faces = mesh.faces
    first = np.argmin(faces, axis=1)
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return replace(mesh, faces=faces[np.lexsort(faces.T[::-1])])
