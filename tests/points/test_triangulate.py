"""Triangulated points compared with the walls of a textured room, for exact cameras."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.captures import OPENGL, look_at
from helpers.textured_room import HALF, photograph, wall_texture
from PIL import Image

from linprim_geo.base.errors import DiskFull, LinprimError
from linprim_geo.base.options import TrainOptions
from linprim_geo.capture.load import load_scene
from linprim_geo.geometry.feature_points import (
    ObservedPoints,
    matching_pairs,
    not_isolated,
    posed_model,
    reliable_points,
    sampson_px,
    verify_matches,
)
from linprim_geo.points.start_points import with_points
from linprim_geo.points.triangulate import triangulate_points

SIZE, FOCAL = (200, 150), 170.0


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A folder with 7 views (one held out) of a corner of the room."""
    root = tmp_path_factory.mktemp("room")
    frames = []
    for i in range(7):
        camera = look_at((-0.9 + 0.25 * i, -1.0 + 0.1 * i, 0.3 * np.sin(2.0 * i)), (1.5, 2.0, 0.2), SIZE, FOCAL)
        Image.fromarray(photograph(camera)).save(root / f"{i}.png")
        frames.append({"file_path": f"{i}.png", "transform_matrix": (camera.camera_to_world @ OPENGL).tolist()})
    header = {"w": SIZE[0], "h": SIZE[1], "fl_x": FOCAL, "fl_y": FOCAL, "frames": frames}
    (root / "transforms.json").write_text(json.dumps(header))
    return root


def test_points_lie_on_the_walls_with_their_colours(room, tmp_path):
    lines = []
    cloud = triangulate_points(load_scene(room), cache=tmp_path, log=lines.append, threads=2)
    assert len(cloud.xyz) > 150
    off = np.abs(np.abs(cloud.xyz).max(axis=1) - HALF)
    # A keypoint is good to a few tenths of a pixel; at depth 3.5, focal 170 and a parallax of 10 degrees or
    # more, 0.1 px is 0.012 in depth.
    assert np.median(off) < 0.012
    assert np.quantile(off, 0.95) < 0.15
    difference = np.abs(cloud.rgb - wall_texture(cloud.xyz)).mean(axis=1)
    assert np.median(difference) < 12
    assert cloud.error_px.shape == (len(cloud.xyz),) and cloud.error_px.max() <= 1.5
    assert len(lines) == 2 and str(len(cloud.xyz)) in lines[1]
    # the second time it comes from the cache, the same to the bit
    again = triangulate_points(load_scene(room), cache=tmp_path, log=lines.append)
    np.testing.assert_array_equal(again.xyz, cloud.xyz)
    assert len(lines) == 3 and ".npz" in lines[2]
    half = load_scene(room, downscale=2)
    assert not np.array_equal(triangulate_points(half, cache=tmp_path, threads=2).xyz.shape, cloud.xyz.shape)


def test_the_same_seed_gives_the_same_points(room, tmp_path):
    first = triangulate_points(load_scene(room), cache=tmp_path / "a", threads=2)
    second = triangulate_points(load_scene(room), cache=tmp_path / "b", threads=1)
    np.testing.assert_array_equal(first.xyz, second.xyz)


