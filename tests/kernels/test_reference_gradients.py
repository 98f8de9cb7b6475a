"""Gradients of the reference, compared with finite differences, and finite at edges and vertices."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.finite_differences import assert_every_gradient, assert_gradient_along_a_direction
from helpers.reference_scenes import IDENTITY, IMAGES, axis_camera, octahedra, random_scene

from linprim_geo.kernels.reference.rasterize import rasterize

pytestmark = pytest.mark.usefixtures("one_thread")


def all_outputs(camera):
    def run(*parameters):
        result = rasterize(*parameters, **camera)
        return tuple(result[name] for name in IMAGES)

    return run


def test_gradients_of_all_outputs_agree_with_finite_differences():
    parameters, camera = random_scene(20, 4, 4)
    parameters = [p.requires_grad_() for p in parameters]
    result = rasterize(*parameters, **camera)
    assert all((result[name] != 0).any() for name in IMAGES) and (result["pixels"] > 0).all()
    assert_every_gradient(all_outputs(camera), parameters, atol=1e-6)


@pytest.mark.parametrize(
    "seed,coefficients,more",
    [
        (21, 16, {"stop": 0.4}),
        (22, 9, {"depth": 0.4}),
        (23, 1, {"near": 2.2, "level": 0.7}),
    ],
)
def test_directional_gradients_agree_with_finite_differences(seed, coefficients, more):
    parameters, camera = random_scene(seed, 6, coefficients, width=7, **more)
    pose = camera.pop("world_to_camera")
    inputs = [p.requires_grad_() for p in (*parameters, pose)]

    def run(*inputs):
        result = rasterize(*inputs[:6], world_to_camera=inputs[6], **camera)
        return tuple(result[name] for name in IMAGES)

    assert_gradient_along_a_direction(run, inputs, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(
    "center,near",
    [
        ((0.0, 0.0, 2.0), 0.01),  # through two vertices, and along edges
        ((1.0, 0.0, 2.0), 0.01),  # grazing vertices
        ((0.0, 0.0, 2.0), 1.0),  # the entry vertex on the near plane
        ((0.0, 0.0, 1.0), 0.01),  # the camera on a vertex
        ((0.5, 0.0, 0.5), 0.01),  # the camera on an edge, in the planes of two faces
        ((0.0, 0.0, 0.0), 0.01),  # the camera at the centre, where a colour has no direction
    ],
)
def test_gradients_are_finite_through_edges_and_vertices(center, near, dtype):
    # Focal length and offsets are whole numbers, so slopes, ties and parallel faces come out exactly.
    parameters = [
        p.to(dtype).requires_grad_()
        for p in octahedra([center, (0.0, 0.0, 4.0)], [[1, 1, 1], [2, 1, 1]], [1.0, 0.0], rotation=[IDENTITY] * 2)
    ]
    sh = torch.cat([parameters[4], torch.full((2, 3, 3), 0.1, dtype=dtype)], 1)
    parameters[4] = sh.detach().requires_grad_()
    result = rasterize(*parameters, **axis_camera(5, 5, 1.0), near=near)
    assert (result["pixels"] > 0).all()  # also the second, whose thickness is exactly 0
    for name in IMAGES:
        assert result[name].isfinite().all()
        grads = torch.autograd.grad(result[name].sum(), parameters, retain_graph=True, allow_unused=True)
        assert grads[2] is not None
        for grad in grads:
            assert grad is None or grad.isfinite().all(), name


def test_gradient_of_an_opaque_primitive_is_finite():
    parameters = [p.requires_grad_() for p in octahedra([[0, 0, 5]], [[1, 1, 1]], [1e6])]
    result = rasterize(*parameters, **axis_camera())
    assert result["opacity"][4, 4] == 1
    for grad in torch.autograd.grad(sum(result[name].sum() for name in IMAGES), parameters):
        assert grad.isfinite().all()


def test_gradient_of_the_median_depth_agrees_with_the_closed_form():
    # On the axis with extent e and density s: median = z - e + ln 2 / s.
    parameters = [p.requires_grad_() for p in octahedra([[0, 0, 5]], [[1.0, 1.0, 0.7]], [0.9])]
    median = rasterize(*parameters, **axis_camera())["depth_median"][4, 4]
    center, _, extent, density = torch.autograd.grad(median, parameters[:4])
    assert center[0, 2].item() == pytest.approx(1, rel=1e-13)
    assert extent[0, 2].item() == pytest.approx(-1, rel=1e-13)
    assert density.item() == pytest.approx(-math.log(2) / 0.9**2, rel=1e-13)
