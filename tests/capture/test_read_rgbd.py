"""RGB-D sequences of Redwood, Open3D and TUM, and trajectories of Tanks and Temples: pose, depth map and camera of each
photograph."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.captures import picture, ring
from PIL import Image
from scipy.spatial.transform import Rotation

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.readers.trajectories import nearest

SIZE = (640, 480)
JSON = {"width": 32, "height": 24, "intrinsic_matrix": [30, 0, 0, 0, 30, 0, 15.5, 11.5, 1]}


def refusal(path) -> str:
    with pytest.raises(LinprimError) as caught:
        load_scene(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def log(cameras, numbers=None) -> str:
    numbers = range(len(cameras)) if numbers is None else numbers
    blocks = []
    for number, camera in zip(numbers, cameras, strict=True):
        rows = "\n".join(" ".join(f"{value:.10f}" for value in row) for row in camera.camera_to_world)
        blocks.append(f"{number} {number} {number + 1}\n{rows}\n")
    return "".join(blocks)


def depth_image(index: int, size, steps_per_metre) -> Image.Image:
    values = np.full(size[::-1], (1 + 0.25 * index) * steps_per_metre)
    values[0, 0] = 0
    return Image.fromarray(values.astype(np.uint16))


def write_redwood(root, count=6, color="image", size=(32, 24), depth_name="{:05d}"):
    cameras = ring(count)
    (root / color).mkdir(parents=True)
    (root / "depth").mkdir()
    for i in range(count):
        picture(i, size).save(root / color / f"{i:05d}.jpg")
        depth_image(i, size, 1000).save(root / "depth" / f"{depth_name.format(i)}.png")
    (root / "trajectory.log").write_text(log(cameras))
    if size != SIZE:
        (root / "camera_intrinsic.json").write_text(json.dumps(JSON))
    return cameras


def write_tum(root, count=6):
    """Photographs every 33 ms; poses 4 ms and depth 7 ms later, with more poses between."""
    cameras = ring(count)
    for folder in ("rgb", "depth"):
        (root / folder).mkdir(parents=True)
    rgb, depth, poses = ["# color images"], ["# depth maps"], ["# timestamp tx ty tz qx qy qz qw"]
    for i, camera in enumerate(cameras):
        seconds = 1305031102.175304 + i / 30
        picture(i, SIZE).save(root / "rgb" / f"{seconds:.6f}.jpg")
        depth_image(i, SIZE, 5000).save(root / "depth" / f"{seconds + 0.007:.6f}.png")
        rgb.append(f"{seconds:.6f} rgb/{seconds:.6f}.jpg")
        depth.append(f"{seconds + 0.007:.6f} depth/{seconds + 0.007:.6f}.png")
        x, y, z, w = Rotation.from_matrix(camera.rotation.T).as_quat()
        tx, ty, tz = camera.center
        poses.append(f"{seconds + 0.004:.4f} {tx:.9f} {ty:.9f} {tz:.9f} {x:.9f} {y:.9f} {z:.9f} {w:.9f}")
        poses.append(f"{seconds + 0.014:.4f} 9 9 9 0 0 0 1")
    for name, lines in (("rgb", rgb), ("depth", depth), ("groundtruth", poses)):
        (root / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return cameras


@pytest.mark.parametrize("color, depth_name", [("image", "{:05d}"), ("color", "{:05d}"), ("rgb", "{:04d}-100")])
def test_redwood_frames_have_their_pose_depth_and_pinhole(tmp_path, color, depth_name):
    cameras = write_redwood(tmp_path, color=color, depth_name=depth_name)
    scene = load_scene(tmp_path)
    assert scene.kind == "rgbd" and scene.unit == "m" and len(scene.views) == 6
    for view in scene.views:
        index = int(view.name)
        np.testing.assert_allclose(view.camera.world_to_camera, cameras[index].world_to_camera, atol=1e-8)
        assert (view.camera.fx, view.camera.cx, view.camera.cy) == (30, 16, 12)
        depth = view.load_depth()
        assert depth[0, 0] == 0 and depth[1, 1] == pytest.approx(1 + 0.25 * index)


def test_the_default_camera_is_the_primesense(tmp_path):
    write_redwood(tmp_path, 3, size=SIZE)
    camera = load_scene(tmp_path).train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (525, 525, 320, 240)
    picture(1, (320, 240)).save(tmp_path / "image" / "00001.jpg")
    assert "the image is 320x240, wanted 640x480 as the PrimeSense had" in refusal(tmp_path)


def test_fewer_photographs_than_poses_are_matched_by_number(tmp_path):
    cameras = write_redwood(tmp_path, 7)
    for i in (1, 3, 5):
        (tmp_path / "image" / f"{i:05d}.jpg").unlink()
    views = load_scene(tmp_path).views
    assert sorted(view.name for view in views) == ["00000", "00002", "00004", "00006"]
    for view in views:
        np.testing.assert_allclose(view.camera.world_to_camera, cameras[int(view.name)].world_to_camera, atol=1e-8)
    (tmp_path / "image" / "00002.jpg").rename(tmp_path / "image" / "two.jpg")
    (tmp_path / "depth" / "00002.png").rename(tmp_path / "depth" / "two.png")
    assert "7 poses for 4 images, such as two.jpg" in refusal(tmp_path)


def test_more_photographs_than_poses_are_matched_by_number(tmp_path):
    cameras = write_redwood(tmp_path, 6)
    (tmp_path / "trajectory.log").write_text(log(cameras[1::2], [1, 3, 5]))
    views = load_scene(tmp_path).views
    assert sorted(view.name for view in views) == ["00001", "00003", "00005"]
    (tmp_path / "trajectory.log").write_text(log(cameras[1::2], [1, 3, 6]))
    assert "3 poses for 6 images" in refusal(tmp_path)


@pytest.mark.parametrize(
    "content, words",
    [
        ("", "no line that is not a comment"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n", "4 lines, wanted five for each frame"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 nan 0\n0 0 0 1\n", "not finite"),
        ("0 0 1\n1 0 0 0\n0 1 0\n0 0 1 0\n0 0 0 1\n", "not three whole numbers and a matrix"),
        ("a b c\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "not three whole numbers and a matrix"),
        ("0 0 1\n2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n", "not a rotation"),
        ("0 -1 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "no pose in it"),
    ],
)
def test_damaged_trajectories_are_named(tmp_path, content, words):
    write_redwood(tmp_path, 3)
    (tmp_path / "trajectory.log").write_text(content)
    message = refusal(tmp_path)
    assert words in message and "trajectory.log" in message


def test_missing_depth_maps_and_invalid_intrinsics_are_refused(tmp_path):
    write_redwood(tmp_path, 4)
    (tmp_path / "depth" / "00002.png").unlink()
    assert "3 depth maps for 4 images" in refusal(tmp_path)
    depth_image(2, (32, 24), 1000).save(tmp_path / "depth" / "00002.png")
    infinite, nested = json.dumps({**JSON, "width": float("inf")}), "[" * 100_000
    for content in (
        "{",
        nested,
        "[]",
        '{"width": 32}',
        infinite,
        json.dumps({**JSON, "intrinsic_matrix": [1, 2]}),
    ):
        (tmp_path / "camera_intrinsic.json").write_text(content)
        assert "camera_intrinsic.json: " in (said := refusal(tmp_path)) and "wanted " in said
    # Without a focal length; row by row, which puts the principal point where nothing may be; with skew.
    for matrix in (
        [0, 0, 0, 0, 30, 0, 15, 11, 1],
        [30, 0, 15, 0, 30, 11, 0, 0, 1],
        [30, 0, 0, 2, 30, 0, 15, 11, 1],
    ):
        (tmp_path / "camera_intrinsic.json").write_text(json.dumps({**JSON, "intrinsic_matrix": matrix}))
        assert "wanted fx 0 0 0 fy 0 cx cy 1" in refusal(tmp_path)


def test_tum_photographs_get_the_nearest_pose_and_depth(tmp_path):
    cameras = write_tum(tmp_path)
    scene = load_scene(tmp_path)
    assert scene.kind == "tum" and scene.unit == "m" and len(scene.views) == 6
    views = sorted(scene.views, key=lambda view: view.image_path.name)
    for index, (view, camera) in enumerate(zip(views, cameras, strict=True)):
        np.testing.assert_allclose(view.camera.world_to_camera, camera.world_to_camera, atol=1e-6)
        assert view.load_depth()[1, 1] == pytest.approx(1 + 0.25 * index, abs=1e-4)


def test_tum_photographs_need_a_pose_but_no_depth(tmp_path):
    write_tum(tmp_path)
    lines = (tmp_path / "groundtruth.txt").read_text().splitlines()
    (tmp_path / "groundtruth.txt").write_text("\n".join(lines[:1] + lines[3:]))
    lines = (tmp_path / "depth.txt").read_text().splitlines()
    (tmp_path / "depth.txt").write_text("\n".join(lines[:-1]))
    views = sorted(load_scene(tmp_path).views, key=lambda view: view.image_path.name)
    assert len(views) == 5 and [view.depth_path is None for view in views] == [False] * 4 + [True]
    (tmp_path / "depth.txt").unlink()
    assert all(view.depth_path is None for view in load_scene(tmp_path).views)


def test_damaged_tum_lists_are_named(tmp_path):
    write_tum(tmp_path, 3)
    for name, content, words in (
        ("groundtruth.txt", "# nothing\n", "no line that is not a comment"),
        ("groundtruth.txt", "1305031102.1 0 0 0 0 0 0\n", "row 1: .* is no pose"),
        ("groundtruth.txt", "1305031102.1 0 0 nan 0 0 0 1\n", "row 1: .* is no pose"),
        ("groundtruth.txt", "1305031102.1 0 0 0 0 0 0 0\n", "row 1: .* is no pose"),
        ("groundtruth.txt", "1305031102.1 0 0 0 0 0 0 1e300\n", "row 1: .* is no pose"),
        ("groundtruth.txt", "5.0 0 0 0 0 0 0 1\n", "no pose within 0.02 s of any of the 3 photographs"),
        ("rgb.txt", "now rgb/1.jpg\n", "row 1: .* wanted a timestamp and a file name"),
        ("rgb.txt", "1305031102.175304 rgb/none.jpg\n", "none.jpg is not on disk"),
        ("depth.txt", "1305031102.1\n", "wanted a timestamp and a file name"),
    ):
        before = (tmp_path / name).read_text()
        (tmp_path / name).write_text(content)
        with pytest.raises(LinprimError, match=words):
            load_scene(tmp_path)
        (tmp_path / name).write_text(before)
    assert len(load_scene(tmp_path).views) == 3


def test_tum_lists_may_have_absolute_paths(tmp_path):
    write_tum(tmp_path / "lists")
    text = (tmp_path / "lists" / "rgb.txt").read_text()
    (tmp_path / "lists" / "rgb.txt").write_text(text.replace(" rgb/", f" {tmp_path}/photos/"))
    (tmp_path / "lists" / "rgb").rename(tmp_path / "photos")
    assert len(load_scene(tmp_path / "lists").views) == 6


def test_nearest_finds_timestamps_within_a_limit():
    found = nearest(np.array([0.0, 1.0, 2.0]), np.array([-0.3, 0.4, 0.6, 1.0, 9.0]), 0.45)
    np.testing.assert_array_equal(found, [0, 0, 1, 1, -1])


@pytest.mark.parametrize("folder", ["images", "Barn", "."])
def test_tanks_and_temples_is_read_by_its_trajectory(tmp_path, folder):
    cameras = ring(8)
    (tmp_path / folder).mkdir(exist_ok=True)
    for i in range(8):
        picture(i).save(tmp_path / folder / f"{i + 1:06d}.jpg")
    (tmp_path / "Barn_COLMAP_SfM.log").write_text(log(cameras).replace("5 5 6\n", "5 -1 0\n"))
    (tmp_path / "Barn.json").write_text("{}")
    assert "a trajectory without intrinsics, wanted a COLMAP model in sparse/0, or intrinsics.json" in refusal(tmp_path)
    (tmp_path / "intrinsics.json").write_text(json.dumps(JSON))
    scene = load_scene(tmp_path)
    assert scene.kind == "tnt" and "000006" not in {view.name for view in scene.views} and len(scene.views) == 7
    for view in scene.views:
        np.testing.assert_allclose(view.camera.world_to_camera, cameras[int(view.name) - 1].world_to_camera, atol=1e-8)
        assert (view.camera.fx, view.camera.cx) == (30, 16)


def test_an_absurd_image_width_is_refused(tmp_path):
    (tmp_path / "images").mkdir()
    for i in range(8):
        picture(i).save(tmp_path / "images" / f"{i + 1:06d}.jpg")
    (tmp_path / "Barn_COLMAP_SfM.log").write_text(log(ring(8)))
    (tmp_path / "intrinsics.json").write_text(json.dumps({**JSON, "width": 10**300}))
    assert "the image is 32x24, wanted 1000" in refusal(tmp_path)
