"""The textured plane z = 0, analytic photographs of it, and meshes near it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from linprim_geo.capture.types import Photo
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.surface.normals import vertex_normals
from linprim_geo.synthetic.camera_paths import look_at

SIZE, FOCAL, DISTANCE = 96, 90.0, 3.0
FOOTPRINT = DISTANCE / FOCAL


def camera(eye):
    return Camera(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, look_at(np.array(eye), np.zeros(3)))


def ring(count=8, slant=0.8):
    """Returns cameras on a ring above the plane that look at the origin."""
    angles = 2 * np.pi * np.arange(count) / count
    return [camera((slant * np.cos(a) * DISTANCE, slant * np.sin(a) * DISTANCE, DISTANCE)) for a in angles]


def texture(x, y):
    """Returns the brightness of the plane z = 0, 0 to 1, with waves of four to eight footprints."""
    waves = np.sin(40 * x + 9 * y) + np.sin(31 * y - 14 * x) + np.sin(22 * (x + y))
    return 0.5 + 0.15 * waves


def photograph(view, paint=texture):
    """Returns the photograph of the plane by a camera; `paint`(x, y) is its brightness."""
    rays = view.world_rays()
    hit = view.center - rays * (view.center[2] / rays[..., 2])[..., None]
    value = np.round(255 * np.clip(paint(hit[..., 0], hit[..., 1]), 0, 1)).astype(np.uint8)
    return Photo(np.repeat(value[..., None], 3, axis=2))


class Shown:
    """A view of the plane: its camera and photograph."""

    def __init__(self, view, paint=texture):
        self.camera, self.photo = view, photograph(view, paint)

    def load(self):
        return self.photo


def sheet(height, reach=0.5, steps=41):
    """Returns the graph of `height`(x, y) as a grid of triangles that face upward."""
    line = np.linspace(-reach, reach, steps)
    x, y = np.meshgrid(line, line, indexing="ij")
    k = np.arange(steps * steps).reshape(steps, steps)
    a, b, c, d = k[:-1, :-1].ravel(), k[1:, :-1].ravel(), k[1:, 1:].ravel(), k[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    mesh = Mesh(np.stack([x.ravel(), y.ravel(), height(x, y).ravel()], 1), faces)
    return replace(mesh, normals=vertex_normals(mesh))


def inner(mesh, reach=0.4):
    """Marks the vertices less than `reach` from the origin in x and y."""
    return (np.abs(mesh.vertices[:, :2]) < reach).all(1)
