"""The compiled rasterizer against its float64 twin, invariants and differences, on ordinary and on hard scenes."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
import torch
from octahedra import (
    BUILDS,
    C0,
    COLOR,
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
    random_pose,
    random_scene,
    twin,
)

from linprim_geo import ops, reference
from linprim_geo.camera import Camera
from linprim_geo.errors import LinprimError


@pytest.fixture(autouse=True)
def few_threads():
    before = torch.get_num_threads(), ops.threads(), ops.instruction_set()
    torch.set_num_threads(1)
    ops.set_threads(1)
    yield
    torch.set_num_threads(before[0])
    ops.set_threads(before[1])
    ops.set_instruction_set(before[2])


# --- the twin ---
#
# Tolerances, in units of eps = 2^-52 or 2^-23, derived once for all comparisons below. A face's inverse depth is a + b dx + c dy;
# each term and their sums are rounded: the face is off by about 4 eps of the tile's 16 pixels where it is steep, by 4 eps t of
# depth t where it is seen square on. The thickness of a slice is thus off by
#     d_tau = 4 eps density (|v| t + 16 |d chord / d pixel|)
# and colour, opacity and normal, being sums of weights of sum at most 1, by no more than the sum of w d_tau / tau, as a thick
# slice does not pass its error on. With t = 5 and chords of half a unit that vary over a pixel or two, this is 40 to 400 eps;
# depths are that good relative to their own range, the distortion to depth squared. Gradients start from sums that cancel a
# digit: ten times more. In double the mean depth inside a thin slice adds the first terms that its series leaves out, at
# tau = 0.3: tau^7 / 1209600 and, for the derivative, tau^6 / 172800.
VALUE, GRADIENT = 400, 4000
SERIES, SERIES_GRADIENT = 0.3**7 / 1209600, 0.3**6 / 172800
USES_SERIES = ("depth_expected", "distortion", "all")


@lru_cache(maxsize=4)
def expectation(make, *args):
    """Images and gradients of the twin for inputs rounded to `dtype`: once for all instruction sets."""
    parameters, view, options, dtype = make(*args)
    inputs = leaves([p.to(dtype) for p in parameters])
    images = twin(inputs, view, **options)
    shown = {name: images[name] for name in IMAGES}
    weights = cotangents(shown)
    grads = {name: gradients({name: image}, inputs, weights) for name, image in shown.items()}
    grads["all"] = [sum(g) for g in zip(*(grads[name] for name in IMAGES), strict=True)]
    return inputs, view, options, {k: v.detach() for k, v in images.items()}, weights, grads


def scales(images) -> dict[str, float]:
    """The range that the error of an image is relative to."""
    depth = max(1.0, float(images["depth_first"].max()) + float(images["depth_expected"].abs().max()))
    return {name: {"distortion": depth**2}.get(name, depth if name.startswith("depth") else 1.0) for name in IMAGES}


def assert_like_twin(make, *args, isa="scalar", value=VALUE, gradient=GRADIENT, each=False):
    """Outputs, statistics and gradients of the core equal the twin's, to `value` and `gradient` eps."""
    inputs, view, options, images, weights, grads = expectation(make, *args)
    dtype = inputs[0].dtype
    eps = torch.finfo(dtype).eps
    with kernels(isa):
        out = ops.rasterize(*inputs, view, geometry=True, **options)
        assert torch.equal(out.pixels.long(), images["pixels"])
        torch.testing.assert_close(out.max_weight.double(), images["max_weight"].double(), rtol=0, atol=value * eps)
        shown, scale = fields(out), scales(images)
        for name in IMAGES:
            largest = float((shown[name].detach().double() - images[name]).abs().max()) / scale[name]
            bound = value * eps + (SERIES if name in USES_SERIES else 0)
            assert largest <= bound, f"{name}: off by {largest:.2e} of its range, {bound:.2e} is allowed"
        for loss in (*IMAGES, "all") if each else ("all",):
            chosen = shown if loss == "all" else {loss: shown[loss]}
            for name, got, wanted in zip(NAMES, gradients(chosen, inputs, weights), grads[loss], strict=True):
                if name == "rotation":  # the gradient of a quaternion goes with 1 / its length
                    length = inputs[1].detach().double().norm(dim=1, keepdim=True)
                    got, wanted = got * length, wanted * length
                # A row is compared with the largest of its tensor, and no less than what one pixel may weigh.
                size = max(float(wanted.abs().max()) if wanted.numel() else 0.0, 1.0)
                worst = float((got.double() - wanted).abs().max()) / size if wanted.numel() else 0.0
                bound = gradient * eps + (SERIES_GRADIENT if loss in USES_SERIES else 0)
                assert worst <= bound, f"{loss} to {name}: off by {worst:.2e} of its largest, {bound:.2e} is allowed"
    return images


