"""Makes a surface as smooth as its predicted error allows.

Where depths are exact they fix the surface. Where they are not, as on a column of one colour between two outlines, the
fused surface is a crumpled sheet within its predicted error; any smooth surface within that error is as likely, and as
a rule nearer to the true one. One energy weighs data and smoothness for all vertices x at once, with v the given
positions:

    sum over vertices of  |x - v|^2 / error^2  +  |mean of x at the neighbours - x|^2 / bend^2
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from linprim_geo.geometry.mesh import Mesh
from linprim_geo.surface.normals import vertex_normals

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

BEND = 0.1
"""Distance of a vertex from the mean of its neighbours, in edge lengths, that costs as much as being off by its
predicted error: that of a radius of curvature of five edges."""

ROUNDS, PRECISION = 300, 1e-3
"""Most iterations of conjugate gradients, and the relative residual at which they stop."""


def faired(mesh: Mesh) -> Mesh:
    """Return the mesh with the vertices of least energy, each at most its `quality` from where it was, with new
    normals.

    A boundary vertex has only its two neighbours along the boundary, and moves only along its normal, so that holes do
    not grow. All edges have equal weight, which suits meshes from voxels; the edges of slivers pull too hard. Memory:
    some 500 bytes per vertex. The result is identical to the last bit for any number of threads.

    Args:
        mesh: with a positive `quality`, the predicted error in the mesh's unit.

    Source: Desbrun and others 1999, implicit fairing, of second order; the weights are those of least squares.
    """
    assert mesh.quality is not None
    vertices, error = mesh.vertices.astype(np.float64), mesh.quality.astype(np.float64)
    moves, border = _least(mesh, vertices, error)
    normals = vertex_normals(replace(mesh, vertices=vertices + moves))[border].astype(np.float64)
    moves[border] = (moves[border] * normals).sum(1, keepdims=True) * normals
    moves *= np.minimum(1, error / np.maximum(np.linalg.norm(moves, axis=1), 1e-300))[:, None]
    mesh = replace(mesh, vertices=vertices + moves)
    return replace(mesh, normals=vertex_normals(mesh))


def _least(mesh: Mesh, vertices: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (V, 3) moves to the least energy, and (V,) bool: which vertices are on a boundary."""
    from scipy.sparse.linalg import LinearOperator, cg

    bending, border = _off_the_mean(mesh)
    corners = vertices[mesh.faces]
    bend = BEND * np.median(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2))
    bending_back, held = bending.T.tocsr(), ((bend / error) ** 2)[:, None]
    diagonal = held + np.asarray(bending_back.power(2).sum(1))

    def pull(moves: np.ndarray) -> np.ndarray:
        moves = moves.reshape(-1, 3)
        return (held * moves + bending_back @ (bending @ moves)).ravel()

    def scaled(moves: np.ndarray) -> np.ndarray:
        return (moves.reshape(-1, 3) / diagonal).ravel()

    shape = (vertices.size, vertices.size)
    wanted = -(bending_back @ (bending @ vertices)).ravel()
    solve = LinearOperator(shape, pull), LinearOperator(shape, scaled)
    return cg(solve[0], wanted, rtol=PRECISION, maxiter=ROUNDS, M=solve[1])[0].reshape(-1, 3), border


def _off_the_mean(mesh: Mesh) -> tuple[csr_matrix, np.ndarray]:
    """Return the (V, V) matrix of the mean of a vertex's neighbours less its own value, and (V,) bool: which vertices
    are on a boundary.

    A boundary vertex has only its neighbours along the boundary. Where boundaries meet in a vertex its row is zero.
    """
    from scipy.sparse import coo_matrix, diags

    first, second = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    ends, count = (np.concatenate([first, second]), np.concatenate([second, first])), len(mesh.vertices)
    faces = coo_matrix((np.ones(len(ends[0])), ends), shape=(count, count)).tocsr()  # number of faces at each edge
    row = np.repeat(np.arange(count), np.diff(faces.indptr))
    along = faces.data == 1
    border = np.bincount(row[along], minlength=count) > 0
    faces.data[:] = along | ~border[row]
    neighbours = np.bincount(row, faces.data, minlength=count)
    neighbours[border & (neighbours != 2)] = 0
    faces.eliminate_zeros()
    share = np.divide(1, neighbours, out=np.zeros(count), where=neighbours > 0)
    return (diags(share) @ faces - diags((neighbours > 0).astype(float))).tocsr(), border
