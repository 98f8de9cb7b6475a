"""`load_scene`: layouts, splits, masks, downscaling, names, and errors for invalid captures."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from helpers.captures import OPENGL, edit, picture, ring, transforms, write_colmap, write_transforms
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions
from linprim_geo.capture import load
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.types import check_pose


def refusal(path, **options) -> str:
    with pytest.raises(LinprimError) as caught:
        load_scene(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_every_eighth_by_name_is_held_out(tmp_path):
    cameras = write_transforms(tmp_path, 10)
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.test] == ["00", "08"]
    assert [view.name for view in scene.train] == ["01", "02", "03", "04", "05", "06", "07", "09"]
    for view in scene.views:
        np.testing.assert_allclose(view.camera.world_to_camera, cameras[int(view.name)].world_to_camera, atol=1e-12)


@pytest.mark.parametrize(("every", "held_out"), [(0, []), (3, ["00", "03", "06", "09"]), (100, ["00"])])
@pytest.mark.parametrize("named", [False, True])
def test_test_every_overrides_the_split_of_the_data_set(every, held_out, named, tmp_path):
    write_transforms(tmp_path, 10)
    if named:
        edit(tmp_path / "transforms.json", lambda content: content.update(test_filenames=["images/05.png"]))
    scene = load_scene(tmp_path, test_every=every)
    assert [view.name for view in scene.test] == held_out and len(scene.train) == 10 - len(held_out)


def test_invalid_test_every_is_refused(tmp_path):
    write_transforms(tmp_path, 10)
    with pytest.raises(LinprimError, match="--test-every 1 leaves 0 of 10 photographs to train on"):
        load_scene(tmp_path, test_every=1)
    with pytest.raises(LinprimError, match="--test-every is -1, wanted auto, or 0 to 1000000"):
        load_scene(tmp_path, test_every=-1)


def test_the_split_does_not_depend_on_the_order_of_frames(tmp_path):
    write_transforms(tmp_path, 10)
    edit(tmp_path / "transforms.json", lambda content: content["frames"].reverse())
    assert [view.name for view in load_scene(tmp_path).test] == ["00", "08"]


def test_two_images_are_both_used_for_training(tmp_path):
    write_transforms(tmp_path, 2)
    scene = load_scene(tmp_path)
    assert len(scene.train) == 2 and not scene.test


def test_test_split_has_precedence_over_val_and_side_images_are_no_views(tmp_path):
    cameras = ring(6)
    for split, indices in (("train", [0, 1, 2]), ("val", [3]), ("test", [4, 5])):
        (tmp_path / split).mkdir()
        paths = []
        for i in indices:
            picture(i).save(tmp_path / split / f"r_{i % 3}.png")
            picture(i).save(tmp_path / split / f"r_{i % 3}_depth.png")
            picture(i).save(tmp_path / split / f"r_{i % 3}_normal.png")
            paths.append(f"./{split}/r_{i % 3}")
        content = transforms([cameras[i] for i in indices], paths)
        header = {"camera_angle_x": 2 * np.arctan(16 / 30.0), "frames": content["frames"]}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(header))
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.train] == ["train_r_0", "train_r_1", "train_r_2"]
    assert [view.name for view in scene.test] == ["test_r_1", "test_r_2"]
    camera = scene.train[0].camera
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [30, 30, 16, 12])
    (tmp_path / "transforms_test.json").unlink()
    assert [view.name for view in load_scene(tmp_path).test] == ["val_r_0"]


def test_an_empty_test_file_means_no_held_out_views(tmp_path):
    write_transforms(tmp_path, 10, name="transforms_train.json")
    assert len(load_scene(tmp_path).test) == 2
    (tmp_path / "transforms_test.json").write_text('{"frames": []}')
    scene = load_scene(tmp_path)
    assert len(scene.train) == 10 and not scene.test
    (tmp_path / "transforms_train.json").write_text('{"frames": []}')
    assert "transforms_train.json: the list 'frames' is empty" in refusal(tmp_path)


@pytest.mark.parametrize("factor", [1, 2, 3, 5])
def test_downscaled_cameras_project_to_the_averaged_pixels(tmp_path, factor):
    cameras = write_transforms(tmp_path, 3)
    # A ramp in x and y: its mean over a block is its value at the block's centre, so the new pixel (j+0.5,
    # i+0.5) must see what the old image has at factor * (j+0.5, i+0.5).
    x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
    ramp = np.stack([x * 6, y * 6, np.full_like(x, 77)], axis=2).astype(np.uint8)
    for i in range(3):
        Image.fromarray(ramp).save(tmp_path / "images" / f"{i:02d}.png")
    scene = load_scene(tmp_path, downscale=factor)
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    for view in scene.views:
        full, _ = cameras[int(view.name)].project(points)
        small, _ = view.camera.project(points)
        np.testing.assert_allclose(small * factor, full, atol=1e-9)
        rgb = view.load().rgb
        assert rgb.shape == (24 // factor, 32 // factor, 3) == (view.camera.height, view.camera.width, 3)
        j, i = np.meshgrid(np.arange(rgb.shape[1]), np.arange(rgb.shape[0]))
        assert np.abs(rgb[..., 0] - 6 * factor * (j + 0.5)).max() <= 1
        assert np.abs(rgb[..., 1] - 6 * factor * (i + 0.5)).max() <= 1


def test_alpha_channel_is_foreground_and_all_opaque_counts_as_none(tmp_path):
    alpha = np.zeros((24, 32))
    alpha[5:15, 5:20] = 255
    write_transforms(tmp_path / "cut", 4, alpha=alpha)
    write_transforms(tmp_path / "full", 4, alpha=np.full((24, 32), 255))
    cut, full = load_scene(tmp_path / "cut"), load_scene(tmp_path / "full")
    assert cut.has_alpha and not full.has_alpha
    np.testing.assert_array_equal(cut.train[0].load().alpha, alpha)
    assert full.train[0].load().alpha is None


@pytest.mark.parametrize("folder, pattern", [("masks", "{}.png"), ("mask", "{}.png"), ("masks", "{}.png.png")])
def test_mask_folders_are_found(tmp_path, folder, pattern):
    write_transforms(tmp_path, 4)
    (tmp_path / folder).mkdir()
    mask = np.zeros((24, 32), np.uint8)
    mask[:, :7] = 1  # files that hold 0 and 1 mean 0 and 255
    for i in range(4):
        Image.fromarray(mask).save(tmp_path / folder / pattern.format(f"{i:02d}"))
    scene = load_scene(tmp_path)
    for view in scene.views:
        np.testing.assert_array_equal(view.load().alpha, mask * 255)
    (tmp_path / folder / pattern.format("02")).unlink()
    assert "no mask for 1 of 4 images" in refusal(tmp_path) and "02.png" in refusal(tmp_path)


def test_masks_option_and_its_errors(tmp_path):
    write_transforms(tmp_path / "scene", 3)
    (tmp_path / "mine").mkdir()
    for i in range(3):
        Image.new("L", (32, 24), 255 * (i % 2)).save(tmp_path / "mine" / f"{i:02d}.png")
    scene = load_scene(tmp_path / "scene", masks=tmp_path / "mine")
    assert {view.name: int(view.load().alpha.max()) for view in scene.views} == {"00": 0, "01": 255, "02": 0}
    Image.new("L", (30, 24)).save(tmp_path / "mine" / "01.png")
    assert "the mask is 30x24, wanted 32x24" in refusal(tmp_path / "scene", masks=tmp_path / "mine")
    assert "--masks nowhere: no such folder" in refusal(tmp_path / "scene", masks="nowhere")


def test_mask_folders_without_images_are_ignored(tmp_path):
    write_transforms(tmp_path, 3)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "readme.txt").write_text("none yet")
    assert not load_scene(tmp_path).has_alpha


def test_depth_is_scaled_and_zero_where_unknown(tmp_path):
    write_transforms(tmp_path, 3, depth_unit_scale_factor=0.001)
    depth = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)
    Image.fromarray(depth).save(tmp_path / "d.png")
    np.save(tmp_path / "d.npy", np.where(depth > 5, depth, np.nan).astype(np.float32))

    def name_depth(content):
        content["frames"][1]["depth_file_path"] = "d.png"
        content["frames"][2]["depth_file_path"] = "d.npy"

    edit(tmp_path / "transforms.json", name_depth)
    views = {view.name: view for view in load_scene(tmp_path).views}
    assert views["00"].load_depth() is None
    np.testing.assert_allclose(views["01"].load_depth(), depth * 0.001, rtol=1e-6)
    np.testing.assert_allclose(views["02"].load_depth(), np.where(depth > 5, depth, 0) * 0.001, rtol=1e-6)
    assert views["01"].load_depth().dtype == np.float32
    Image.fromarray(depth[:10]).save(tmp_path / "d.png")
    with pytest.raises(LinprimError, match="depth map is 32x10, wanted 32x24"):
        views["01"].load_depth()


def test_colmap_and_transforms_of_the_same_cameras_agree(tmp_path):
    write_transforms(tmp_path / "json", 9)
    write_colmap(tmp_path / "colmap", 9)
    ours, theirs = load_scene(tmp_path / "json"), load_scene(tmp_path / "colmap")
    assert (ours.kind, theirs.kind) == ("transforms", "colmap")
    for a, b in zip(ours.views, theirs.views, strict=True):
        assert a.name == b.name
        np.testing.assert_allclose(a.camera.K, b.camera.K)
        np.testing.assert_allclose(a.camera.world_to_camera, b.camera.world_to_camera, atol=1e-12)
        np.testing.assert_array_equal(a.load().rgb, b.load().rgb)


def test_equal_stems_get_distinct_names(tmp_path):
    cameras = ring(4)
    paths = ["a/0.png", "a/0.jpg", "b/0.png", "b/1.png"]
    for i, path in enumerate(paths):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        picture(i).save(tmp_path / path)
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(cameras, paths)))
    names = {view.name for view in load_scene(tmp_path).views}
    assert names == {"a_0.png", "a_0.jpg", "b_0.png", "b_1.png"}


def test_folders_without_a_capture_are_refused(tmp_path):
    assert "no such folder" in refusal(tmp_path / "nothing")
    assert "no photographs (the folder is empty)" in refusal(tmp_path)
    (tmp_path / "photos").mkdir()
    picture(0).save(tmp_path / "photos" / "a.png")
    message = refusal(tmp_path)
    assert "no camera poses found (1 images" in message and "sparse/0" in message
    assert "a file, wanted the folder" in refusal(tmp_path / "photos" / "a.png")


def test_missing_damaged_or_wrongly_sized_images_are_refused(tmp_path):
    write_transforms(tmp_path, 4)
    image = tmp_path / "images" / "02.png"
    content = image.read_bytes()
    image.write_bytes(b"")
    assert "02.png" in refusal(tmp_path) and "the file is empty" in refusal(tmp_path)
    image.write_bytes(b"<html>404</html>")
    assert "not an image in a known format" in refusal(tmp_path)
    picture(2, size=(30, 24)).save(image)
    assert "the image is 30x24, wanted 32x24" in refusal(tmp_path)
    image.unlink()
    assert "1 of 4 images are not on disk" in refusal(tmp_path)
    image.write_bytes(content[: len(content) // 2])  # the header is whole: found out when it is decoded
    view = next(view for view in load_scene(tmp_path).views if view.name == "02")
    with pytest.raises(LinprimError, match="02.png: cannot be read as an image"):
        view.load()


def test_photographs_rotated_by_exif_are_rotated_to_fit_their_camera(tmp_path):
    write_transforms(tmp_path, 3)
    pixels = np.asarray(picture(1))
    exif = Image.Exif()
    exif[0x0112] = 6  # shown after a quarter turn clockwise
    Image.fromarray(np.rot90(pixels).copy()).save(tmp_path / "images" / "01.png", exif=exif)
    view = next(view for view in load_scene(tmp_path).views if view.name == "01")
    np.testing.assert_array_equal(view.load().rgb, pixels)


def test_one_image_is_refused(tmp_path):
    write_transforms(tmp_path, 1)
    assert "1 posed image found, wanted at least two" in refusal(tmp_path)


@pytest.mark.parametrize(("longest", "factor"), [(40, 1), (32, 1), (31, 2), (16, 2), (11, 3)])
def test_large_photographs_are_averaged_down_by_default(longest, factor, tmp_path, monkeypatch):
    write_transforms(tmp_path, 3)  # 32 by 24 pixels
    monkeypatch.setattr(load, "LONGEST_SIDE", longest)
    scene = load_scene(tmp_path)
    assert scene.downscale == factor == scene.train[0].downscale
    assert scene.train[0].camera.width == 32 // factor
    assert load_scene(tmp_path, downscale=1).train[0].camera.width == 32


def test_automatic_downscale_uses_the_longest_side_of_all_photographs(tmp_path, monkeypatch):
    write_transforms(tmp_path, 3)
    tall = np.zeros((64, 48, 3), np.uint8)
    Image.fromarray(tall).save(tmp_path / "images" / "tall.png")

    def add_tall(content):
        frame = content["frames"][0] | {"file_path": "images/tall.png", "w": 48, "h": 64}
        content["frames"].append(frame | {"fl_x": 40.0, "fl_y": 40.0, "cx": 24.0, "cy": 32.0})

    edit(tmp_path / "transforms.json", add_tall)
    monkeypatch.setattr(load, "LONGEST_SIDE", 32)
    assert {(view.camera.width, view.camera.height) for view in load_scene(tmp_path).views} == {(16, 12), (24, 32)}


def test_automatic_downscale_is_reported(tmp_path, monkeypatch):
    write_transforms(tmp_path, 3)
    monkeypatch.setattr(load, "LONGEST_SIDE", 16)
    for options, told in ((SceneOptions(), 1), (SceneOptions(downscale=2), 0), (SceneOptions(downscale=1), 0)):
        lines: list[str] = []
        assert (
            load.resolved_downscale(load_scene(tmp_path, options), options, lines.append)
            == (options.downscale != 1) + 1
        )
        assert len(lines) == told and all("2 by 2, to 16x12" in line and "--downscale 1" in line for line in lines)


@pytest.mark.parametrize("value", [0, -1, 1.5, True])
def test_downscale_must_be_a_whole_number(tmp_path, value):
    write_transforms(tmp_path, 3)
    assert f"--downscale is {value}, wanted " in refusal(tmp_path, downscale=value)


def test_downscale_to_nothing_is_refused(tmp_path):
    write_transforms(tmp_path, 3)
    assert "leaves nothing" in refusal(tmp_path, downscale=25)


def bad_poses():
    nan = np.eye(4)
    nan[1, 3] = np.nan
    mirrored = np.diag([1.0, 1.0, -1.0, 1.0])
    row = np.eye(4)
    row[3] = [0, 0, 1, 1]
    return {
        "not finite": nan,
        "it scales by 0, 0, 0": np.diag([0.0, 0.0, 0.0, 1.0]),
        "it scales by 2, 2, 2": np.diag([2.0, 2.0, 2.0, 1.0]),
        "mirrors": mirrored,
        "last row": row,
    }


@pytest.mark.parametrize("said", list(bad_poses()))
def test_poses_that_are_not_rigid_are_refused(tmp_path, said):
    write_transforms(tmp_path, 3)
    pose = bad_poses()[said]
    edit(tmp_path / "transforms.json", lambda c: c["frames"][1].update(transform_matrix=pose.tolist()))
    message = refusal(tmp_path)
    assert said in message and "frame 1 (images/01.png)" in message


def test_rounded_poses_are_made_orthonormal():
    camera = ring(5)[2]
    rounded = np.round(camera.camera_to_world @ OPENGL, 4)
    pose = check_pose(rounded, "here")
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(pose, rounded, atol=2e-4)  # a few times the rounding of half a digit


def test_a_moved_folder_is_read_from_its_new_place(tmp_path):
    write_transforms(tmp_path / "a", 3)
    shutil.move(tmp_path / "a", tmp_path / "b")
    assert all(view.image_path.is_relative_to(tmp_path / "b") for view in load_scene(tmp_path / "b").views)