def ordinary(case, dtype):
    """Eight scenes: sizes around the tile's 16 and the block's 4, every degree, camera outside and in the midst."""
    width, height, count, coefficients, depth, options = [
        (17, 13, 12, 4, 3.0, {}),
        (33, 18, 20, 16, 3.0, {"stop": 0.0}),
        (1, 1, 30, 9, 2.5, {"level": 0.8}),
        (1, 50, 15, 4, 3.5, {"stop": 0.3}),
        (50, 1, 15, 1, 3.0, {"near": 0.8}),
        (16, 16, 20, 9, 0.6, {"stop": 0.05, "level": 0.3}),
        (5, 3, 10, 16, 2.0, {"near": 1.5, "level": 0.95}),
        (20, 35, 25, 1, -0.3, {"near": 0.05}),
    ][case]
    parameters, view = random_scene(100 + case, count, coefficients, width, height, depth)
    return parameters, view, options, dtype


@pytest.mark.parametrize("case", range(8))
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_equals_the_twin(case, dtype):
    for isa in ["scalar"] if dtype == torch.float64 else KERNELS:
        images = assert_like_twin(ordinary, case, dtype, isa=isa, each=dtype == torch.float64)
        assert (images["pixels"] > 0).sum() >= 3 and (images["opacity"] > 0.3).any()


def far_off_center(dtype):
    """Principal point 20 image widths beside the image."""
    view = camera(16, 12, 60.0, cx=-320.7)
    return octahedra([[12.0, 0.1, 2.1]], [[1.0, 0.4, 0.3]], [2.0], [[1.0, 0.2, -0.4, 0.3]]), view, {}, dtype


def far_away(dtype):
    """World coordinates of a million with the camera among them; double only."""
    rng = np.random.default_rng(5)
    parameters, view = random_scene(7, 12, 4)
    shift = 10 ** rng.uniform(4, 6, 3)
    pose = view.world_to_camera.copy()
    pose[:3, 3] -= pose[:3, :3] @ shift
    parameters[0] = parameters[0] + torch.from_numpy(shift)
    return parameters, Camera(view.width, view.height, view.fx, view.fy, view.cx, view.cy, pose), {}, dtype


