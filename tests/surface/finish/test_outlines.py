"""Vertices on outlines are moved to the outlines of masks, tested with exact masks of known bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers.captures import ring

from linprim_geo.capture.types import Photo
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.kernels import ops
from linprim_geo.surface.finish.outlines import _covered, moved_to_outlines
from linprim_geo.surface.finish.self_intersections import crossings
from linprim_geo.surface.mesh_views import MeshViews

RADIUS, FINE = 1.0, 5
CAMERAS = ring(16, size=(112, 112), focal=130.0)
FOOTPRINT = np.median([np.linalg.norm(camera.center) for camera in CAMERAS]) / 130.0


class Masked:
    """A view whose mask is the share of FINE x FINE rays per pixel that hit a body; its photograph is black."""

    def __init__(self, camera, hits, alpha_of=lambda share: np.round(255 * share)):
        rays = camera.magnified(FINE).world_rays().reshape(-1, 3)
        shape = (camera.height, FINE, camera.width, FINE)
        share = hits(camera.center, rays).reshape(shape).mean((1, 3))
        self.camera = camera
        self.photo = Photo(np.zeros((*share.shape, 3), np.uint8), alpha_of(share).astype(np.uint8))

    def load(self):
        return self.photo


def of_ball(center, rays):
    length = np.linalg.norm(rays, axis=1)
    along = rays @ -center / length
    return center @ center - along**2 < RADIUS**2


def of_mesh(mesh):
    caster = RayCaster(mesh.vertices, mesh.faces)
    return lambda center, rays: caster.cast_single(center, rays)[1] >= 0


def ball(radius):
    made = trimesh.creation.icosphere(5, radius)
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces))


def block(half):
    made = trimesh.creation.box((2 * half, 2 * half, 2 * half))
    for _ in range(5):
        made = made.subdivide()
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces))


@pytest.fixture(scope="module")
def views():
    return [Masked(camera, of_ball) for camera in CAMERAS]


def off_by(mesh):
    """(V,) distance of vertices from the ball's surface in pixels."""
    return (np.linalg.norm(mesh.vertices, axis=1) - RADIUS) / FOOTPRINT


def moved_of(before, after):
    return np.linalg.norm(after.vertices - before.vertices, axis=1) > 1e-9


@pytest.mark.parametrize("pixels", [-0.3, 0.3])
def test_vertices_of_a_ball_move_to_the_outline_of_masks(views, pixels):
    mesh = ball(RADIUS + pixels * FOOTPRINT)
    found = moved_to_outlines(mesh, views)
    moved = moved_of(mesh, found)
    assert moved.mean() > 0.1
    assert np.abs(off_by(mesh)[moved]).mean() == pytest.approx(0.3, abs=0.01)
    assert np.abs(off_by(found)[moved]).mean() < 0.15  # many of these are on the outlines of only one or two views
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1)
    assert len(crossings(found)[0]) == 0


def test_worn_edges_of_a_block_are_restored():
    true = block(0.7)
    views = [Masked(camera, of_mesh(true)) for camera in CAMERAS]
    # Edges are worn as by voxels: half a pixel inside of both sides.
    worn = true.vertices.copy()
    edge = (np.abs(worn) > 0.7 - 1e-9).sum(1) >= 2
    worn[edge] *= 1 - 0.5 * FOOTPRINT / 0.7
    found = moved_to_outlines(replace(true, vertices=worn), views)
    moved = edge & moved_of(replace(true, vertices=worn), found)
    assert moved.sum() > 0.3 * edge.sum()
    before, after = (np.linalg.norm((v - true.vertices)[moved], axis=1).mean() for v in (worn, found.vertices))
    assert after < 0.6 * before
    flat = (np.abs(true.vertices) > 0.7 - 3 * FOOTPRINT).sum(1) < 2
    assert flat.sum() > 1000
    assert np.abs(found.vertices - worn)[flat].max() < 0.1 * FOOTPRINT


def test_a_correct_ball_stays(views):
    off = np.abs(off_by(moved_to_outlines(ball(RADIUS), views)))
    assert off.max() < 0.1 and off.mean() < 0.01


def test_covered_shares_of_pixels_agree_with_supersampling():
    face = Mesh(np.array([[-0.8, -0.5, 0.0], [0.9, -0.4, 0.1], [0.1, 0.8, -0.2]]), np.array([[0, 1, 2]]))
    for camera in CAMERAS[:3]:
        covered, _, near = _covered(camera, MeshViews(face.vertices, face.faces))
        wanted = Masked(camera, of_mesh(face)).photo.alpha / 255
        assert near.sum() > 50 and np.abs(covered - wanted)[near].mean() < 0.08


def test_binary_or_missing_masks_are_not_used():
    mesh = ball(RADIUS - 0.3 * FOOTPRINT)
    for alpha_of in (lambda share: 255 * (share > 0.5), lambda share: np.full_like(share, 255)):
        assert moved_to_outlines(mesh, [Masked(camera, of_ball, alpha_of) for camera in CAMERAS]) is mesh
    without = [Masked(camera, of_ball) for camera in CAMERAS]
    for view in without:
        view.photo = Photo(view.photo.rgb)
    assert moved_to_outlines(mesh, without) is mesh


def test_distant_outlines_are_ignored(views):
    mesh = ball(RADIUS - 3.5 * FOOTPRINT)
    np.testing.assert_array_equal(moved_to_outlines(mesh, views).vertices, mesh.vertices)


def test_an_unseen_mesh_is_unchanged(views):
    mesh = ball(RADIUS)
    mesh = replace(mesh, vertices=mesh.vertices + 100.0)
    np.testing.assert_array_equal(moved_to_outlines(mesh, views).vertices, mesh.vertices)


def test_an_empty_mesh_stays_empty(views):
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    assert moved_to_outlines(empty, views) is empty


def test_results_do_not_depend_on_threads(views, few_threads):
    mesh = ball(RADIUS - 0.2 * FOOTPRINT)
    found = moved_to_outlines(mesh, views).vertices
    ops.set_threads(3)
    np.testing.assert_array_equal(moved_to_outlines(mesh, views).vertices, found)
