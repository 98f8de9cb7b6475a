"""Moves the outlines of a mesh to where masks show them.

A pixel on an outline mixes foreground and background, so photographs agree best slightly inside of it: vertices that
they have refined lie too far inside, by 0.15 pixels on the built-in part. A mask whose pixels hold the share that the
object covers locates the outline to a fraction of a pixel: summed along a line across it, the shares give how far the
object reaches. Only vertices on an outline move, and their neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from linprim_geo.capture.types import View
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.sampling import sample_bilinear, sample_nearest
from linprim_geo.surface.finish.photo_consistency import neighbour_average
from linprim_geo.surface.finish.safe_moves import moved_safely
from linprim_geo.surface.mesh_views import MeshViews

REACH, STEP = 2.0, 0.25
"""Pixels: how far on both sides an outline is searched for, and the spacing of samples. Parts narrower than REACH have
a second outline within it, and are left alone."""

NEAR = 0.5
"""Pixels: a vertex is on the outline if the mesh, as it is drawn, ends at most this far from it."""

BLUR, STEEPEST = 1.0, 0.4
"""Standard deviation in pixels of the Gaussian filter with which the mask's gradient is taken, and the slope of a
straight outline after a filter of 1 pixel: the peak of a normal density. A slope below half of it is no outline, or one
that bends within a pixel."""

UNEVEN = 0.05
"""Tolerance on coverage: it has to be 1 at the inner end, 0 at the outer end, and may rise by no more than this in
between."""

PARTLY = 0.5
"""Least number of partly covered pixels, as a share of the neighbouring pixel pairs of which one is at least half
covered and the other is not, for a mask to hold coverage: an outline partly covers every pixel that it runs through. A
mask of only 0 and 255 has no such pixels."""

SAMPLES = 3
"""Rays along each side of a pixel with which the mesh's coverage of the pixel is sampled."""

DEPTH_CHECK_INSET = 1.5
"""Pixels inside of an outline at which the depth of the mesh is checked. It may differ from that of the vertex by what
a sphere as large as the mesh's diagonal falls off there; if it differs by more, the outline is that of something else
in front or behind."""

PRIOR_VIEWS, RINGS, ROUNDS = 1.0, 1, 2
"""Weight of the present position of a vertex, in views; rings of neighbours over which moves are averaged; and how
often vertices move."""


def moved_to_outlines(mesh: Mesh, views: Sequence[View]) -> Mesh:
    """Return the mesh with the vertices on its outlines moved across these to the outlines of the masks, by least
    squares over the views, ROUNDS times, with new normals.

    Vertices go back where the surface would intersect itself. Views without a mask, or whose mask holds no coverage
    (PARTLY), are ignored. Memory: some 400 bytes per vertex. The result is identical to the last bit for any number of
    threads. Accuracy: the vertices on the outlines of a ball that is 0.3 pixels too small before 16 cameras are off by
    0.15 pixels in the mean afterwards (tests/surface/finish/test_outlines.py).
    """
    if len(mesh.faces) == 0 or not views or views[0].load().alpha is None:  # all views have masks, or none has
        return mesh
    views = [view for view in views if _has_coverage_mask(view)]
    if not views:
        return mesh
    for _ in range(ROUNDS):
        mesh = moved_safely(mesh, mesh.vertices + _moves(mesh, views))
    return mesh


def _has_coverage_mask(view: View) -> bool:
    """Return whether a view has a mask whose pixels hold coverage, see PARTLY."""
    if (alpha := view.load().alpha) is None:
        return False
    half = alpha >= 128
    changes = np.count_nonzero(half[1:] != half[:-1]) + np.count_nonzero(half[:, 1:] != half[:, :-1])
    return bool(changes > 0 and np.count_nonzero((alpha > 0) & (alpha < 255)) >= PARTLY * changes)


