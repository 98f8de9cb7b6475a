"""Denoising of surfaces by filtered normals, limited by photo-consistency."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.textured_plane import FOOTPRINT, Shown, inner, ring, sheet, texture

from linprim_geo.geometry.mesh import Mesh, face_areas, face_normals
from linprim_geo.kernels import ops, surface_ops
from linprim_geo.surface.finish.denoise import CONTRAST, denoised, filtered
from linprim_geo.surface.finish.photo_consistency import predicted_error
from linprim_geo.surface.normals import vertex_normals


def rough(mesh: Mesh, deviation: float, seed: int = 0) -> Mesh:
    shift = np.random.default_rng(seed).normal(0, deviation, mesh.vertices.shape)
    return replace(mesh, vertices=mesh.vertices + shift)


def roof(angle: float, steps: int = 41) -> Mesh:
    """Two planes that meet along y at an angle in degrees, with noise of a tenth of an edge length."""
    slope = np.tan(np.radians(angle / 2))
    return rough(sheet(lambda x, y: -slope * np.abs(x), steps=steps), 0.0025)


def filtered_in_numpy(mesh: Mesh, bound: np.ndarray, contrast: float, normal_rounds: int, vertex_rounds: int):
    """The formulas of csrc/surface/filter_normals.h in numpy."""
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces
    normal, area = face_normals(mesh), face_areas(mesh)
    fans = [np.nonzero((faces == v).any(1))[0] for v in range(len(vertices))]
    for _ in range(normal_rounds):
        averaged = np.zeros_like(normal)
        for f, corners in enumerate(faces):
            for g in np.concatenate([fans[v] for v in corners]):
                difference = normal[f] - normal[g]
                near = max(0.0, 1 - difference @ difference / contrast**2)
                averaged[f] += area[g] * near**2 * normal[g]
        normal = averaged / np.linalg.norm(averaged, axis=1, keepdims=True)
    start = vertices.copy()
    for _ in range(vertex_rounds):
        middle, moved = vertices[faces].mean(1), vertices.copy()
        for v, fan in enumerate(fans):
            ahead = np.einsum("fk,fk->f", normal[fan], middle[fan] - vertices[v])
            moved[v] += (area[fan] * ahead) @ normal[fan] / area[fan].sum()
            away = moved[v] - start[v]
            moved[v] = start[v] + away * min(1, bound[v] / max(np.linalg.norm(away), 1e-300))
        vertices = moved
    return vertices


def test_filter_normals_agrees_with_numpy():
    mesh = roof(60, steps=9)
    bound = np.random.default_rng(1).uniform(0, 0.003, len(mesh.vertices))
    found = np.array(mesh.vertices, np.float64, order="C")
    surface_ops.filter_normals(np.ascontiguousarray(mesh.faces), bound, 0.6, 3, 4, found)
    # Sums of some 40 products of numbers below 1, 7 times.
    assert np.abs(found - filtered_in_numpy(mesh, bound, 0.6, 3, 4)).max() < 1e-13


def tilts(mesh: Mesh, side: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Angles in degrees between a normal and those of the faces on one side."""
    return np.degrees(np.arccos(np.clip(face_normals(mesh)[side] @ normal, -1, 1)))


@pytest.mark.parametrize("angle", [45, 90])
def test_planes_are_flattened_and_the_edge_is_kept(angle):
    mesh = roof(angle)
    smooth = replace(mesh, vertices=filtered(mesh, np.full(len(mesh.vertices), 0.02)))
    half = np.radians(angle / 2)
    right = mesh.vertices[mesh.faces].mean(1)[:, 0] > 0
    for side, normal in ((right, [np.sin(half), 0, np.cos(half)]), (~right, [-np.sin(half), 0, np.cos(half)])):
        before, after = tilts(mesh, side, np.array(normal)), tilts(smooth, side, np.array(normal))
        # Noise of a tenth of an edge tilts faces by some 8 degrees.
        assert np.median(before) > 5 and np.median(after) < 0.15 * np.median(before)
        assert np.quantile(after, 0.95) < 0.3 * np.quantile(before, 0.95)


