"""Scenes for every variant of the compiled rasterizer (primitive, ray model, order), and the parametrisation of tests
over them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from helpers.octahedra import random_scene

LADDER = [
    *itertools.product(("octahedron", "tetrahedron"), ("exact", "affine"), ("center", "entry", "overlap")),
    ("gaussian", "affine", "center"),
]
SOLID = [variant for variant in LADDER if variant[0] != "gaussian"]
DTYPES = [torch.float32, torch.float64]


def ladder(variants, dtypes=None):
    """Parametrises a test over variants and, if given, scalar types."""
    if dtypes is None:
        return pytest.mark.parametrize("variant", variants, ids=["-".join(r) for r in variants])
    cases = list(itertools.product(variants, dtypes))
    return pytest.mark.parametrize("variant,dtype", cases, ids=["-".join((*r, str(d)[6:])) for r, d in cases])


def options_of(variant) -> dict:
    """Returns the options of `rasterize` for a variant."""
    return dict(zip(("primitive", "ray_model", "order"), variant, strict=True))


def scene_of(variant, seed, count=8, coefficients=1, **camera):
    """Returns an ordinary random scene of a variant's primitive in float64, and its camera."""
    parameters, view = random_scene(seed, count, coefficients, **camera)
    rng = np.random.default_rng(seed)
    if variant[0] == "tetrahedron":
        parameters[2] = torch.from_numpy(rng.uniform(0.2, 1.2, (count, 4)))
    if variant[0] == "gaussian":
        parameters[2], parameters[3] = parameters[2] * 0.5, torch.from_numpy(rng.uniform(0.05, 1.0, count))
    return parameters, view
