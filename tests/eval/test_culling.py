"""Culling of samples by cameras, compared with closed forms and float64 rays, and distances along rays."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.surfaces import SCORES, camera_above, grid, join, sphere

from linprim_geo.eval.culling import compare_along_rays, count_views
from linprim_geo.eval.mesh import score_mesh
from linprim_geo.eval.surface_samples import sample_surface
from linprim_geo.geometry.raycast import RayCaster

ROUNDING = 1e-14


def test_the_visible_share_of_a_sphere_agrees_with_the_closed_form():
    result = score_mesh(sphere(1.1, 5), sphere(1.0, 5), samples=40_000, cameras=[camera_above(3.0)])
    # A point is seen where its normal turns to the camera: cos > r / d, a cap of (1 - r / d) / 2 of the area.
    # The faceted outline is off by up to an edge, 0.06, of its circumference at the silhouette.
    assert result["visible"]["kept_prediction"] == pytest.approx((1 - 1.1 / 3.0) / 2, abs=0.004)
    assert result["visible"]["kept_reference"] == pytest.approx((1 - 1.0 / 3.0) / 2, abs=0.004)
    assert result["visible"]["chamfer"] == pytest.approx(0.1, abs=2e-3)
    below = np.eye(4)
    below[2, 3] = 3.0
    both = [camera_above(3.0), replace(camera_above(3.0), world_to_camera=below)]
    both = score_mesh(sphere(1.1, 5), sphere(1.0, 5), samples=40_000, cameras=both)["visible"]
    assert both["kept_prediction"] == pytest.approx(2 * result["visible"]["kept_prediction"], abs=0.002)


def test_hidden_surfaces_count_only_without_culling():
    front, behind = grid(20, 10), grid(20, 10, height=-0.4)
    cameras = [camera_above(2.0, target=(1.0, 0.5))]
    result = score_mesh(join(front, behind), front, samples=4000, cameras=cameras)
    assert result["accuracy"] == pytest.approx(0.2, abs=1e-3) and result["precision"] == pytest.approx(0.5, abs=1e-3)
    visible = result["visible"]
    assert visible["accuracy"] < ROUNDING and visible["precision"] == 1.0 and visible["f1"] == 1.0
    # Seen from a height of 2, the upper sheet hides 1.2 times its size at the lower one, 0.4 below it.
    assert visible["kept_prediction"] == pytest.approx(0.5, abs=1e-3) and visible["kept_reference"] == 1.0
    assert SCORES <= set(visible)
    assert {"chamfer_percent_diagonal", "standard_error_percent_diagonal"} <= set(visible)


def test_samples_outside_of_images_are_culled():
    # The image shows x in [0, 1] of the [0, 2] x [0, 1] rectangle: half of it.
    camera = camera_above(1.0, focal=200.0, target=(0.5, 0.5))
    result = score_mesh(grid(height=0.0), grid(), samples=8000, cameras=[camera])
    assert result["visible"]["kept_reference"] == pytest.approx(0.5, abs=2e-3)


def test_cameras_that_see_nothing_give_nan_for_visible_scores_only():
    away = [camera_above(-1.0)]  # looks down from below
    result = score_mesh(grid(height=0.1), grid(), samples=500, cameras=away)
    assert result["visible"]["kept_prediction"] == 0.0 and math.isnan(result["visible"]["chamfer"])
    assert math.isnan(result["visible"]["f1"])
    assert result["chamfer"] == pytest.approx(0.1)
    assert score_mesh(grid(), grid(), samples=500, cameras=[])["visible"]["kept_reference"] == 0.0
    assert "visible" not in score_mesh(grid(), grid(), samples=500)


def test_culling_by_embree_agrees_with_float64_rays():
    import igl

    # Two crossing spheres and a wall: much is hidden, by others and by itself.
    mesh = join(sphere(1.0, 4), sphere(0.7, 4, (0.9, 0.2, 0.3)), grid(9, 9, height=-0.8))
    points, face = sample_surface(mesh, 20_000, 0)
    tree = igl.AABB()
    tree.init(mesh.vertices, mesh.faces)
    caster = RayCaster(mesh.vertices, mesh.faces)
    slack = 1e-5 * mesh.diagonal
    for camera in (camera_above(3.0), camera_above(5.0, target=(1.0, -0.6))):
        seen = count_views(caster, points, [camera], slack, faces=face) > 0
        ray = points - camera.center
        hit, distance, _ = tree.intersect_ray_first(
            mesh.vertices, mesh.faces, np.tile(camera.center, (len(ray), 1)), ray
        )
        reached = (distance >= 1.0 - slack / np.linalg.norm(ray, axis=1)) | (hit == face)
        pixel, depth = camera.project(points)
        inside = (depth > 0) & (pixel >= 0).all(1) & (pixel < (camera.width, camera.height)).all(1)
        assert 0.1 < seen.mean() < 0.6
        # They may differ only where a float32 ray leaves the silhouette by 1e-6 of the diagonal.
        assert (seen != (reached & inside)).sum() <= 2
    # Rays of this sample that slip between triangles would be re-cast; aimed into faces, none does.
    assert caster.recast == 0


# --- along the rays of the cameras ---------------------------------------------------------------------------


def test_ray_distances_of_an_offset_plane_agree_with_the_closed_form():
    camera = camera_above(3.0, target=(1.0, 0.5))
    # 200 x 200 pixels at focal length 100 see 6 x 6 around the target, which both planes fill.
    plane = replace(grid(5, 5), vertices=8 * grid(5, 5, (1.0, 1.0)).vertices - [3, 3.5, 0])
    lower = replace(plane, vertices=plane.vertices - [0, 0, 0.25])
    result = compare_along_rays(lower, plane, [camera], rays=10**6, tau=0.3)
    slant = np.linalg.norm(camera.ray_grid(), axis=2)
    assert result["rays"] == 200 * 200 and result["both"] == 1.0 and result["miss"] == 0.0
    assert result["distance_mean"] == pytest.approx(0.25 * slant.mean(), rel=1e-9)
    assert result["distance_signed_mean"] == pytest.approx(result["distance_mean"])
    assert result["within_tau"] == pytest.approx((0.25 * slant <= 0.3).mean(), abs=1e-4)
    assert math.isnan(result["phantom"])  # there is no ray without a reference
    swapped = compare_along_rays(plane, lower, [camera], rays=5000, tau=0.3, seed=2)
    assert swapped["rays"] == 5000 and swapped["distance_signed_mean"] < 0
    assert swapped["distance_mean"] == pytest.approx(result["distance_mean"], abs=4 * swapped["standard_error"])


def test_misses_and_phantoms_are_shares_of_possible_rays():
    left, right = grid(3, 3, size=(1.0, 1.0)), grid(3, 3, size=(1.0, 1.0))
    right = replace(right, vertices=right.vertices + [0.5, 0.0, 0.0])
    # The image shows [-0.5, 1.5] x [-0.5, 1.5]: 1/4 is left, half of it shared with right.
    camera = camera_above(1.0, focal=100.0, target=(0.5, 0.5))
    result = compare_along_rays(right, left, [camera, camera], rays=10**6, tau=0.1)
    assert result["rays"] == 2 * 200 * 200
    assert result["both"] == pytest.approx(1 / 8, abs=0.01) and result["miss"] == pytest.approx(1 / 2, abs=0.01)
    assert result["phantom"] == pytest.approx(1 / 6, abs=0.01)  # 1/8 of the 3/4 without left
    assert result["within_tau"] == pytest.approx(1 / 2, abs=0.01) and result["distance_mean"] < 1e-12
    nobody = compare_along_rays(right, left, [], rays=100, tau=0.1)
    assert nobody["rays"] == 0 and math.isnan(nobody["miss"])


def test_rays_through_edges_and_vertices_hit():
    # Pixel centres that fall onto the vertices, edges and diagonals of the plane, 1e6 away from the origin.
    away = np.array([1e6, -2e6, 5e5])
    plane = grid(16, 16, size=(2.0, 2.0))
    camera = camera_above(1.0, focal=16.0, target=(1.0 + 1 / 32, 1.0 + 1 / 32))
    camera = replace(camera, width=32, height=32, cx=16.0, cy=16.0)
    move = np.eye(4)
    move[:3, 3] = -away
    far = replace(camera, world_to_camera=camera.world_to_camera @ move)
    lower = replace(plane, vertices=plane.vertices - [0, 0, 1.0])
    for eye, shift in ((camera, 0.0), (far, away)):
        pair = [
            join(replace(m, vertices=m.vertices + shift), replace(lower, vertices=lower.vertices + shift))
            for m in (plane, plane)
        ]
        result = compare_along_rays(*pair, [eye], rays=10**6, tau=0.1)
        assert result["distance_mean"] == 0.0
        depth = RayCaster(pair[0].vertices, pair[0].faces).render_depth(eye)[0]
        inside = np.isfinite(depth)
        assert inside.mean() > 0.9 and np.abs(depth[inside] - 1.0).max() < 2e-9  # nobody fell through to 2
