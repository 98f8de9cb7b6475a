"""Hard cases of the rasterizer as seeded generators: many tiny scenes at once, one named class of difficulty each.

A scene is a camera with a window of a few pixels and one or a few primitives; one of its rays is aimed at a point
inside the first primitive, and the densities are chosen so that this ray neither misses nor is opaque, unless that is
the point of the class. Everything is rounded to float32 values, held in float64, so that every rung of the accuracy
ladder and the reference (`linprim_geo.eval.hard_cases.many_scenes`) see the same numbers.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from linprim_geo.eval.hard_cases import many_scenes
from linprim_geo.eval.hard_cases.many_scenes import Scenes
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.primitives import reference_length
from linprim_geo.kernels.reference.rasterize import rotation_matrix

WINDOW = 4  # pixels along a side of the image of a scene
NEAR = 0.01

POLYHEDRA = ("octahedron", "tetrahedron")
KINDS = (*POLYHEDRA, "gaussian")


@dataclass(frozen=True)
class HardClass:
    """One class of hard cases: `make(rng, primitive, ray_model, count)` gives `count` scenes.

    `value`: whether images and gradients are compared, or only looked through for NaN, infinity and transmittance;
    `ties`: whether rays meet edges and vertices, where every one-sided gradient is right.
    """

    name: str
    make: Callable[[np.random.Generator, str, str, int], Scenes]
    primitives: tuple[str, ...] = KINDS
    value: bool = True
    ties: bool = False
    about: str = ""


CLASSES: dict[str, HardClass] = {}


def hard_class(name: str, **options):
    """Registers the generator below it as a class of that name; its docstring says what is hard."""

    def add(make):
        CLASSES[name] = HardClass(name, make, about=(make.__doc__ or "").strip(), **options)
        return make

    return add


def log_uniform(rng: np.random.Generator, low: float, high: float, *shape: int) -> np.ndarray:
    """10 to a power between `low` and `high`."""
    return 10 ** rng.uniform(low, high, shape)


def _rounded(x) -> Tensor:
    """The nearest float32 numbers, as float64."""
    return torch.as_tensor(np.asarray(x, dtype=np.float64)).float().double()


def _extents(primitive: str) -> int:
    return 4 if primitive == "tetrahedron" else 3


def _poses(rng: np.random.Generator, count: int, shift: float = 1.0) -> np.ndarray:
    pose = np.tile(np.eye(4), (count, 1, 1))
    pose[:, :3, :3] = rotation_matrix(torch.from_numpy(rng.normal(size=(count, 4)))).numpy()
    pose[:, :3, 3] = shift * rng.normal(size=(count, 3))
    return pose


def _inside(rng: np.random.Generator, primitive: str, extent: np.ndarray, reach: float = 0.8) -> np.ndarray:
    """A point in each primitive, local axes, relative to its centre, (..., 3); `reach` 1 goes to its surface."""
    if primitive == "tetrahedron":
        share = rng.dirichlet(np.ones(4), extent.shape[:-1])
        share = reach * share + (1 - reach) / extent / (1 / extent).sum(-1, keepdims=True)  # the centre's own weights
        return (share * extent) @ many_scenes.CORNERS.numpy()
    y = rng.normal(size=(*extent.shape[:-1], 3))
    y *= reach * rng.random((*extent.shape[:-1], 1)) ** (1 / 3) / np.abs(y).sum(-1, keepdims=True)
    return y * extent


def build(
    rng: np.random.Generator,
    primitive: str,
    ray_model: str,
    center: np.ndarray,
    extent: np.ndarray,
    *,
    rotation: np.ndarray | None = None,
    pose: np.ndarray | None = None,
    density: np.ndarray | None = None,
    tau: np.ndarray | None = None,
    focal: np.ndarray | None = None,
    footprint: np.ndarray | None = None,
    near: np.ndarray | float = NEAR,
    target: np.ndarray | None = None,
    one_color: bool = False,
) -> Scenes:
    """Scenes from camera-space centres, with a window about the ray to a point of the first primitive.

    Args:
        center: (B, M, 3), camera space; extent: (B, M, 3 or 4).
        rotation: (B, M, 4) primitive to world, random without.
        pose: (B, 4, 4), random without.
        density: (B, M); without, such that the aimed ray has the thickness `tau` (B, M) in each primitive, 0.01 to 3
            without.
        focal: (B,) px; without, such that the largest extent covers `footprint` (B,) px, 1 to 300 without.
        target: (B, 3) point that is aimed at, camera space; random inside the first primitive without.
    """
    count, many = center.shape[:2]
    pose = _poses(rng, count) if pose is None else pose
    turn, shift = pose[:, :3, :3], pose[:, :3, 3]
    world = np.einsum("bji,bmj->bmi", turn, center - shift[:, None])
    rotation = rng.normal(size=(count, many, 4)) if rotation is None else rotation
    near = np.broadcast_to(np.asarray(near, dtype=np.float64), (count,))
    sh = rng.uniform(-0.8, 0.8, (count, many, 1, 3))
    if one_color:
        sh[:] = sh[:, :1]
    scenes = Scenes(
        primitive=primitive,
        ray_model=ray_model,
        center=_rounded(world),
        rotation=_rounded(rotation),
        extent=_rounded(extent),
        density=torch.ones(count, many, dtype=torch.float64),
        sh=_rounded(sh),
        pose=torch.from_numpy(pose.copy()),
        focal=torch.ones(count, 2, dtype=torch.float64),
        middle=torch.zeros(count, 2, dtype=torch.float64),
        near=torch.from_numpy(near.copy()),
        width=WINDOW,
        height=WINDOW,
        aimed=torch.zeros(count, dtype=torch.long),
    )

    # From here on with the rounded numbers, so that the ray hits.
    at, axes = (x.numpy()[:, 0] for x in many_scenes.camera_space(scenes))
    if target is None:
        for _ in range(12):
            point = at + np.einsum("bij,bj->bi", axes, _inside(rng, primitive, scenes.extent.numpy()[:, 0]))
            if target is None:
                target = point
            target = np.where((target[:, 2] > near)[:, None] | (ray_model == "affine"), target, point)
    z = np.where(np.abs(at[:, 2]) > 1e-12, at[:, 2], 1.0)
    if ray_model == "affine" or primitive == "gaussian":
        middle, away = at[:, :2] / z[:, None], target - at
        aim = middle + (away[:, :2] - middle * away[:, 2:]) / z[:, None]
    else:
        aim = target[:, :2] / np.where(target[:, 2] > 0, target[:, 2], 1.0)[:, None]
    if focal is None:
        footprint = log_uniform(rng, 0, 2.5, count) if footprint is None else footprint
        size = np.abs(scenes.extent.numpy()[:, 0]).max(-1)
        distance = np.abs(target[:, 2]) if ray_model == "exact" else np.abs(z)
        focal = np.clip(footprint * distance / np.maximum(size, 1e-30), 0.5, 1e5)
    focal = np.stack([focal, focal * rng.uniform(0.9, 1.1, count)], -1)
    pixel = rng.integers(WINDOW, size=(count, 2))
    scenes = replace(
        scenes,
        focal=torch.from_numpy(focal),
        middle=torch.from_numpy(pixel + 0.5 - focal * aim),
        aimed=torch.from_numpy(pixel[:, 1] * WINDOW + pixel[:, 0]),
    )
    if density is None and primitive == "gaussian":
        density = rng.uniform(0.05, 1.0, (count, many))
    elif density is None:
        tau = log_uniform(rng, -2, 0.5, count, many) if tau is None else tau
        chord = many_scenes.aimed_chord(scenes).numpy()
        fallback = np.maximum(scenes.extent.numpy().min(-1), 1e-18)
        density = np.clip(tau / np.where(chord > 0, chord, fallback), 0, 1e18)
    return replace(scenes, density=_rounded(density))


def _before(rng, extent: np.ndarray, low: float = 0.3, high: float = 1.5) -> np.ndarray:
    """Centres in front of the camera, 10^low to 10^high times the largest extent away, (B, M, 3); others near the
    first."""
    count, many = extent.shape[:2]
    size = extent[:, 0].max(-1)
    z = size * log_uniform(rng, low, high, count)
    direction = np.concatenate([rng.uniform(-0.5, 0.5, (count, 2)), np.ones((count, 1))], 1)
    return (z[:, None] * direction)[:, None] + 0.3 * size[:, None, None] * rng.normal(size=(count, many, 3)) * (
        np.arange(many) > 0
    )[:, None]


def _shape(rng, primitive: str, count: int, many: int = 1, low: float = -0.7, high: float = 0.3) -> np.ndarray:
    return log_uniform(rng, low, high, count, many, _extents(primitive))


@hard_class("ordinary")
def ordinary(rng, primitive, ray_model, count):
    """One primitive of half-axes 0.2 to 2 in front of the camera: what the others are compared with."""
    extent = _shape(rng, primitive, count)
    return build(rng, primitive, ray_model, _before(rng, extent), extent)


@hard_class("several")
def several(rng, primitive, ray_model, count):
    """Five that overlap."""
    extent = _shape(rng, primitive, count, 5, -0.3, 0.3)
    return build(rng, primitive, ray_model, _before(rng, extent), extent, footprint=log_uniform(rng, 0.5, 1.5, count))


def _thin(rng, primitive, ray_model, count, axes: int, low: float, high: float):
    """`axes` of the half-axes shorter than the others by 10^low to 10^high, at least 1e-6."""
    extent = _shape(rng, primitive, count, low=-0.3, high=0.3)
    long = log_uniform(rng, -1, 1 if high < 5 else 3, count)[:, None]
    thin = 10 ** -rng.uniform(low, high, (count, 1))
    axes = axes + 1 if primitive == "tetrahedron" and axes == 2 else axes
    extent[:, 0] *= long
    extent[:, 0, :axes] = np.maximum(extent[:, 0, :axes] * thin, 1e-6)
    extent = np.take_along_axis(
        extent, rng.permuted(np.tile(np.arange(extent.shape[2]), (count, 1)), axis=1)[:, None], 2
    )
    return build(rng, primitive, ray_model, _before(rng, extent), extent)


@hard_class("needles")
def needles(rng, primitive, ray_model, count):
    """Two half-axes (a tetrahedron: three vertices) 10 to 1e3 times shorter than the other; it covers 1 to 300 px
    along."""
    return _thin(rng, primitive, ray_model, count, 2, 1, 3)


@hard_class("plates")
def plates(rng, primitive, ray_model, count):
    """One half-axis (a tetrahedron: one vertex) 10 to 1e3 times shorter than the others."""
    return _thin(rng, primitive, ray_model, count, 1, 1, 3)


@hard_class("needles 1e9")
def extreme_needles(rng, primitive, ray_model, count):
    """Needles of 1e-6 to 1e3 units, up to 1e9 times longer than thick: down to 1e-7 px across."""
    return _thin(rng, primitive, ray_model, count, 2, 3, 9)


@hard_class("plates 1e9")
def extreme_plates(rng, primitive, ray_model, count):
    """Plates of 1e-6 to 1e3 units."""
    return _thin(rng, primitive, ray_model, count, 1, 3, 9)


@hard_class("mixed axes")
def mixed_axes(rng, primitive, ray_model, count):
    """Every half-axis anywhere from 1e-6 to 1e3."""
    extent = _shape(rng, primitive, count, low=-6, high=3)
    return build(rng, primitive, ray_model, _before(rng, extent), extent)


@hard_class("slivers", primitives=("tetrahedron",))
def slivers(rng, primitive, ray_model, count):
    """Tetrahedra with one vertex 10 to 1e4 times nearer to the centre or farther than the others."""
    extent = _shape(rng, primitive, count, low=-0.2, high=0.2)
    extent[:, 0, 0] *= 10 ** (rng.uniform(1, 4, count) * rng.choice([-1, 1], count))
    return build(rng, primitive, ray_model, _before(rng, extent), extent)


@hard_class("zero axes")
def zero_axes(rng, primitive, ray_model, count):
    """One extent 0 or negative (polyhedra), or exactly 0 (Gaussians): polyhedra are not drawn."""
    extent = _shape(rng, primitive, count)
    center = _before(rng, extent)
    scenes = build(rng, primitive, ray_model, center, extent)
    flat = scenes.extent.clone()
    flat[torch.arange(count), 0, torch.from_numpy(rng.integers(_extents(primitive), size=count))] = torch.from_numpy(
        np.where((rng.random(count) < 0.5) & (primitive != "gaussian"), -0.5, 0.0)
    )
    return replace(scenes, extent=flat)


@hard_class("denormal axes", value=False)
def denormal_axes(rng, primitive, ray_model, count):
    """One extent below the smallest normal float32, others 1e-30 to 1; thickness as it comes."""
    extent = _shape(rng, primitive, count, low=-30, high=0)
    center = _before(rng, _shape(rng, primitive, count))
    extent[np.arange(count), 0, rng.integers(_extents(primitive), size=count)] = log_uniform(rng, -44.8, -38, count)
    density = rng.random((count, 1)) if primitive == "gaussian" else log_uniform(rng, -3, 18, count, 1)
    return build(rng, primitive, ray_model, center, extent, density=density, focal=log_uniform(rng, 0, 4, count))


@hard_class("huge axes")
def huge_axes(rng, primitive, ray_model, count):
    """Half-axes of 1e4 to 1e8, the camera inside or in front."""
    extent = _shape(rng, primitive, count, low=4, high=8)
    center = _before(rng, extent)
    within = rng.random(count) < 0.5
    center[within, 0] = -_inside(rng, primitive, extent[within, 0])
    return build(rng, primitive, ray_model, center, extent)


@hard_class("overflowing axes", value=False)
def overflowing_axes(rng, primitive, ray_model, count):
    """Half-axes of 1e10 to 3e38; rays end at a depth of 1e12."""
    extent = _shape(rng, primitive, count, low=10, high=38)
    density = rng.random((count, 1)) if primitive == "gaussian" else log_uniform(rng, -38, 18, count, 1)
    center = _before(rng, np.minimum(extent, 1e30)) * log_uniform(rng, -30, 0, count)[:, None, None]
    return build(rng, primitive, ray_model, center, extent, density=density, focal=log_uniform(rng, 0, 4, count))


def _about_face(rng, primitive, ray_model, count, outside: bool, gap: np.ndarray):
    """The camera at height `gap` (in distances of the centre from the face) over a face's plane, beside the face or on
    it."""
    extent = _shape(rng, primitive, count)
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
    # Local axes turned so that the centre, or for a camera on the face anything, is in view.
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
    """The camera in the plane of a face beside it, to 1e-12 ... 1e-3 of the centre's distance from it, or exactly."""
    gap = log_uniform(rng, -12, -3, count) * rng.choice([-1, 1], count) * (rng.random(count) < 0.8)
    return _about_face(rng, primitive, ray_model, count, True, gap)


