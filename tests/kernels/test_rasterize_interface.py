"""Input that the compiled rasterizer accepts or refuses, and finite output with or without visible primitives."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from helpers.ladder import DTYPES, LADDER, ladder, options_of, scene_of
from helpers.octahedra import (
    IMAGES,
    KERNELS,
    NAMES,
    assert_identical,
    camera,
    cotangents,
    everything,
    fields,
    gradients,
    hard_scene,
    kernels,
    leaves,
    octahedra,
    random_scene,
    twin,
)

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import ops

pytestmark = pytest.mark.usefixtures("few_threads")


# --- nothing but finite numbers ---


def assert_finite_everywhere(scene, view, options):
    """All outputs and gradients are finite and the opacity is a share; returns whether anything was hit."""
    inputs = leaves(scene)
    screen = torch.zeros(len(inputs[0]), 3, dtype=inputs[0].dtype, requires_grad=True)
    out = ops.rasterize(*inputs, view, geometry=True, screen=screen, **options)
    images = fields(out)
    total = sum(
        (image * torch.linspace(-1, 1, image.numel(), dtype=image.dtype).view_as(image)).sum()
        for image in images.values()
    )
    grads = torch.autograd.grad(total, [*inputs, screen])
    assert all(bool(x.isfinite().all()) for x in (*images.values(), out.max_weight, *grads))
    # 1 - T with 0 <= T <= 1, and weights T alpha with alpha <= 1 to a rounding.
    assert (
        0 <= out.opacity.min()
        and out.opacity.max() <= 1
        and out.max_weight.max() <= 1 + 4 * torch.finfo(inputs[0].dtype).eps
    )
    return bool((out.pixels > 0).any())


def test_hard_scenes_give_finite_results():
    hit = 0
    others = [name for name in KERNELS if name != KERNELS[-1]]
    for seed in range(1800):
        scene, view, options = hard_scene(seed)
        hit += assert_finite_everywhere(scene, view, options)
        single = [p.float() for p in scene]
        for isa in (KERNELS[-1], *([others[seed // 4 % len(others)]] if seed % 4 == 0 and others else [])):
            ops.set_instruction_set(isa)
            assert_finite_everywhere(single, view, options)
    assert hit > 900


@pytest.mark.parametrize("isa", KERNELS)
def test_an_overflowing_thickness_gives_finite_results(isa):
    scene = [p.float() for p in octahedra([[0.01, 0.02, 3.0]], [[1.0, 1.0, 1.0]], [3e38])]
    with kernels(isa):
        out = ops.rasterize(*scene, camera(), geometry=True)
    assert all(bool(image.isfinite().all()) for image in fields(out).values())


@pytest.mark.parametrize("isa", KERNELS)
def test_a_denormal_axis_gives_finite_gradients(isa):
    scene = [
        p.float()
        for p in octahedra([[0.0, 0.0, 0.0]], [[0.0255, 0.281, 2.55e-41]], [1.0], [(-0.186, -1.351, 2.53, -0.4255)])
    ]
    inputs = leaves(scene)
    with kernels(isa):
        out = ops.rasterize(*inputs, Camera(50, 1, 3014.0, 3652.0, 25.0, 0.5, np.eye(4)), near=0.0185)
        for extent in (1.0, 2.0):
            ops.rasterize(*[p.float() for p in octahedra([[0, 0, 3.0]], [[extent] * 3], [1.0])], camera())
        grads = torch.autograd.grad(out.rgb.sum(), inputs)
    assert all(bool(g.isfinite().all()) for g in grads)


def test_the_gradient_of_a_distortion_above_1e12_is_finite():
    pose = np.eye(4)
    pose[:3] = [
        [0.2375, 0.9251, -0.2964, 0.4593],
        [0.9511, -0.1594, 0.2647, -1.8639],
        [0.1977, -0.3448, -0.9176, 0.0787],
    ]
    view = Camera(4, 4, 86.0239, 82.3206, 153.2871, -79.6595, pose)
    rows = (
        [[239230.375, 152163.4375, -1350907.875]],
        [[-0.7587, -0.9164, 0.1832, -0.441]],
        [[1.2543e25, 1.0934e28, 1.7432e36]],
    )
    values = [torch.tensor(row, requires_grad=True) for row in (*rows, [1.1603e-17], [[[0.2104, 0.328, 0.5226]]])]
    out = ops.rasterize(*values, torch.zeros(3), view, order="overlap", geometry=True, stop=0.0)
    cotangent = torch.linspace(-1, 1, out.distortion.numel()).view_as(out.distortion)
    gradients = torch.autograd.grad(out.distortion, values, cotangent, allow_unused=True)
    assert float(out.distortion.max()) > 1e12
    assert all(bool(torch.isfinite(g).all()) for g in gradients if g is not None) and float(gradients[3].abs()) > 0


# --- few primitives, few pixels ---


def assert_finite(parameters, view, options) -> bool:
    """Images and gradients are finite and opacity is a share; returns whether anything was hit."""
    *images, _, _, c, r, e, d, s, b, screen = everything(parameters, view, **options)
    assert all(bool(x.isfinite().all()) for x in (*images, c, r, e, d, s, b, screen))
    assert 0 <= float(images[1].min()) and float(images[1].max()) <= 1
    return bool((images[1] > 0).any())


@ladder(LADDER, DTYPES)
def test_zero_and_one_primitive_in_images_of_any_shape(variant, dtype):
    options = options_of(variant)
    for (width, height), count in itertools.product(((1, 1), (1, 5000), (5000, 1)), (0, 1)):
        focal = max(4.0, 0.8 * max(width, height))
        parameters, view = scene_of(variant, 5, 1, width=width, height=height, depth=2.0, spread=0.05, focal=focal)
        parameters = [p[:count] if i < 5 else p for i, p in enumerate(parameters)]
        assert assert_finite([p.to(dtype) for p in parameters], view, options) == (count == 1)
        if width == height == count == 1:
            wanted = twin(parameters, view, geometry=False, **options)
            got = ops.rasterize(*[p.to(dtype) for p in parameters], view, **options).rgb.double()
            torch.testing.assert_close(got, wanted["rgb"], rtol=0, atol=1e3 * torch.finfo(dtype).eps)


@ladder(LADDER, DTYPES)
def test_primitives_out_of_view_give_background_and_zero_gradients(variant, dtype):
    options = options_of(variant)
    parameters, view = scene_of(variant, 6, 4)
    pose = view.world_to_camera.copy()
    pose[2, 3] -= 100.0  # everything is behind the camera now
    inputs = leaves(parameters, dtype)
    view = Camera(view.width, view.height, view.fx, view.fy, view.cx, view.cy, pose)
    out = ops.rasterize(*inputs, view, geometry=True, **options)
    assert torch.equal(out.rgb, inputs[5].detach()[:, None, None].expand_as(out.rgb)) and not out.opacity.any()
    assert not any(getattr(out, name).any() for name in IMAGES[1:]) and not out.pixels.any()
    grads = torch.autograd.grad(out.rgb.sum() + out.depth_expected.sum(), inputs, allow_unused=True)
    assert not any(g.any() for g in grads[:5] if g is not None)


# --- the interface ---


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", NAMES)
def test_non_finite_inputs_are_refused_with_their_row(name, bad):
    scene, view = random_scene(81, 5, 4)
    tensor = scene[NAMES.index(name)]
    row = 2
    tensor.view(len(tensor), -1)[row, 0] = bad
    with pytest.raises(LinprimError, match=f"{name}: row {row} "):
        ops.rasterize(*scene, view)


@ladder(LADDER, DTYPES)
def test_non_finite_inputs_of_every_variant_are_refused_with_their_row(variant, dtype):
    options = options_of(variant)
    for name, bad in itertools.product(NAMES, (math.nan, math.inf, -math.inf)):
        parameters, view = scene_of(variant, 81, 5, 4)
        parameters = [p.to(dtype) for p in parameters]
        tensor = parameters[NAMES.index(name)]
        tensor.view(len(tensor), -1)[2, -1] = bad
        with pytest.raises(LinprimError, match=f"{name}: row 2 "):
            ops.rasterize(*parameters, view, **options)


@pytest.mark.parametrize("name", NAMES)
def test_wrong_shapes_are_refused_by_name(name):
    scene, view = random_scene(82, 5, 4)
    i = NAMES.index(name)
    scene[i] = scene[i][..., :-1]
    with pytest.raises(ValueError, match=name):
        ops.rasterize(*scene, view)


def test_two_coefficients_are_refused():
    scene, view = random_scene(83, 5, 4)
    scene[4] = scene[4][:, :2]
    with pytest.raises(ValueError, match=r"sh has to have shape \(N, 1 \| 4 \| 9 \| 16, 3\)"):
        ops.rasterize(*scene, view)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int64])
def test_other_dtypes_are_refused(dtype):
    scene, view = random_scene(84, 5, 4)
    with pytest.raises(LinprimError, match="float32 or float64"):
        ops.rasterize(*[p.to(dtype) for p in scene], view)


@pytest.mark.parametrize("odd", range(1, 6))
def test_tensors_of_two_dtypes_are_refused(odd):
    scene, view = random_scene(85, 5, 4)
    mixed = [p.double() if i == odd else p.float() for i, p in enumerate(scene)]
    with pytest.raises((LinprimError, ValueError, TypeError), match=NAMES[odd]):
        ops.rasterize(*mixed, view)


@pytest.mark.parametrize("change", [{"width": 0}, {"height": -1}, {"fx": 0.0}, {"fy": -3.0}, {"fx": float("nan")}])
def test_impossible_cameras_are_refused(change):
    scene, view = random_scene(86, 5, 4)
    values = {k: getattr(view, k) for k in ("width", "height", "fx", "fy", "cx", "cy", "world_to_camera")}
    with pytest.raises((ValueError, RuntimeError)):
        ops.rasterize(*scene, Camera(**values | change))
    for options, name in (
        ({"near": 0.0}, "near"),
        ({"near": -1.0}, "near"),
        ({"stop": -1.0}, "stop"),
        ({"stop": 1.0}, "stop"),
    ):
        with pytest.raises(ValueError, match=name):
            ops.rasterize(*scene, view, **options)


@pytest.mark.parametrize(
    "change", [{"cx": float("nan")}, {"world_to_camera": np.full((4, 4), np.nan)}, {"fx": float("inf")}]
)
def test_non_finite_cameras_are_refused(change):
    scene, view = random_scene(86, 5, 4)
    values = {k: getattr(view, k) for k in ("width", "height", "fx", "fy", "cx", "cy", "world_to_camera")}
    with pytest.raises((LinprimError, ValueError)):
        ops.rasterize(*scene, Camera(**values | change))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_non_contiguous_inputs_give_the_same_result_and_stay_unchanged(dtype):
    scene, view = random_scene(87, 7, 9, 20, 14)
    scene = [p.to(dtype) for p in scene]
    wanted = everything(scene, view)
    strided = [torch.stack([p, torch.full_like(p, 7.0)], -1)[..., 0] for p in scene]
    transposed = [p.transpose(0, -1).contiguous().transpose(0, -1) for p in scene]
    assert not any(p.is_contiguous() for p in strided) and not transposed[0].is_contiguous()
    for layout in (strided, transposed):
        before = [p.clone() for p in layout]
        inputs = [p.detach().requires_grad_() for p in layout]
        screen = torch.zeros(7, 3, dtype=dtype, requires_grad=True)
        out = ops.rasterize(*inputs, view, geometry=True, screen=screen)
        images = fields(out)
        grads = gradients(images, [*inputs, screen], cotangents(images))
        assert_identical([*images.values(), out.max_weight, out.pixels, *grads], wanted)
        assert_identical(layout, before)


def test_non_contiguous_output_gradients_are_accepted():
    scene, view = random_scene(88, 7, 1, 20, 14)
    inputs = leaves(scene)
    out = ops.rasterize(*inputs, view)
    weight = torch.rand(20, 14, 3, dtype=torch.float64).permute(2, 1, 0)
    a = torch.autograd.grad(out.rgb, inputs, weight, retain_graph=True)
    b = torch.autograd.grad(out.rgb, inputs, weight.contiguous())
    assert_identical(a, b)


def test_an_unknown_instruction_set_is_refused_and_the_old_one_kept():
    before = ops.instruction_set()
    with pytest.raises(LinprimError, match="v9"):
        ops.set_instruction_set("v9")
    assert ops.instruction_set() == before and "scalar" in KERNELS
