"""ScanNet++ scenes: images, cameras, split and coordinate frame, and errors for damaged files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.captures import OPENGL, picture, reconstruction, ring

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import load_scene

FISHEYE = [30.0, 30.0, 16.0, 12.0, 0.01, -0.002, 0.001, 0.0]
# nerfstudio's world, from COLMAP's.
APPLIED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])


def transforms(cameras, names, applied=True, **intrinsics) -> str:
    matrix = np.vstack([APPLIED, [0, 0, 0, 1]])
    frames = [
        {
            "file_path": name,
            "mask_path": name.replace("JPG", "png"),
            "transform_matrix": (matrix @ c.camera_to_world @ OPENGL).tolist(),
        }
        for c, name in zip(cameras, names, strict=True)
    ]
    header = {
        "w": 32,
        "h": 24,
        "fl_x": 30.0,
        "fl_y": 30.0,
        "cx": 16.0,
        "cy": 12.0,
        "has_mask": True,
        **intrinsics,
    }
    header |= {"frames": frames[:-2], "test_frames": frames[-2:]}
    if applied:
        header["applied_transform"] = APPLIED.tolist()
    return json.dumps(header)


def write_dslr(root, distorted=True, undistorted=False, colmap=True):
    """A scene's folder with 7 images for training and 2 held out; returns the cameras and points."""
    cameras, dslr = ring(9), root / "dslr"
    names = [f"DSC{i:05d}.JPG" for i in range(9)]
    for folder in (
        ["resized_images"] * distorted + ["resized_undistorted_images"] * undistorted + ["resized_anon_masks"]
    ):
        (dslr / folder).mkdir(parents=True)
        for i, name in enumerate(names):
            picture(i).save(dslr / folder / name, format="JPEG")
    (dslr / "nerfstudio").mkdir()
    distortion = dict(zip(("k1", "k2", "k3", "k4"), FISHEYE[4:], strict=True))
    (dslr / "nerfstudio/transforms.json").write_text(
        transforms(cameras, names, camera_model="OPENCV_FISHEYE", **distortion)
    )
    (dslr / "nerfstudio/transforms_undistorted.json").write_text(
        transforms(cameras, names, camera_model="PINHOLE", fl_x=25.0, fl_y=25.0)
    )
    (dslr / "train_test_lists.json").write_text(
        json.dumps({"train": names[:-2], "test": names[-2:], "has_masks": True})
    )
    xyz = np.random.default_rng(3).uniform(-0.5, 0.5, (12, 3))
    if colmap:
        (dslr / "colmap").mkdir()
        reconstruction(cameras, names, xyz, "OPENCV_FISHEYE", FISHEYE).write_text(str(dslr / "colmap"))
    (root / "scans").mkdir()
    (root / "scans/mesh_aligned_0.05.ply").touch()
    return cameras, xyz


def check(scene, cameras):
    assert scene.kind == "scannetpp" and scene.unit == "m" and not scene.has_alpha
    assert [view.name for view in scene.test] == ["DSC00007", "DSC00008"] and len(scene.train) == 7
    for view in scene.views:
        wanted = cameras[int(view.name[3:])].world_to_camera
        np.testing.assert_allclose(view.camera.world_to_camera, wanted, atol=1e-9)


@pytest.mark.parametrize("inside", [".", "dslr"])
def test_fisheye_images_are_read_with_colmap_poses(tmp_path, inside):
    cameras, xyz = write_dslr(tmp_path, undistorted=True)
    scene = load_scene(tmp_path / inside)
    check(scene, cameras)
    assert scene.train[0].lens.model == "OPENCV_FISHEYE" and scene.train[0].image_path.parent.name == "resized_images"
    np.testing.assert_allclose(scene.points.xyz, xyz, atol=1e-9)


@pytest.mark.parametrize("colmap", [True, False])
def test_undistorted_images_have_separate_cameras(tmp_path, colmap):
    cameras, _ = write_dslr(tmp_path, distorted=False, undistorted=True, colmap=colmap)
    scene = load_scene(tmp_path)
    check(scene, cameras)
    assert scene.train[0].lens is None and scene.train[0].camera.fx == 25
    assert (scene.points is not None) == colmap


