"""Photo-consistency along the normals of a mesh, tested with exact photographs of a textured plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.textured_plane import (
    DISTANCE,
    FOOTPRINT,
    SIZE,
    Shown,
    camera,
    inner,
    ring,
    sheet,
    texture,
)

from linprim_geo.geometry.mesh import Mesh
from linprim_geo.kernels import ops, surface_ops
from linprim_geo.surface.finish import photo_consistency
from linprim_geo.surface.finish.photo_consistency import best_agreement, photo_gains, predicted_error, refine_surface
from linprim_geo.surface.normals import vertex_normals


@pytest.fixture(scope="module")
def shown():
    return [Shown(view) for view in ring()]


def agreement(mesh, shown):
    return best_agreement(mesh, [s.camera for s in shown], (s.load() for s in shown))


def predicted(mesh, shown):
    return predicted_error(mesh, [s.camera for s in shown], (s.load() for s in shown))


def test_exposure_gains_are_found_on_an_inaccurate_surface():
    true = np.exp(0.25 * np.cos(2.3 * np.arange(8)))
    true /= np.exp(np.log(true).mean())
    views = ring()
    drifting = [
        Shown(view, lambda x, y, gain=gain: 0.6 * gain * texture(x, y)) for view, gain in zip(views, true, strict=True)
    ]
    mesh = sheet(lambda x, y: 0.7 * FOOTPRINT * np.cos(3 * x))
    gains = photo_gains(mesh, views, (s.load() for s in drifting))
    np.testing.assert_allclose(gains, true, rtol=0.02)
    middle = inner(mesh)
    moved = refine_surface(mesh, drifting, 2, gains)
    left = np.abs(refine_surface(mesh, drifting, 2).vertices[middle, 2]).mean()
    assert np.abs(moved.vertices[middle, 2]).mean() < 0.3 * np.abs(mesh.vertices[middle, 2]).mean() < left
    apart = [camera((100.0 * k, 0.0, DISTANCE)) for k in range(2)]  # the second camera does not see the mesh
    assert photo_gains(mesh, apart, (Shown(view).load() for view in apart)).tolist() == [1.0, 1.0]


@pytest.mark.parametrize("height", [-1.5, -0.6, 0.0, 0.4, 1.2])
def test_the_best_agreement_is_at_the_true_plane(shown, height):
    mesh = sheet(lambda x, y: np.full_like(x, height * FOOTPRINT))
    found, middle = agreement(mesh, shown), inner(mesh)
    assert found.seen_by_two[middle].all() and found.inside[middle].mean() > 0.99
    assert np.median(found.offset[middle]) == pytest.approx(-height * FOOTPRINT, abs=0.1 * FOOTPRINT)
    assert (np.abs(found.offset[middle] + height * FOOTPRINT) < 0.5 * FOOTPRINT).mean() > 0.95


def test_predicted_errors_agree_with_true_ones(shown):
    mesh = sheet(lambda x, y: 1.2 * FOOTPRINT * np.sin(6 * x))
    middle = inner(mesh)
    told, truth = predicted(mesh, shown)[middle], np.abs(mesh.vertices[middle, 2])
    # The texture repeats, so a few vertices agree best one period away.
    assert np.median(np.abs(told - truth)) < 0.1 * FOOTPRINT
    assert told.mean() == pytest.approx(truth.mean(), rel=0.15)


def test_predicted_errors_grow_with_falling_contrast():
    mesh = sheet(lambda x, y: np.zeros_like(x))
    middle, before = inner(mesh), 0.0
    for contrast in (0.1, 0.03, 0.01):
        faint = [Shown(view, lambda x, y, contrast=contrast: 0.5 + contrast * (texture(x, y) - 0.5)) for view in ring()]
        actual = np.median(np.abs(agreement(mesh, faint).offset[middle]))
        told = np.median(predicted(mesh, faint)[middle])
        assert max(before, 0.5 * actual) < told < 3 * actual
        before = told
    # Without texture the predicted error is that of the prior.
    plain = [Shown(view, lambda x, y: np.full_like(x, 0.5)) for view in ring()]
    footprint = photo_consistency._footprints(*photo_consistency._points(mesh), [s.camera for s in plain])[middle]
    scale, place = photo_consistency.PRIOR_SCALE, np.linspace(0, 3, 10_001)
    for _ in range(photo_consistency.PRIOR_ROUNDS):
        scale = np.average(place, weights=np.exp(-place / scale))
    assert predicted(mesh, plain)[middle] == pytest.approx(scale * footprint, rel=0.05)


def test_search_directions_are_smoother_than_vertex_normals():
    random = np.random.default_rng(0)
    mesh = sheet(lambda x, y: np.zeros_like(x))
    jitter = random.normal(size=mesh.vertices.shape) * [0.3, 0.3, 0.1] * (mesh.vertices[1, 1] - mesh.vertices[0, 1])
    rough = replace(mesh, vertices=mesh.vertices + jitter)
    middle = inner(mesh)
    tilt, own = (
        np.median(np.hypot(*n[middle, :2].T)) for n in (photo_consistency._points(rough)[1], vertex_normals(rough))
    )
    assert tilt < 0.5 * own


def test_refinement_converges_to_the_plane(shown):
    mesh = sheet(lambda x, y: FOOTPRINT * np.sin(6 * x) * np.cos(5 * y))
    middle = inner(mesh)
    errors = [np.abs(refine_surface(mesh, shown, rounds).vertices[middle, 2]).mean() for rounds in (0, 1, 2)]
    assert errors[1] < 0.3 * errors[0] and errors[2] < 0.15 * errors[0]
    again = refine_surface(mesh, shown, 2)
    assert (again.faces == mesh.faces).all() and np.allclose(again.normals, vertex_normals(again))


def test_a_textureless_surface_is_not_moved():
    plain = [Shown(view, lambda x, y: np.full_like(x, 0.5)) for view in ring()]
    mesh = sheet(lambda x, y: FOOTPRINT * np.sin(6 * x))
    moved = refine_surface(mesh, plain, 2)
    assert np.abs(moved.vertices - mesh.vertices).max() < 0.01 * FOOTPRINT


def test_exposure_does_not_shift_the_best_agreement(shown):
    mesh = sheet(lambda x, y: np.full_like(x, 0.8 * FOOTPRINT))
    gains = np.linspace(0.8, 1.2, len(shown))
    drifted = [Shown(s.camera, lambda x, y, g=g: g * texture(x, y)) for s, g in zip(shown, gains, strict=True)]
    found, middle = agreement(mesh, drifted), inner(mesh)
    assert np.median(found.offset[middle]) == pytest.approx(-0.8 * FOOTPRINT, abs=0.2 * FOOTPRINT)


def test_hidden_vertices_take_the_predicted_error_of_the_nearest(shown):
    mesh = sheet(lambda x, y: np.full_like(x, 0.8 * FOOTPRINT))
    above = mesh.vertices + [0, 0, 0.5]
    below = Mesh(np.concatenate([mesh.vertices, above]), np.concatenate([mesh.faces, mesh.faces + len(above)]))
    found = agreement(below, shown)
    hidden = np.flatnonzero((np.abs(below.vertices[:, :2]) < 0.1).all(1) & (below.vertices[:, 2] < 0.25))
    assert not found.seen_by_two[hidden].any()
    told = predicted(below, shown)
    assert np.isfinite(told).all()
    seen_by_two = np.flatnonzero(found.seen_by_two)
    for row in hidden[:3]:
        nearest = seen_by_two[
            np.argsort(np.linalg.norm(below.vertices[seen_by_two] - below.vertices[row], axis=1))[
                : photo_consistency.NEIGHBOURS
            ]
        ]
        assert told[row] == pytest.approx(told[nearest].mean(), rel=0.05)  # ties among the nearest
    assert np.isnan(predicted(mesh, shown[:1])).all()
    assert (refine_surface(mesh, shown[:1], 1).vertices == mesh.vertices).all()


def test_transparent_photographs_give_no_sharpness(shown):
    mesh = sheet(lambda x, y: np.full_like(x, 0.5 * FOOTPRINT))
    clear = [replace(s.photo, alpha=np.zeros((SIZE, SIZE), np.uint8)) for s in shown]
    found = best_agreement(mesh, [s.camera for s in shown], clear)
    assert found.seen_by_two[inner(mesh)].all() and found.sharpness.max() < 1e-3


def test_add_photo_agrees_with_numpy(shown):
    """Compare with the definition in float64 numpy."""
    mesh = sheet(lambda x, y: 0.3 * FOOTPRINT * np.sin(9 * y), steps=9)
    footprint, normals = np.full(len(mesh.vertices), FOOTPRINT), photo_consistency._points(mesh)[1]
    found = agreement(mesh, shown)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photo_consistency, "_footprints", lambda points, normals, cameras: footprint)
        same = agreement(mesh, shown)
    sums = np.zeros((3, len(mesh.vertices), len(photo_consistency.OFFSETS)))
    for s in shown:
        c, image = s.camera, s.photo.rgb[..., 0] / 255.0
        toward = c.center - mesh.vertices
        cosine = np.einsum("vd,vd->v", normals, toward) / np.linalg.norm(toward, axis=1)
        for k, offset in enumerate(photo_consistency.OFFSETS):
            pixel, _ = c.project(mesh.vertices + offset * FOOTPRINT * normals)
            x, y = pixel.T - 0.5
            j, i = np.floor(x).astype(int), np.floor(y).astype(int)
            a, b = x - j, y - i
            value = (1 - b) * ((1 - a) * image[i, j] + a * image[i, j + 1]) + b * (
                (1 - a) * image[i + 1, j] + a * image[i + 1, j + 1]
            )
            sums[:, :, k] += [cosine, cosine * value, cosine * value**2]
    mean = sums[1] / sums[0]
    spread = np.sqrt(np.maximum(sums[2] / sums[0] - mean**2, 0))
    middle = inner(mesh, 0.45)  # all views see these
    best = photo_consistency.OFFSETS[spread.argmin(1)]
    rows, k = np.arange(len(spread)), np.clip(spread.argmin(1), 2, len(photo_consistency.OFFSETS) - 3)
    rise = np.minimum(spread[rows, k - 2], spread[rows, k + 2]) - spread[rows, k]
    middle &= np.abs(best) < 2
    assert same.sharpness[middle] == pytest.approx(rise[middle], abs=2e-3)
    assert (np.abs(same.offset / FOOTPRINT - best)[middle] <= 0.5 + 1e-6).all()
    assert np.abs(found.offset - same.offset)[middle].max() < FOOTPRINT


@pytest.mark.parametrize("tilt", [0.0, 40.0, 70.0])
def test_visibility_tolerances_behind_surfaces_and_beside_jumps(tilt):
    """A point may lie up to z (1 + tan t) / f behind the surface, for depth z, tilt t and focal length f. Depths may
    jump by up to 4 times as much."""
    focal, size, outline = 100.0, 9, 4.0
    angle, pose, lens = np.radians(tilt), np.eye(4)[:3], (focal, focal, size / 2, size / 2)
    normal = np.array([[np.sin(angle), 0.0, -np.cos(angle)]])

    def seen(depth, jump):
        """Whether a point at depth 2 counts as visible, with the surface at `depth`."""
        image, depths, jumps = (np.full((size, size), x, np.float32) for x in (0.5, depth, jump))
        views, weight, sums = np.zeros(1, np.int32), np.zeros(1, np.float32), np.zeros((2, 1, 1), np.float32)
        point, one, here = np.array([[0.0, 0.0, 2.0]]), np.ones(1), np.zeros(1)
        rules = (photo_consistency.LEAST_COSINE, outline)
        surface_ops.add_photo(pose, lens, image, depths, jumps, rules, here, point, normal, one, views, weight, *sums)
        if views[0]:
            assert weight[0] == pytest.approx(np.cos(angle), rel=1e-6)
        return bool(views[0])

    slope = 2 / focal * (1 + np.tan(angle))
    assert seen(2 - 0.99 * slope, 0) and not seen(2 - 1.01 * slope, 0)
    assert seen(2, 0.99 * outline * slope) and not seen(2, 1.01 * outline * slope)


def test_footprints_agree_with_the_closed_form():
    """The footprint is z / (f cos t), with tilt t and the geometric mean f of the focal lengths: the least over views
    with a tilt below 81 degrees."""
    angle = np.radians([0.0, 30.0, 60.0, 81.0, 82.0])
    point, lens = np.tile([0.0, 0.0, 2.0], (5, 1)), (80.0, 125.0, 5.0, 5.0)
    normal = np.stack([np.sin(angle), np.zeros(5), -np.cos(angle)], 1)
    least = np.full(5, 9.0)
    for away in (0.0, 1.0):
        pose = np.eye(4)[:3]
        pose[2, 3] = away  # the second view is one farther away
        surface_ops.least_footprints(pose, lens, 10, 10, photo_consistency.LEAST_COSINE, point, normal, least)
    assert least == pytest.approx([*(2 / (100 * np.cos(angle[:4]))), 9.0], rel=1e-12)


def test_large_and_unknown_footprints_are_limited():
    """One vertex of a sheet in front of the camera is tilted by 80 degrees, one faces away."""
    mesh, view = sheet(lambda x, y: np.zeros_like(x), steps=9), camera((0.0, 0.0, DISTANCE))
    normals = np.tile([0.0, 0.0, 1.0], (len(mesh.vertices), 1))
    normals[40], normals[41] = [np.sin(np.radians(80)), 0, np.cos(np.radians(80))], [0, 0, -1]
    found = photo_consistency._footprints(mesh.vertices, normals, [view])
    others = np.delete(found, [40, 41])
    assert found[[40, 41]] == pytest.approx(photo_consistency.LARGEST_FOOTPRINT * np.median(others), rel=0.05)
    assert others == pytest.approx(np.full(len(others), FOOTPRINT), rel=0.05)


def test_neighbour_average_counts_each_neighbour_once():
    mesh = sheet(lambda x, y: np.zeros_like(x), steps=4)
    values = np.random.default_rng(0).normal(size=len(mesh.vertices))
    found = photo_consistency.neighbour_average(mesh) @ values
    for vertex in range(len(values)):
        around = np.unique(mesh.faces[(mesh.faces == vertex).any(1)])
        assert found[vertex] == pytest.approx(values[around].mean(), abs=1e-12)


def test_results_do_not_depend_on_threads(shown, few_threads):
    mesh = sheet(lambda x, y: FOOTPRINT * np.sin(6 * x))
    one = agreement(mesh, shown)
    ops.set_threads(3)
    three = agreement(mesh, shown)
    for name in ("offset", "sharpness", "seen_by_two", "inside"):
        assert getattr(one, name).tobytes() == getattr(three, name).tobytes()
