"""Photographs of other sizes: a folder named by `--images`, and the smaller ones of Mip-NeRF 360."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from helpers.captures import picture, write_colmap, write_transforms
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import load_scene

SIZE = (32, 24)


def shrink(root, folder, size, count=6, suffix=".png"):
    (root / folder).mkdir()
    for i in range(count):
        picture(100 + i, size).save(root / folder / f"{i:02d}{suffix}")


@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_folders_of_smaller_photographs_replace_averaging(tmp_path, write):
    write(tmp_path, 6)
    averaged = {view.name: view for view in load_scene(tmp_path, downscale=4).views}
    shrink(tmp_path, "images_4", (8, 6))
    for view in load_scene(tmp_path, downscale=4).views:
        np.testing.assert_array_equal(view.load().rgb, np.asarray(picture(100 + int(view.name), (8, 6))))
        np.testing.assert_allclose(view.camera.K, averaged[view.name].camera.K, atol=1e-12)
    for view in load_scene(tmp_path, downscale=2).views:
        assert view.load().rgb.shape == (12, 16, 3) and view.image_path.parent.name == "images"


def test_rounded_sizes_scale_each_axis_separately(tmp_path):
    write_colmap(tmp_path, 6)
    shrink(tmp_path, "images_5", (6, 5))  # of 6.4 x 4.8
    view = load_scene(tmp_path, downscale=5).train[0]
    assert view.image_path.parent.name == "images_5" and view.load().rgb.shape == (5, 6, 3)
    np.testing.assert_allclose(
        [view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy],
        [30 * 6 / 32, 30 * 5 / 24, 3, 2.5],
        rtol=1e-12,
    )


def test_lenses_are_scaled_with_smaller_photographs(tmp_path):
    write_colmap(tmp_path, 6, model="SIMPLE_RADIAL", params=[30.0, 16.0, 12.0, -0.1])
    shrink(tmp_path, "images_2", (16, 12))
    view = load_scene(tmp_path, downscale=2).train[0]
    assert view.image_path.parent.name == "images_2" and view.lens.params == (15.0, 8.0, 6.0, -0.1)


@pytest.mark.parametrize("problem", ["one missing", "another size", "masks"])
def test_incomplete_or_masked_folders_fall_back_to_averaging(tmp_path, problem):
    write_colmap(tmp_path, 6)
    shrink(tmp_path, "images_2", (16, 12))
    if problem == "one missing":
        (tmp_path / "images_2" / "03.png").unlink()
    elif problem == "another size":
        picture(0, (16, 11)).save(tmp_path / "images_2" / "03.png")
    else:
        (tmp_path / "masks").mkdir()
        for i in range(6):
            Image.fromarray(np.full((24, 32), 255, np.uint8)).save(tmp_path / "masks" / f"{i:02d}.png")
    view = load_scene(tmp_path, downscale=2).train[0]
    assert view.image_path.parent.name == "images" and view.load().rgb.shape == (12, 16, 3)


@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_a_named_folder_is_used_at_its_size(tmp_path, write):
    cameras = write(tmp_path, 6)
    cameras = cameras[0] if isinstance(cameras, tuple) else cameras
    shrink(tmp_path, "photos", (64, 48), suffix=".jpg")
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    for view in load_scene(tmp_path, images="photos").views:
        assert view.load().rgb.shape == (48, 64, 3) and view.image_path.suffix == ".jpg"
        np.testing.assert_allclose(
            view.camera.project(points)[0], 2 * cameras[int(view.name)].project(points)[0], atol=1e-9
        )
    assert load_scene(tmp_path, images="photos", downscale=4).train[0].load().rgb.shape == (12, 16, 3)


def test_a_named_folder_replaces_missing_images(tmp_path):
    write_colmap(tmp_path, 6)
    shutil.move(tmp_path / "images", tmp_path / "original")
    assert len(load_scene(tmp_path, images="original").views) == 6


def test_named_folders_that_do_not_match_are_refused(tmp_path):
    write_colmap(tmp_path, 6)
    shrink(tmp_path, "photos", (16, 12))
    picture(0, (16, 16)).save(tmp_path / "photos" / "02.png")
    with pytest.raises(LinprimError, match="02.png: the image is 16x16, wanted the shape of 32x24"):
        load_scene(tmp_path, images="photos")
    (tmp_path / "photos" / "02.png").unlink()
    with pytest.raises(LinprimError, match="no image for 1 of 6 cameras, the first is 02.png"):
        load_scene(tmp_path, images="photos")
    with pytest.raises(LinprimError, match="--images nowhere: no such folder"):
        load_scene(tmp_path, images="nowhere")
