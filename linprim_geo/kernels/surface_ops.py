"""The core's functions on surface points and voxels: votes of depth maps, brightness and colours from photographs.

All arrays are C-contiguous numpy arrays; those named as sums are changed in place. `pose` is a camera's 12 numbers
(rotation rows, then translation) and `lens` its (fx, fy, cx, cy), both as `Camera.pinhole` gives them. Results are the
same to the last bit for any number of threads. Arrays whose shape or type does not fit raise ValueError.
"""

from __future__ import annotations

import numpy as np

from linprim_geo import _core


def add_photo(
    pose, lens, image, depth, jump, rules, offset, point, normal, footprint, views, weight, value, square
) -> None:
    """Adds a photograph's brightness along the normals of P points to the sums.

    Args:
        image, depth, jump: (H, W) float32 brightness, depth of the surface, and largest less least depth of 3x3 pixels.
        rules: least cosine of a view onto a point, and how many times the slope's depth jump makes an outline.
        offset: (K,) float64 places along the normal, in footprints.
        point, normal, footprint: (P, 3), (P, 3), (P,) float64.
        views, weight, value, square: (P,) int32, (P,) float32, (P, K), (P, K) float32 sums.
    """
    _core.add_photo(
        pose, lens, image, depth, jump, rules, offset, point, normal, footprint, views, weight, value, square
    )


def least_footprints(pose, lens, width: int, height: int, least_cosine: float, point, normal, least) -> None:
    """Lowers `least` (P,) float64 to the length that a pixel of this view covers at (P, 3) float64 points, where the
    view looks at them under more than `least_cosine` and they lie in the image."""
    _core.least_footprints(pose, lens, width, height, least_cosine, point, normal, least)