@hard_class("camera on a face", primitives=POLYHEDRA)
def camera_on_a_face(rng, primitive, ray_model, count):
    """The camera on a face or at most 1e-6 of the centre's distance from it off it."""
    gap = log_uniform(rng, -12, -6, count) * rng.choice([-1, 1], count) * (rng.random(count) < 0.7)
    return _about_face(rng, primitive, ray_model, count, False, gap)


@hard_class("vertices and edges", primitives=POLYHEDRA, ties=True)
def vertices_and_edges(rng, primitive, ray_model, count):
    """Rays exactly through vertices, along edges and through points of edges: axes aligned, everything a power of
    two."""
    extent = 2.0 ** rng.integers(-3, 2, (count, 1, _extents(primitive)))
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
    """The camera inside the primitive; an affine one is drawn only if its centre is in front."""
    extent = _shape(rng, primitive, count)
    q = rng.normal(size=(count, 1, 4))
    axes = rotation_matrix(torch.from_numpy(q[:, 0])).numpy()
    pose = _poses(rng, count)
    local = _inside(rng, primitive, extent[:, 0], 0.9)
    center = -np.einsum("bij,bjk,bk->bi", pose[:, :3, :3], axes, local)
    near = extent[:, 0].min(-1) * log_uniform(rng, -3, -1, count)
    return build(rng, primitive, ray_model, center[:, None], extent, rotation=q, pose=pose, near=near)


