"""Orders, affine rays and screen filter of the reference: closed forms and invariances."""

from __future__ import annotations

import itertools
import math

import mpmath
import numpy as np
import pytest
import torch
from helpers.reference_ladder import MODELS, ORDERS, POLYHEDRA, pixel_of, scene
from helpers.reference_scenes import EXACT, IMAGES, assert_same, axis_camera, gray, octahedra, tensor

from linprim_geo.kernels.reference import blend as reference_blend
from linprim_geo.kernels.reference.rasterize import rasterize

pytestmark = pytest.mark.usefixtures("one_thread")


# --- orders ---


@pytest.mark.parametrize("primitive,model", list(itertools.product(POLYHEDRA, MODELS)))
def test_orders_agree_without_overlap(primitive, model):
    parameters, camera = scene(primitive, 61, 6, width=9, height=8)
    turn, shift = camera["world_to_camera"][:3, :3], camera["world_to_camera"][:3, 3]
    spaced = 0.3 * torch.randn(6, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    spaced[:, 2] = 3.0 + 3.2 * torch.arange(6)  # extents are below 1.5
    parameters[0] = (spaced - shift) @ turn
    parameters[2], parameters[3] = 0.8 * parameters[2] + 0.2, 0.4 * parameters[3]
    a, b, c = (rasterize(*parameters, **camera, primitive=primitive, ray_model=model, order=order) for order in ORDERS)
    assert (a["pixels"] > 0).sum() >= 5 and (a["depth_median"] > 0).any()
    assert_same(a, b, rtol=0, atol=0)
    # Only the distortion of overlap counts the spread inside a primitive.
    assert_same(a, c, [name for name in a if name != "distortion"], rtol=1e-10, atol=1e-12)
    assert (c["distortion"] >= a["distortion"] - 1e-13).all() and (c["distortion"] > a["distortion"] + 1e-4).any()


def nested(order, **more):
    """On the axis a large primitive fills 2 to 8, and a small one with nearer centre 3.5 to 4.5."""
    parameters = octahedra(
        [[0, 0, 5], [0, 0, 4]], [[1, 1, 3], [1, 1, 0.5]], [0.2, 0.9], color=[0.3, 0.9], background=(0.5,) * 3
    )
    result = rasterize(*parameters, **axis_camera(1, 1), order=order, **more)
    return pixel_of(result, 0, 0) | {name: result[name] for name in ("max_weight", "pixels")}


@pytest.mark.parametrize("model", MODELS)
def test_nested_primitives_agree_with_closed_forms_in_all_orders(model):
    big, small = -math.expm1(-1.2), -math.expm1(-0.9)
    end = math.exp(-2.1)
    by_center, by_entry, overlap = (nested(order, ray_model=model) for order in ORDERS)
    want = 0.9 * small + 0.3 * (1 - small) * big + 0.5 * end
    assert by_center["rgb"][0].item() == pytest.approx(want, rel=1e-13)
    assert by_center["depth_first"].item() == pytest.approx(3.5, rel=1e-14)
    want = 0.3 * big + 0.9 * (1 - big) * small + 0.5 * end
    assert by_entry["rgb"][0].item() == pytest.approx(want, rel=1e-13)
    assert by_entry["depth_first"].item() == pytest.approx(2, rel=1e-14)
    # 2 to 3.5 at 0.2, 3.5 to 4.5 at 1.1, 4.5 to 8 at 0.2
    parts = [-math.expm1(-0.3), math.exp(-0.3) * -math.expm1(-1.1), math.exp(-1.4) * -math.expm1(-0.7)]
    assert overlap["max_weight"].tolist() == pytest.approx(
        [parts[0] + parts[1] * 0.2 / 1.1 + parts[2], parts[1] * 0.9 / 1.1], rel=1e-13
    )
    assert overlap["rgb"][0].item() == pytest.approx(
        0.3 * overlap["max_weight"][0].item() + 0.9 * overlap["max_weight"][1].item() + 0.5 * end, rel=1e-13
    )
    assert overlap["opacity"].item() == pytest.approx(1 - end, rel=1e-13)
    assert overlap["depth_first"].item() == pytest.approx(2, rel=1e-14)
    assert overlap["depth_median"].item() == pytest.approx(3.5 + (math.log(2) - 0.3) / 1.1, rel=1e-13)
    means = [
        a + 1 / rate - (b - a) / math.expm1(rate * (b - a))
        for a, b, rate in ((2, 3.5, 0.2), (3.5, 4.5, 1.1), (4.5, 8, 0.2))
    ]
    assert overlap["depth_expected"].item() == pytest.approx(np.dot(parts, means), rel=1e-12)


def test_overlap_ends_at_the_first_event_below_stop():
    # 4 to 6 and 5 to 9, each with a rate of 1; T at the events 4, 5, 6, 9 is 1, e^-1, e^-3, e^-6.
    parameters = octahedra([[0, 0, 5], [0, 0, 7]], [[1, 1, 1], [1, 1, 2]], [1.0, 1.0])
    for stop, thickness, pixels in (
        (0.0, 6, [1, 1]),
        (math.exp(-3.01), 6, [1, 1]),
        (math.exp(-2.99), 3, [1, 1]),  # below it at 5.99, but a segment is not cut
        (math.exp(-1.01), 3, [1, 1]),
        (math.exp(-0.99), 1, [1, 0]),  # the second begins where the ray ends
        (1.0, 1, [1, 0]),
    ):
        result = rasterize(*parameters, **axis_camera(1, 1), order="overlap", stop=stop, level=math.exp(-1.6))
        assert (result["depth_median"] > 0).item() == (thickness > 1)  # not where the ray has ended
        assert result["opacity"].item() == pytest.approx(-math.expm1(-thickness), rel=1e-13)
        assert result["pixels"].tolist() == pixels
        assert (result["max_weight"] > 0).tolist() == [bool(n) for n in pixels]


def test_distortion_of_one_primitive_agrees_with_the_closed_form():
    # Thin: uniform over the chord, so A^2 L^2 / 12. Thick: exponential, so 1 / density^2.
    for extent, density, want in ((0.7, 1e-5, (1.4e-5 * 1.4) ** 2 / 12), (3.0, 20.0, 1 / 400)):
        parameters = octahedra([[0, 0, 5]], [[1, 1, extent]], [density])
        value = rasterize(*parameters, **axis_camera(1, 1), order="overlap")["distortion"].item()
        assert value == pytest.approx(want, rel=2e-5)


@pytest.mark.parametrize("primitive,model", list(itertools.product(POLYHEDRA, MODELS)))
def test_coincident_copies_share_the_density_under_overlap(primitive, model):
    parameters, camera = scene(primitive, 62, 4, width=9, height=8)
    options = dict(primitive=primitive, ray_model=model, order="overlap", screen_filter=0.4)
    before = rasterize(*parameters, **camera, **options)
    copies = [p.repeat(3, *[1] * (p.ndim - 1)).requires_grad_() for p in parameters[:5]]
    split = [*copies[:3], copies[3] / 3, copies[4], parameters[5]]
    after = rasterize(*split, **camera, **options)
    assert_same(before, after, IMAGES, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(after["max_weight"], before["max_weight"].repeat(3) / 3, **EXACT)
    assert (after["pixels"] == before["pixels"].repeat(3)).all() and (before["pixels"] > 0).all()
    # Ends that coincide are no kink of a picture: no copy is worth more than another.
    weights = torch.rand(3, 8, 9, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    for grad in torch.autograd.grad((after["rgb"] * weights).sum(), copies):
        torch.testing.assert_close(grad[:4], grad[4:8], rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(grad[:4], grad[8:], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("order", ["entry", "overlap"])
def test_images_do_not_depend_on_the_order_of_primitives(order):
    parameters, camera = scene("tetrahedron", 63, 8, width=9, height=8, stop=0.2)
    shuffle = torch.tensor([3, 1, 7, 0, 5, 2, 6, 4])
    before = rasterize(*parameters, **camera, primitive="tetrahedron", order=order)
    after = rasterize(
        *[p[shuffle] for p in parameters[:5]], parameters[5], **camera, primitive="tetrahedron", order=order
    )
    assert_same(before, after, IMAGES)
    assert (after["pixels"] == before["pixels"][shuffle]).all()


def test_ties_of_entry_are_ordered_by_index():
    # Both are cut by the near plane, so both begin at it; the centres say the opposite.
    parameters = octahedra(
        [[0, 0, 0.4], [0, 0, 0.3], [0, 0, 3]], [[1, 1, 1]] * 3, [0.5, 0.7, 0.3], color=[0.1, 0.5, 0.9]
    )
    pixel = rasterize(*parameters, **axis_camera(1, 1, near=0.1), order="entry")["rgb"][0, 0, 0].item()
    a, b, c = math.exp(-0.5 * 1.3), math.exp(-0.7 * 1.2), math.exp(-0.6)
    assert pixel == pytest.approx(0.1 * (1 - a) + 0.5 * a * (1 - b) + 0.9 * a * b * (1 - c), rel=1e-13)


@pytest.mark.parametrize("block", [1, 200])
def test_images_do_not_depend_on_blocks_of_rays(block, monkeypatch):
    parameters, camera = scene("octahedron", 64, 10, width=9, height=8)
    whole = rasterize(*parameters, **camera, order="overlap")
    monkeypatch.setattr(reference_blend, "BLOCK", block)
    assert_same(whole, rasterize(*parameters, **camera, order="overlap"), rtol=1e-13, atol=1e-14)


def test_depth_variance_and_mean_transmittance_agree_with_mpmath():
    with mpmath.workdps(60):
        for tau in (1e-9, 1e-3, 0.1, 0.2499, 0.25, 0.3, 1.0, 5.0, 40.0, 1e3):
            x = mpmath.mpf(tau)
            variance = float(1 / x**2 - mpmath.exp(-x) / mpmath.expm1(-x) ** 2)
            assert reference_blend.depth_variance_fraction(tensor(tau)).item() == pytest.approx(variance, rel=4.5e-14)
            mean = float(-mpmath.expm1(-x) / x)
            assert reference_blend.mean_transmittance(tensor(tau)).item() == pytest.approx(mean, rel=2e-15)
    assert reference_blend.depth_variance_fraction(tensor(0.0)).item() == pytest.approx(1 / 12, rel=1e-15)
    assert reference_blend.mean_transmittance(tensor(0.0)).item() == 1
    tau = torch.logspace(-8, 2, 41, dtype=torch.float64).requires_grad_()
    for f in (reference_blend.depth_variance_fraction, reference_blend.mean_transmittance):
        assert torch.autograd.gradcheck(f, tau, eps=1e-9, atol=1e-6)


# --- affine rays ---


@pytest.mark.parametrize("primitive", POLYHEDRA)
def test_error_of_affine_rays_is_quadratic_in_size(primitive):
    g = torch.Generator().manual_seed(7)
    center = tensor([[0.9, -0.6, 2.0]])
    rotation = torch.randn(1, 4, generator=g, dtype=torch.float64)
    extent = 0.4 + torch.rand(1, 4 if primitive == "tetrahedron" else 3, generator=g, dtype=torch.float64)
    errors = []
    for size in (0.04, 0.02, 0.01, 0.005):
        # The same picture at every size; thickness, and depth less the centre's, shrink with it.
        focal = 8.0 / size
        camera = axis_camera(15, 15, focal) | dict(cx=7.5 - focal * 0.45, cy=7.5 + focal * 0.3)
        parameters = [center, rotation, size * extent, tensor([1.0]), tensor([gray(1.0)]), tensor([0.0] * 3)]
        exact, affine = (rasterize(*parameters, **camera, primitive=primitive, ray_model=m) for m in MODELS)
        both = (exact["opacity"] > 0) & (affine["opacity"] > 0)
        assert both.sum() > 20
        errors.append(
            [
                (torch.log1p(-exact["opacity"]) - torch.log1p(-affine["opacity"])).abs().max().item(),
                (exact["depth_first"] - affine["depth_first"])[both].abs().max().item(),
            ]
        )
    errors = np.array(errors)
    assert (errors > 1e-7).all()
    order = np.log2(errors[:-1] / errors[1:])
    assert (abs(order[-1] - 2) < 0.15).all(), order


def test_affine_rays_use_the_near_plane_for_centres_only():
    parameters = octahedra([[0, 0, 0.5]], [[1, 1, 1]], [0.8])
    inside = pixel_of(rasterize(*parameters, **axis_camera(near=0.4), ray_model="affine"), 4, 4)
    assert inside["opacity"].item() == pytest.approx(-math.expm1(-1.6), rel=1e-14)
    assert inside["depth_first"].item() == pytest.approx(-0.5, rel=1e-14)
    for near in (0.5, 0.6):
        leaves = [p.clone().requires_grad_() for p in parameters]
        result = rasterize(*leaves, **axis_camera(near=near), ray_model="affine")
        assert result["opacity"].max() == 0 and result["pixels"].item() == 0
        assert torch.autograd.grad(result["rgb"].sum(), leaves[5])[0].tolist() == [81.0] * 3


# --- screen filter ---


def total_thickness(parameters, camera, **options):
    return -torch.log1p(-rasterize(*parameters, **camera, stop=0.0, **options)["opacity"]).sum().item()


@pytest.mark.parametrize("primitive,model", list(itertools.product(POLYHEDRA, MODELS)))
def test_screen_filter_keeps_the_total_thickness(primitive, model):
    # Small, so that |v| hardly changes over it: exact thickness carries the |v| of the true pixel.
    extent = [0.003, 0.004, 0.002] if primitive == "octahedron" else [0.003, 0.004, 0.002, 0.005]
    parameters = [
        tensor(x) for x in ([[0.1, 0.2, 2.0]], [[0.9, 0.2, -0.4, 0.1]], [extent], [3.0], [gray(1.0)], [0.0] * 3)
    ]
    focal = 4e4
    camera = axis_camera(300, 300, focal) | dict(cx=150.2 - focal * 0.05, cy=149.7 - focal * 0.1)
    plain = total_thickness(parameters, camera, primitive=primitive, ray_model=model)
    filtered = total_thickness(parameters, camera, primitive=primitive, ray_model=model, screen_filter=90.0)
    options = dict(primitive=primitive, ray_model=model)
    wide, narrow = (
        [
            np.ptp(np.nonzero(rasterize(*parameters, **camera, **options, screen_filter=k)["opacity"].numpy())[axis])
            for axis in (0, 1)
        ]
        for k in (90.0, 0.0)
    )
    # Riemann sums of continuous functions over 5e3 pixels or more.
    assert filtered == pytest.approx(plain, rel=2e-3)
    for a, b in zip(wide, narrow, strict=True):
        assert a - b == pytest.approx(90, abs=2)  # pixels at either end; the corners are sharp
        assert b > 60


def test_screen_filter_on_the_axis_agrees_with_the_closed_form():
    parameters = octahedra([[0, 0, 5]], [[1.0, 0.5, 0.7]], [0.9])
    k = 0.8
    for model in MODELS:
        pixel = pixel_of(rasterize(*parameters, **axis_camera(), ray_model=model, screen_filter=k), 4, 4)
        sx, sy = (
            8 * 1.0 / 5,
            8 * 0.5 / 5,
        )  # half width and height in px; the near and far vertex are on the axis
        sx, sy = sx / (sx + k / 2), sy / (sy + k / 2)
        assert pixel["opacity"].item() == pytest.approx(-math.expm1(-0.9 * sx * sy * 1.4), rel=1e-13)
        assert pixel["depth_first"].item() == pytest.approx(4.3, rel=1e-14)
        # Off the axis: as a lens of focal lengths f / s sees it.
        camera = axis_camera()
        wide = rasterize(*parameters, **camera | dict(fx=8 / sx, fy=8 / sy), ray_model="exact")
        narrow = rasterize(*parameters, **camera, ray_model="exact", screen_filter=k)
        assert (wide["depth_first"] > 0).sum() >= 5
        torch.testing.assert_close(narrow["depth_first"], wide["depth_first"], **EXACT)


def test_screen_filter_skips_primitives_across_the_near_plane():
    parameters = octahedra([[0.1, 0, 1.0]], [[0.5, 0.5, 0.8]], [0.9])
    for near, same in ((0.21, True), (0.19, False)):
        a, b = (rasterize(*parameters, **axis_camera(near=near), screen_filter=k) for k in (0.0, 3.0))
        assert torch.equal(a["opacity"], b["opacity"]) == same
