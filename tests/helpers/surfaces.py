"""Triangulated shapes with known distances, and a camera above them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from linprim_geo.eval.surface_samples import refine
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh

# Keys that users of the scores of a mesh rely on: the scores, and the settings that they were computed with.
SCORES = {
    *("accuracy", "completeness", "chamfer", "precision", "recall", "f1", "normal_consistency", "hausdorff"),
    "standard_error",
}
CONTEXT = {"protocol", "unit", "tau", "samples", "seed", "seconds"}


def grid(columns=4, rows=3, size=(2.0, 1.0), height=0.0):
    """Returns a rectangle with a corner at the origin, facing +z, cut into columns x rows x 2 triangles."""
    x, y = np.meshgrid(np.linspace(0, size[0], columns + 1), np.linspace(0, size[1], rows + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], 1)
    a = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    b, c, d = a + 1, a + columns + 2, a + columns + 1
    return Mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def sphere(radius=1.0, rounds=3, center=(0.0, 0.0, 0.0)):
    """Returns an octahedron whose faces are split into four `rounds` times, with all vertices moved onto the sphere."""
    vertices = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([(a, b, c) for a in (0, 3) for b in (1, 4) for c in (2, 5)])
    outward = np.linalg.det(vertices[faces]) > 0
    mesh = Mesh(vertices, np.where(outward[:, None], faces, faces[:, ::-1]))
    for _ in range(rounds):
        mesh = refine(mesh, 0.0, max_faces=4 * len(mesh.faces))
        mesh = Mesh(mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True), mesh.faces)
    return replace(mesh, vertices=mesh.vertices * radius + np.asarray(center))


def inradius(mesh):
    """Returns the smallest distance of the origin from a face's plane: a triangulated sphere lies between it and the
    radius."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return float((np.einsum("ij,ij->i", normal, a) / np.linalg.norm(normal, axis=1)).min())


def wavy():
    """Returns an open surface whose distance to the rectangle below it varies."""
    mesh = grid(30, 20)
    x, y, _ = mesh.vertices.T
    return replace(mesh, vertices=np.stack([x, y, 0.05 * np.sin(7 * x) * np.cos(5 * y) + 0.02 * x], 1))


def join(*meshes):
    """Returns one mesh of several."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets[:-1], strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def rotation(seed=0):
    """Returns a random rotation matrix."""
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def camera_above(height, focal=100.0, target=(0.0, 0.0)):
    """Returns a camera of 200 x 200 pixels that looks straight down at `target`."""
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = -pose[:3, :3] @ np.array([*target, height])
    return Camera(200, 200, focal, focal, 100.0, 100.0, pose)


def edge_uses(faces: np.ndarray) -> np.ndarray:
    """Returns for each edge of (M, 3) faces the number of faces that have it."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(edges[:, 0] * (faces.max() + 1) + edges[:, 1], return_counts=True)[1]


def areas(vertices, faces):
    """Returns the (F,) areas of triangles."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
