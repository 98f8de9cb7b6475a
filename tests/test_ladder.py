"""The rasterizer's primitives, ray models, orders and screen filter against the float64 twin, value and gradient."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from octahedra import IMAGES, KERNELS, fields, kernels, random_scene

from linprim_geo import ops, reference

# What the core has: an order other than the centres' needs an entry, which a Gaussian has not.
RUNGS = [
    *itertools.product(("octahedron", "tetrahedron"), ("exact", "affine"), ("center", "entry", "overlap")),
    ("gaussian", "affine", "center"),
]
NAMES = ["-".join(rung) for rung in RUNGS]


def scene_of(
    seed: int,
    rung: tuple[str, str, str],
    count: int = 14,
    coefficients: int = 4,
    size=(19, 14),
    dtype=torch.float64,
):
    """Tensors that require gradients, the camera, and the keywords of the rung."""
    primitive, ray_model, order = rung
    parameters, view = random_scene(seed, count, coefficients, *size)
    rng = np.random.default_rng(seed)
    if primitive == "tetrahedron":
        parameters[2] = torch.from_numpy(rng.uniform(0.15, 0.6, (count, 4)))
    if primitive == "gaussian":
        parameters[2] = parameters[2] * 0.5
        parameters[3] = torch.from_numpy(rng.uniform(0.05, 1.0, count))
    leaves = [p.to(dtype).requires_grad_() for p in parameters]
    # Where a ray stops inside an overlap, the twin's gradient knows which of the boundaries it stopped at, the core's does not.
    return (
        leaves,
        view,
        dict(primitive=primitive, ray_model=ray_model, order=order, stop=0.0 if order == "overlap" else 1e-3),
    )


def both(leaves, view, options, geometry=True):
    """Images and gradients (of random weights) of the core and of the twin, as two pairs."""
    results = []
    weights = None
    for core in (True, False):
        inputs = [p.detach().to(p.dtype if core else torch.float64).requires_grad_() for p in leaves]
        if core:
            images = fields(
                ops.rasterize(*inputs, view, geometry=geometry, **options), IMAGES if geometry else IMAGES[:2]
            )
        else:
            out = reference.rasterize(
                *inputs,
                world_to_camera=torch.from_numpy(view.world_to_camera),
                fx=view.fx,
                fy=view.fy,
                cx=view.cx,
                cy=view.cy,
                width=view.width,
                height=view.height,
                geometry=geometry,
                **options,
            )
            images = {name: out[name] for name in (IMAGES if geometry else IMAGES[:2])}
        if weights is None:
            generator = torch.Generator().manual_seed(3)
            weights = {
                name: torch.rand(image.shape, generator=generator, dtype=torch.float64) - 0.3
                for name, image in images.items()
            }
        loss = sum((image.double() * weights[name]).sum() for name, image in images.items())
        grads = torch.autograd.grad(loss, inputs, allow_unused=True)
        results.append(
            (images, [torch.zeros_like(p) if g is None else g for p, g in zip(inputs, grads, strict=True)])
        )
    return results


def assert_alike(leaves, view, options, geometry, value: float, gradient: float):
    (shown, grads), (wanted, wanted_grads) = both(leaves, view, options, geometry)
    for name, image in wanted.items():
        scale = max(float(image.detach().abs().max()), 1e-3)
        off = float((shown[name].detach().double() - image).abs().max())
        assert off <= value * scale, f"{name} is off by {off / scale:.1e} of its range"
    for index, (found, truth) in enumerate(zip(grads, wanted_grads, strict=True)):
        off, scale = float((found.double() - truth).abs().max()), max(float(truth.abs().max()), 1e-6)
        assert off <= gradient * scale, f"gradient {index} is off by {off / scale:.1e} of its largest"


@pytest.mark.parametrize("rung", RUNGS, ids=NAMES)
@pytest.mark.parametrize("geometry", [False, True], ids=["colour", "geometry"])
@pytest.mark.parametrize("screen_filter", [0.0, 0.7], ids=["plain", "filtered"])
def test_double_precision_equals_the_twin(rung, geometry, screen_filter):
    for seed in range(4):
        leaves, view, options = scene_of(100 + seed, rung)
        assert_alike(leaves, view, options | {"screen_filter": screen_filter}, geometry, 1e-9, 1e-7)


@pytest.mark.parametrize("rung", RUNGS, ids=NAMES)
@pytest.mark.parametrize("isa", KERNELS)
def test_single_precision_is_near_the_twin(rung, isa):
    with kernels(isa):
        for seed in range(2):
            leaves, view, options = scene_of(200 + seed, rung, dtype=torch.float32)
            assert_alike(leaves, view, options, False, 1e-4, 2e-3)