@hard_class("centre behind the camera")
def centre_behind(rng, primitive, ray_model, count):
    """The centre behind the camera, the body in front or, once in five, wholly behind."""
    extent = _shape(rng, primitive, count)
    z = -extent[:, 0].min(-1) * rng.uniform(0.05, 0.6, count)
    z = np.where(rng.random(count) < 0.2, -2 * extent[:, 0].max(-1), z)
    center = np.stack([*(0.2 * extent[:, 0].min(-1) * rng.normal(size=(2, count))), z], -1)[:, None]
    return build(rng, primitive, ray_model, center, extent, near=extent[:, 0].min(-1) * 1e-2)


@hard_class("near plane")
def near_plane(rng, primitive, ray_model, count):
    """The near plane cuts the primitive anywhere."""
    extent = _shape(rng, primitive, count)
    center = _before(rng, extent, 0.0, 0.5)
    near = np.maximum(center[:, 0, 2] + extent[:, 0].min(-1) * rng.uniform(-0.5, 0.5, count), 1e-2)
    return build(rng, primitive, ray_model, center, extent, near=near)


@hard_class("plates at the near plane", primitives=POLYHEDRA)
def plates_at_near_plane(rng, primitive, ray_model, count):
    """Plates 10 to 1e4 times thinner than wide that the near plane cuts, seen at any angle."""
    extent = _shape(rng, primitive, count, low=-0.2, high=0.2)
    extent[:, 0, 0] *= 10 ** -rng.uniform(1, 4, count)
    center = _before(rng, extent, 0.0, 0.3)
    near = center[:, 0, 2] * rng.uniform(0.95, 1.0, count)
    return build(rng, primitive, ray_model, center, extent, near=near)