TURNED = (0.9, 0.3, -0.2, 0.4)
# name: centres, half-axes, densities, rotations, options of rasterize, camera, and by how much the tolerances of value and gradient are
# larger than above: t over the thickness of plates and needles, 1e3, of which the twin itself loses as much; the distance in pixels
# of the tile from the reference; and behind something opaque the rest of a ray is a difference good to 4 eps, which the density multiplies.
HARD = {
    "camera inside": ([[0.1, 0.05, 0.2]], [[1.0, 0.9, 1.1]], [0.7], [TURNED], {}, {}, 1, 1),
    "camera inside several": (
        [[0.1, 0, 0.2], [0, 0.2, -0.1], [0.3, 0, 0.4]], [[1, 0.9, 1.1]] * 3, [0.7, 0.2, 1.5], None, {}, {}, 1, 1,
    ),
    "near plane crossed": ([[0.1, 0.2, 1.0]], [[0.8, 0.7, 0.9]], [1.5], [TURNED], {"near": 0.9}, {}, 1, 1),
    "centre behind, body in front": (
        [[0.2, 0.1, -1.0]], [[2.0, 1.5, 4.0]], [0.6], [(1.0, 0.05, 0.1, 0.0)], {}, {}, 1, 1,
    ),
    "behind entirely": ([[0.0, 0.1, -3.0]], [[1.0, 1.0, 1.0]], [1.0], [TURNED], {}, {}, 1, 1),
    "behind the near plane": ([[0.0, 0.1, 0.5]], [[0.3, 0.3, 0.3]], [1.0], [TURNED], {"near": 1.0}, {}, 1, 1),
    "off screen": ([[9.0, 0.1, 3.0]], [[1.0, 1.0, 1.0]], [1.0], [TURNED], {}, {}, 1, 1),
    "between the planes of a slab": ([[0.05, 0.02, 5.0]], [[0.3, 0.25, 4.9]], [2.0], None, {}, {}, 1, 1),
    "long towards the camera, turned": (
        [[0.3, 0.1, 4.0]], [[0.5, 0.2, 3.2]], [2.0], [(1.0, 0.03, -0.05, 0.2)], {}, {}, 1, 1,
    ),
    "needle": (
        [[0.1, 0.05, 3.0]], [[2.0, 1.2e-3, 0.9e-3]], [500.0], [TURNED], {}, {"width": 30, "height": 30, "focal": 600.0}, 20, 10,
    ),
    "plate seen edge-on": (
        [[0.0, 0.4, 3.0]], [[1.4, 2e-3, 1.2]], [40.0], [(1.0, -0.0585, 0.0, 0.0)], {}, {"focal": 200.0, "cy": -17.2}, 5, 10,
    ),
    "plate seen square on": (
        [[0.1, 0.05, 3.0]], [[1.3, 1.2, 1e-3]], [700.0], [(1.0, 0.02, 0.05, 0.3)], {}, {}, 30, 100,
    ),
    "below a pixel": ([[0.10, 0.06, 4.0]], [[0.02, 0.03, 0.02]], [30.0], None, {}, {"cx": 8.05, "cy": 6.2}, 4, 20),
    "covers the image a thousand times": (
        [[30.0, 10.0, 700.0]], [[600.0, 500.0, 690.0]], [3e-3], [(1.0, 0.02, 0.03, 0.1)], {}, {}, 1, 1,
    ),
    "thickness from 1e-9 to 1e4": (
        [[0, 0, 2.0], [0.1, 0, 4.0], [0, 0.1, 7.0]], [[1, 0.9, 0.8]] * 3, [1e-9, 0.3, 1e4], None, {}, {}, 1, 500,
    ),
    "opaque behind opaque": (
        [[0, 0, 2.0], [0.1, 0, 4.0]], [[1, 0.9, 0.8]] * 2, [300.0, 300.0], None, {"stop": 0.0}, {}, 1, 1,
    ),
    "no density": ([[0, 0, 2.0], [0.1, 0, 4.0]], [[1, 0.9, 0.8]] * 2, [0.0, 0.0], [TURNED] * 2, {}, {}, 1, 1),
    "coincident": ([[0.1, 0, 3.0]] * 5, [[1, 0.9, 0.8]] * 5, [0.2, 0.5, 1.0, 0.1, 0.3], [TURNED] * 5, {}, {}, 1, 1),
    "quaternions of any length": (
        [[0.1, 0, 3.0]] * 3, [[1, 0.5, 0.8]] * 3, [0.5] * 3, [[x * s for x in TURNED] for s in (1e-6, 3.0, 1e6)], {}, {}, 1, 1,
    ),
    "nothing": ([], [], [], None, {}, {}, 1, 1),
}


def hard(name, dtype):
    """A named hard case; none of its rays is within rounding of a vertex, edge or face plane."""
    center, extent, density, rotation, options, view, *_ = HARD[name]
    parameters = octahedra(center, extent, density, rotation)
    if not center:
        parameters = [p.reshape(0, *shape) for p, shape in zip(parameters, ((3,), (4,), (3,), (), (1, 3)), strict=False)] + parameters[5:]
    return parameters, camera(**view), options, dtype


@pytest.mark.parametrize("name", HARD)
def test_hard_cases_equal_the_twin(name):
    value, gradient = HARD[name][-2:]
    for dtype, isa in BUILDS:
        images = assert_like_twin(hard, name, getattr(torch, dtype), isa=isa, value=value * VALUE, gradient=gradient * GRADIENT)
    hidden = name in ("behind entirely", "behind the near plane", "off screen", "nothing")
    assert bool((images["pixels"] > 0).any()) != hidden


@pytest.mark.parametrize("dtype,isa", BUILDS)
def test_principal_point_far_outside_the_image(dtype, isa):
    # 320 pixels from the reference to the tile, not 16.
    images = assert_like_twin(far_off_center, getattr(torch, dtype), isa=isa, value=20 * VALUE, gradient=20 * GRADIENT)
    assert images["opacity"].max() > 0.3


def test_a_million_units_from_the_origin():
    # Both subtract the same 1e6 from sums of three products: each loses up to 3e6 eps of position, and half-axes are a tenth.
    images = assert_like_twin(far_away, torch.float64, value=6e7, gradient=6e8)
    assert (images["opacity"] > 0.3).any()


