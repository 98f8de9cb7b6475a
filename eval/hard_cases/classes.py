"""Seeded generators of hard cases for the rasterizer: batches of tiny scenes, grouped in classes by the kind of
difficulty.

A scene is a camera with an image of a few pixels and one or a few primitives. One ray is aimed at a point inside the
first primitive. Densities are chosen such that this ray neither misses nor is opaque, unless the class is about that.
All numbers are rounded to float32 and stored as float64, so that every variant of the kernels and the reference
(`linprim_geo.eval.hard_cases.many_scenes`) get the same input.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from linprim_geo.base import kinds
from linprim_geo.eval.hard_cases import many_scenes
from linprim_geo.eval.hard_cases.class_scenes import (
    KINDS,
    POLYHEDRA,
    build,
    extent_count,
    log_uniform,
    placed_before,
    points_inside,
    random_extents,
    random_poses,
)
from linprim_geo.eval.hard_cases.many_scenes import Scenes
from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels.reference.rasterize import rotation_matrix


@dataclass(frozen=True)
class HardClass:
    """One class of hard cases: `make(rng, primitive, ray_model, count)` returns `count` scenes.

    `value`: whether images and gradients are compared with the reference; otherwise they are only checked for NaN,
    infinity and an opacity outside [0, 1]. `ties`: whether rays meet edges and vertices, where every one-sided gradient
    is correct.
    """

    name: str
    make: Callable[[np.random.Generator, str, str, int], Scenes]
    primitives: tuple[str, ...] = KINDS
    value: bool = True
    ties: bool = False
    about: str = ""


CLASSES: dict[str, HardClass] = {}


def hard_class(name: str, **options):
    """Register the decorated generator as a class of that name; its docstring becomes the printed description."""

    def add(make):
        CLASSES[name] = HardClass(name, make, about=(make.__doc__ or "").strip(), **options)
        return make

    return add


@hard_class("ordinary")
def ordinary(rng, primitive, ray_model, count):
    """One primitive with half-axes 0.2 to 2 in front of the camera, for comparison with the other classes."""
    extent = random_extents(rng, primitive, count)
    return build(rng, primitive, ray_model, placed_before(rng, extent), extent)


@hard_class("several")
def several(rng, primitive, ray_model, count):
    """Five primitives that overlap."""
    extent = random_extents(rng, primitive, count, 5, -0.3, 0.3)
    return build(
        rng, primitive, ray_model, placed_before(rng, extent), extent, footprint=log_uniform(rng, 0.5, 1.5, count)
    )


def _thin(rng, primitive, ray_model, count, axes: int, low: float, high: float):
    """Build primitives with `axes` half-axes shorter than the others by factors of 10^low to 10^high, but at least
    1e-6."""
    extent = random_extents(rng, primitive, count, low=-0.3, high=0.3)
    long = log_uniform(rng, -1, 1 if high < 5 else 3, count)[:, None]
    thin = 10 ** -rng.uniform(low, high, (count, 1))
    axes = axes + 1 if primitive == "tetrahedron" and axes == 2 else axes
    extent[:, 0] *= long
    extent[:, 0, :axes] = np.maximum(extent[:, 0, :axes] * thin, 1e-6)
    extent = np.take_along_axis(
        extent, rng.permuted(np.tile(np.arange(extent.shape[2]), (count, 1)), axis=1)[:, None], 2
    )
    return build(rng, primitive, ray_model, placed_before(rng, extent), extent)


@hard_class("needles")
def needles(rng, primitive, ray_model, count):
    """Two half-axes (tetrahedron: three vertices) 10 to 1e3 times shorter than the third; 1 to 300 px long in the
    image."""
    return _thin(rng, primitive, ray_model, count, 2, 1, 3)


@hard_class("plates")
def plates(rng, primitive, ray_model, count):
    """One half-axis (tetrahedron: one vertex) 10 to 1e3 times shorter than the others."""
    return _thin(rng, primitive, ray_model, count, 1, 1, 3)


@hard_class("needles 1e9")
def extreme_needles(rng, primitive, ray_model, count):
    """Needles of 1e-6 to 1e3 units, up to 1e9 times longer than thick, down to 1e-7 px wide."""
    return _thin(rng, primitive, ray_model, count, 2, 3, 9)


@hard_class("plates 1e9")
def extreme_plates(rng, primitive, ray_model, count):
    """Plates of 1e-6 to 1e3 units."""
    return _thin(rng, primitive, ray_model, count, 1, 3, 9)


@hard_class("mixed axes")
def mixed_axes(rng, primitive, ray_model, count):
    """Each half-axis independently between 1e-6 and 1e3."""
    extent = random_extents(rng, primitive, count, low=-6, high=3)
    return build(rng, primitive, ray_model, placed_before(rng, extent), extent)


@hard_class("slivers", primitives=("tetrahedron",))
def slivers(rng, primitive, ray_model, count):
    """Tetrahedra with one vertex 10 to 1e4 times nearer to the centre, or farther from it, than the others."""
    extent = random_extents(rng, primitive, count, low=-0.2, high=0.2)
    extent[:, 0, 0] *= 10 ** (rng.uniform(1, 4, count) * rng.choice([-1, 1], count))
    return build(rng, primitive, ray_model, placed_before(rng, extent), extent)


@hard_class("zero axes")
def zero_axes(rng, primitive, ray_model, count):
    """One extent 0 or negative (polyhedra) or exactly 0 (Gaussians). Such polyhedra are not drawn."""
    extent = random_extents(rng, primitive, count)
    center = placed_before(rng, extent)
    scenes = build(rng, primitive, ray_model, center, extent)
    flat = scenes.extent.clone()
    flat[torch.arange(count), 0, torch.from_numpy(rng.integers(extent_count(primitive), size=count))] = (
        torch.from_numpy(np.where((rng.random(count) < 0.5) & (primitive != "gaussian"), -0.5, 0.0))
    )
    return replace(scenes, extent=flat)


@hard_class("denormal axes", value=False)
def denormal_axes(rng, primitive, ray_model, count):
    """One extent below the smallest normal float32, the others 1e-30 to 1; the optical thickness is not adjusted."""
    extent = random_extents(rng, primitive, count, low=-30, high=0)
    center = placed_before(rng, random_extents(rng, primitive, count))
    extent[np.arange(count), 0, rng.integers(extent_count(primitive), size=count)] = log_uniform(rng, -44.8, -38, count)
    density = rng.random((count, 1)) if primitive == "gaussian" else log_uniform(rng, -3, 18, count, 1)
    return build(rng, primitive, ray_model, center, extent, density=density, focal=log_uniform(rng, 0, 4, count))


@hard_class("huge axes")
def huge_axes(rng, primitive, ray_model, count):
    """Half-axes of 1e4 to 1e8, with the camera inside or in front."""
    extent = random_extents(rng, primitive, count, low=4, high=8)
    center = placed_before(rng, extent)
    within = rng.random(count) < 0.5
    center[within, 0] = -points_inside(rng, primitive, extent[within, 0])
    return build(rng, primitive, ray_model, center, extent)


@hard_class("overflowing axes", value=False)
def overflowing_axes(rng, primitive, ray_model, count):
    """Half-axes of 1e10 to 3e38; rays end at a depth of 1e12."""
    extent = random_extents(rng, primitive, count, low=10, high=38)
    density = rng.random((count, 1)) if primitive == "gaussian" else log_uniform(rng, -38, 18, count, 1)
    center = placed_before(rng, np.minimum(extent, 1e30)) * log_uniform(rng, -30, 0, count)[:, None, None]
    return build(rng, primitive, ray_model, center, extent, density=density, focal=log_uniform(rng, 0, 4, count))


def _about_face(rng, primitive, ray_model, count, outside: bool, gap: np.ndarray):
    """Place the camera near the plane of a face, above a point of the face or, with `outside`, beside the face. `gap`
    is its signed height above the plane, in units of the distance of the centre from the face."""
    extent = random_extents(rng, primitive, count)
    exact = rng.random(count) < 0.3
    extent[exact] = 2.0 ** np.round(np.log2(extent[exact]))
    # Barycentric coordinates of the camera in the plane of the face of the first three vertices.
    share = rng.dirichlet(np.ones(3), count)
    if outside:
        far = rng.uniform(1.5, 6.0, count)[:, None]
        share = (
            share
            + far
            * (np.eye(3)[rng.integers(3, size=count)] - share)
            * np.array([1.0, -1.0])[rng.integers(2, size=count)][:, None]
        )
    share[exact] = np.round(share[exact] * 8) / 8
    share[exact, 2] = 1 - share[exact, 0] - share[exact, 1]
    arms = many_scenes.CORNERS[:3].numpy() if primitive == "tetrahedron" else np.eye(3)
    eye = (share * extent[:, 0, :3]) @ arms * (1 + gap[:, None])
    # Local axes turned such that the camera looks at the centre.
    q = rng.normal(size=(count, 1, 4))
    q[exact] = (1.0, 0.0, 0.0, 0.0)
    axes = rotation_matrix(torch.from_numpy(q[:, 0])).numpy()
    center_world = np.zeros((count, 3))
    eye_world = np.einsum("bij,bj->bi", axes, eye)
    forward = center_world - eye_world
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up = rng.normal(size=(count, 3))
    right = np.cross(up, forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    pose = np.tile(np.eye(4), (count, 1, 1))
    pose[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:, :3, 3] = -np.einsum("bij,bj->bi", pose[:, :3, :3], eye_world)
    return build(rng, primitive, ray_model, pose[:, None, :3, 3], extent, rotation=q, pose=pose, near=1e-3)


@hard_class("faces edge-on", primitives=POLYHEDRA)
def faces_edge_on(rng, primitive, ray_model, count):
    """The camera beside a face and in its plane, exactly or within 1e-12 to 1e-3 of the centre's distance from it."""
    gap = log_uniform(rng, -12, -3, count) * rng.choice([-1, 1], count) * (rng.random(count) < 0.8)
    return _about_face(rng, primitive, ray_model, count, True, gap)