@hard_class("one pixel")
def one_pixel(rng, primitive, ray_model, count):
    """As large as a pixel."""
    extent = _shape(rng, primitive, count)
    return build(
        rng,
        primitive,
        ray_model,
        _before(rng, extent, 0.3, 3.0),
        extent,
        footprint=rng.uniform(0.3, 0.8, count),
    )


@hard_class("a thousandth of a pixel")
def subpixel(rng, primitive, ray_model, count):
    """A thousandth of a pixel large, hit by the one ray that is aimed at it."""
    extent = _shape(rng, primitive, count)
    return build(
        rng,
        primitive,
        ray_model,
        _before(rng, extent, 1, 4),
        extent,
        footprint=rng.uniform(3e-4, 2e-3, count),
    )


@hard_class("a thousand screens")
def thousand_screens(rng, primitive, ray_model, count):
    """A thousand to 25,000 times as wide as the window: 4,000 to 100,000 px."""
    extent = _shape(rng, primitive, count)
    return build(rng, primitive, ray_model, _before(rng, extent), extent, footprint=log_uniform(rng, 3.6, 5, count))


@hard_class("a million units away")
def far_coordinates(rng, primitive, ray_model, count):
    """Camera and primitive at world coordinates of 1e6, where float32 resolves 0.06 units."""
    extent = _shape(rng, primitive, count)
    return build(rng, primitive, ray_model, _before(rng, extent), extent, pose=_poses(rng, count, 1e6))


