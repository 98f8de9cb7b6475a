"""`transforms*.json`: cameras and side files of all dialects, their points, and errors for damaged files."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from helpers.captures import edit, look_at, picture, reconstruction, ring, transforms, write_transforms
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import has_poses, load_scene
from linprim_geo.capture.readers.ply_points import read_points_ply


def refusal(path, **options) -> str:
    with pytest.raises(LinprimError) as caught:
        load_scene(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_opengl_poses_are_converted(tmp_path):
    # camera-to-world = identity in OpenGL axes: at the origin, x right, y up, looking along -z
    write_transforms(tmp_path, 3)
    edit(tmp_path / "transforms.json", lambda c: c["frames"][1].update(transform_matrix=np.eye(4).tolist()))
    camera = next(view.camera for view in load_scene(tmp_path).views if view.name == "01")
    pixels, depth = camera.project(np.array([[0.0, 0, -2], [1, 0, -2], [0, 1, -2]]))
    np.testing.assert_allclose(depth, 2)
    np.testing.assert_allclose(pixels, [[16, 12], [16 + 15, 12], [16, 12 - 15]])


def test_intrinsics_per_frame_override_those_of_the_file(tmp_path):
    write_transforms(tmp_path, 4)
    picture(1, size=(40, 20)).save(tmp_path / "images" / "01.png")
    own = {"w": 40, "h": 20, "fl_x": 50.0, "fl_y": 51.0, "cx": 19.0, "cy": 11.0}
    edit(tmp_path / "transforms.json", lambda c: c["frames"][1].update(own))
    cameras = {view.name: view.camera for view in load_scene(tmp_path).views}
    one = cameras["01"]
    assert (one.width, one.height, one.fx, one.fy, one.cx, one.cy) == (40, 20, 50, 51, 19, 11)
    assert cameras["02"].fx == 30


def test_intrinsics_from_view_angles_and_image_size(tmp_path):
    write_transforms(tmp_path, 3)

    def only_angles(content):
        for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
            del content[key]
        content["camera_angle_x"] = 2 * np.arctan(16 / 40)

    edit(tmp_path / "transforms.json", only_angles)
    camera = load_scene(tmp_path).train[0].camera
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [40, 40, 16, 12])
    edit(tmp_path / "transforms.json", lambda c: c.update(camera_angle_y=2 * np.arctan(12 / 20)))
    np.testing.assert_allclose(load_scene(tmp_path).train[0].camera.fy, 20)


@pytest.mark.parametrize(
    "keys, model, params",
    [
        ({"k1": 0.1, "p2": 0.01}, "OPENCV", (0.1, 0, 0, 0.01)),
        ({"camera_model": "OPENCV", "k1": 0.1, "k3": 0.02}, "FULL_OPENCV", (0.1, 0, 0, 0, 0.02, 0, 0, 0)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.01}, "OPENCV_FISHEYE", (0.1, 0, 0, 0.01)),
        ({"is_fisheye": True, "k2": 0.1}, "OPENCV_FISHEYE", (0, 0.1, 0, 0)),
        ({"camera_model": "PINHOLE"}, None, ()),
        ({"camera_model": "OPENCV", "k1": 0, "k2": 0.0}, None, ()),
    ],
)
def test_distortion_keys_select_the_lens_model(tmp_path, keys, model, params):
    write_transforms(tmp_path, 3, **keys)
    lens = load_scene(tmp_path).train[0].lens
    if model is None:
        assert lens is None
    else:
        assert lens.model == model and lens.params == (30, 30, 16, 12, *params)


def test_files_of_instant_ngp_are_read(tmp_path):
    """Files of its script have one lens, integers as floats, the sharpness of images, and `aabb_scale`."""
    cameras = ring(5)
    content = transforms(cameras, [f"./images/{i:04d}.png" for i in range(5)])
    angles = {"camera_angle_x": 2 * math.atan(16 / 30), "camera_angle_y": 2 * math.atan(12 / 30)}
    distortion = {"k1": 0.02, "k2": -0.01, "k3": 0, "k4": 0, "p1": 0.001, "p2": -0.002, "is_fisheye": False}
    content = {**angles, **content, **distortion, "w": 32.0, "h": 24.0, "aabb_scale": 16}
    (tmp_path / "images").mkdir()
    for i, frame in enumerate(content["frames"]):
        picture(i).save(tmp_path / frame["file_path"])
        frame["sharpness"] = 100.0 + i
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    scene = load_scene(tmp_path)
    assert len(scene.views) == 5
    for view in scene.views:
        assert (view.lens.model, view.lens.params[4:]) == ("OPENCV", (0.02, -0.01, 0.001, -0.002))
        np.testing.assert_allclose(view.camera.world_to_camera, cameras[int(view.name)].world_to_camera, atol=1e-12)


def test_frames_marked_bad_are_left_out(tmp_path):
    write_transforms(tmp_path, 6)
    path = tmp_path / "transforms.json"
    edit(path, lambda c: [frame.update(is_bad=i in (1, 4)) for i, frame in enumerate(c["frames"])])
    (tmp_path / "images" / "04.png").unlink()
    assert sorted(view.name for view in load_scene(tmp_path).views) == ["00", "02", "03", "05"]
    edit(path, lambda c: c["frames"][0].update(is_bad=1))
    assert "frame 0 (images/00.png): 'is_bad' is 1, wanted true or false" in refusal(tmp_path)
    edit(path, lambda c: [frame.update(is_bad=True) for frame in c["frames"]])
    assert "all 6 frames are marked 'is_bad'" in refusal(tmp_path)


def test_named_splits_of_nerfstudio_are_used(tmp_path):
    write_transforms(
        tmp_path, 6, train_filenames=["images/00.png"], test_filenames=["images/02.png", "./images/05.png"]
    )
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.test] == ["02", "05"] and len(scene.train) == 4


def test_test_frames_are_held_out(tmp_path):
    write_transforms(tmp_path, 6)
    edit(tmp_path / "transforms.json", lambda c: c.update(test_frames=[c["frames"].pop(3)]))
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.test] == ["03"] and len(scene.train) == 5


def test_a_named_file_is_read_instead(tmp_path):
    write_transforms(tmp_path, 4)
    write_transforms(tmp_path, 3, name="other.json")
    assert len(load_scene(tmp_path / "other.json").views) == 3


def test_mask_paths_of_frames_are_used(tmp_path):
    write_transforms(tmp_path, 3)
    mask = np.zeros((24, 32), np.uint8)
    mask[3:9] = 255
    Image.fromarray(mask).save(tmp_path / "m.png")
    edit(tmp_path / "transforms.json", lambda c: c["frames"][1].update(mask_path="m.png"))
    views = {view.name: view for view in load_scene(tmp_path).views}
    np.testing.assert_array_equal(views["01"].load().alpha, mask)
    assert (views["02"].load().alpha == 255).all()


def write_ply(path, xyz, rgb=None, kind="binary_little_endian", dtype="float"):
    order = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}[kind]
    fields = [(axis, order + ("f4" if dtype == "float" else "f8")) for axis in "xyz"]
    lines = [f"property {dtype} {axis}" for axis in "xyz"]
    if rgb is not None:
        floats = rgb.dtype.kind == "f"
        fields += [(name, order + ("f4" if floats else "u1")) for name in ("red", "green", "blue")]
        lines += [f"property {'float' if floats else 'uchar'} {name}" for name in ("red", "green", "blue")]
    table = np.zeros(len(xyz), dtype=fields)
    for i, axis in enumerate("xyz"):
        table[axis] = xyz[:, i]
    for i, name in enumerate(("red", "green", "blue") if rgb is not None else ()):
        table[name] = rgb[:, i]
    header = "\n".join(["ply", f"format {kind} 1.0", f"element vertex {len(xyz)}", *lines, "end_header", ""])
    body = (
        table.tobytes()
        if kind != "ascii"
        else "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode()
    )
    path.write_bytes(header.encode() + body)


XYZ = np.random.default_rng(3).uniform(-0.5, 0.5, (20, 3)).astype(np.float32)
RGB = np.random.default_rng(4).integers(0, 256, (20, 3), dtype=np.uint8)


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("colors", [RGB, (RGB / 255).astype(np.float32), None])
def test_points_of_every_ply_encoding_are_read(tmp_path, kind, colors):
    write_ply(tmp_path / "p.ply", XYZ, colors, kind)
    cloud = read_points_ply(tmp_path / "p.ply")
    np.testing.assert_allclose(cloud.xyz, XYZ, rtol=1e-6)
    np.testing.assert_array_equal(cloud.rgb, np.full((20, 3), 128) if colors is None else RGB)


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
def test_truncated_points_are_refused(tmp_path, kind):
    write_transforms(tmp_path, 3, ply_file_path="p.ply")
    write_ply(tmp_path / "p.ply", XYZ, RGB, kind)
    assert len(load_scene(tmp_path).points.xyz) == 20
    content = (tmp_path / "p.ply").read_bytes()
    (tmp_path / "p.ply").write_bytes(content[:-40])
    assert "p.ply: cut short" in refusal(tmp_path) and "of 20 points" in refusal(tmp_path)
    (tmp_path / "p.ply").write_bytes(content[:30])
    assert "p.ply" in refusal(tmp_path)
    (tmp_path / "p.ply").unlink()
    assert "'ply_file_path'" in refusal(tmp_path) and "not on disk" in refusal(tmp_path)


def test_non_finite_points_are_left_out(tmp_path):
    xyz = XYZ.copy()
    xyz[3, 1] = np.nan
    write_ply(tmp_path / "p.ply", xyz, RGB)
    cloud = read_points_ply(tmp_path / "p.ply")
    assert len(cloud.xyz) == 19 and (cloud.rgb[3] == RGB[4]).all()


def write_model(folder, cameras, names, xyz):
    folder.mkdir(parents=True)
    reconstruction(cameras, names, xyz).write_binary(str(folder))


def test_points_come_from_the_model_whose_cameras_agree(tmp_path):
    cameras = write_transforms(tmp_path, 5)
    names = [f"{i:02d}.png" for i in range(5)]
    assert load_scene(tmp_path).points is None
    other = ring(5, radius=5.0)
    write_model(tmp_path / "sparse/0", other, names, XYZ + 1)
    assert load_scene(tmp_path).points is None
    nearly = [look_at(c.center + [0.005, 0, 0], c.center + c.rotation[2]) for c in cameras]
    write_model(tmp_path / "sparse_sfm/0", nearly, names, XYZ + 2)
    np.testing.assert_allclose(load_scene(tmp_path).points.xyz, XYZ + 2, atol=1e-6)
    write_model(tmp_path / "sparse_gt", cameras, names, XYZ)
    np.testing.assert_allclose(load_scene(tmp_path).points.xyz, XYZ, atol=1e-6)
    np.testing.assert_allclose(load_scene(tmp_path, sparse="sparse_sfm").points.xyz, XYZ + 2, atol=1e-6)
    assert "its cameras are not those of" in refusal(tmp_path, sparse="sparse/0")


@pytest.mark.parametrize("scale", [None, 2.5])
def test_applied_transform_and_scale_apply_to_colmap_points(tmp_path, scale):
    turn = np.array([[0.0, 1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, -1, 0.1]])  # as nerfstudio exchanges axes
    header = {} if scale is None else {"applied_scale": scale}
    cameras = write_transforms(tmp_path, 5, applied_transform=turn.tolist(), **header)
    scale = scale or 1.0
    theirs = []
    for camera in cameras:
        pose = np.eye(4)
        pose[:3, :3] = camera.rotation @ turn[:, :3]
        pose[:3, 3] = camera.rotation @ turn[:, 3] + camera.world_to_camera[:3, 3] / scale
        theirs.append(type(camera)(32, 24, camera.fx, camera.fy, camera.cx, camera.cy, pose))
    write_model(tmp_path / "colmap/sparse/0", theirs, [f"{i:02d}.png" for i in range(5)], XYZ)
    wanted = scale * (XYZ @ turn[:, :3].T + turn[:, 3])
    np.testing.assert_allclose(load_scene(tmp_path).points.xyz, wanted, atol=1e-6)


def test_damaged_models_are_ignored_unless_requested(tmp_path):
    cameras = write_transforms(tmp_path, 3)
    write_model(tmp_path / "sparse/0", cameras, [f"{i:02d}.png" for i in range(3)], XYZ)
    file = tmp_path / "sparse/0/points3D.bin"
    file.write_bytes(file.read_bytes()[:-5])
    assert load_scene(tmp_path).points is None
    assert "points3D.bin: cut short" in refusal(tmp_path, sparse="sparse/0")


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda c: c.pop("frames"), "no list 'frames'"),
        (lambda c: c.update(frames=[]), "'frames' is empty"),
        (lambda c: c["frames"][1].pop("file_path"), "frame 1: no 'file_path'"),
        (lambda c: c["frames"][1].pop("transform_matrix"), "'transform_matrix' is missing"),
        (lambda c: c["frames"][1].update(transform_matrix=[[1, 2], [3, 4]]), "not a table of 4x4 numbers"),
        (lambda c: c["frames"][1].update(transform_matrix=[[1, "x"]] * 4), "not a table of 4x4 numbers"),
        (lambda c: c.update(fl_x="wide"), "'fl_x' is 'wide', wanted a finite number"),
        (lambda c: c.update(fl_x=-3), "focal length that is not positive"),
        (lambda c: (c.update(fl_x=0), c.pop("fl_y")), "focal length that is not positive"),
        (lambda c: c.update(fl_x=0), "focal length that is not positive"),
        (lambda c: (c.pop("fl_x"), c.pop("fl_y")), "neither 'fl_x' nor 'camera_angle_x'"),
        (lambda c: c.update(fl_x=None, fl_y=None, camera_angle_x=3.5), "between 0 and pi"),
        (lambda c: c.update(w=31), "the image is 32x24, wanted 31x24"),
        (lambda c: c.update(w=31.5), "wanted whole numbers"),
        (lambda c: c.update(camera_model="PANORAMIX"), "unknown camera model 'PANORAMIX'"),
        (lambda c: c.update(k4=0.1), "'k4' is 0.1"),
        (lambda c: c["frames"][1].update(file_path="images/99.png"), "1 of 3 images are not on disk"),
        (lambda c: c["frames"][1].update(mask_path="m.png"), "'mask_path'"),
        (lambda c: c["frames"][1].update(depth_file_path="d.png"), "'depth_file_path'"),
        (lambda c: c.update(applied_transform=[1, 2]), "'applied_transform' is not"),
        (lambda c: c.update(test_frames=1.5), "'test_frames' is 1.5, wanted a list"),
        (lambda c: c.update(applied_scale=0), "'applied_scale' is 0.0, wanted a positive number"),
        (lambda c: c.update(applied_scale="2"), "'applied_scale' is '2', wanted a finite number"),
        (lambda c: c.update(test_filenames="images/00.png"), "is not a list of paths"),
    ],
)
def test_invalid_entries_are_named(tmp_path, change, said):
    write_transforms(tmp_path, 3)
    edit(tmp_path / "transforms.json", change)
    message = refusal(tmp_path)
    assert said in message and str(tmp_path) in message


def test_invalid_json_is_refused(tmp_path):
    write_transforms(tmp_path, 3)
    file = tmp_path / "transforms.json"
    file.write_text(file.read_text()[:200])
    assert "not valid JSON at line 1" in refusal(tmp_path)
    file.write_text(json.dumps([1, 2]))
    assert "no list 'frames'" in refusal(tmp_path)
    file.write_bytes(b"\xff\xfe\x00garbage")
    assert "cannot be read" in refusal(tmp_path)


def test_too_few_training_frames_are_refused(tmp_path):
    cameras = ring(3)
    for split, indices in (("train", [0]), ("test", [1, 2])):
        paths = [f"{i}.png" for i in indices]
        for i in indices:
            picture(i).save(tmp_path / f"{i}.png")
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(transforms([cameras[i] for i in indices], paths)))
    assert "1 of 3 images are for training" in refusal(tmp_path)


def test_a_dangling_link_is_refused(tmp_path):
    (tmp_path / "transforms.json").symlink_to(tmp_path / "gone.json")
    for read in (load_scene, has_poses):
        with pytest.raises(LinprimError, match="transforms.json: is a link to a file that is not there"):
            read(tmp_path)
