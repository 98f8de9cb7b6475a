"""Operators of the compiled core on surface points, meshes and voxels: TSDF votes of depth maps, colours from
photographs.

All arrays are C-contiguous numpy arrays; those described as sums are changed in place. `pose` is a camera's 12 numbers
(rotation rows, then translation) and `lens` its (fx, fy, cx, cy), both as returned by `Camera.pinhole`. Results are
bitwise the same for any number of threads. Arrays whose shape or type does not fit raise ValueError.
"""

from __future__ import annotations

import numpy as np

from linprim_geo import _core


def add_photo(
    pose, lens, image, depth, jump, rules, offset, point, normal, footprint, views, weight, value, square
) -> None:
    """Add a photograph's brightness along the normals of P points to the sums.

    Args:
        image, depth, jump: (H, W) float32 brightness, surface depth, and largest minus smallest depth of 3x3 pixels.
        rules: smallest cosine between a view and the normal, and the factor by which a depth jump must exceed that of
            the slope to count as an outline.
        offset: (K,) float64 positions along the normal, in footprints.
        point, normal, footprint: (P, 3), (P, 3), (P,) float64.
        views, weight, value, square: (P,) int32, (P,) float32, (P, K), (P, K) float32 sums.
    """
    _core.add_photo(
        pose, lens, image, depth, jump, rules, offset, point, normal, footprint, views, weight, value, square
    )


def least_footprints(pose, lens, width: int, height: int, least_cosine: float, point, normal, least) -> None:
    """Lower `least` (P,) float64 to the pixel footprint of this view at (P, 3) float64 points, for points in its image
    with a viewing cosine above `least_cosine`."""
    _core.least_footprints(pose, lens, width, height, least_cosine, point, normal, least)


def visible_points(pose, lens, width: int, height: int, point) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project (P, 3) float64 points into an image.

    Returns: (P,) bool whether each is in front of the camera and in the image; of these, in their order, (Q, 2) float64
    columns and rows (0.5 is the centre of the first pixel), and (Q,) float64 depths along the optical axis.
    """
    inside = np.empty(len(point), np.uint8)
    place, depth = _core.visible_points(pose, lens, width, height, point, inside)
    return inside.view(bool), place.reshape(-1, 2), depth


def count_looking_views(views, point, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Count the views that see each of (P, 3) float64 points, and those among them with a depth there.

    A view sees a point in its image unless the view's depth is smaller than the point's by more than the share
    `margin`. It knows the depth if it has one that differs by no more than that.

    Args:
        views: (pose, lens, depth) of each, with depth (H, W) float32, NaN where there is none.

    Returns: (P,) int32 each.
    """
    looking, knowing = np.empty(len(point), np.int32), np.empty(len(point), np.int32)
    _core.count_looking_views(list(views), point, margin, looking, knowing)
    return looking, knowing


def add_colors(pose, lens, image, depth, near, far, rules, point, normal, best, shade, good) -> None:
    """Add a photograph's colours as samples of P points, each of which keeps its best samples.

    Args:
        image: (H, W, 3) float32, or (H, W, 4) with alpha from 0 to 255 and premultiplied colours.
        depth, near, far: (H, W) float32 surface depth, and smallest and largest depth of 3x3 pixels.
        rules: four numbers, see csrc/surface/point_colors.h.
        point, normal: (P, 3) float64.
        best, shade, good: (P, K) float32 weights, (P, K, 3) float32 colours, (P,) uint8 numbers of good samples; the
            sums.
    """
    _core.add_colors(pose, lens, image, depth, near, far, rules, point, normal, best, shade, good)


def face_samples(pose, lens, depth, vertex, corner, bary, behind: float, slack: float, skip, found) -> None:
    """Set bit s of `found` (F,) uint8 where sample s of a face may be visible: it lies in the image, and no deeper than
    (1 + behind) d + slack, with d the largest depth of the four pixels around it.

    Args:
        depth: (H, W) float32.
        vertex, corner: (V, 3) float64, (F, 3) int64.
        bary: (S, 3) float64 barycentric coordinates of the samples.
        skip: (F,) uint8, faces to leave out.
    """
    _core.face_samples(pose, lens, depth, vertex, corner, bary, behind, slack, skip, found)