@hard_class("thickness 1e-12 to 1e4", primitives=POLYHEDRA)
def any_thickness(rng, primitive, ray_model, count):
    """Optical thickness 1e-12 to 1e4 of two that overlap."""
    extent = _shape(rng, primitive, count, 2)
    return build(rng, primitive, ray_model, _before(rng, extent), extent, tau=log_uniform(rng, -12, 4, count, 2))


@hard_class("ends of the opacity")
def ends_of_opacity(rng, primitive, ray_model, count):
    """Density from a raw value of -80 to 80 by softplus over the reference length; a Gaussian's by the logistic
    function."""
    extent = _shape(rng, primitive, count)
    raw = rng.uniform(-80, 80, (count, 1)) * rng.choice([0.05, 1.0], (count, 1))
    if primitive == "gaussian":
        density = 1 / (1 + np.exp(-raw))
    else:
        density = np.logaddexp(0, raw) / reference_length(extent[:, 0], primitive)[:, None]
    return build(rng, primitive, ray_model, _before(rng, extent), extent, density=density)


@hard_class("coincident")
def coincident(rng, primitive, ray_model, count, many: int = 200):
    """Two hundred times the same primitive, of densities 1e-3 to 1 times a two-hundredth; one colour."""
    extent = np.repeat(_shape(rng, primitive, count), many, 1)
    center = np.repeat(_before(rng, extent[:, :1]), many, 1)
    tau = log_uniform(rng, -3, 0, count, many) * log_uniform(rng, -1, 1, count, 1) / many
    q = np.repeat(rng.normal(size=(count, 1, 4)), many, 1)
    density = np.clip(tau * many, 0.01, 1) if primitive == "gaussian" else None
    scenes = build(rng, primitive, ray_model, center, extent, rotation=q, tau=tau, density=density, one_color=True)
    return replace(scenes, coincident=True)