@hard_class("camera on a face", primitives=POLYHEDRA)
def camera_on_a_face(rng, primitive, ray_model, count):
    """The camera on a face, or within 1e-6 of the centre's distance from it."""
    gap = log_uniform(rng, -12, -6, count) * rng.choice([-1, 1], count) * (rng.random(count) < 0.7)
    return _about_face(rng, primitive, ray_model, count, False, gap)


@hard_class("vertices and edges", primitives=POLYHEDRA, ties=True)
def vertices_and_edges(rng, primitive, ray_model, count):
    """Rays exactly through vertices, along edges and through points of edges: aligned axes, all numbers powers of
    two."""
    extent = 2.0 ** rng.integers(-3, 2, (count, 1, extent_count(primitive)))
    extent[rng.random(count) < 0.5] = 0.5
    pose = np.tile(np.eye(4), (count, 1, 1))
    q = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1, 1))
    center = np.stack([rng.integers(-2, 3, count), rng.integers(-2, 3, count), 2.0 ** rng.integers(2, 5, count)], -1)[
        :, None
    ].astype(float)
    scenes = build(rng, primitive, ray_model, center, extent, rotation=q, pose=pose)
    arms, _ = many_scenes.vertices(scenes)
    arms = arms[:, 0].numpy()
    first, second = (arms[np.arange(count), rng.integers(arms.shape[1], size=count)] for _ in range(2))
    target = center[:, 0] + first + rng.choice([0.0, 0.0, 0.5, 0.25], count)[:, None] * (second - first)
    return build(
        rng,
        primitive,
        ray_model,
        center,
        extent,
        rotation=q,
        pose=pose,
        target=target,
        focal=2.0 ** rng.integers(2, 10, count),
    )