@pytest.mark.parametrize("gap", [1e-12, 1e-9, -1e-9, 1e-7])
def test_edge_on_faces_move_by_two_parts_in_a_million(gap):
    # sum(|m|) = 1 + gap: the camera is that near to the plane of a face, whose distance is kept above 2e-6 of the primitive. The
    # face therefore moves by 2e-6 of its distance from the centre, 0.5 here, and the thickness by density |v| as much.
    center = torch.tensor([0.3, 0.2, 3.0], dtype=torch.float64)
    extent = torch.tensor([1.2, 1.0, 0.0], dtype=torch.float64)
    extent[2] = center[2] / (1 + gap - (center[:2] / extent[:2]).sum())
    density, view = 0.8, camera(33, 25)
    scene = octahedra([center.tolist()], [extent.tolist()], [density])
    got, wanted = ops.rasterize(*scene, view), twin(scene, view)
    assert wanted["opacity"].max() > 0.5
    ray = 1.3
    bound = density * ray * float(extent.max()) * 2 * 2e-6
    off = (got.opacity - wanted["opacity"]).abs()
    # A ray within 1e-6 of the face's own plane passes or misses the whole body.
    assert int((off > bound).sum()) <= 1


def test_order_is_that_of_the_centres_and_ties_keep_their_index():
    scene, view = random_scene(31, 6, 1)
    pose = view.world_to_camera
    local = scene[0].numpy() @ pose[:3, :3].T + pose[:3, 3]
    local[:, 2] = 3.0
    flat = Camera(view.width, view.height, view.fx, view.fy, view.cx, view.cy, np.eye(4))
    scene[0] = torch.from_numpy(local)
    got, wanted = ops.rasterize(*scene, flat), twin(scene, flat)
    torch.testing.assert_close(got.rgb, wanted["rgb"], rtol=1e-11, atol=1e-11)
    scene[0][:] = scene[0][0]
    got = ops.rasterize(*scene, flat)
    swapped = [p.flip(0) if i < 5 else p for i, p in enumerate(scene)]
    assert (ops.rasterize(*swapped, flat).rgb - got.rgb).abs().max() > 1e-3


def test_double_orders_depths_that_a_float_cannot_tell_apart():
    scene = octahedra([[0, 0, 4.0 + 1e-8], [0.1, 0, 4.0]], [[0.5, 0.5, 0.5]] * 2, [3.0, 3.0])
    view = camera(9, 9)
    torch.testing.assert_close(ops.rasterize(*scene, view).rgb, twin(scene, view)["rgb"], rtol=1e-9, atol=1e-9)


# --- what is not drawn, and degenerate parameters ---


@pytest.mark.parametrize("dtype,isa", BUILDS)
def test_half_axes_that_are_not_positive_are_not_drawn(dtype, isa):
    scene, view = random_scene(41, 9, 4)
    scene = [p.to(getattr(torch, dtype)) for p in scene]
    keep = torch.tensor([0, 2, 3, 5, 6, 8])
    scene[2][1, 2], scene[2][4, 0], scene[2][7] = 0.0, -0.5, -1.0
    with kernels(isa):
        images = everything(scene, view)
        alone = everything([p[keep] if i < 5 else p for i, p in enumerate(scene)], view)
    rows = {8, 9, 10, 11, 12, 13, 14, 16}  # statistics and gradients per primitive
    for i, (x, y) in enumerate(zip(images, alone, strict=True)):
        assert torch.equal(x[keep] if i in rows else x, y), i
        if i in rows:
            assert not x[[1, 4, 7]].any(), i


def test_a_density_below_zero_counts_as_zero():
    scene, view = random_scene(42, 6, 1)
    scene[3][2] = -0.7
    got = ops.rasterize(*scene, view, geometry=True)
    scene[3][2] = 0.0
    assert_identical(list(fields(got).values()), list(fields(ops.rasterize(*scene, view, geometry=True)).values()))


@pytest.mark.parametrize("dtype,isa", BUILDS)
def test_a_zero_quaternion_is_no_rotation(dtype, isa):
    scene = [p.to(getattr(torch, dtype)) for p in octahedra([[0.1, 0.2, 3.0], [0, 0, 4.0]], [[1, 0.5, 0.7]] * 2, [0.8, 1.0])]
    view = camera()
    with kernels(isa):
        wanted = everything(scene, view)
        scene[1][1] = 0
        got = everything(scene, view)
    assert not got[11][1].any()  # no direction in which to turn
    wanted[11][1] = 0
    assert_identical(got, wanted)