def test_images_without_texture_give_no_points(tmp_path):
    frames = []
    for i in range(3):
        Image.new("RGB", (64, 48), (90, 90, 90)).save(tmp_path / f"{i}.png")
        pose = look_at((0.3 * i, -3, 0), size=(64, 48)).camera_to_world @ OPENGL
        frames.append({"file_path": f"{i}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 60.0, "frames": frames}))
    with pytest.raises(LinprimError, match="only 0 points could be triangulated from 2 images"):
        triangulate_points(load_scene(tmp_path), cache=tmp_path / "cache")


def test_matching_pairs_are_neighbours_with_similar_directions(room):
    cameras = [view.camera for view in load_scene(room).train]
    pairs = matching_pairs(cameras, partners=2)
    assert all(i < j for i, j in pairs) and len(set(pairs)) == len(pairs)
    assert (0, 1) in pairs and (0, len(cameras) - 1) not in pairs
    away = look_at(cameras[0].center, cameras[0].center - cameras[0].rotation[2])
    assert matching_pairs([cameras[0], away]) == []


def test_isolated_points_are_dropped():
    rng = np.random.default_rng(0)
    wall = np.concatenate([rng.uniform(0, 4, (500, 2)), np.zeros((500, 1))], axis=1)
    stray = np.array([[2.0, 2.0, 30.0], [-9.0, 0.0, 1.0], [-9.0, 0.5, 1.2]])
    keep = not_isolated(np.concatenate([wall, stray]), np.full(503, 3.0))
    assert keep[:500].mean() > 0.98 and not keep[500:].any()
    # A far wall is kept like a near one if the angular spacing of its points is the same.
    far = wall * 20 + [0, 0, 60]
    keep = not_isolated(np.concatenate([wall, far]), np.r_[np.full(500, 3.0), np.full(500, 60.0)])
    assert keep.mean() > 0.98


def test_unreliable_points_are_dropped(room):
    cameras = [view.camera for view in load_scene(room).train]
    rng = np.random.default_rng(0)
    wall = np.concatenate([rng.uniform(-1, 1, (200, 1)), np.full((200, 1), 2.0), rng.uniform(-1, 1, (200, 1))], axis=1)
    odd = {
        "error of three": (1.6, [0, 2, 5]),
        "error of two": (0.6, [0, 5]),
        "angle": (0.1, [3]),
        "fine": (0.1, [0, 5]),
    }
    xyz = np.concatenate([wall, np.full((4, 3), [0.0, 2.0, 0.0]), [[0.0, 20.0, 0.0]]])
    error = np.array([0.1] * 200 + [value for value, _ in odd.values()] + [0.1])
    tracks = [[0, 2, 5]] * 200 + [track for _, track in odd.values()] + [[0, 5]]

    def points(xyz):
        point = np.repeat(np.arange(len(xyz)), [len(track) for track in tracks])
        colors, pixels = np.zeros((len(xyz), 3), np.uint8), np.zeros((len(point), 2))
        return ObservedPoints(xyz, colors, error, point, np.concatenate(tracks), pixels)

    keep = reliable_points(cameras, points(xyz))
    assert keep[:200].mean() > 0.98
    assert keep[200:].tolist() == [False, False, False, True, False]
    near_wall = xyz.copy()
    near_wall[-1] = [0.0, 2.0, 0.1]  # the last one was dropped for its place alone
    assert reliable_points(cameras, points(near_wall))[-1]


def test_sampson_distance_is_in_pixels(room):
    first, second = (load_scene(room).train[i].camera for i in (0, 4))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)) + [1.5, 2.0, 0.2]
    one, two = first.project(points)[0], second.project(points)[0]
    assert sampson_px(first, second, one, two).max() < 1e-9
    # The epipolar line in the second image, from two depths on the same ray; the step across it is 5 px.
    farther = second.project(first.center + 1.01 * (points - first.center))[0]
    along = (farther - two) / np.linalg.norm(farther - two, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    assert sampson_px(first, second, one, two + 5 * along).max() < 1e-6
    # Sampson's distance shares the step between both images: 5 / sqrt(2) if both see the scene at the same
    # size; these two differ by a fifth or so.
    np.testing.assert_allclose(sampson_px(first, second, one, two + 5 * across), 5 / np.sqrt(2), rtol=0.25)


def test_matches_off_the_epipolar_lines_are_dropped(room, tmp_path):
    import pycolmap

    views = load_scene(room).train
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (6, 3)) + [1.5, 2.0, 0.2]
    one, two = (views[i].camera.project(points)[0] for i in (0, 4))
    two[4:] += 20 * np.array([0.5, np.sqrt(0.75)])  # far off any epipolar line of these cameras, which run sideways
    posed_model([view.camera for view in views], tmp_path / "db")
    with pycolmap.Database.open(tmp_path / "db") as database:
        for i in range(len(views)):
            keypoints = {0: one, 4: two}.get(i, np.zeros((1, 2)))
            database.write_keypoints(i + 1, keypoints.astype(np.float32))
        database.write_matches(1, 5, np.repeat(np.arange(6, dtype=np.uint32)[:, None], 2, axis=1))
    verify_matches([view.camera for view in views], tmp_path / "db", [(0, 4), (1, 2)])
    with pycolmap.Database.open(tmp_path / "db") as database:
        kept = database.read_two_view_geometry(1, 5).inlier_matches
        assert not database.exists_two_view_geometry(2, 3)
    assert kept[:, 0].tolist() == kept[:, 1].tolist() == [0, 1, 2, 3]


def test_full_disk_is_raised_instead_of_using_random_points(room, monkeypatch):
    scene, options = load_scene(room), TrainOptions(max_primitives=100)

    def failing(error):
        return lambda *_, **__: (_ for _ in ()).throw(error)

    monkeypatch.setattr("linprim_geo.points.triangulate.triangulate_points", failing(LinprimError("too few matches")))
    assert len(with_points(scene, options, lambda _: None).points.xyz) > 0
    monkeypatch.setattr("linprim_geo.points.triangulate.triangulate_points", failing(DiskFull("no space left")))
    with pytest.raises(DiskFull):
        with_points(scene, options, lambda _: None)


def test_full_disk_while_writing_keypoints_is_reported(room, monkeypatch, tmp_path):
    monkeypatch.setattr("linprim_geo.base.files._disk_is_full", lambda _: True)
    monkeypatch.setattr(
        "linprim_geo.geometry.feature_points._match",
        lambda *_: (_ for _ in ()).throw(RuntimeError("database or disk is full")),
    )
    with pytest.raises(DiskFull, match=r"database\.db: no space left"):
        triangulate_points(load_scene(room), cache=tmp_path)