def _moves(mesh: Mesh, views: Sequence[View]) -> np.ndarray:
    """Return (V, 3) moves of the vertices, 0 for those neither on an outline nor beside one that is."""
    from scipy.sparse import csr_matrix

    count, faces, vertices = len(mesh.vertices), mesh.faces, mesh.vertices.astype(np.float64)
    caster, corners = MeshViews(vertices, faces, kept_bytes=0), vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    heights = np.einsum("fk,fk->f", normals, corners[:, 0])
    rows, columns = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    faces_of = csr_matrix((np.ones(len(rows), np.int32), (rows, columns)), (count, len(faces)))
    # Normal equations per vertex, summed over the views: o o^T and o s, where the outline lies s further in direction
    # o.
    squares, sums = np.zeros((count, 9)), np.zeros((count, 3))
    for view in views:
        camera = view.camera
        covered, depths, mixed = _covered(camera, caster)
        pixels, depth = camera.project(vertices)
        rows = np.flatnonzero(camera.shows(pixels, depth, margin=REACH + 1))
        rows = rows[sample_nearest(mixed, pixels[rows])]
        front = faces_of[rows] @ (normals @ camera.center > heights).astype(np.int32)
        rows = rows[(front > 0) & (front < np.diff(faces_of.indptr)[rows])]
        footprint = depth[rows] / camera.fx
        fall = np.sqrt(caster.diagonal * DEPTH_CHECK_INSET * footprint)
        told, across, ahead = _outlines_ahead(_shares(view), covered, depths, pixels[rows], depth[rows], fall)
        rows, across = rows[told], np.append(across, np.zeros((len(across), 1)), axis=1) @ camera.rotation
        towards = vertices[rows] - camera.center
        across -= (np.einsum("nk,nk->n", across, towards) / np.einsum("nk,nk->n", towards, towards))[:, None] * towards
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        squares[rows] += (across[:, :, None] * across[:, None, :]).reshape(-1, 9)
        sums[rows] += across * (ahead * footprint[told])[:, None]
    average = neighbour_average(mesh)
    for _ in range(RINGS):
        squares, sums = average @ squares, average @ sums
    moves, some = np.zeros((count, 3)), sums.any(1)
    prior = PRIOR_VIEWS * np.eye(3)
    moves[some] = np.linalg.solve(squares[some].reshape(-1, 3, 3) + prior, sums[some, :, None])[..., 0]
    return moves


def _shares(view: View) -> np.ndarray:
    """Return (H, W) float32: the share of each pixel that the mask of a view covers."""
    alpha = view.load().alpha
    assert alpha is not None
    return alpha / np.float32(255)


def _covered(camera: Camera, caster: MeshViews) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (H, W) float32 coverage of each pixel by the mesh (by SAMPLES squared rays near outlines), its depth at
    pixel centres, and bool: where an outline is near."""
    depths, face = caster.first_hits(camera)
    hit = face >= 0
    mixed = maximum_filter(hit, 3) & ~minimum_filter(hit, 3)
    row, column = np.nonzero(mixed)
    inside = (np.arange(SAMPLES) + 0.5) / SAMPLES
    x = (column[:, None, None] + inside - camera.cx) / camera.fx
    y = (row[:, None, None] + inside[:, None] - camera.cy) / camera.fy
    rays = np.stack(np.broadcast_arrays(x, y, 1.0), axis=-1).reshape(-1, 3) @ camera.rotation
    found = caster.cast_single(camera.center, rays)[1] >= 0
    covered = hit.astype(np.float32)
    covered[mixed] = found.reshape(-1, SAMPLES**2).mean(1)
    return covered, depths, mixed


def _outlines_ahead(
    shares: np.ndarray, covered: np.ndarray, depths: np.ndarray, pixels: np.ndarray, depth: np.ndarray, fall: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare the outlines of mesh and mask at vertices at (P, 2) `pixels` with (P,) `depth`.

    Returns: (P,) bool, which vertices are on an outline of both; for these N the (N, 2) unit directions across the
        outline, outwards, and by how many pixels the mask's outline lies further out than the mesh's.
    """
    told = np.zeros(len(pixels), bool)
    slopes = -np.stack(np.gradient(gaussian_filter(shares, BLUR))[::-1], axis=-1)
    slope = sample_bilinear(slopes, pixels)
    steepness = np.linalg.norm(slope, axis=1)
    rows = np.flatnonzero(steepness > 0.5 * STEEPEST / BLUR)
    across = slope[rows] / steepness[rows, None]

    places = np.arange(-REACH, REACH + STEP / 2, STEP)
    there = pixels[rows, None] + places[:, None] * across[:, None]
    profile = sample_bilinear(np.stack([shares, covered], axis=-1), there).astype(np.float64)
    mask, mesh = profile[..., 0], profile[..., 1]
    own = STEP * mesh.sum(1) - REACH
    behind = sample_nearest(depths, pixels[rows] - DEPTH_CHECK_INSET * across)
    fits = np.abs(behind - depth[rows]) < fall[rows]
    good = _ends(mask) & _ends(mesh) & (np.abs(own) <= NEAR) & fits
    told[rows[good]] = True
    return told, across[good], (STEP * mask.sum(1) - REACH - own)[good]


def _ends(profile: np.ndarray) -> np.ndarray:
    """Return (N,) bool: whether coverage is 1 at the first of (N, K) places, 0 at the last, and does not rise in
    between."""
    rises = np.maximum(np.diff(profile, axis=1), 0).sum(1)
    return (profile[:, 0] > 1 - UNEVEN) & (profile[:, -1] < UNEVEN) & (rises < UNEVEN)