@pytest.mark.parametrize("geometry", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_primitives(dtype, geometry):
    scene = [p.to(dtype) for p in hard("nothing", dtype)[0]]
    inputs, view = leaves(scene), camera(5, 3)
    out = ops.rasterize(*inputs, view, geometry=geometry)
    assert torch.equal(out.rgb, inputs[5].detach()[:, None, None].expand(3, 3, 5)) and not out.opacity.any()
    grads = torch.autograd.grad(out.rgb.sum(), inputs)
    assert [g.shape for g in grads] == [p.shape for p in scene] and grads[5].tolist() == [15.0] * 3


def test_stop_is_the_transmittance_before_a_primitive():
    # Three plates in a row of transmittance 1/2 each: the third is met with 1/4 left.
    scene = octahedra([[0, 0, 2.0 + i] for i in range(3)], [[50.0, 50.0, 0.25]] * 3, [2 * np.log(2)] * 3)
    view = camera(1, 1, cx=0.5, cy=0.5)
    for stop, left in ((0.0, 1 / 8), (0.2, 1 / 8), (0.26, 1 / 4), (0.51, 1 / 2)):
        out = ops.rasterize(*scene, view, geometry=True, stop=stop)
        assert 1 - out.opacity.item() == pytest.approx(left, rel=1e-12)
        assert int(out.pixels.sum()) == round(-np.log2(left))


def test_median_depth_follows_its_level():
    scene = octahedra([[0, 0, 5.0]], [[50.0, 50.0, 2.0]], [0.7])
    view = camera(1, 1, cx=0.5, cy=0.5)
    for level in (0.9, 0.5, 0.1):
        out = ops.rasterize(*scene, view, geometry=True, level=level)
        assert out.depth_median.item() == pytest.approx(3 - np.log(level) / 0.7, rel=1e-12)
    assert ops.rasterize(*scene, view, geometry=True, level=0.05).depth_median.item() == 0  # e^-2.8 is 0.06


# --- gradients ---


@pytest.mark.parametrize("geometry", [False, True])
@pytest.mark.parametrize("seed,coefficients,depth", [(51, 4, 3.0), (52, 1, 0.5), (53, 16, 2.5)])
def test_gradients_by_finite_differences(seed, coefficients, depth, geometry):
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
    torch.library.opcheck(torch.ops.linprim_geo.rasterize.default, operator_arguments(screen=False, requires_grad=False))


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
def test_weights_of_the_adjoint_are_those_of_the_forward_pass_bit_by_bit(dtype, isa):
    # One pixel at a time, no sum is rounded: the gradient to a primitive's coefficient of degree 0 is C0 times its weight, and
    # `max_weight` is that weight. It is 0 exactly where the forward pass did not hit.
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
def test_colour_does_not_depend_on_whether_geometry_is_asked_for(dtype, isa):
    scene, view = random_scene(63, 20, 9, 33, 20)
    scene = [p.to(getattr(torch, dtype)) for p in scene]
    with kernels(isa):
        images = [fields(ops.rasterize(*scene, view, geometry=g), COLOR) for g in (False, True)]
    # The two kernels may be contracted differently: each rounding counts once.
    for name in COLOR:
        torch.testing.assert_close(images[0][name], images[1][name], rtol=0, atol=200 * torch.finfo(images[0][name].dtype).eps)


def test_gradient_to_the_background_is_the_transmittance():
    scene, view = random_scene(64, 10, 4)
    inputs = leaves(scene)
    out = ops.rasterize(*inputs, view)
    weight = torch.rand(3, view.height, view.width, dtype=torch.float64)
    (grad,) = torch.autograd.grad((out.rgb * weight).sum(), inputs[5])
    torch.testing.assert_close(grad, ((1 - out.opacity.detach()) * weight).sum((1, 2)), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("samples", [1, 3])
def test_screen_gradient_is_that_of_moving_a_centre_by_a_pixel(samples):
    # Degree 0: the colour does not turn with the centre. The loss's own third derivative bounds the difference quotient.
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


def test_two_graphs_may_be_differentiated_in_any_order_and_twice():
    first, second = (random_scene(seed, 30, 4, 40, 30) for seed in (66, 67))
    alone = [everything(*first), everything(*second)]
    inputs = [leaves(first[0]), leaves(second[0])]
    out = [fields(ops.rasterize(*x, view, geometry=True)) for x, view in zip(inputs, (first[1], second[1]), strict=True)]
    for k in (0, 1, 1, 0):
        grads = gradients(out[k], inputs[k], cotangents(out[k]))
        assert_identical(grads, alone[k][10:16])


@pytest.mark.parametrize("geometry", [False, True])
@pytest.mark.parametrize("dtype,isa", BUILDS)
def test_gradients_do_not_depend_on_what_was_rendered_in_between(dtype, isa, geometry):
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


def test_a_list_is_taken_again_only_for_the_very_same_content():
    # Every pair of scenes differs in one value of one tensor, or in one number of the view.
    scene, view = random_scene(69, 12, 4, 20, 14)
    values = {k: getattr(view, k) for k in ("width", "height", "fx", "fy", "cx", "cy", "world_to_camera")}
    pose = view.world_to_camera.copy()
    pose[0, 3] += 0.1
    others = [({name: 1.3}, {}, {}) for name in NAMES]
    others += [({}, {"fx": view.fx * 1.1}, {}), ({}, {"cy": view.cy + 2}, {}), ({}, {"world_to_camera": pose}, {}), ({}, {}, {"near": 2.9})]
    wanted = everything(scene, view)[10:16]
    for factors, numbers, options in others:
        inputs = leaves(scene)
        images = fields(ops.rasterize(*inputs, view, geometry=True))
        changed = [p * factors.get(name, 1.0) for name, p in zip(NAMES, scene, strict=True)]
        ops.rasterize(*changed, Camera(**values | numbers), geometry=True, **options)
        ops.rasterize(*changed, Camera(**values | numbers), geometry=False, **options)
        assert_identical(gradients(images, inputs, cotangents(images)), wanted)


# --- statistics, samples ---


def test_statistics_count_what_was_hit():
    scene, view = random_scene(71, 20, 1, 40, 30)
    out = ops.rasterize(*scene, view, geometry=True)
    stats = ops.statistics()
    assert stats["primitives"] == 20 and stats["hit_lanes"] == int(out.pixels.sum())
    assert stats["visited_lanes"] >= stats["hit_lanes"] and int((out.pixels > 0).sum()) <= stats["visible"] <= 20
    assert (out.max_weight[out.pixels > 0] > 0).all() and not out.max_weight[out.pixels == 0].any()


def test_samples_average_a_magnified_image():
    scene, view = random_scene(72, 10, 4, 9, 7)
    fine = ops.rasterize(*scene, view.magnified(2))
    got = ops.rasterize(*scene, view, samples=2)
    for image, large in ((got.rgb, fine.rgb), (got.opacity[None], fine.opacity[None])):
        mean = large.reshape(large.shape[0], view.height, 2, view.width, 2).mean((2, 4))
        torch.testing.assert_close(image, mean, rtol=1e-13, atol=1e-13)
    with pytest.raises(ValueError, match="samples"):
        ops.rasterize(*scene, view, samples=2, geometry=True)
    with pytest.raises(ValueError, match="samples"):
        ops.rasterize(*scene, view, samples=0)


# --- the depth of a level, overlaps included ---


def overlap_depth(scene, view, near, level):
    """Where the summed thickness of a ray reaches ln(1 / level): the twin's intervals, cut at all their ends; 0 where never."""
    center, rotation, extent, density = (p.double() for p in scene[:4])
    pose = torch.from_numpy(view.world_to_camera)
    local = center @ pose[:3, :3].T + pose[:3, 3]
    turn = pose[:3, :3] @ reference.rotation_matrix(rotation)
    rays = reference.pixel_rays(view.width, view.height, view.fx, view.fy, view.cx, view.cy, center)
    spans = []
    for i in range(len(center)):
        start, end, *_ = reference.clip_to_octahedron(rays @ turn[i] / extent[i], -(local[i] @ turn[i]) / extent[i], near)
        spans.append(torch.where(end > start, torch.stack([start, end]), torch.zeros(())))
    spans = torch.stack(spans)  # (N, 2, pixels)
    out = torch.zeros(len(rays), dtype=torch.float64)
    for p, length in enumerate(rays.norm(dim=1)):
        starts, ends = spans[:, 0, p], spans[:, 1, p]
        cuts = spans[:, :, p].reshape(-1).sort().values
        thickness = (density * length * (torch.minimum(cuts[:, None], ends) - starts).clamp(min=0)).sum(1)
        k = int((thickness < -np.log(level)).sum())
        if 0 < k < len(cuts):
            share = (-np.log(level) - thickness[k - 1]) / (thickness[k] - thickness[k - 1])
            out[p] = cuts[k - 1] + share * (cuts[k] - cuts[k - 1])
    return out.reshape(view.height, view.width)


@pytest.mark.parametrize("seed,depth,near,level", [(91, 3.0, 0.01, 0.5), (92, 0.5, 0.2, 0.8), (93, 2.0, 0.01, 0.05)])
def test_level_depth_equals_the_sum_of_the_twins_intervals(seed, depth, near, level):
    scene, view = random_scene(seed, 25, 1, 21, 18, depth)
    for dtype, isa in BUILDS:
        inputs = [p.to(getattr(torch, dtype)) for p in scene]
        wanted = overlap_depth(inputs, view, near, level)
        assert (wanted > 0).sum() > 30
        with kernels(isa):
            got = ops.level_depth(*inputs[:5], view, level=level, near=near)[0].double()
            again = ops.level_depth(*[p.flip(0) for p in inputs[:5]], view, level=level, near=near)[0].double()
        # Thickness is good to 400 eps (above); the depth to that over density |v|, at least 0.1 in sum where little is behind.
        eps = torch.finfo(getattr(torch, dtype)).eps
        for image in (got, again):
            both = (image > 0) & (wanted > 0)
            assert int((~both & ((image > 0) | (wanted > 0))).sum()) <= 1  # a ray whose whole thickness is the level
            torch.testing.assert_close(image[both], wanted[both], rtol=0, atol=1000 * eps * 5)


@pytest.mark.parametrize("level", [0.0, 1.0, -0.5, float("nan")])
def test_impossible_levels_are_refused(level):
    scene, view = random_scene(94, 3, 1)
    with pytest.raises(ValueError, match="level"):
        ops.level_depth(*scene[:5], view, level=level)


@pytest.mark.parametrize("isa", KERNELS)
def test_level_depth_keeps_its_digits_before_a_far_background(isa):
    near = ([0.0, 0.0, 3.0], 2.0, 1.0)
    results = []
    for far in (None, 1e5):
        rows = [near] if far is None else [near, ([0.0, 0.0, far], far / 4, 10.0 / far)]
        center, extent, density = (torch.tensor(x) for x in zip(*rows, strict=True))
        turn = torch.tensor([[1.0, 0, 0, 0]] * len(rows))
        with kernels(isa):
            results.append(
                ops.level_depth(
                    center, turn, extent[:, None].repeat(1, 3), density, torch.zeros(len(rows), 1, 3), camera(8, 8), level=0.6
                )
            )
    (alone, alone_opacity), (before, opacity) = results
    hit = alone > 0
    assert hit.sum() > 8
    # The bracket reaches 40,000 times as far, and the depth keeps float32's digits: 4 roundings.
    torch.testing.assert_close(before[hit], alone[hit], rtol=4 * 1.2e-7, atol=0)
    assert (opacity >= alone_opacity).all() and (opacity > alone_opacity).any()


def test_no_primitives_have_no_level_depth():
    scene = hard("nothing", torch.float64)[0]
    assert not any(image.any() for image in ops.level_depth(*scene[:5], camera(5, 3), level=0.5))


# --- invariants ---


def test_a_rigid_motion_and_a_change_of_unit_change_nothing():
    scene, view = random_scene(73, 12, 1, 20, 15)
    wanted = ops.rasterize(*scene, view, geometry=True)
    rng = np.random.default_rng(1)
    motion = random_pose(rng, 3.0)  # x_new = R x + t
    center = scene[0].numpy() @ motion[:3, :3].T + motion[:3, 3]
    w, x, y, z = scene[1].T
    angle = np.arccos(np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1))
    skew = motion[:3, :3] - motion[:3, :3].T
    axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / (2 * np.sin(angle))
    a, (b, c, d) = np.cos(angle / 2), np.sin(angle / 2) * axis
    turned = torch.stack(
        [a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y, a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w], 1
    )
    pose = view.world_to_camera @ np.linalg.inv(motion)
    k = 37.0
    pose[:3, 3] *= k
    moved = [torch.from_numpy(center) * k, turned, scene[2] * k, scene[3] / k, scene[4], scene[5]]
    view2 = Camera(view.width, view.height, view.fx, view.fy, view.cx, view.cy, pose)
    got = ops.rasterize(*moved, view2, geometry=True, near=0.01 * k)
    for name, unit in zip(IMAGES, (1, 1, k, k, k, k * k, 1, 1), strict=True):
        torch.testing.assert_close(getattr(got, name), unit * getattr(wanted, name), rtol=1e-9, atol=1e-9 * unit)


def test_a_part_of_an_image_is_the_image_of_that_part():
    # Tiles, blocks and bounds fall elsewhere; the rays are the same.
    scene, view = random_scene(74, 40, 4, 50, 41)
    whole = ops.rasterize(*scene, view, geometry=True)
    for left, top, width, height in ((0, 0, 3, 2), (7, 5, 30, 21), (33, 16, 17, 25)):
        part = Camera(width, height, view.fx, view.fy, view.cx - left, view.cy - top, view.world_to_camera)
        out = ops.rasterize(*scene, part, geometry=True)
        for name in IMAGES:
            crop = getattr(whole, name)[..., top : top + height, left : left + width]
            torch.testing.assert_close(getattr(out, name), crop, rtol=1e-10, atol=1e-10)


# --- nothing but finite numbers ---


def assert_finite_everywhere(scene, view, options):
    """All outputs and gradients are finite and the opacity is a share; returns whether anything was hit."""
    inputs = leaves(scene)
    screen = torch.zeros(len(inputs[0]), 3, dtype=inputs[0].dtype, requires_grad=True)
    out = ops.rasterize(*inputs, view, geometry=True, screen=screen, **options)
    images = fields(out)
    total = sum((image * torch.linspace(-1, 1, image.numel(), dtype=image.dtype).view_as(image)).sum() for image in images.values())
    grads = torch.autograd.grad(total, [*inputs, screen])
    assert all(bool(x.isfinite().all()) for x in (*images.values(), out.max_weight, *grads))
    # 1 - T with 0 <= T <= 1, and weights T alpha with alpha <= 1 to a rounding.
    assert 0 <= out.opacity.min() and out.opacity.max() <= 1 and out.max_weight.max() <= 1 + 4 * torch.finfo(inputs[0].dtype).eps
    return bool((out.pixels > 0).any())


def test_hard_scenes_give_finite_numbers_only():
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
def test_a_thickness_beyond_float_gives_finite_numbers(isa):
    scene = [p.float() for p in octahedra([[0.01, 0.02, 3.0]], [[1.0, 1.0, 1.0]], [3e38])]
    with kernels(isa):
        out = ops.rasterize(*scene, camera(), geometry=True)
    assert all(bool(image.isfinite().all()) for image in fields(out).values())


@pytest.mark.parametrize("isa", KERNELS)
def test_a_denormal_axis_gives_finite_gradients(isa):
    scene = [p.float() for p in octahedra([[0.0, 0.0, 0.0]], [[0.0255, 0.281, 2.55e-41]], [1.0], [(-0.186, -1.351, 2.53, -0.4255)])]
    inputs = leaves(scene)
    with kernels(isa):
        out = ops.rasterize(*inputs, Camera(50, 1, 3014.0, 3652.0, 25.0, 0.5, np.eye(4)), near=0.0185)
        for extent in (1.0, 2.0):
            ops.rasterize(*[p.float() for p in octahedra([[0, 0, 3.0]], [[extent] * 3], [1.0])], camera())
        grads = torch.autograd.grad(out.rgb.sum(), inputs)
    assert all(bool(g.isfinite().all()) for g in grads)


# --- the interface ---


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", NAMES)
def test_an_input_that_is_not_finite_is_named_with_its_row(name, bad):
    scene, view = random_scene(81, 5, 4)
    tensor = scene[NAMES.index(name)]
    row = 2
    tensor.view(len(tensor), -1)[row, 0] = bad
    with pytest.raises(LinprimError, match=f"{name}: row {row} "):
        ops.rasterize(*scene, view)


@pytest.mark.parametrize("name", NAMES)
def test_a_wrong_shape_is_named(name):
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
    for options, name in (({"near": 0.0}, "near"), ({"near": -1.0}, "near"), ({"stop": -1.0}, "stop"), ({"stop": 1.0}, "stop")):
        with pytest.raises(ValueError, match=name):
            ops.rasterize(*scene, view, **options)


@pytest.mark.parametrize("change", [{"cx": float("nan")}, {"world_to_camera": np.full((4, 4), np.nan)}, {"fx": float("inf")}])
def test_cameras_that_are_not_finite_are_refused(change):
    scene, view = random_scene(86, 5, 4)
    values = {k: getattr(view, k) for k in ("width", "height", "fx", "fy", "cx", "cy", "world_to_camera")}
    with pytest.raises((LinprimError, ValueError)):
        ops.rasterize(*scene, Camera(**values | change))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_inputs_of_any_layout_give_the_same_and_stay_as_they_are(dtype):
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


def test_gradients_that_are_not_contiguous_are_read_right():
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