@hard_class("camera inside")
def camera_inside(rng, primitive, ray_model, count):
    """The camera inside the primitive. With affine rays a primitive is only drawn if its centre is in front."""
    extent = random_extents(rng, primitive, count)
    q = rng.normal(size=(count, 1, 4))
    axes = rotation_matrix(torch.from_numpy(q[:, 0])).numpy()
    pose = random_poses(rng, count)
    local = points_inside(rng, primitive, extent[:, 0], 0.9)
    center = -np.einsum("bij,bjk,bk->bi", pose[:, :3, :3], axes, local)
    near = extent[:, 0].min(-1) * log_uniform(rng, -3, -1, count)
    return build(rng, primitive, ray_model, center[:, None], extent, rotation=q, pose=pose, near=near)


@hard_class("centre behind the camera")
def centre_behind(rng, primitive, ray_model, count):
    """The centre behind the camera, with the body in front or, in one of five scenes, completely behind."""
    extent = random_extents(rng, primitive, count)
    z = -extent[:, 0].min(-1) * rng.uniform(0.05, 0.6, count)
    z = np.where(rng.random(count) < 0.2, -2 * extent[:, 0].max(-1), z)
    center = np.stack([*(0.2 * extent[:, 0].min(-1) * rng.normal(size=(2, count))), z], -1)[:, None]
    return build(rng, primitive, ray_model, center, extent, near=extent[:, 0].min(-1) * 1e-2)


