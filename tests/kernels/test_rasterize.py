"""The compiled rasterizer, compared with the float64 reference on ordinary and hard scenes."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
import torch
from helpers.octahedra import (
    BUILDS,
    IMAGES,
    KERNELS,
    NAMES,
    assert_identical,
    camera,
    cotangents,
    everything,
    fields,
    gradients,
    kernels,
    leaves,
    octahedra,
    random_scene,
    twin,
)

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import ops

pytestmark = pytest.mark.usefixtures("few_threads")


# --- the twin ---
#
# Tolerances, in units of eps = 2^-52 or 2^-23, derived once for all comparisons below. A face's inverse depth is a + b
# dx + c dy; each term and their sums are rounded: the face is off by about 4 eps of the tile's 16 pixels where it is
# steep, by 4 eps t of depth t where it is seen square on. The thickness of a slice is thus off by d_tau = 4 eps density
# (|v| t + 16 |d chord / d pixel|) and colour, opacity and normal, being sums of weights of sum at most 1, by no more
# than the sum of w d_tau / tau, as a thick slice does not pass its error on. With t = 5 and chords of half a unit that
# vary over a pixel or two, this is 40 to 400 eps; depths are that good relative to their own range, the distortion to
# depth squared. Gradients start from sums that cancel a digit: ten times more. In double the mean depth inside a thin
# slice adds the first terms that its series leaves out, at tau = 0.3: tau^7 / 1209600 and, for the derivative, tau^6 /
# 172800.
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
    """The ranges to which errors of images are relative."""
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
def test_ordinary_scenes_agree_with_the_reference(case, dtype):
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
# name: centres, half-axes, densities, rotations, options of rasterize, camera, and by how much the tolerances of value
# and gradient are larger than above: t over the thickness of plates and needles, 1e3, of which the twin itself loses as
# much; the distance in pixels of the tile from the reference; and behind something opaque the rest of a ray is a
# difference good to 4 eps, which the density multiplies.
HARD = {
    "camera inside": ([[0.1, 0.05, 0.2]], [[1.0, 0.9, 1.1]], [0.7], [TURNED], {}, {}, 1, 1),
    "camera inside several": (
        [[0.1, 0, 0.2], [0, 0.2, -0.1], [0.3, 0, 0.4]],
        [[1, 0.9, 1.1]] * 3,
        [0.7, 0.2, 1.5],
        None,
        {},
        {},
        1,
        1,
    ),
    "near plane crossed": ([[0.1, 0.2, 1.0]], [[0.8, 0.7, 0.9]], [1.5], [TURNED], {"near": 0.9}, {}, 1, 1),
    "centre behind, body in front": (
        [[0.2, 0.1, -1.0]],
        [[2.0, 1.5, 4.0]],
        [0.6],
        [(1.0, 0.05, 0.1, 0.0)],
        {},
        {},
        1,
        1,
    ),
    "behind entirely": ([[0.0, 0.1, -3.0]], [[1.0, 1.0, 1.0]], [1.0], [TURNED], {}, {}, 1, 1),
    "behind the near plane": ([[0.0, 0.1, 0.5]], [[0.3, 0.3, 0.3]], [1.0], [TURNED], {"near": 1.0}, {}, 1, 1),
    "off screen": ([[9.0, 0.1, 3.0]], [[1.0, 1.0, 1.0]], [1.0], [TURNED], {}, {}, 1, 1),
    "between the planes of a slab": ([[0.05, 0.02, 5.0]], [[0.3, 0.25, 4.9]], [2.0], None, {}, {}, 1, 1),
    "long towards the camera, turned": (
        [[0.3, 0.1, 4.0]],
        [[0.5, 0.2, 3.2]],
        [2.0],
        [(1.0, 0.03, -0.05, 0.2)],
        {},
        {},
        1,
        1,
    ),
    "needle": (
        [[0.1, 0.05, 3.0]],
        [[2.0, 1.2e-3, 0.9e-3]],
        [500.0],
        [TURNED],
        {},
        {"width": 30, "height": 30, "focal": 600.0},
        20,
        10,
    ),
    "plate seen edge-on": (
        [[0.0, 0.4, 3.0]],
        [[1.4, 2e-3, 1.2]],
        [40.0],
        [(1.0, -0.0585, 0.0, 0.0)],
        {},
        {"focal": 200.0, "cy": -17.2},
        5,
        10,
    ),
    "plate seen square on": (
        [[0.1, 0.05, 3.0]],
        [[1.3, 1.2, 1e-3]],
        [700.0],
        [(1.0, 0.02, 0.05, 0.3)],
        {},
        {},
        30,
        100,
    ),
    "below a pixel": ([[0.10, 0.06, 4.0]], [[0.02, 0.03, 0.02]], [30.0], None, {}, {"cx": 8.05, "cy": 6.2}, 4, 20),
    "covers the image a thousand times": (
        [[30.0, 10.0, 700.0]],
        [[600.0, 500.0, 690.0]],
        [3e-3],
        [(1.0, 0.02, 0.03, 0.1)],
        {},
        {},
        1,
        1,
    ),
    "thickness from 1e-9 to 1e4": (
        [[0, 0, 2.0], [0.1, 0, 4.0], [0, 0.1, 7.0]],
        [[1, 0.9, 0.8]] * 3,
        [1e-9, 0.3, 1e4],
        None,
        {},
        {},
        1,
        500,
    ),
    "opaque behind opaque": (
        [[0, 0, 2.0], [0.1, 0, 4.0]],
        [[1, 0.9, 0.8]] * 2,
        [300.0, 300.0],
        None,
        {"stop": 0.0},
        {},
        1,
        1,
    ),
    "no density": ([[0, 0, 2.0], [0.1, 0, 4.0]], [[1, 0.9, 0.8]] * 2, [0.0, 0.0], [TURNED] * 2, {}, {}, 1, 1),
    "coincident": ([[0.1, 0, 3.0]] * 5, [[1, 0.9, 0.8]] * 5, [0.2, 0.5, 1.0, 0.1, 0.3], [TURNED] * 5, {}, {}, 1, 1),
    "quaternions of any length": (
        [[0.1, 0, 3.0]] * 3,
        [[1, 0.5, 0.8]] * 3,
        [0.5] * 3,
        [[x * s for x in TURNED] for s in (1e-6, 3.0, 1e6)],
        {},
        {},
        1,
        1,
    ),
    "nothing": ([], [], [], None, {}, {}, 1, 1),
}


def hard(name, dtype):
    """A named hard case; none of its rays is within rounding of a vertex, edge or face plane."""
    center, extent, density, rotation, options, view, *_ = HARD[name]
    parameters = octahedra(center, extent, density, rotation)
    if not center:
        parameters = [
            p.reshape(0, *shape) for p, shape in zip(parameters, ((3,), (4,), (3,), (), (1, 3)), strict=False)
        ] + parameters[5:]
    return parameters, camera(**view), options, dtype


@pytest.mark.parametrize("name", HARD)
def test_hard_cases_agree_with_the_reference(name):
    value, gradient = HARD[name][-2:]
    for dtype, isa in BUILDS:
        images = assert_like_twin(
            hard, name, getattr(torch, dtype), isa=isa, value=value * VALUE, gradient=gradient * GRADIENT
        )
    hidden = name in ("behind entirely", "behind the near plane", "off screen", "nothing")
    assert bool((images["pixels"] > 0).any()) != hidden


@pytest.mark.parametrize("dtype,isa", BUILDS)
def test_accuracy_with_a_principal_point_far_outside_the_image(dtype, isa):
    # 320 pixels from the reference to the tile, not 16.
    images = assert_like_twin(far_off_center, getattr(torch, dtype), isa=isa, value=20 * VALUE, gradient=20 * GRADIENT)
    assert images["opacity"].max() > 0.3


def test_accuracy_a_million_units_from_the_origin():
    # Both subtract the same 1e6 from sums of three products: each loses up to 3e6 eps of position, and half-axes are a
    # tenth.
    images = assert_like_twin(far_away, torch.float64, value=6e7, gradient=6e8)
    assert (images["opacity"] > 0.3).any()


@pytest.mark.parametrize("gap", [1e-12, 1e-9, -1e-9, 1e-7])
def test_edge_on_faces_move_by_two_parts_in_a_million(gap):
    # sum(|m|) = 1 + gap: the camera is that near to the plane of a face, whose distance is kept above 2e-6 of the
    # primitive. The face therefore moves by 2e-6 of its distance from the centre, 0.5 here, and the thickness by
    # density |v| as much.
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


def test_primitives_are_ordered_by_centre_and_ties_by_index():
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
def test_primitives_with_non_positive_half_axes_are_not_drawn(dtype, isa):
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
    scene = [
        p.to(getattr(torch, dtype)) for p in octahedra([[0.1, 0.2, 3.0], [0, 0, 4.0]], [[1, 0.5, 0.7]] * 2, [0.8, 1.0])
    ]
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
def test_no_primitives_give_the_background(dtype, geometry):
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