def visible_points(pose, lens, width: int, height: int, point) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where (P, 3) float64 points lie in an image.

    Returns: (P,) bool whether each is in front of the camera and in the image; of these, in their order, (Q, 2) float64
    columns and rows, 0.5 in the middle of the first pixel, and (Q,) float64 depths along the optical axis.
    """
    inside = np.empty(len(point), np.uint8)
    place, depth = _core.visible_points(pose, lens, width, height, point, inside)
    return inside.view(bool), place.reshape(-1, 2), depth


def count_looking_views(views, point, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """How many views look at each of (P, 3) float64 points, and how many of these know a depth there.

    A view looks at a point in its image unless its depth there is less than the point's by more than the share `margin`
    of that, and knows it if it has one that differs by no more.

    Args:
        views: (pose, lens, depth) of each, with depth (H, W) float32, NaN where there is none.

    Returns: (P,) int32 each.
    """
    looking, knowing = np.empty(len(point), np.int32), np.empty(len(point), np.int32)
    _core.count_looking_views(list(views), point, margin, looking, knowing)
    return looking, knowing


def add_colors(pose, lens, image, depth, near, far, rules, point, normal, best, shade, good) -> None:
    """Offers a photograph's colours to P points, of which each keeps its best samples.

    Args:
        image: (H, W, 3) float32, or (H, W, 4) with alpha from 0 to 255, by which the others are multiplied already.
        depth, near, far: (H, W) float32 depth of the surface, least and largest depth of 3x3 pixels.
        rules: four numbers, see csrc/surface/point_colors.h.
        point, normal: (P, 3) float64.
        best, shade, good: (P, K) float32 weights, (P, K, 3) float32 colours, (P,) uint8 how many good ones; the sums.
    """
    _core.add_colors(pose, lens, image, depth, near, far, rules, point, normal, best, shade, good)


def face_samples(pose, lens, depth, vertex, corner, bary, behind: float, slack: float, skip, found) -> None:
    """Sets bit s of `found` (F,) uint8 where sample s of a face may be seen: it lies in the image, and no farther than
    (1 + behind) d + slack for the largest depth d of the four pixels round it.

    Args:
        depth: (H, W) float32.
        vertex, corner: (V, 3) float64, (F, 3) int64.
        bary: (S, 3) float64 barycentric coordinates of the samples.
        skip: (F,) uint8, faces that are left out.
    """
    _core.face_samples(pose, lens, depth, vertex, corner, bary, behind, slack, skip, found)


def points_within(center, normal, offset, point, enlarged: float, least: int) -> tuple[np.ndarray, np.ndarray]:
    """The points within each of N convex bodies: (N,) int64 how many, and the rows of them all, body by body.

    A body { x : normal_f . (x - center) <= offset_f } is `enlarged` about its centre; one in which fewer than `least`
    points lie as it is has none. `center` (N, 3), `normal` (N, F, 3), `offset` (N, F), `point` (P, 3) are float64.
    """
    return _core.points_within(center, normal, offset, point, enlarged, least)


def first_hits(pose, lens, width: int, height: int, vertex, corner) -> tuple[np.ndarray, np.ndarray]:
    """What the rays through the pixel centres of a view hit first of a mesh with (V, 3) float64 vertices and (M, 3)
    int64 faces: (H, W) float32 depth along the optical axis, infinite for nothing, and (H, W) int32 face, there -1."""
    depth, face = np.empty((height, width), np.float32), np.empty((height, width), np.int32)
    _core.first_hits(pose, lens, vertex, corner, depth, face)
    return depth, face


def make_surfels(pose, lens, depth, background, clamped, confidence, rules) -> np.ndarray:
    """(H W, 8) float32, a plane per pixel of a depth map, see csrc/surface/fuse.h and surfels.h.

    Args:
        depth: (H, W) float64; no surface where it is not positive and finite.
        background, clamped: (H, W) uint8, where there is no surface and the ray is free, and where the depth is only a
            least one.
        confidence: (H, W) float64, not negative.
        rules: voxel and truncation as lengths, and two numbers more, see csrc/surface/surfels.h.
    """
    table = np.empty((depth.size, 8), np.float32)
    _core.make_surfels(pose, lens, depth, background, clamped, confidence, rules, table)
    return table


def add_votes(
    project, width: int, height: int, surfels, rules, rows, corner, voxel: float, resolution: int, total, weight, free
) -> None:
    """Adds the votes of a depth map to the voxels of the blocks `rows` of a sparse grid.

    Args:
        project: 12 numbers, rows of world to pixels times depth.
        surfels: (H W, columns) float32, a plane per pixel, see csrc/surface/fuse.h.
        rules: eight numbers, how much a vote weighs by its distance, see csrc/surface/fuse.h.
        rows: (K,) int64 blocks.
        corner: (B, 3) float64, the first voxel of each block.
        total, weight, free: (B, resolution^3) float32 sums.
    """
    _core.add_votes(project, width, height, surfels, rules, rows, corner, voxel, resolution, total, weight, free)


def marching_cubes(index, level, resolution: int, distance, known, owned) -> tuple[np.ndarray, np.ndarray]:
    """The surface between voxels inside and outside, of blocks of several sizes that do not overlap, without cracks.

    A voxel of level l is 2^l long, in finest voxels, as are all lengths; it has its distance at its centre. Block
    (0, 0, 0) of any level starts at the origin. A manifold, but for borders, if the levels of blocks that touch differ
    by one at most. Source: Schaefer and Warren 2004.

    Args:
        index: (B, 3) int64, in blocks of its level.
        level: (B,) int64, from 0.
        distance: (B, resolution^3) float32, x fastest, negative inside, never 0.
        known: (B, resolution^3) uint8; there is no surface beside a voxel that is not.
        owned: (B,) uint8; only cubes are marched of which the first of the smallest blocks is owned.

    Returns:
        (V, 3) float64 vertices, (F, 3) int64 faces, counter-clockwise seen from outside.
    """
    vertices, faces = _core.marching_cubes(index, level, resolution, distance, known, owned)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def filter_normals(corner, bound, contrast: float, normal_rounds: int, vertex_rounds: int, vertex) -> None:
    """Moves the vertices of a mesh so that the normals of its faces become those of their neighbours, but for edges.

    Each of `normal_rounds` averages the normals of faces that share a vertex, by area and Tukey's weight of their
    difference; each of `vertex_rounds` moves vertices towards the planes of their faces. Source: Zheng et al. 2011,
    Sun et al. 2007.

    Args:
        corner: (M, 3) int64 faces.
        bound: (V,) float64, no vertex moves farther.
        contrast: length of the difference of two unit normals from which on they have nothing to do with each other.
        vertex: (V, 3) float64, changed in place.
    """
    _core.filter_normals(corner, bound, contrast, normal_rounds, vertex_rounds, vertex)


def crease_edges(corner, vertex, rules) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The planes on which the ends of edges of a mesh lie that go across creases, or are beside such edges.

    Args:
        corner: (M, 3) int64 faces.
        vertex: (V, 3) float64.
        rules: nine numbers, see csrc/surface/crease_sides.h.

    Returns:
        (E, 2) int64 ends, the lower one first, in order; (E, 2, 4) the plane n . x = d of each as n, d; (E,) bool
        whether the two meet at a crease between the ends; (E,) the length of edges around. Those that do not cross
        share a face with an end of one that does, and edges of flat faces are none of them.
    """
    end, plane, crosses, length = _core.crease_edges(corner, vertex, rules)
    return end.reshape(-1, 2), plane.reshape(-1, 2, 4), crosses.astype(bool), length


def normals(corner, vertex) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals of the (V, 3) float64 vertices of a mesh, those of its (M, 3) int64 faces averaged by the angles of
    the faces there, and of the faces: (V, 3) and (M, 3). Zero for vertices of no face and faces without area."""
    vertices, faces = _core.normals(corner, vertex)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def crossings(corner, vertex, end) -> tuple[np.ndarray, np.ndarray]:
    """Faces of a mesh and edges that go through them without sharing a vertex, see csrc/surface/crossings.h.

    Args:
        corner: (M, 3) int64 faces.
        vertex: (V, 3) float64.
        end: (E, 2) int64 vertices of the edges.

    Returns:
        (N,) int64 faces and (N,) int64 edges, by edge and then by face.
    """
    return _core.crossings(corner, vertex, end)


def simplify(corner, vertex, tolerance) -> tuple[np.ndarray, np.ndarray]:
    """Fewer faces that pass every vertex of a mesh within its tolerance; borders stay within it of where they were.

    Edges are collapsed by quadric error, as long as what is gone stays near enough; the topology stays. Source: Garland
    and Heckbert 1997, Hoppe 1996.

    Args:
        corner: (M, 3) int64 faces.
        vertex: (V, 3) float64.
        tolerance: (V,) float64, positive.

    Returns:
        (W, 3) float64 vertices, (F, 3) int64 faces.
    """
    vertices, faces = _core.simplify(corner, vertex, tolerance)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)