@hard_class("equal depth")
def equal_depth(rng, primitive, ray_model, count):
    """Four that overlap with centres at exactly the same depth, listed in any order."""
    extent = _shape(rng, primitive, count, 4, -0.3, 0.3)
    center = _before(rng, extent)
    center[:, :, 2] = center[:, :1, 2]
    pose = np.tile(np.eye(4), (count, 1, 1))
    return build(rng, primitive, ray_model, center, extent, pose=pose, footprint=log_uniform(rng, 0.5, 1.5, count))


@hard_class("quaternions")
def quaternions(rng, primitive, ray_model, count):
    """Quaternions of length 1e-18 to 1e18, and one in ten of length 0, which is no rotation."""
    extent = _shape(rng, primitive, count)
    q = rng.normal(size=(count, 1, 4)) * log_uniform(rng, -18, 18, count)[:, None, None]
    q[rng.random(count) < 0.1] = 0
    return build(rng, primitive, ray_model, _before(rng, extent), extent, rotation=q)


def one_scene(scenes: Scenes, index: int, dtype: torch.dtype = torch.float64) -> tuple[list[Tensor], Camera, dict]:
    """The tensors, camera and options of scene `index`, as `linprim_geo.kernels.ops.rasterize` takes them."""
    s = scenes
    parameters = [x[index].to(dtype) for x in (s.center, s.rotation, s.extent, s.density, s.sh)]
    (fx, fy), (cx, cy) = s.focal[index].tolist(), s.middle[index].tolist()
    view = Camera(s.width, s.height, fx, fy, cx, cy, s.pose[index].numpy())
    options = dict(primitive=s.primitive, ray_model=s.ray_model, near=float(s.near[index]), stop=0.0)
    return [*parameters, torch.zeros(3, dtype=dtype)], view, options


def generate(name: str, primitive: str, ray_model: str, count: int, seed: int = 0) -> Scenes:
    """`count` scenes of the class `name`, the same for the same arguments."""
    key = [seed, zlib.crc32(name.encode()), KINDS.index(primitive), ("exact", "affine").index(ray_model)]
    return CLASSES[name].make(np.random.default_rng(key), primitive, ray_model, count)