@hard_class("near plane")
def near_plane(rng, primitive, ray_model, count):
    """Primitives cut by the near plane at any place."""
    extent = random_extents(rng, primitive, count)
    center = placed_before(rng, extent, 0.0, 0.5)
    near = np.maximum(center[:, 0, 2] + extent[:, 0].min(-1) * rng.uniform(-0.5, 0.5, count), 1e-2)
    return build(rng, primitive, ray_model, center, extent, near=near)


@hard_class("plates at the near plane", primitives=POLYHEDRA)
def plates_at_near_plane(rng, primitive, ray_model, count):
    """Plates 10 to 1e4 times thinner than wide, cut by the near plane and seen at any angle."""
    extent = random_extents(rng, primitive, count, low=-0.2, high=0.2)
    extent[:, 0, 0] *= 10 ** -rng.uniform(1, 4, count)
    center = placed_before(rng, extent, 0.0, 0.3)
    near = center[:, 0, 2] * rng.uniform(0.95, 1.0, count)
    return build(rng, primitive, ray_model, center, extent, near=near)


@hard_class("one pixel")
def one_pixel(rng, primitive, ray_model, count):
    """Primitives of the size of a pixel."""
    extent = random_extents(rng, primitive, count)
    return build(
        rng,
        primitive,
        ray_model,
        placed_before(rng, extent, 0.3, 3.0),
        extent,
        footprint=rng.uniform(0.3, 0.8, count),
    )


@hard_class("a thousandth of a pixel")
def subpixel(rng, primitive, ray_model, count):
    """Primitives of a thousandth of a pixel, hit only by the ray that is aimed at them."""
    extent = random_extents(rng, primitive, count)
    return build(
        rng,
        primitive,
        ray_model,
        placed_before(rng, extent, 1, 4),
        extent,
        footprint=rng.uniform(3e-4, 2e-3, count),
    )


@hard_class("a thousand screens")
def thousand_screens(rng, primitive, ray_model, count):
    """Primitives 1,000 to 25,000 times as wide as the window: 4,000 to 100,000 px."""
    extent = random_extents(rng, primitive, count)
    return build(
        rng, primitive, ray_model, placed_before(rng, extent), extent, footprint=log_uniform(rng, 3.6, 5, count)
    )


@hard_class("a million units away")
def far_coordinates(rng, primitive, ray_model, count):
    """Camera and primitive at world coordinates of 1e6, where the resolution of float32 is 0.06 units."""
    extent = random_extents(rng, primitive, count)
    return build(rng, primitive, ray_model, placed_before(rng, extent), extent, pose=random_poses(rng, count, 1e6))


