"""The rasterizer's primitives, ray models, orders and screen filter against the float64 twin, value and gradient."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from helpers.octahedra import IMAGES, KERNELS, camera, fields, kernels, octahedra, random_scene, twin

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import ops

# What the core has: an order other than the centres' needs an entry, which a Gaussian has not.
VARIANTS = [
    *itertools.product(("octahedron", "tetrahedron"), ("exact", "affine"), ("center", "entry", "overlap")),
    ("gaussian", "affine", "center"),
]
NAMES = ["-".join(variant) for variant in VARIANTS]


def scene_of(
    seed: int,
    variant: tuple[str, str, str],
    count: int = 14,
    coefficients: int = 4,
    size=(19, 14),
    dtype=torch.float64,
):
    """Tensors that require gradients, the camera, and the keywords of the variant."""
    primitive, ray_model, order = variant
    parameters, view = random_scene(seed, count, coefficients, *size)
    rng = np.random.default_rng(seed)
    if primitive == "tetrahedron":
        parameters[2] = torch.from_numpy(rng.uniform(0.15, 0.6, (count, 4)))
    if primitive == "gaussian":
        parameters[2] = parameters[2] * 0.5
        parameters[3] = torch.from_numpy(rng.uniform(0.05, 1.0, count))
    leaves = [p.to(dtype).requires_grad_() for p in parameters]
    # Where a ray stops inside an overlap, the twin's gradient knows which of the boundaries it stopped at, the core's
    # does not.
    return (
        leaves,
        view,
        dict(primitive=primitive, ray_model=ray_model, order=order, stop=0.0 if order == "overlap" else 1e-3),
    )


def weighted(images, names):
    """The sum of the named images with fixed random weights."""
    generator = torch.Generator().manual_seed(3)
    weights = [torch.rand(images[name].shape, generator=generator, dtype=torch.float64) - 0.3 for name in names]
    return sum((images[name].double() * weight).sum() for name, weight in zip(names, weights, strict=True))


def gradients(loss, inputs, **how):
    grads = torch.autograd.grad(loss, inputs, allow_unused=True, **how)
    return [torch.zeros_like(p) if g is None else g for p, g in zip(inputs, grads, strict=True)]


def by_core(leaves, view, options, geometry=True):
    """Images of the core, and gradients of their weighted sum."""
    inputs = [p.detach().requires_grad_() for p in leaves]
    names = IMAGES if geometry else IMAGES[:2]
    images = fields(ops.rasterize(*inputs, view, geometry=geometry, **options), names)
    return images, gradients(weighted(images, names), inputs)


def by_twin(leaves, view, options, geometry=(True,)):
    """{geometry: what `by_core` gives} of the twin in double precision, all from one of its images, which are the same
    with and without geometry."""
    inputs = [p.detach().double().requires_grad_() for p in leaves]
    images = twin(inputs, view, geometry=any(geometry), **options)
    found = {}
    for each in geometry:
        names = IMAGES if each else IMAGES[:2]
        grads = gradients(weighted(images, names), inputs, retain_graph=True)
        found[each] = {name: images[name].detach() for name in names}, grads
    return found


@cache
def twin_of(seed, variant, screen_filter):
    """`by_twin` of a scene, for the tests with geometry and those without."""
    leaves, view, options = scene_of(seed, variant)
    return by_twin(leaves, view, options | {"screen_filter": screen_filter}, (True, False))


@cache
def rounded_twin_of(seed, variant):
    """`by_twin` of a scene in single precision, for all instruction sets."""
    return by_twin(*scene_of(seed, variant, dtype=torch.float32), (False,))


def assert_alike(leaves, view, options, geometry, value: float, gradient: float, twin=None):
    """The core equals the twin, or `twin`, which is what `by_twin` gave."""
    shown, grads = by_core(leaves, view, options, geometry)
    wanted, wanted_grads = (twin or by_twin(leaves, view, options, (geometry,)))[geometry]
    for name, image in wanted.items():
        scale = max(float(image.detach().abs().max()), 1e-3)
        off = float((shown[name].detach().double() - image).abs().max())
        assert off <= value * scale, f"{name} is off by {off / scale:.1e} of its range"
    for index, (found, truth) in enumerate(zip(grads, wanted_grads, strict=True)):
        off, scale = float((found.double() - truth).abs().max()), max(float(truth.abs().max()), 1e-6)
        assert off <= gradient * scale, f"gradient {index} is off by {off / scale:.1e} of its largest"


@pytest.mark.parametrize("variant", VARIANTS, ids=NAMES)
@pytest.mark.parametrize("geometry", [False, True], ids=["colour", "geometry"])
@pytest.mark.parametrize("screen_filter", [0.0, 0.7], ids=["plain", "filtered"])
def test_double_precision_agrees_with_the_reference(variant, geometry, screen_filter):
    for seed in range(4):
        leaves, view, options = scene_of(100 + seed, variant)
        twin = twin_of(100 + seed, variant, screen_filter)
        assert_alike(leaves, view, options | {"screen_filter": screen_filter}, geometry, 1e-9, 1e-7, twin)


@pytest.mark.parametrize("variant", VARIANTS, ids=NAMES)
@pytest.mark.parametrize("isa", KERNELS)
def test_single_precision_is_near_the_reference(variant, isa):
    with kernels(isa):
        for seed in range(2):
            leaves, view, options = scene_of(200 + seed, variant, dtype=torch.float32)
            assert_alike(leaves, view, options, False, 1e-4, 2e-3, rounded_twin_of(200 + seed, variant))


@pytest.mark.parametrize("variant", VARIANTS, ids=NAMES)
def test_largest_weights_and_pixel_counts_agree_with_the_reference(variant):
    """Images have several tiles and incomplete blocks, and some rays stop early."""
    most, stop = 0.0, 0.05
    for seed in range(2):
        leaves, view, options = scene_of(300 + seed, variant, size=(37, 29))
        tensors = [p.detach() for p in leaves]
        wanted = twin(tensors, view, **options | {"stop": stop})
        out = ops.rasterize(*tensors, view, geometry=True, **options | {"stop": stop})
        assert torch.equal(out.pixels.long(), wanted["pixels"])
        torch.testing.assert_close(out.max_weight, wanted["max_weight"], rtol=0, atol=1e-12)
        most = max(most, float(wanted["opacity"].max()))
    assert most > 1 - stop  # some rays do stop


def beside_the_view(primitive: str, count: int, least: float, size: float):
    """Primitives before the camera, `least` to 3 times `least` halves of the image from its middle, of `size` times
    their distance."""
    rng = np.random.default_rng(1)
    view = camera(21, 17, 12.0)
    z = rng.uniform(0.05, 1.5, count)
    half = np.array([view.width / 2 / view.fx, view.height / 2 / view.fy])
    slope = rng.uniform(-1, 1, (count, 2)) * least
    sides = np.arange(count)
    slope[sides, sides % 2] = rng.uniform(least, 3 * least, count) * rng.choice([-1, 1], count)
    center = np.concatenate([slope * half, np.ones((count, 1))], 1) * z[:, None]
    extent = (
        rng.uniform(0.3, 1.0, (count, 4 if primitive == "tetrahedron" else 3))
        * size
        * np.linalg.norm(center, axis=1)[:, None]
    )
    parameters = octahedra(
        center.tolist(),
        extent.tolist(),
        (2 / extent.min(1)).tolist(),
        rotation=rng.normal(size=(count, 4)).tolist(),
    )
    return [p.requires_grad_() for p in parameters], view


@pytest.mark.parametrize("primitive", ["octahedron", "tetrahedron"])
def test_affine_rays_do_not_stretch_primitives_beside_the_view(primitive):
    """With the Jacobian at a centre far to the side, a primitive would cover the whole image."""
    leaves, view = beside_the_view(primitive, 80, 3.0, 0.3)
    exact, affine = (
        ops.rasterize(*[p.detach() for p in leaves], view, primitive=primitive, ray_model=model).opacity
        for model in ("exact", "affine")
    )
    assert exact.mean() < 0.001
    assert affine.mean() < 0.001


@pytest.mark.parametrize("primitive", ["octahedron", "tetrahedron"])
@pytest.mark.parametrize("order", ["center", "entry", "overlap"])
@pytest.mark.parametrize("screen_filter", [0.0, 0.7], ids=["plain", "filtered"])
def test_affine_rays_with_centres_outside_the_image_agree_with_the_reference(primitive, order, screen_filter):
    leaves, view = beside_the_view(primitive, 40, 1.1, 0.8)
    options = dict(primitive=primitive, ray_model="affine", order=order, stop=0.0, screen_filter=screen_filter)
    assert ops.rasterize(*[p.detach() for p in leaves], view, **options).opacity.mean() > 0.2
    assert_alike(leaves, view, options, True, 1e-9, 1e-7)


@pytest.mark.parametrize("variant", [variant for variant in VARIANTS if variant[1] == "affine"], ids="-".join)
def test_a_crop_far_from_the_principal_point_equals_the_full_image(variant):
    """Primitives inside a crop far from the principal point must not be treated as far outside of the image."""
    primitive, ray_model, order = variant
    rng = np.random.default_rng(4)
    whole = camera(61, 13, 40.0)
    part = replace(whole, width=15, cx=whole.cx - 46)
    pixels, z = rng.uniform([48, 2], [59, 11], (12, 2)), rng.uniform(1, 3, 12)
    slope = (pixels - [whole.cx, whole.cy]) / [whole.fx, whole.fy]
    center = np.concatenate([slope, np.ones((12, 1))], 1) * z[:, None]
    extent = rng.uniform(0.05, 0.15, (12, 4 if primitive == "tetrahedron" else 3))
    tensors = octahedra(center.tolist(), extent.tolist(), [0.9] * 12, rotation=rng.normal(size=(12, 4)).tolist())
    options = dict(primitive=primitive, ray_model=ray_model, order=order)
    images = [ops.rasterize(*tensors, view, **options).rgb for view in (whole, part)]
    assert float((images[1] - tensors[5][:, None, None]).abs().max()) > 0.05
    assert torch.allclose(images[0][..., 46:], images[1], atol=1e-10)


@pytest.mark.parametrize("opacity", [1.0, 0.7])
def test_a_clamped_alpha_has_no_gradient(opacity):
    """One Gaussian of standard deviation 1 over one pixel, 0.1 from its middle: alpha is min(0.99, opacity exp(-0.1^2 /
    2)), and at 0.99 it moves with neither opacity nor place."""
    view = Camera(1, 1, 10.0, 10.0, 0.5, 0.5, np.eye(4))
    tensors = octahedra([[0.02, 0.0, 2.0]], [[0.2] * 3], [opacity], sh=[[[0.3] * 3]])
    leaves = [p.requires_grad_() for p in tensors]
    options = dict(primitive="gaussian", ray_model="affine", order="center", screen_filter=0.0)
    shown = ops.rasterize(*leaves, view, **options).opacity
    moved, _, _, faded, _, _ = gradients(shown.sum(), leaves)
    shown = shown.detach()
    # A focal length of 10 at a depth of 2: 5 pixels per unit. The ray leans by 0.01, which makes the variance 1.0001.
    assert float(shown) == pytest.approx(min(0.99, opacity * np.exp(-(0.1**2) / 2)), rel=1e-5)
    if opacity == 1:
        assert not moved.any() and not faded.any()
    else:
        assert float(faded) == pytest.approx(float(shown) / opacity, rel=1e-12)
        assert float(moved[0, 0]) == pytest.approx(-5 * 0.1 * float(shown), rel=1e-3)