def test_nerfstudio_poses_are_transformed_to_the_frame_of_colmap(tmp_path):
    cameras, _ = write_dslr(tmp_path, colmap=False)
    check(load_scene(tmp_path), cameras)


def test_phone_captures_use_the_default_split(tmp_path):
    cameras, phone = ring(9), tmp_path / "iphone"
    names = [f"frame_{i * 10:06d}.jpg" for i in range(9)]
    for folder in ("rgb", "colmap"):
        (phone / folder).mkdir(parents=True)
    for i in range(90):
        picture(i).save(phone / "rgb" / f"frame_{i:06d}.jpg")
    reconstruction(cameras, [f"video/{name}" for name in names], [[0, 0, 0]]).write_text(str(phone / "colmap"))
    for path in (tmp_path, phone):
        scene = load_scene(path)
        assert len(scene.views) == 9 and [view.name for view in scene.test] == [
            "frame_000000",
            "frame_000080",
        ]
        for view in scene.views:
            np.testing.assert_allclose(
                view.camera.world_to_camera, cameras[int(view.name[6:]) // 10].world_to_camera, atol=1e-9
            )


def test_only_missing_test_images_are_accepted(tmp_path):
    write_dslr(tmp_path)
    (tmp_path / "dslr/resized_images/DSC00008.JPG").unlink()
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.test] == ["DSC00007"] and len(scene.train) == 7
    (tmp_path / "dslr/resized_images/DSC00003.JPG").unlink()
    with pytest.raises(LinprimError, match="1 of the 9 images of .* are not on disk, the first is DSC00003.JPG"):
        load_scene(tmp_path)


@pytest.mark.parametrize("distorted", [True, False])
@pytest.mark.parametrize("colmap", [True, False])
def test_images_marked_bad_are_left_out(tmp_path, distorted, colmap):
    write_dslr(tmp_path, distorted=distorted, undistorted=not distorted, colmap=colmap)
    path = tmp_path / "dslr/nerfstudio" / ("transforms.json" if distorted else "transforms_undistorted.json")
    header = json.loads(path.read_text())
    for entry in header["frames"] + header["test_frames"]:
        entry["is_bad"] = entry["file_path"] in ("DSC00002.JPG", "DSC00008.JPG")
    path.write_text(json.dumps(header))
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.train] == [f"DSC{i:05d}" for i in (0, 1, 3, 4, 5, 6)]
    assert [view.name for view in scene.test] == ["DSC00007"]
    for entry in header["frames"] + header["test_frames"]:
        entry["is_bad"] = True
    path.write_text(json.dumps(header))
    with pytest.raises(LinprimError, match="all images are marked 'is_bad', wanted some that are not"):
        load_scene(tmp_path)
    header["frames"][0]["is_bad"] = "no"
    path.write_text(json.dumps(header))
    with pytest.raises(LinprimError, match="frame 0 .*: 'is_bad' is 'no', wanted true or false"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    "file, content, words",
    [
        ("train_test_lists.json", "{", "not valid JSON at line 1, column 2"),
        ("train_test_lists.json", "[" * 100_000, "cannot be read .*wanted lists of image names"),
        ("train_test_lists.json", '{"train": []}', "no list 'test'"),
        ("train_test_lists.json", '{"test": [1]}', "no list 'test'"),
        ("colmap/images.txt", "", "the COLMAP model cannot be read"),
        ("nerfstudio/transforms_undistorted.json", None, "no such file, wanted the cameras of"),
        ("nerfstudio/transforms_undistorted.json", '{"frames": []}', "the list 'frames' is empty"),
    ],
)
def test_damaged_files_are_named(tmp_path, file, content, words):
    write_dslr(tmp_path, distorted=not file.startswith("nerfstudio"), undistorted=True)
    if content is None:
        (tmp_path / "dslr" / file).unlink()
    else:
        (tmp_path / "dslr" / file).write_text(content)
    with pytest.raises(LinprimError, match=words) as caught:
        load_scene(tmp_path)
    assert "\n" not in str(caught.value)