@hard_class("thickness 1e-12 to 1e4", primitives=POLYHEDRA)
def any_thickness(rng, primitive, ray_model, count):
    """Two primitives that overlap, with optical thicknesses of 1e-12 to 1e4."""
    extent = random_extents(rng, primitive, count, 2)
    return build(rng, primitive, ray_model, placed_before(rng, extent), extent, tau=log_uniform(rng, -12, 4, count, 2))


@hard_class("ends of the opacity")
def ends_of_opacity(rng, primitive, ray_model, count):
    """Density from a raw value of -80 to 80, by softplus over the reference length; for Gaussians by the logistic
    function."""
    extent = random_extents(rng, primitive, count)
    raw = rng.uniform(-80, 80, (count, 1)) * rng.choice([0.05, 1.0], (count, 1))
    if primitive == "gaussian":
        density = 1 / (1 + np.exp(-raw))
    else:
        density = np.logaddexp(0, raw) / kinds.KINDS[primitive].reference_length(extent[:, 0])[:, None]
    return build(rng, primitive, ray_model, placed_before(rng, extent), extent, density=density)


@hard_class("coincident")
def coincident(rng, primitive, ray_model, count, many: int = 200):
    """200 copies of the same primitive in one colour, with densities of 1e-3 to 1 times 1/200."""
    extent = np.repeat(random_extents(rng, primitive, count), many, 1)
    center = np.repeat(placed_before(rng, extent[:, :1]), many, 1)
    tau = log_uniform(rng, -3, 0, count, many) * log_uniform(rng, -1, 1, count, 1) / many
    q = np.repeat(rng.normal(size=(count, 1, 4)), many, 1)
    density = np.clip(tau * many, 0.01, 1) if primitive == "gaussian" else None
    scenes = build(rng, primitive, ray_model, center, extent, rotation=q, tau=tau, density=density, one_color=True)
    return replace(scenes, coincident=True)


@hard_class("equal depth")
def equal_depth(rng, primitive, ray_model, count):
    """Four primitives that overlap, with centres at exactly the same depth, in any order."""
    extent = random_extents(rng, primitive, count, 4, -0.3, 0.3)
    center = placed_before(rng, extent)
    center[:, :, 2] = center[:, :1, 2]
    pose = np.tile(np.eye(4), (count, 1, 1))
    return build(rng, primitive, ray_model, center, extent, pose=pose, footprint=log_uniform(rng, 0.5, 1.5, count))


@hard_class("quaternions")
def quaternions(rng, primitive, ray_model, count):
    """Quaternions of length 1e-18 to 1e18, and one in ten of length 0, which stands for no rotation."""
    extent = random_extents(rng, primitive, count)
    q = rng.normal(size=(count, 1, 4)) * log_uniform(rng, -18, 18, count)[:, None, None]
    q[rng.random(count) < 0.1] = 0
    return build(rng, primitive, ray_model, placed_before(rng, extent), extent, rotation=q)


def one_scene(scenes: Scenes, index: int, dtype: torch.dtype = torch.float64) -> tuple[list[Tensor], Camera, dict]:
    """Return the tensors, camera and options of scene `index`, as arguments of `linprim_geo.kernels.ops.rasterize`."""
    s = scenes
    parameters = [x[index].to(dtype) for x in (s.center, s.rotation, s.extent, s.density, s.sh)]
    (fx, fy), (cx, cy) = s.focal[index].tolist(), s.middle[index].tolist()
    view = Camera(s.width, s.height, fx, fy, cx, cy, s.pose[index].numpy())
    options = dict(primitive=s.primitive, ray_model=s.ray_model, near=float(s.near[index]), stop=0.0)
    return [*parameters, torch.zeros(3, dtype=dtype)], view, options


def generate(name: str, primitive: str, ray_model: str, count: int, seed: int = 0) -> Scenes:
    """Return `count` scenes of the class `name`; equal arguments give equal scenes."""
    key = [seed, zlib.crc32(name.encode()), KINDS.index(primitive), ("exact", "affine").index(ray_model)]
    return CLASSES[name].make(np.random.default_rng(key), primitive, ray_model, count)
