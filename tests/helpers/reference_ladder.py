"""Scenes of every primitive for the torch reference (the twin), and its variants: primitive, ray model and order."""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from helpers.reference_scenes import random_scene

POLYHEDRA, MODELS, ORDERS = ("octahedron", "tetrahedron"), ("exact", "affine"), ("center", "entry", "overlap")
VARIANTS = list(itertools.product(POLYHEDRA, MODELS, ORDERS))
BASIS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3)


def scene(primitive, seed, count, coefficients=4, **more):
    """Returns a `random_scene` with primitives of this kind, and its camera."""
    parameters, camera = random_scene(seed, count, coefficients, **more)
    g = torch.Generator().manual_seed(1000 + seed)
    uniform = torch.rand(count, 5, generator=g, dtype=torch.float64)
    if primitive == "tetrahedron":
        parameters[2] = 0.5 + uniform[:, :4]
    elif primitive == "gaussian":
        parameters[2] = 0.1 + 0.4 * uniform[:, :3]
        parameters[3] = 0.2 + 0.8 * uniform[:, 3]
    return parameters, camera


def pixel_of(result, row, column):
    """Returns the values of one pixel of all images."""
    return {name: value[..., row, column] for name, value in result.items() if value.ndim > 1}
