"""Tetrahedra of the reference: their four triangles, their pieces, and those without size."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from helpers.reference_ladder import BASIS, MODELS, ORDERS, pixel_of, scene
from helpers.reference_scenes import IMAGES, assert_same, axis_camera, gray, tensor

from linprim_geo.kernels.reference import blend as reference_blend
from linprim_geo.kernels.reference import rasterize as reference
from linprim_geo.kernels.reference import shapes as reference_shapes
from linprim_geo.kernels.reference.rasterize import rasterize

pytestmark = pytest.mark.usefixtures("one_thread")


def moeller_trumbore(ray, a, b, c):
    """Depth at which the ray from the origin meets the triangle, or None."""
    e1, e2 = b - a, c - a
    h = np.cross(ray, e2)
    det = e1 @ h
    u, k = -(a @ h) / det, np.cross(-a, e1)
    v = (ray @ k) / det
    return (e2 @ k) / det if u >= 0 and v >= 0 and u + v <= 1 else None


def test_tetrahedron_agrees_with_its_four_triangles():
    quaternion, extent = [0.9, 0.3, -0.2, 0.4], [0.7, 1.4, 0.9, 1.1]
    parameters = [tensor(x) for x in ([[0.2, -0.1, 4.0]], [quaternion], [extent], [0.8], [gray(1.0)], [0.0] * 3)]
    camera = axis_camera(24, 24, 26.0)
    result = rasterize(*parameters, **camera, primitive="tetrahedron", stop=0.0)
    turn = reference.rotation_matrix(tensor(quaternion)).numpy()
    vertices = np.array([0.2, -0.1, 4.0]) + np.array(extent)[:, None] * (BASIS @ turn.T)
    met = 0
    for i, j in itertools.product(range(24), range(24)):
        ray = np.array([(j - 11.5) / 26, (i - 11.5) / 26, 1.0])
        t = [moeller_trumbore(ray, *vertices[list(f)]) for f in itertools.combinations(range(4), 3)]
        t = [x for x in t if x is not None]
        chord = max(t) - min(t) if t else 0.0
        opacity = result["opacity"][i, j].item()
        assert opacity == pytest.approx(-math.expm1(-0.8 * np.linalg.norm(ray) * chord), rel=1e-10, abs=1e-13)
        if len(t) == 2:
            met += 1
            assert result["depth_first"][i, j].item() == pytest.approx(min(t), rel=1e-12)
    assert 50 < met < 400


def test_tetrahedron_on_the_axis_agrees_with_the_closed_form():
    # Turned so that b_0 is the axis: vertex 0 nearest at z - d, the face behind it at z + d/3.
    b = BASIS[0]
    axis = np.cross(b, [0, 0, -1])
    angle = math.acos(-b[2])
    axis = axis / np.linalg.norm(axis) * math.sin(angle / 2)
    parameters = [
        tensor(x)
        for x in (
            [[0.0, 0, 5]],
            [[math.cos(angle / 2), *axis]],
            [[0.6] * 4],
            [0.9],
            [gray(1.0)],
            [0.0] * 3,
        )
    ]
    parameters[0][0, :2] = tensor([1e-7, 2e-7])  # off the vertex, so that one face is entered and not three
    for model in MODELS:
        pixel = pixel_of(rasterize(*parameters, **axis_camera(), primitive="tetrahedron", ray_model=model), 4, 4)
        assert pixel["depth_first"].item() == pytest.approx(5 - 0.6, abs=1e-5)
        assert pixel["opacity"].item() == pytest.approx(-math.expm1(-0.9 * 0.8), abs=1e-5)
        assert (pixel["normal"] / pixel["opacity"])[2].item() == pytest.approx(-1 / 3, abs=1e-6)


def cut_tetrahedron():
    """A regular tetrahedron, and the octahedron and four tetrahedra that cuts through its edge midpoints make."""
    d, density = 1.2, 0.7
    center, turn = np.array([0.1, -0.2, 4.0]), [0.8, 0.1, 0.5, -0.3]
    vertices = d * BASIS @ reference.rotation_matrix(tensor(turn)).numpy().T

    def shape(kind, centers, size):
        n, columns = len(centers), 3 if kind == "octahedron" else 4
        return [tensor(x) for x in (centers, [turn] * n, [[size] * columns] * n, [density] * n, [gray(0.8)] * n)]

    whole = shape("tetrahedron", center[None], d)
    middle = shape("octahedron", center[None], d / math.sqrt(3))
    corners = shape("tetrahedron", center + vertices / 2, d / 2)
    return whole, middle, corners


def test_thickness_of_a_tetrahedron_is_the_sum_of_its_pieces():
    whole, middle, corners = cut_tetrahedron()
    camera, background = axis_camera(20, 20, 24.0), torch.zeros(3, dtype=torch.float64)
    tau = [
        -torch.log1p(-rasterize(*x, background, **camera, primitive=kind, stop=0.0)["opacity"])
        for x, kind in ((whole, "tetrahedron"), (middle, "octahedron"), (corners, "tetrahedron"))
    ]
    assert (tau[0] > 0).sum() > 50 and (tau[1] > 0).sum() > 20 and (tau[2] > 0).sum() > 50
    torch.testing.assert_close(tau[0], tau[1] + tau[2], rtol=1e-10, atol=1e-12)


def test_overlap_of_pieces_equals_the_whole_tetrahedron():
    whole, middle, corners = cut_tetrahedron()
    camera, background = axis_camera(20, 20, 24.0), tensor([0.1, 0.2, 0.3])
    want = rasterize(*whole, background, **camera, primitive="tetrahedron", order="overlap", stop=0.0)
    rays = reference.pixel_rays(20, 20, 24.0, 24.0, 10.0, 10.0, background)
    limits = reference_shapes.view_limits((20, 20), (24.0, 24.0), (10.0, 10.0))
    options = dict(ray_model="exact", screen_filter=0.0, focal=(24.0, 24.0), limits=limits, near=0.01)
    parts = [
        reference_shapes.polyhedron_chords(
            x[0], reference.rotation_matrix(x[1]), x[2], x[3], rays, primitive=kind, **options
        )
        for x, kind in ((middle, "octahedron"), (corners, "tetrahedron"))
    ]
    chords = reference_shapes.Chords(
        *[
            torch.cat([getattr(c, name) + (name == "primitive") * k for k, c in enumerate(parts)], -1)
            for name in ("pixel", "primitive", "t_in", "t_out", "rate", "tau", "normal")
        ]
    )
    got = reference_blend.blend_overlapping(
        chords,
        torch.full((5, 3), 0.8, dtype=torch.float64),
        background,
        400,
        stop=0.0,
        level=0.5,
        geometry=True,
    )
    for name in ("rgb", "opacity", "depth_expected", "depth_first", "depth_median", "distortion"):
        torch.testing.assert_close(got[name].reshape(want[name].shape), want[name], rtol=1e-9, atol=1e-11)
    assert (want["depth_median"] > 0).any() and want["distortion"].max() > 0.01


def test_primitive_without_size_is_not_drawn():
    parameters, camera = scene("tetrahedron", 60, 3)
    for order in ORDERS:
        alone = rasterize(
            *[p[::2] for p in parameters[:5]], parameters[5], **camera, primitive="tetrahedron", order=order
        )
        flat = [p.clone() for p in parameters]
        for size in (0.0, -0.4):
            flat[2][1, 3] = size
            leaves = [p.requires_grad_() for p in flat]
            result = rasterize(*leaves, **camera, primitive="tetrahedron", order=order)
            assert_same(alone, result, IMAGES, rtol=0, atol=0)
            assert result["pixels"][1] == 0
            assert all(g.isfinite().all() for g in torch.autograd.grad(result["rgb"].sum(), leaves))
            flat = [p.detach() for p in leaves]