def points_within(center, normal, offset, point, enlarged: float, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the points inside each of N convex bodies. Returns (N,) int64 counts and the indices of all points, body by
    body.

    A body { x : normal_f . (x - center) <= offset_f } is `enlarged` about its centre. A body that contains fewer than
    `least` points without enlargement gets none. `center` (N, 3), `normal` (N, F, 3), `offset` (N, F), `point` (P, 3)
    are float64.
    """
    return _core.points_within(center, normal, offset, point, enlarged, least)


def first_hits(pose, lens, width: int, height: int, vertex, corner) -> tuple[np.ndarray, np.ndarray]:
    """Return the first hits of the rays through the pixel centres of a view with a mesh of (V, 3) float64 vertices and
    (M, 3) int64 faces: (H, W) float32 depth along the optical axis, infinite for a miss, and (H, W) int32 face, -1 for
    a miss."""
    depth, face = np.empty((height, width), np.float32), np.empty((height, width), np.int32)
    _core.first_hits(pose, lens, vertex, corner, depth, face)
    return depth, face


def make_surfels(pose, lens, depth, background, clamped, confidence, rules) -> np.ndarray:
    """Return (H W, 8) float32 surfels, one plane per pixel of a depth map, see csrc/surface/fuse.h and surfels.h.

    Args:
        depth: (H, W) float64; no surface where it is not positive and finite.
        background, clamped: (H, W) uint8: where there is no surface and the ray is free, and where the depth is only a
            lower bound.
        confidence: (H, W) float64, not negative.
        rules: voxel size and truncation as lengths, and two more numbers, see csrc/surface/surfels.h.
    """
    table = np.empty((depth.size, 8), np.float32)
    _core.make_surfels(pose, lens, depth, background, clamped, confidence, rules, table)
    return table


def add_votes(
    project, width: int, height: int, surfels, rules, rows, corner, voxel: float, resolution: int, total, weight, free
) -> None:
    """Add the votes of a depth map to the voxels of the blocks `rows` of a sparse grid (TSDF fusion).

    Args:
        project: 12 numbers, rows of the matrix from world to pixels times depth.
        surfels: (H W, columns) float32, a plane per pixel, see csrc/surface/fuse.h.
        rules: eight numbers that define the weight of a vote by its distance, see csrc/surface/fuse.h.
        rows: (K,) int64 blocks.
        corner: (B, 3) float64, the first voxel of each block.
        total, weight, free: (B, resolution^3) float32 sums.
    """
    _core.add_votes(project, width, height, surfels, rules, rows, corner, voxel, resolution, total, weight, free)


def marching_cubes(index, level, resolution: int, distance, known, owned) -> tuple[np.ndarray, np.ndarray]:
    """Extract the surface between inside and outside voxels, for non-overlapping blocks of several sizes, without
    cracks.

    A voxel of level l has side 2^l, in units of the finest voxel, as all lengths here; its distance is taken at its
    centre. Block (0, 0, 0) of any level starts at the origin. The result is a manifold, except at borders, if the
    levels of touching blocks differ by at most one. Source: Schaefer and Warren 2004.

    Args:
        index: (B, 3) int64, in blocks of its level.
        level: (B,) int64, from 0.
        distance: (B, resolution^3) float32, x fastest, negative inside, never 0.
        known: (B, resolution^3) uint8; there is no surface next to an unknown voxel.
        owned: (B,) uint8; only cubes whose first smallest block is owned are processed.

    Returns:
        (V, 3) float64 vertices, (F, 3) int64 faces, counter-clockwise seen from outside.
    """
    vertices, faces = _core.marching_cubes(index, level, resolution, distance, known, owned)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def filter_normals(corner, bound, contrast: float, normal_rounds: int, vertex_rounds: int, vertex) -> None:
    """Smooth a mesh while keeping its edges: move the vertices so that face normals become more like those of their
    neighbours.

    Each of `normal_rounds` averages the normals of faces that share a vertex, weighted by area and Tukey's weight of
    their difference; each of `vertex_rounds` moves vertices towards the planes of their faces. Source: Zheng et al.
    2011, Sun et al. 2007.

    Args:
        corner: (M, 3) int64 faces.
        bound: (V,) float64, largest displacement of each vertex.
        contrast: length of the difference of two unit normals from which their weight is 0.
        vertex: (V, 3) float64, changed in place.
    """
    _core.filter_normals(corner, bound, contrast, normal_rounds, vertex_rounds, vertex)


def crease_edges(corner, vertex, rules) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return, for mesh edges that cross creases or lie next to such edges, the planes on which their ends lie.

    Args:
        corner: (M, 3) int64 faces.
        vertex: (V, 3) float64.
        rules: nine numbers, see csrc/surface/crease_sides.h.

    Returns:
        (E, 2) int64 end vertices, the lower index first, sorted; (E, 2, 4) the plane n . x = d of each end as n, d;
            (E,) bool whether the two planes meet at a crease between the ends; (E,) the length of edges around. Edges
            that do not cross a crease share a face with an end of one that does; edges of flat faces are not included.
    """
    end, plane, crosses, length = _core.crease_edges(corner, vertex, rules)
    return end.reshape(-1, 2), plane.reshape(-1, 2, 4), crosses.astype(bool), length


def normals(corner, vertex) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals of the (V, 3) float64 vertices and of the (M, 3) int64 faces of a mesh, (V, 3) and (M, 3).

    Vertex normals are averages of face normals, weighted by the angle of the face at the vertex. Zero for vertices
    without faces and faces without area.
    """
    vertices, faces = _core.normals(corner, vertex)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def crossings(corner, vertex, end) -> tuple[np.ndarray, np.ndarray]:
    """Return faces of a mesh and edges that pass through them without a common vertex, see csrc/surface/crossings.h.

    Args:
        corner: (M, 3) int64 faces.
        vertex: (V, 3) float64.
        end: (E, 2) int64 vertices of the edges.

    Returns:
        (N,) int64 faces and (N,) int64 edges, sorted by edge and then by face.
    """
    return _core.crossings(corner, vertex, end)


def simplify(corner, vertex, tolerance) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh with fewer faces that passes every original vertex within its tolerance; borders move by no more
    than it.

    Edges are collapsed by quadric error as long as removed vertices stay close enough; the topology is preserved.
    Source: Garland and Heckbert 1997, Hoppe 1996.

    Args:
        corner: (M, 3) int64 faces.
        vertex: (V, 3) float64.
        tolerance: (V,) float64, positive.

    Returns:
        (W, 3) float64 vertices, (F, 3) int64 faces.
    """
    vertices, faces = _core.simplify(corner, vertex, tolerance)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)
