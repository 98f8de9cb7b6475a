"""The predicted error of a surface that depth maps of a plane are fused into."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.geometry.mesh import Mesh
from linprim_geo.surface.fusion.depth_error import FINEST, error_by_depths, error_of_nearest, largest_error
from linprim_geo.surface.fusion.tsdf_field import DepthFrame

SIZE, FOCAL, DISTANCE, REACH = (60, 48), 60.0, 3.0, 0.3
PIXEL = DISTANCE / FOCAL
# A tilted plane that all cameras see, and triangles on it.
NORMAL = np.array([0.3, -1.0, 0.2]) / np.linalg.norm([0.3, -1.0, 0.2])


def plane() -> Mesh:
    across = np.cross(NORMAL, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    grid = np.linspace(-0.5, 0.5, 12)
    points = np.array([a * across + b * np.cross(NORMAL, across) for a in grid for b in grid])
    corner = np.arange(144).reshape(12, 12)[:-1, :-1].ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 12], 1), np.stack([corner + 1, corner + 13, corner + 12], 1)]
    )
    return Mesh(points, faces, normals=np.tile(NORMAL, (144, 1)).astype(np.float32))


def frame(x: float, off: float, confidence: float = 1.0) -> DepthFrame:
    """Depths of the plane, shifted by `off` along its normal, from a camera at x."""
    camera = look_at((x, -DISTANCE, 0.1), (0.0, 0.0, 0.0), size=SIZE, focal=FOCAL)
    depth = (off - camera.center @ NORMAL) / (camera.world_rays() @ NORMAL)
    return DepthFrame(camera, depth.astype(np.float32), confidence=np.full(depth.shape, confidence, np.float32))


def test_error_combines_the_spread_of_depths_and_a_part_of_a_pixel():
    mesh, finest = plane(), FINEST * PIXEL
    exact = error_by_depths(mesh, [frame(x, 0.0) for x in (-0.4, 0.0, 0.4)], REACH)
    assert exact.dtype == np.float32 and exact == pytest.approx(finest, rel=0.3)
    noisy = error_by_depths(mesh, [frame(x, off) for x, off in ((-0.4, 0.1), (0.0, -0.1), (0.4, 0.1))], REACH)
    assert noisy == pytest.approx(np.hypot(exact, 0.1), rel=3e-3)
    # Weighted mean square: (0.1^2 + 0.1^2 + 0.25 * 0.18^2) / 2.25.
    weighted = [frame(-0.4, 0.1), frame(0.0, -0.1), frame(0.4, 0.18, confidence=0.25)]
    assert error_by_depths(mesh, weighted, REACH) == pytest.approx(np.hypot(exact, np.sqrt(0.0281 / 2.25)), rel=3e-3)


def test_unfused_depths_do_not_count():
    mesh = plane()
    exact = error_by_depths(mesh, [frame(x, 0.0) for x in (-0.4, 0.0)], REACH)
    nothing = frame(0.2, 0.0)
    nothing.depth[:] = 0
    behind = look_at((0.0, DISTANCE, 0.1), (0.0, 0.0, 0.0), size=SIZE, focal=FOCAL)
    depth = -(behind.center @ NORMAL) / (behind.world_rays() @ NORMAL)
    from_behind = DepthFrame(behind, depth * 1.01, confidence=np.ones(depth.shape, np.float32))
    clamped = frame(0.3, 0.5 * REACH)
    clamped = replace(clamped, clamped=np.ones(clamped.depth.shape, bool))
    more = [frame(-0.4, 0.0), frame(0.0, 0.0), frame(0.4, 1.1 * REACH), nothing, from_behind, clamped]
    assert error_by_depths(mesh, more, REACH) == pytest.approx(exact, rel=1e-6)


def test_unconfirmed_vertices_have_the_largest_error():
    mesh = plane()
    for frames in ([frame(0.0, 0.0)], [frame(x, 0.0, confidence=0.1) for x in (-0.4, 0.0, 0.4)], []):
        assert (error_by_depths(mesh, frames, REACH) == np.float32(largest_error(REACH))).all()
    anywhere = np.random.default_rng(0).uniform(-REACH, REACH, 100_000)
    assert largest_error(REACH) == pytest.approx(np.sqrt(np.mean(anywhere**2)), rel=0.01)
    apart = [frame(x, off) for x, off in ((-0.4, 0.9 * REACH), (0.0, -0.9 * REACH), (0.4, 0.9 * REACH))]
    assert (error_by_depths(mesh, apart, REACH) == np.float32(largest_error(REACH))).all(), "nothing is known either"


def test_new_vertices_have_at_least_the_error_of_their_distance():
    mesh = replace(plane(), quality=np.linspace(0.01, 0.05, 144, dtype=np.float32))
    moved = mesh.vertices + 0.01 * NORMAL
    assert (error_of_nearest(mesh, moved) == mesh.quality).all()
    far = mesh.vertices[:1] + 0.4 * NORMAL
    assert error_of_nearest(mesh, far) == pytest.approx([0.4])