def test_no_vertex_moves_farther_than_its_bound():
    mesh = roof(90)
    bound = np.where(np.arange(len(mesh.vertices)) % 3 == 0, 0, 1e-4)
    moved = np.linalg.norm(filtered(mesh, bound) - mesh.vertices, axis=1)
    assert (moved <= bound * (1 + 1e-9)).all() and np.isclose(moved[bound > 0], 1e-4).mean() > 0.5


def test_results_do_not_depend_on_threads(few_threads):
    mesh = rough(sheet(lambda x, y: 0.1 * x * y, steps=101), 0.001)
    bound = np.full(len(mesh.vertices), 0.01)
    one = filtered(mesh, bound)
    ops.set_threads(3)
    assert (filtered(mesh, bound) == one).all()


def test_degenerate_faces_and_unused_vertices_are_harmless():
    mesh = roof(90)
    corner = len(mesh.vertices)
    odd = Mesh(
        np.concatenate([mesh.vertices, [[9, 9, 9]]]),
        np.concatenate([mesh.faces, [[0, 0, 1], [0, 1, 0]]]),
    )
    found = filtered(odd, np.full(corner + 1, 0.01))
    assert np.isfinite(found).all() and (found[corner] == 9).all()
    assert np.abs(found[:corner] - filtered(mesh, np.full(corner, 0.01))).max() < 1e-12


def test_wrong_arrays_are_refused():
    vertices, corners = np.zeros((3, 3)), np.array([[0, 1, 3]])
    with pytest.raises(ValueError, match="outside of the vertices"):
        surface_ops.filter_normals(corners, np.zeros(3), CONTRAST, 1, 1, vertices)
    with pytest.raises(ValueError, match="bound"):
        surface_ops.filter_normals(corners, np.zeros((3, 1)), CONTRAST, 1, 1, vertices)
    with pytest.raises(ValueError, match="contrast"):
        surface_ops.filter_normals(corners[:0], np.zeros(3), 0.0, 1, 1, vertices)


def test_noise_is_removed_where_photographs_have_little_texture():
    faint = [Shown(view, lambda x, y: 0.5 + 0.05 * (texture(x, y) - 0.5)) for view in ring()]
    mesh = rough(sheet(lambda x, y: np.zeros_like(x)), 0.1 * FOOTPRINT)
    smooth, middle = denoised(mesh, faint), inner(mesh)
    up = np.array([0, 0, 1.0])
    before, after = (np.degrees(np.arccos(vertex_normals(m)[middle] @ up)).mean() for m in (mesh, smooth))
    assert after < 0.5 * before
    assert np.abs(smooth.vertices[middle, 2]).mean() < 0.7 * np.abs(mesh.vertices[middle, 2]).mean()
    assert (smooth.faces == mesh.faces).all() and np.allclose(smooth.normals, vertex_normals(smooth))
    assert smooth.quality.dtype == np.float32 and np.isfinite(smooth.quality).all()


def test_vertices_with_good_photo_consistency_stay(monkeypatch):
    """The filter is replaced by one that lifts an exact plane by half a footprint."""
    shown, mesh = [Shown(view) for view in ring()], sheet(lambda x, y: np.zeros_like(x))
    monkeypatch.setattr(
        "linprim_geo.surface.finish.denoise.filtered", lambda mesh, bound: mesh.vertices + [0, 0, 0.5 * FOOTPRINT]
    )
    middle, stays = inner(mesh, 0.3), denoised(mesh, shown)
    assert np.abs(stays.vertices[middle, 2]).max() < 0.05 * FOOTPRINT
    told = predicted_error(mesh, [s.camera for s in shown], (s.load() for s in shown))
    np.testing.assert_allclose(stays.quality[middle], told[middle], rtol=0.05)
    low = replace(mesh, vertices=mesh.vertices - [0, 0, 0.5 * FOOTPRINT])
    assert np.abs(denoised(low, shown).vertices[middle, 2]).max() < 0.05 * FOOTPRINT


def test_a_surface_seen_by_one_photograph_is_unchanged():
    mesh = rough(sheet(lambda x, y: np.zeros_like(x)), 0.1 * FOOTPRINT)
    smooth = denoised(mesh, [Shown(view) for view in ring()[:1]])
    assert (smooth.vertices == mesh.vertices).all() and np.isnan(smooth.quality).all()
