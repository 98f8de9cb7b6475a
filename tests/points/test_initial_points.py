"""Normalisation of scenes and initial points, for cameras and silhouettes with a known solution."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import OPENGL, look_at, picture, ring, transforms
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.types import PointCloud, Scene, View
from linprim_geo.geometry.region import focus_point
from linprim_geo.points.initial_points import (
    CAMERA_DISTANCE,
    _colors,
    evenly_spread_views,
    frusta_points,
    scene_normalization,
    visual_hull_points,
)

PLACE = np.array([100.0, -40.0, 7.0])
RADIUS = 0.8


def scene_of(cameras, xyz=None) -> Scene:
    views = tuple(View(str(i), camera, Path(f"{i}.png")) for i, camera in enumerate(cameras))
    points = None if xyz is None else PointCloud(xyz, np.zeros((len(xyz), 3), np.uint8))
    return Scene(Path("here"), "test", views, (), points)


def moved(cameras):
    return [look_at(c.center + PLACE, PLACE, size=(c.width, c.height), focal=c.fx) for c in cameras]


def distances(scene, similarity):
    return np.array([np.linalg.norm(view.camera.transformed(similarity).center) for view in scene.train])


def test_normalised_cameras_around_an_object_have_the_given_median_distance():
    scene = scene_of(moved(ring(9)))
    similarity = scene_normalization(scene)
    np.testing.assert_allclose(similarity.offset, PLACE, atol=1e-9)
    np.testing.assert_allclose(np.median(distances(scene, similarity)), CAMERA_DISTANCE)


def test_points_determine_the_normalisation_if_given():
    # the object is not where the axes meet, but a quarter of the way towards it
    cameras = [look_at(c, (0, 0, 0)) for c in np.array([[4.0, 0.2 * i, 0.1 * i] for i in range(-4, 5)])]
    xyz = np.random.default_rng(0).normal(0, 0.1, (500, 3)) + [3.0, 0, 0]
    similarity = scene_normalization(scene_of(cameras, xyz))
    np.testing.assert_allclose(similarity.offset, [3, 0, 0], atol=0.05)
    np.testing.assert_allclose(similarity.scale, CAMERA_DISTANCE / 1.0, rtol=0.1)
    # far background points in a corner of few images do not move it
    far = np.concatenate([xyz, np.random.default_rng(1).normal(0, 5, (60, 3)) + [-80, 20, 0]])
    again = scene_normalization(scene_of(cameras, far))
    np.testing.assert_allclose(again.offset, similarity.offset, atol=0.02)


def test_points_behind_every_camera_are_ignored():
    cameras = [look_at((4.0, 0.3 * i, 0.2 * i)) for i in range(-4, 5)]
    similarity = scene_normalization(scene_of(cameras, np.full((50, 3), 30.0)))
    np.testing.assert_allclose(similarity.offset, [0, 0, 0], atol=1e-9)


def test_focus_is_robust_to_outlier_cameras():
    cameras = ring(20)
    cameras[3] = look_at(cameras[3].center, (3.0, 9.0, 4.0))
    cameras[11] = look_at(cameras[11].center, (-7.0, 1.0, 6.0))
    np.testing.assert_allclose(scene_normalization(scene_of(cameras)).offset, [0, 0, 0], atol=1e-6)


def test_outward_cameras_are_centred_at_their_median():
    inside_out = [look_at(PLACE + c.center, PLACE + 2 * c.center) for c in ring(12, radius=1.0)]
    scene = scene_of(inside_out)
    centers = np.array([camera.center for camera in inside_out])
    axes = np.array([camera.rotation[2] for camera in inside_out])
    assert focus_point(centers, axes) is None
    similarity = scene_normalization(scene)
    np.testing.assert_allclose(similarity.offset, np.median(centers, axis=0))
    np.testing.assert_allclose(np.median(distances(scene, similarity)), CAMERA_DISTANCE)


def test_parallel_cameras_have_no_focus():
    parallel = [look_at((0.3 * i, -4, 0.1 * i), (0.3 * i, 0, 0.1 * i)) for i in range(6)]
    similarity = scene_normalization(scene_of(parallel))
    assert np.isfinite(similarity.scale) and np.isfinite(similarity.offset).all()
    np.testing.assert_allclose(np.median(distances(scene_of(parallel), similarity)), CAMERA_DISTANCE)


def test_cameras_in_one_place_without_points_are_refused():
    turning = [look_at((1, 2, 3), (np.cos(a) + 1, np.sin(a) + 2, 3)) for a in np.linspace(0, 6, 9)]
    with pytest.raises(LinprimError, match="all cameras are in one place"):
        scene_normalization(scene_of(turning))


def silhouettes(root, cameras, half_size=None, color=(200, 60, 20)):
    """RGBA images of a ball at PLACE; the transparent part hides another colour."""
    paths = []
    for i, camera in enumerate(cameras):
        rays = camera.world_rays()
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        to = PLACE - camera.center
        miss = np.linalg.norm(np.cross(rays, to), axis=-1)
        alpha = np.where((miss <= RADIUS) & (rays @ to > 0), 255, 0).astype(np.uint8)
        rgb = np.where(alpha[..., None] > 0, np.array(color), np.array([0, 0, 255])).astype(np.uint8)
        Image.fromarray(np.concatenate([rgb, alpha[..., None]], axis=2)).save(root / f"{i:02d}.png")
        paths.append(f"{i:02d}.png")
    (root / "transforms.json").write_text(json.dumps(transforms(cameras, paths)))
    return load_scene(root)


def sphere_ring(count=24, **options):
    """Cameras all over a sphere round PLACE."""
    directions = np.random.default_rng(5).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return [look_at(PLACE + 4 * d, PLACE, size=(96, 80), focal=110.0, **options) for d in directions]


def test_visual_hull_of_a_ball_is_the_ball(tmp_path):
    scene = silhouettes(tmp_path, sphere_ring())
    cloud = visual_hull_points(scene, 5000, seed=1)
    assert cloud.xyz.shape == (5000, 3) and cloud.rgb.shape == (5000, 3)
    distance = np.linalg.norm(cloud.xyz - PLACE, axis=1)
    # The hull of 21 silhouettes is a little more than the ball; a pixel is 4 / 110 = 0.036 wide there.
    assert distance.max() < RADIUS * 1.25 + 0.04
    # uniform in the volume: the share within half the radius is an eighth, or less as the hull is larger
    inner = (distance < RADIUS / 2).mean()
    assert 0.125 / 1.25 < inner < 0.125 * 1.1
    np.testing.assert_allclose(cloud.xyz.mean(axis=0), PLACE, atol=0.05)
    np.testing.assert_allclose(cloud.rgb, np.broadcast_to([200, 60, 20], (5000, 3)), atol=1)
    again = visual_hull_points(scene, 5000, seed=1)
    np.testing.assert_array_equal(again.xyz, cloud.xyz)
    assert (visual_hull_points(scene, 5000, seed=2).xyz != cloud.xyz).any()


def test_colors_come_from_the_foreground_only(tmp_path):
    # The pixels beside the ball hide blue: a point there has no colour of its own and gets the ball's.
    scene = silhouettes(tmp_path, sphere_ring(8))
    beside = PLACE + np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [0.1, 0.1, 0.1]])
    colors = _colors(beside, evenly_spread_views(scene.train, 8))
    np.testing.assert_allclose(colors, np.broadcast_to([200, 60, 20], (4, 3)), atol=1)


def test_visual_hull_of_an_object_cut_off_by_images(tmp_path):
    # so close that the ball fills the image: nothing is known outside, and nothing inside of it is lost
    near = [look_at(PLACE + 0.45 * (c.center - PLACE), PLACE, size=(96, 80), focal=150.0) for c in sphere_ring()]
    scene = silhouettes(tmp_path, sphere_ring()[:12] + near[12:])
    distance = np.linalg.norm(visual_hull_points(scene, 3000, seed=0).xyz - PLACE, axis=1)
    assert np.quantile(distance, 0.99) < RADIUS * 1.6
    assert 0.125 / 2.5 < (distance < RADIUS / 2).mean() < 0.125 * 1.2


def test_masks_that_do_not_fit_the_cameras_are_refused(tmp_path):
    cameras = sphere_ring(12)
    scene = silhouettes(tmp_path, cameras)
    for i in range(0, 12, 2):  # empty masks in half of the views
        Image.new("RGBA", (96, 80)).save(tmp_path / f"{i:02d}.png")
    with pytest.raises(LinprimError, match="no point is foreground in the masks"):
        visual_hull_points(scene, 100, seed=0)


def test_a_scene_without_masks_has_no_visual_hull(tmp_path):
    with pytest.raises(LinprimError, match="no alpha channel and no masks"):
        visual_hull_points(scene_of(ring(5)), 10, 0)


def test_frusta_points_are_seen_by_three_cameras_and_take_their_colours(tmp_path):
    cameras = moved(ring(10, size=(32, 24)))
    paths = [f"{i}.png" for i in range(10)]
    for path in paths:
        Image.new("RGB", (32, 24), (10, 90, 170)).save(tmp_path / path)
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(cameras, paths)))
    scene = load_scene(tmp_path)
    cloud = frusta_points(scene, 2000, seed=0)
    seen = np.zeros(2000, dtype=int)
    for view in scene.train:
        pixels, depth = view.camera.project(cloud.xyz)
        with np.errstate(invalid="ignore"):
            seen += (depth > 0) & (pixels > 0).all(1) & (pixels < [32, 24]).all(1)
    assert cloud.xyz.shape == (2000, 3) and seen.min() >= 3
    assert (cloud.rgb == [10, 90, 170]).all()
    np.testing.assert_array_equal(frusta_points(scene, 2000, seed=0).xyz, cloud.xyz)


def test_frusta_points_of_two_cameras_without_overlap(tmp_path):
    poses = [look_at((1, 0, 0), (5, 0, 0)), look_at((-1, 0, 0), (-5, 0, 0))]
    frames = []
    for i, camera in enumerate(poses):
        picture(i).save(tmp_path / f"{i}.png")
        frames.append({"file_path": f"{i}.png", "transform_matrix": (camera.camera_to_world @ OPENGL).tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))
    assert frusta_points(load_scene(tmp_path), 100, seed=0).xyz.shape == (100, 3)
