"""Comparison of plain regions by shading: agreement with float64, convergence, and invalid input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.kernels.reference.stereo import compare_shading as reference
from linprim_geo.kernels.stereo_ops import compare_shading

PLANE = np.array([0.05, -0.03, 0.3])
MOVES = np.array([[0.3, 0.0, 0.02], [0.0, 0.3, -0.01], [0.02, 0.05, 0.3]])


def camera_at(x, y):
    camera = look_at((x, y, -3.0), (0.0, 0.0, 0.5), size=(60, 44), focal=50.0, up=(0.0, 1.0, 0.0), shift=(-1.0, 1.0))
    return replace(camera, fy=52.0)


def pair(seed=0, tone=0.0, noise=0.3):
    """A region of one photograph and box means of another: light falls off along the wall PLANE, with different
    exposure and a bend."""
    rng, own, other = np.random.default_rng(seed), camera_at(0.0, 0.0), camera_at(0.5, -0.2)
    y, x = (axis.ravel() for axis in np.mgrid[6:38:2, 8:52:2])
    rays = own.ray_grid()[y, x].astype(np.float64)

    def light(points):
        return 120 + 25 * np.exp(-((points[:, 0] - 0.6) ** 2)) + 18 * points[:, 1]

    points = own.center + rays / (rays @ PLANE)[:, None] @ own.rotation
    value = light(points) + noise * rng.standard_normal(len(rays))
    # The same wall in the other camera.
    normal = own.rotation.T @ PLANE
    offset = 1 + normal @ own.center
    grid = other.world_rays().reshape(-1, 3)
    hit = other.center + grid * ((offset - normal @ other.center) / (grid @ normal))[:, None]
    seen = light(hit).reshape(44, 60) * 1.15 - 20
    seen = seen + tone * (seen - 120) ** 2 / 100 + noise * rng.standard_normal((44, 60))
    means = np.stack([seen, *np.gradient(seen)[::-1]], -1).astype(np.float32)
    plain = rng.random((44, 60)) > 0.1
    return {"rays": rays, "value": value, "own": own, "other": other, "means": means, "plain": plain}


@pytest.mark.parametrize(("seed", "tone", "plane"), [(0, 0.0, PLANE), (1, 0.5, PLANE), (2, 0.2, PLANE * 1.1)])
def test_compare_shading_agrees_with_float64(seed, tone, plane):
    given = pair(seed, tone)
    found = compare_shading(plane=plane, moves=MOVES, least=1, **given)
    shown, left, left_variance, variance, information, downhill = reference(plane=plane, moves=MOVES, **given)
    np.testing.assert_array_equal(found.shown, shown)
    assert found.boxes == np.count_nonzero(shown) > 150
    np.testing.assert_allclose(found.left, left, atol=1e-9)
    assert found.left_variance == pytest.approx(left_variance, rel=1e-9)
    assert found.variance == pytest.approx(variance, rel=1e-9)
    np.testing.assert_allclose(found.information, information, rtol=1e-6, atol=1e-6 * np.abs(information).max())
    np.testing.assert_allclose(found.downhill, downhill, rtol=1e-6, atol=1e-6 * np.abs(downhill).max())


def test_gauss_newton_steps_converge_to_the_true_plane():
    given = pair(noise=0.01)
    wrong = PLANE + MOVES @ [0.02, -0.015, 0.01]
    for _ in range(4):
        found = compare_shading(plane=wrong, moves=MOVES, least=1, **given)
        wrong = wrong + MOVES @ np.linalg.solve(found.information, found.downhill)
    np.testing.assert_allclose(wrong, PLANE, atol=2e-3)


def test_exposure_and_bend_leave_no_residual_on_the_true_plane():
    # Interpolation of means, in single precision, is all that is left.
    assert compare_shading(plane=PLANE, moves=MOVES, least=1, **pair(noise=0.0)).left_variance < 0.01
    assert compare_shading(plane=PLANE, moves=MOVES, least=1, **pair(noise=0.0, tone=0.3)).left_variance < 0.01
    assert compare_shading(plane=1.3 * PLANE, moves=MOVES, least=1, **pair(noise=0.0)).left_variance > 0.1


def test_too_few_boxes_give_an_empty_result():
    given = pair()
    found = compare_shading(plane=PLANE, moves=MOVES, least=1, **given)
    fewer = compare_shading(plane=PLANE, moves=MOVES, least=found.boxes + 1, **given)
    assert fewer.boxes == 0 and not fewer.shown.any() and not fewer.left.any() and not fewer.information.any()
    behind = compare_shading(plane=-PLANE, moves=MOVES, least=1, **given)
    assert behind.boxes == 0


def test_uniform_photographs_give_finite_equations():
    given = pair(noise=0.0)
    given["value"][:], given["means"][:] = 100.0, (100.0, 0.0, 0.0)
    found = compare_shading(plane=PLANE, moves=MOVES, least=1, **given)
    assert found.boxes > 0 and np.isfinite(found.information).all() and np.isfinite(found.downhill).all()
    assert not np.abs(found.left).max() > 1e-9


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"value": np.zeros(3)}, "rays has shape"),
        ({"means": np.zeros((44, 60), np.float32)}, "means have to have shape"),
        ({"plain": np.zeros((43, 60), bool)}, "plain has shape"),
        ({"moves": np.zeros((2, 3))}, "moves has shape"),
    ],
)
def test_invalid_arrays_are_refused(changed, said):
    with pytest.raises(ValueError, match=said):
        compare_shading(**{"plane": PLANE, "moves": MOVES, "least": 1, **pair(), **changed})
