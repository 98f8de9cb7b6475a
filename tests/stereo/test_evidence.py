"""Comparison of depths between photographs of a wall with known depth."""

from __future__ import annotations

import numpy as np
from helpers.captures import look_at

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.confidence import MOST_PIXELS, RIGHT, evidence
from linprim_geo.stereo.evidence import compare_depths

NORMAL = np.array([0.3, -0.25, 1.0]) / np.linalg.norm([0.3, -0.25, 1.0])


def camera_at(center, target=(0.0, 0.0, 0.0)) -> Camera:
    return look_at(center, target, size=(96, 72), focal=110.0, up=(0.0, 1.0, 0.0))


def plane_of(camera: Camera) -> np.ndarray:
    """(3, H, W) inverse depth of a wall through the origin, and its slopes."""
    inverse = -(camera.world_rays() @ NORMAL) / (camera.center @ NORMAL)
    return np.stack([inverse, np.gradient(inverse, axis=1), np.gradient(inverse, axis=0)])


ONE, OTHER = camera_at((0, 0, -3)), camera_at((0.5, 0, -2.9))


def test_another_view_of_the_same_wall_confirms_depths():
    seen = compare_depths(ONE, 1 / plane_of(ONE)[0], OTHER, plane_of(OTHER))
    inside = np.s_[10:-10, 20:-20]
    # Float32 pixels of up to 96, and slopes by differences, which are exact on planes.
    assert seen.reprojection_error[inside].max() < 1e-3 and np.abs(seen.depth_difference[inside]).max() < 1e-5
    assert seen.confirms[inside].all()
    # `pixel` is the pixel of the other view that the point projects to.
    points = ONE.center + ONE.world_rays() / plane_of(ONE)[0][..., None]
    pixels = OTHER.project(points[inside].reshape(-1, 3))[0].astype(int)
    assert np.array_equal(seen.pixel[inside].ravel(), pixels[:, 1] * OTHER.width + pixels[:, 0])


def test_parallax_agrees_with_finite_differences():
    depth, step = 1 / plane_of(ONE)[0], 1e-4
    near, far = (
        OTHER.project((ONE.center + ONE.world_rays() * (depth * (1 + sign * step))[..., None]).reshape(-1, 3))[0]
        for sign in (-1, 1)
    )
    moved = np.linalg.norm(far - near, axis=1).reshape(depth.shape) / (2 * step)
    parallax = compare_depths(ONE, depth, OTHER, plane_of(OTHER)).parallax
    seen = parallax > 0
    # The error of central differences with a step of 1e-4 is about 1e-8.
    assert seen.mean() > 0.7 and np.allclose(parallax[seen], moved[seen], rtol=1e-4)


def test_wrong_and_unknown_depths_are_not_confirmed():
    seen = compare_depths(ONE, 1.05 / plane_of(ONE)[0], OTHER, plane_of(OTHER))
    assert not seen.confirms.any()
    # The other view has the wall about 5 % nearer along nearly the same ray.
    known = np.isfinite(seen.reprojection_error)
    assert np.allclose(seen.depth_difference[known], 1 / 1.05 - 1, atol=0.03)
    nothing = compare_depths(ONE, np.full((72, 96), np.nan), OTHER, plane_of(OTHER))
    assert np.isinf(nothing.reprojection_error).all() and (nothing.pixel == -1).all()
    nothing = compare_depths(ONE, 1 / plane_of(ONE)[0], OTHER, np.full((3, 72, 96), np.nan))
    assert np.isinf(nothing.reprojection_error).all() and not nothing.confirms.any()


def test_evidence_counts_views_that_have_a_depth_at_the_point():
    plane, known = plane_of(ONE), np.ones((72, 96), bool)
    same, other = (compare_depths(ONE, scale / plane[0], OTHER, plane_of(OTHER)) for scale in (1.0, 1.05))
    unseen = compare_depths(ONE, 1 / plane[0], OTHER, np.full((3, 72, 96), np.nan))
    # This view has depths everywhere, but the point is outside of its image.
    beside = camera_at((0.5, 0, -2.9), (1.5, 0, 0))
    outside = compare_depths(ONE, 1 / plane[0], beside, np.broadcast_to([[[0.3]], [[0.0]], [[0.0]]], (3, 72, 96)))
    cost = np.full((72, 96), 0.1, np.float32)
    at = (36, 48)
    assert outside.pixel[at] == -1 and (outside.pixel >= 0).any()
    grey = np.full((72, 96), 100, np.uint8)
    found = evidence(grey, plane, cost, known, [same, other, unseen, outside])[at]
    pixels = min(np.log2(RIGHT * same.parallax[at]), MOST_PIXELS)
    assert np.allclose(found, [1, 1, 1 / 2, 0.1, pixels, 1], atol=1e-6)
    assert np.allclose(evidence(grey, plane, cost, known, [unseen])[at][1:3], 0)


def test_unknown_depths_give_no_support():
    plane, known = plane_of(ONE), np.zeros((72, 96), bool)
    known[:, :48] = True
    grey = np.full((72, 96), 100, np.uint8)
    supported = evidence(grey, plane, np.zeros((72, 96), np.float32), known, [])[..., 5]
    # Windows have 21 columns; the share of known ones falls linearly towards the unknown half of the image.
    assert np.allclose(supported[30], [*np.ones(38), *(np.arange(20, 10, -1) / 21), *np.zeros(48)])
