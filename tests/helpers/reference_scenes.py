"""Scenes and cameras for the torch reference (the twin), and the comparison of its images."""

from __future__ import annotations

import torch

from linprim_geo.kernels.reference import rasterize as reference

IMAGES = (
    "rgb",
    "opacity",
    "depth_expected",
    "depth_median",
    "depth_first",
    "normal",
    "normal_median",
    "distortion",
)
LENGTHS = {"depth_expected": 1, "depth_median": 1, "depth_first": 1, "distortion": 2}
C0 = 0.28209479177387814
IDENTITY = (1.0, 0.0, 0.0, 0.0)
# Tolerance for float64: some hundred operations on numbers of order 1 to 10, several of which cancel a digit.
EXACT = dict(rtol=1e-11, atol=1e-12)


def tensor(values, dtype=torch.float64):
    return torch.tensor(values, dtype=dtype)


def gray(level):
    """Returns the spherical harmonics coefficients (1, 3) of degree 0 of the grey `level`."""
    return [[(level - 0.5) / C0] * 3]


def octahedra(center, extent, density, color=None, rotation=None, background=(0.0, 0.0, 0.0)):
    """Returns the six tensors of `rasterize` from lists; by default without rotation, and with a grey of 1."""
    n = len(center)
    rotation = rotation or [IDENTITY] * n
    sh = [gray(c) for c in (color or [1.0] * n)]
    return [tensor(x) for x in (center, rotation, extent, density, sh, background)]


def axis_camera(width=9, height=9, focal=8.0, **more):
    """Returns a camera at the origin that looks along +z, with the middle pixel's centre exactly on the axis."""
    return (
        dict(
            world_to_camera=torch.eye(4, dtype=torch.float64),
            fx=focal,
            fy=focal,
            cx=width / 2,
            cy=height / 2,
            width=width,
            height=height,
        )
        | more
    )


def random_pose(generator):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = reference.rotation_matrix(torch.randn(4, generator=generator, dtype=torch.float64))
    pose[:3, 3] = torch.randn(3, generator=generator, dtype=torch.float64)
    return pose


def random_scene(seed, count, coefficients=4, width=6, height=5, depth=3.0, spread=0.5, **more):
    """Returns overlapping random octahedra and a camera of random pose that looks at them."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)

    pose = random_pose(g)
    center_camera = spread * normal(count, 3) * tensor([1.0, 1.0, 2.0]) + tensor([0.0, 0.0, depth])
    center = (center_camera - pose[:3, 3]) @ pose[:3, :3]
    parameters = [
        center,
        normal(count, 4),
        uniform(0.3, 1.0, count, 3),
        uniform(0.2, 1.5, count),
        0.3 * normal(count, coefficients, 3),
        uniform(0.0, 1.0, 3),
    ]
    camera = dict(
        world_to_camera=pose,
        fx=2.1 * width,
        fy=1.9 * width,
        cx=width / 2 + 0.13,
        cy=height / 2 - 0.21,
        width=width,
        height=height,
    )
    return parameters, camera | more


def assert_same(a, b, names=IMAGES + ("max_weight", "pixels"), **tolerance):
    for name in names:
        torch.testing.assert_close(a[name], b[name], **(tolerance or EXACT), msg=lambda m, name=name: f"{name}: {m}")
