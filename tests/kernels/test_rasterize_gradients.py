"""Gradients of the compiled rasterizer by finite differences, its operators, and state between its passes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.octahedra import (
    BUILDS,
    C0,
    COLOR,
    IMAGES,
    NAMES,
    assert_identical,
    cotangents,
    everything,
    fields,
    gradients,
    kernels,
    leaves,
    random_scene,
)

from linprim_geo.base.kinds import KINDS
from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import ops

pytestmark = pytest.mark.usefixtures("few_threads")


@pytest.mark.parametrize("geometry", [False, True])
@pytest.mark.parametrize("seed,coefficients,depth", [(51, 4, 3.0), (52, 1, 0.5), (53, 16, 2.5)])
def test_gradients_agree_with_finite_differences(seed, coefficients, depth, geometry):
    # Six pixels and three primitives; seeds whose rays keep clear of edges by more than the step.
    scene, view = random_scene(seed, 3, coefficients, 3, 2, depth, spread=0.3)
    inputs = leaves(scene)

    def run(*tensors):
        return tuple(fields(ops.rasterize(*tensors, view, geometry=geometry), IMAGES if geometry else COLOR).values())

    assert run(*inputs)[1].max() > 0.1
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=coefficients == 16)


def operator_arguments(dtype=torch.float32, geometry=False, screen=True, requires_grad=True):
    scene, view = random_scene(61, 4, 4, 7, 5)
    inputs = leaves(scene, dtype) if requires_grad else [p.to(dtype) for p in scene]
    zeros = torch.zeros(4, 3, dtype=dtype, requires_grad=requires_grad) if screen else None
    pose = torch.from_numpy(view.world_to_camera)
    numbers = [view.fx, view.fy, view.cx, view.cy, 0.01, 1e-3, 0.5, 0.0]
    return (*inputs, zeros, pose, numbers, [view.width, view.height, 0, 0, 0, int(geometry)])


@pytest.mark.parametrize("geometry", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_operator_is_registered_correctly(geometry, dtype):
    torch.library.opcheck(torch.ops.linprim_geo.rasterize.default, operator_arguments(dtype, geometry))


def test_the_operator_without_gradients_is_registered_correctly():
    torch.library.opcheck(
        torch.ops.linprim_geo.rasterize.default, operator_arguments(screen=False, requires_grad=False)
    )


@pytest.mark.parametrize("geometry", [False, True])
def test_the_adjoint_operator_is_registered_correctly(geometry):
    args = operator_arguments(torch.float64, geometry, requires_grad=False)
    *planes, color, _, _ = torch.ops.linprim_geo.rasterize(*args)
    grads = [torch.ones_like(p) for p in planes[:8]]
    grads[1] = None
    torch.library.opcheck(torch.ops.linprim_geo.rasterize_grad.default, (*args[:6], *args[7:], color, planes, grads))


def test_gradient_of_each_input_alone_equals_that_of_all():
    scene, view = random_scene(62, 5, 4)
    inputs = leaves(scene)
    together = torch.autograd.grad(ops.rasterize(*inputs, view).rgb.square().sum(), inputs)
    for i, wanted in enumerate(together):
        alone = [p.detach() for p in scene]
        alone[i] = inputs[i]
        (grad,) = torch.autograd.grad(ops.rasterize(*alone, view).rgb.square().sum(), inputs[i])
        assert torch.equal(grad, wanted)


@pytest.mark.parametrize("dtype,isa", BUILDS)
def test_weights_of_backward_and_forward_pass_are_bitwise_equal(dtype, isa):
    # One pixel at a time, no sum is rounded: the gradient to a primitive's coefficient of degree 0 is C0 times its
    # weight, and `max_weight` is that weight. It is 0 exactly where the forward pass did not hit.
    met = 0
    with kernels(isa):
        for seed in range(80):
            scene, view = random_scene(700 + seed, 8, 1, 1, 1, 2.0, spread=0.4)
            inputs = leaves(scene, getattr(torch, dtype))
            inputs[4] = torch.full_like(inputs[4], 0.1).requires_grad_()  # no colour is clamped
            out = ops.rasterize(*inputs, view, geometry=True, stop=0.2)
            (grad,) = torch.autograd.grad(out.rgb.sum(), inputs[4])
            met += int((out.max_weight > 0).sum())
            wanted = out.max_weight * torch.tensor(C0, dtype=grad.dtype)
            assert torch.equal(grad, wanted[:, None, None].expand_as(grad))
    assert met > 100


@pytest.mark.parametrize("dtype,isa", BUILDS)
def test_colour_does_not_depend_on_geometry_output(dtype, isa):
    scene, view = random_scene(63, 20, 9, 33, 20)
    scene = [p.to(getattr(torch, dtype)) for p in scene]
    with kernels(isa):
        images = [fields(ops.rasterize(*scene, view, geometry=g), COLOR) for g in (False, True)]
    # The two kernels may be contracted differently: each rounding counts once.
    for name in COLOR:
        torch.testing.assert_close(
            images[0][name], images[1][name], rtol=0, atol=200 * torch.finfo(images[0][name].dtype).eps
        )


def test_gradient_to_the_background_is_the_transmittance():
    scene, view = random_scene(64, 10, 4)
    inputs = leaves(scene)
    out = ops.rasterize(*inputs, view)
    weight = torch.rand(3, view.height, view.width, dtype=torch.float64)
    (grad,) = torch.autograd.grad((out.rgb * weight).sum(), inputs[5])
    torch.testing.assert_close(grad, ((1 - out.opacity.detach()) * weight).sum((1, 2)), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("samples", [1, 3])
def test_screen_gradient_agrees_with_moving_a_centre(samples):
    # Degree 0: the colour does not turn with the centre. The loss's own third derivative bounds the difference
    # quotient.
    scene, view = random_scene(65, 4, 1, 25, 21, depth=4.0, spread=0.3)
    screen = torch.zeros(4, 3, dtype=torch.float64, requires_grad=True)
    weight = torch.rand(3, view.height, view.width, dtype=torch.float64, generator=torch.Generator().manual_seed(3))

    def loss(center):
        return (ops.rasterize(center, *scene[1:], view, samples=samples, screen=screen).rgb * weight).sum()

    (grad,) = torch.autograd.grad(loss(scene[0]), screen)
    assert (grad[:, :2].abs() > 1e-3).sum() >= 4
    # The third column adds lengths tile by tile, so it is at least the length of the sum.
    assert (grad[:, 2] >= grad[:, :2].norm(dim=1) * (1 - 1e-12)).all()
    depth = scene[0].numpy() @ view.rotation[2] + view.world_to_camera[2, 3]
    assert (depth > 1.0).all()
    step = 1e-5
    for i in range(4):
        for axis, focal in ((0, view.fx), (1, view.fy)):
            move = torch.zeros_like(scene[0])
            move[i] = torch.from_numpy(view.rotation[axis] * depth[i] / focal) * step
            quotient = (loss(scene[0] + move) - loss(scene[0] - move)) / (2 * step)
            assert grad[i, axis].item() == pytest.approx(quotient.item(), rel=1e-3, abs=1e-4)


def test_two_graphs_can_be_differentiated_in_any_order_and_twice():
    first, second = (random_scene(seed, 30, 4, 40, 30) for seed in (66, 67))
    alone = [everything(*first), everything(*second)]
    inputs = [leaves(first[0]), leaves(second[0])]
    out = [
        fields(ops.rasterize(*x, view, geometry=True)) for x, view in zip(inputs, (first[1], second[1]), strict=True)
    ]
    for k in (0, 1, 1, 0):
        grads = gradients(out[k], inputs[k], cotangents(out[k]))
        assert_identical(grads, alone[k][10:16])


@pytest.mark.parametrize("geometry", [False, True])
@pytest.mark.parametrize("dtype,isa", BUILDS)
def test_gradients_do_not_depend_on_other_renders_in_between(dtype, isa, geometry):
    scene, view = random_scene(68, 60, 4, 45, 37)
    scene = [p.to(getattr(torch, dtype)) for p in scene]
    with kernels(isa):
        wanted = everything(scene, view, geometry, stop=0.2)
        inputs = leaves(scene)
        images = fields(ops.rasterize(*inputs, view, geometry=geometry, stop=0.2), IMAGES if geometry else COLOR)
        for seed in range(4):  # more views than the core remembers, larger and smaller
            other, elsewhere = random_scene(seed, 10 + 90 * (seed % 2), 1, 30 * (1 + seed % 2), 20)
            ops.rasterize(*[p.to(scene[0].dtype) for p in other], elsewhere)
        grads = gradients(images, inputs, cotangents(images))
        start = 10 if geometry else 2
        assert_identical(grads, wanted[start : start + 6])
        # The same view of the same scene with another stop is another list.
        ops.rasterize(*scene, view, geometry=geometry, stop=0.9)
        assert_identical(gradients(images, inputs, cotangents(images)), grads)


def test_tile_lists_are_reused_only_for_equal_inputs():
    # Every pair of scenes differs in one value of one tensor, or in one number of the view.
    scene, view = random_scene(69, 12, 4, 20, 14)
    values = {k: getattr(view, k) for k in ("width", "height", "fx", "fy", "cx", "cy", "world_to_camera")}
    pose = view.world_to_camera.copy()
    pose[0, 3] += 0.1
    others = [({name: 1.3}, {}, {}) for name in NAMES]
    others += [
        ({}, {"fx": view.fx * 1.1}, {}),
        ({}, {"cy": view.cy + 2}, {}),
        ({}, {"world_to_camera": pose}, {}),
        ({}, {}, {"near": 2.9}),
    ]
    wanted = everything(scene, view)[10:16]
    for factors, numbers, options in others:
        inputs = leaves(scene)
        images = fields(ops.rasterize(*inputs, view, geometry=True))
        changed = [p * factors.get(name, 1.0) for name, p in zip(NAMES, scene, strict=True)]
        ops.rasterize(*changed, Camera(**values | numbers), geometry=True, **options)
        ops.rasterize(*changed, Camera(**values | numbers), geometry=False, **options)
        assert_identical(gradients(images, inputs, cotangents(images)), wanted)


@pytest.mark.parametrize("primitive", ["octahedron", "tetrahedron"])
def test_screen_gradient_of_primitives_across_the_near_plane(primitive):
    """It is taken at the middle of the primitive's depths beyond the near plane."""
    camera = Camera(20, 16, 15.0, 16.0, 10.0, 8.0, np.eye(4))
    near, reach, arms = 0.2, 0.8, 3 if primitive == "octahedron" else 4
    center = torch.tensor([[0.05, -0.1, 0.3], [0.1, 0.05, -0.1], [0.1, 0.1, 3.0]], dtype=torch.float64)
    center.requires_grad_()
    rotation = torch.tensor([[1.0, 0, 0, 0]] * 3, dtype=torch.float64)
    extent = torch.full((3, arms), reach, dtype=torch.float64)
    sh = torch.tensor([0.3, -0.5, 0.9], dtype=torch.float64).reshape(3, 1, 1).repeat(1, 1, 3)
    screen = torch.zeros(3, 3, dtype=torch.float64, requires_grad=True)
    rest = torch.full((3,), 0.7, dtype=torch.float64), sh, torch.zeros(3, dtype=torch.float64)
    out = ops.rasterize(center, rotation, extent, *rest, camera, primitive=primitive, near=near, screen=screen)
    weight = torch.rand(3, 16, 20, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    moved, pulled = torch.autograd.grad((out.rgb * weight).sum(), [center, screen])
    if primitive == "octahedron":
        high = reach
    else:
        high = reach * float(KINDS[primitive].directions[:, 2].max())
    z = center.detach()[:, 2]
    depth = torch.where(z - reach < near, (near + z + high) / 2, z)
    expected = moved[:, :2] * depth[:, None] / torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
    torch.testing.assert_close(pulled[:, :2], expected, rtol=1e-9, atol=1e-12)
    assert (moved[:, :2].norm(dim=1) > 1e-3).all()
    assert (pulled[:, 2] >= pulled[:, :2].norm(dim=1) * (1 - 1e-12)).all()
