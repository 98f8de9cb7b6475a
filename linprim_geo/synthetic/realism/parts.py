"""Parts of a path-traced scene: triangles with a material, and functions that make basic shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.synthetic.textured import TexturedMesh

Image = np.ndarray
"""(H, W, 3) uint8 in sRGB, the first row at v = 1."""


@dataclass(frozen=True)
class Material:
    """The reflectance of a surface.

    `kind` is `diffuse`, `plastic` (a rough clear coat over a diffuse base) or `metal`. `color` is three sRGB values in
    [0, 1] or an image looked up by uv; it is ignored if the part has colours of its own. `roughness` is the alpha of
    the GGX distribution of coat and metal.
    """

    kind: str = "diffuse"
    color: tuple[float, float, float] | Image = (0.5, 0.5, 0.5)
    roughness: float = 0.2


@dataclass(frozen=True)
class Part:
    """Triangles of one material, in metres, z up.

    `vertices` (V, 3), `faces` (F, 3), `uv` (V, 2) or None, `colors` (V, 3) sRGB in [0, 1] or None; `smooth` is whether
    shading normals are interpolated.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    material: Material
    uv: np.ndarray | None = None
    colors: np.ndarray | None = None
    smooth: bool = False

    def moved(self, offset: Sequence[float], turn_deg: float = 0.0) -> Part:
        """Return the part rotated about the z axis and then translated."""
        angle = np.deg2rad(turn_deg)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
        return replace(self, vertices=self.vertices @ turn.T + np.asarray(offset, dtype=np.float64))


def quad(name: str, corner, edge_u, edge_v, material: Material, *, tile: float = 0.0) -> Part:
    """Return a parallelogram with normal edge_u x edge_v; `tile` is the size of one repetition of the image, metres; 0
    stretches it over the whole."""
    corner, edge_u, edge_v = (np.asarray(value, dtype=np.float64) for value in (corner, edge_u, edge_v))
    size = np.array([np.linalg.norm(edge_u), np.linalg.norm(edge_v)])
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64)
    vertices = corner + uv[:, :1] * edge_u + uv[:, 1:] * edge_v
    return Part(name, vertices, np.array([[0, 1, 2], [0, 2, 3]]), material, uv * size / tile if tile else uv)


def box(name: str, lower, upper, material: Material, *, tile: float = 0.0, sides: str = "xXyYzZ") -> Part:
    """Return an axis-parallel box with outward faces; `sides` selects its sides, capital letters are the upper ones."""
    lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    dx, dy, dz = np.diag(upper - lower)
    low, high = lower, upper
    # Corner, u and v of each side; u runs along the longer horizontal edge where there is a choice.
    every = {
        "x": (low + dy, -dy, dz),
        "X": (high - dy - dz, dy, dz),
        "y": (low, dx, dz),
        "Y": (high - dz, -dx, dz),
        "z": (low + dy, dx, -dy),
        "Z": (low + dz, dx, dy),
    }
    return joined(name, [quad(name, *every[side], material, tile=tile) for side in sides])


def joined(name: str, parts: Sequence[Part]) -> Part:
    """Return parts as one part with the material of the first."""
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return replace(
        parts[0],
        name=name,
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([part.faces + first for part, first in zip(parts, start[:-1], strict=True)]),
        uv=None if parts[0].uv is None else np.concatenate([part.uv for part in parts if part.uv is not None]),
    )


def merged(parts: Sequence[Part]) -> list[Part]:
    """Return the same surface with one part per material and shading, which the path tracer renders much faster.
    Diffuse parts of one colour get it at their vertices."""
    groups: dict[tuple, list[Part]] = {}
    for part in parts:
        material, shape = part.material, part.vertices.shape
        if not isinstance(material.color, np.ndarray):
            part = replace(part, uv=None)
            if material.kind == "diffuse" and part.colors is None:
                part = replace(part, material=Material(), colors=np.broadcast_to(np.array(material.color), shape))
        look = id(material.color) if isinstance(material.color, np.ndarray) else part.material.color
        key = part.material.kind, part.material.roughness, look, part.smooth, part.colors is None, part.uv is None
        groups.setdefault(key, []).append(part)
    whole = []
    for group in groups.values():
        colors = [part.colors for part in group if part.colors is not None]
        whole.append(replace(joined(group[0].name, group), colors=np.concatenate(colors) if colors else None))
    return whole


def lathe(name: str, profile, material: Material, *, segments: int = 96) -> Part:
    """Return the surface of revolution of a profile (N, 2) of radius and height about the z axis; its outside is to the
    right of the profile's upward direction."""
    profile = np.asarray(profile, dtype=np.float64)
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    rings = np.stack(
        [profile[:, :1] * np.cos(angle), profile[:, :1] * np.sin(angle), np.repeat(profile[:, 1:], segments + 1, 1)], -1
    )
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    uv = np.stack(np.broadcast_arrays(angle / (2.0 * np.pi), (length / length[-1])[:, None]), axis=-1)
    return Part(
        name, rings.reshape(-1, 3), _grid_faces(len(profile), segments + 1), material, uv.reshape(-1, 2), smooth=True
    )


def tube(name: str, path, radius: float, material: Material, *, segments: int = 16) -> Part:
    """Return a round tube along a polyline (N, 3), open at both ends, without twist of its cross-sections."""
    path = np.asarray(path, dtype=np.float64)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    first = np.eye(3)[np.argmin(np.abs(tangent[0]))]
    normal = np.empty_like(path)
    for i, direction in enumerate(tangent):
        side = (first if i == 0 else normal[i - 1]) - direction * ((first if i == 0 else normal[i - 1]) @ direction)
        normal[i] = side / np.linalg.norm(side)
    other = np.cross(tangent, normal)
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    rings = path[:, None] + radius * (
        np.cos(angle)[None, :, None] * normal[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    )
    faces = _grid_faces(len(path), segments + 1)
    return Part(name, rings.reshape(-1, 3), faces, material, smooth=True)


def _grid_faces(rows: int, columns: int) -> np.ndarray:
    """Return two triangles for every cell of a grid of vertices."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def sphere(name: str, center, radius: float, material: Material, *, segments: int = 96) -> Part:
    """Return a sphere meshed by latitude and longitude."""
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, segments // 2 + 1)
    profile = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return lathe(name, profile, material, segments=segments).moved(center)


def spline(controls, count: int) -> np.ndarray:
    """Return (count, 3) points of a smooth curve through (N, 3) control points, evenly spaced in its parameter."""
    from scipy.interpolate import CubicSpline

    controls = np.asarray(controls, dtype=np.float64)
    place = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(controls, axis=0), axis=1))])
    return CubicSpline(place, controls)(np.linspace(0.0, place[-1], count))


def figure(surface: TexturedMesh, size: float, material: Material, *, edge: float) -> Part:
    """Return a mesh with its colours at the vertices, standing on z = 0 over the origin; its longest side is `size`
    metres.

    `edge` is about the longest edge in metres, and so the resolution of the colours.
    """
    scale = size / np.ptp(surface.used_vertices, axis=0).max()
    vertices, faces, colors = surface.refined(edge / scale)
    lower, upper = vertices.min(0), vertices.max(0)
    vertices = scale * (vertices - np.array([*(0.5 * (lower + upper))[:2], lower[2]]))
    return Part(surface.name, vertices, faces, material, colors=colors / 255.0, smooth=True)
