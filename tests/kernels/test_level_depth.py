"""Depth at which the transmittance of a ray falls to a level, with exact overlap."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.octahedra import BUILDS, KERNELS, camera, kernels, octahedra, random_scene

from linprim_geo.kernels import ops
from linprim_geo.kernels.reference import rasterize as reference

pytestmark = pytest.mark.usefixtures("few_threads")


def overlap_depth(scene, view, near, level):
    """Where the summed thickness of a ray reaches ln(1 / level): the twin's intervals, cut at all their ends; 0 where
    never."""
    center, rotation, extent, density = (p.double() for p in scene[:4])
    pose = torch.from_numpy(view.world_to_camera)
    local = center @ pose[:3, :3].T + pose[:3, 3]
    turn = pose[:3, :3] @ reference.rotation_matrix(rotation)
    rays = reference.pixel_rays(view.width, view.height, view.fx, view.fy, view.cx, view.cy, center)
    spans = []
    for i in range(len(center)):
        start, end, *_ = reference.clip_to_octahedron(
            rays @ turn[i] / extent[i], -(local[i] @ turn[i]) / extent[i], near
        )
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
def test_level_depth_agrees_with_the_reference_intervals(seed, depth, near, level):
    scene, view = random_scene(seed, 25, 1, 21, 18, depth)
    for dtype, isa in BUILDS:
        inputs = [p.to(getattr(torch, dtype)) for p in scene]
        wanted = overlap_depth(inputs, view, near, level)
        assert (wanted > 0).sum() > 30
        with kernels(isa):
            got = ops.level_depth(*inputs[:5], view, level=level, near=near)[0].double()
            again = ops.level_depth(*[p.flip(0) for p in inputs[:5]], view, level=level, near=near)[0].double()
        # Thickness is good to 400 eps (test_rasterize.py); the depth to that over density |v|, at least 0.1 in sum
        # where little is behind.
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
def test_level_depth_is_accurate_in_front_of_a_far_background(isa):
    near = ([0.0, 0.0, 3.0], 2.0, 1.0)
    results = []
    for far in (None, 1e5):
        rows = [near] if far is None else [near, ([0.0, 0.0, far], far / 4, 10.0 / far)]
        center, extent, density = (torch.tensor(x) for x in zip(*rows, strict=True))
        turn = torch.tensor([[1.0, 0, 0, 0]] * len(rows))
        with kernels(isa):
            results.append(
                ops.level_depth(
                    center,
                    turn,
                    extent[:, None].repeat(1, 3),
                    density,
                    torch.zeros(len(rows), 1, 3),
                    camera(8, 8),
                    level=0.6,
                )
            )
    (alone, alone_opacity), (before, opacity) = results
    hit = alone > 0
    assert hit.sum() > 8
    # The bracket reaches 40,000 times as far, and the depth keeps float32's digits: 4 roundings.
    torch.testing.assert_close(before[hit], alone[hit], rtol=4 * 1.2e-7, atol=0)
    assert (opacity >= alone_opacity).all() and (opacity > alone_opacity).any()


def test_level_depth_is_zero_without_primitives():
    scene = [p[:0] for p in octahedra([[0.0, 0.0, 3.0]], [[1.0, 1.0, 1.0]], [1.0])]
    assert not any(image.any() for image in ops.level_depth(*scene[:5], camera(5, 3), level=0.5))
