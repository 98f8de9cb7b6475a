"""DTU scans in the layout of NeuS and IDR: decomposition of projection matrices, and errors for damaged files."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import picture, ring
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.readers.dtu import decomposed

# The unit sphere's frame to the scan's, in mm.
SCALE = np.array([[200.0, 0, 0, 30], [0, 200, 0, -20], [0, 0, 200, 600], [0, 0, 0, 1]])


def write_dtu(root, count=9, images="image", masks="mask", smaller=1, name="cameras_sphere.npz", change=None):
    """Photographs of 32x24 and a file of cameras for photographs `smaller` times as large; returns the cameras in the
    sphere's frame."""
    cameras, arrays = ring(count, shift=(1.5, -0.75)), {}
    (root / images).mkdir(parents=True)
    if masks:
        (root / masks).mkdir()
    for i, camera in enumerate(cameras):
        picture(i).save(root / images / f"{i:06d}.png")
        if masks:
            mask = np.zeros((24, 32), np.uint8)
            mask[:, : 8 + i] = 255
            Image.fromarray(mask).save(root / masks / f"{i:03d}.png")
        matrix = np.eye(4)
        matrix[:3, :3] = np.diag([smaller, smaller, 1]) @ camera.K
        matrix[:2, 2] -= 0.5  # pixel centres at whole numbers
        world = matrix @ camera.world_to_camera @ np.linalg.inv(SCALE)
        arrays[f"world_mat_{i}"] = (world * (-1 if i == 3 else 2.5)).astype(np.float32)
        arrays[f"scale_mat_{i}"] = SCALE.astype(np.float32)
        arrays[f"world_mat_inv_{i}"] = np.linalg.inv(world)
    if change:
        change(arrays)
    np.savez(root / name, **arrays)
    return cameras


def refusal(path) -> str:
    with pytest.raises(LinprimError) as caught:
        load_scene(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    "layout",
    [{}, {"images": "images", "masks": "masks", "name": "cameras.npz"}, {"masks": None}, {"smaller": 4}],
)
def test_cameras_are_recovered_from_projection_matrices(tmp_path, layout):
    cameras = write_dtu(tmp_path, **layout)
    scene = load_scene(tmp_path)
    assert (
        scene.kind == "dtu"
        and len(scene.test) == 2
        and scene.has_alpha == ("masks" not in layout or bool(layout["masks"]))
    )
    for view in scene.views:
        camera = cameras[int(view.name)]
        np.testing.assert_allclose(
            view.camera.world_to_camera, camera.world_to_camera, atol=1e-5
        )  # float32 in units of 600 mm
        # NeuS puts pixel centres at whole numbers of the large photograph.
        np.testing.assert_allclose(view.camera.K, camera.K, atol=2e-3)
        photo = view.load()
        np.testing.assert_array_equal(photo.rgb, np.asarray(picture(int(view.name))))
        if photo.alpha is not None:
            assert (photo.alpha[0] > 0).sum() == 8 + int(view.name)


def test_decomposition_ignores_factor_and_sign():
    camera = ring(3)[1]
    projection = camera.K @ camera.world_to_camera[:3]
    for factor in (1.0, -1.0, -7.0, 1e-3):
        calibration, pose = decomposed(factor * projection, "here")
        np.testing.assert_allclose(calibration, camera.K, atol=1e-9)
        np.testing.assert_allclose(pose, camera.world_to_camera, atol=1e-12)


def _nan(arrays):
    arrays["world_mat_2"][0, 0] = np.nan


def _singular(arrays):
    arrays["world_mat_2"][1] = arrays["world_mat_2"][0]


def _skewed(arrays):
    arrays["world_mat_2"][0] += np.float32(0.3) * arrays["world_mat_2"][1]


def _far_off(arrays):
    arrays["world_mat_2"][0] += np.float32(20) * arrays["world_mat_2"][2]


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda arrays: arrays.pop("world_mat_8"), "8 cameras for 9 images"),
        (lambda arrays: arrays.pop("world_mat_4"), "world_mat_4 is missing|8 cameras"),
        (lambda arrays: arrays.pop("scale_mat_4"), "scale_mat_4 is missing"),
        (lambda arrays: arrays.update(world_mat_1=np.eye(3)), "world_mat_1 is of shape"),
        (lambda arrays: arrays.clear(), "no world_mat_0"),
        (lambda arrays: arrays.update(world_mat_0=np.array([{"a": 1}], object)), "without pickled objects"),
        (_nan, "camera 2: the projection matrix has entries that are not finite"),
        (_singular, "camera 2: the projection matrix has no inverse"),
        (_skewed, "camera 2: the calibration has a skew"),
        (_far_off, "camera 2: its principal point .* is not near the middle"),
    ],
)
def test_damaged_cameras_are_named(tmp_path, change, words):
    import re

    write_dtu(tmp_path, change=change)
    message = refusal(tmp_path)
    assert re.search(words, message) and "cameras_sphere.npz" in message


def test_missing_images_and_masks_are_counted(tmp_path):
    write_dtu(tmp_path)
    (tmp_path / "mask" / "003.png").unlink()
    assert "8 masks for 9 images" in refusal(tmp_path)
    (tmp_path / "image" / "000003.png").unlink()
    assert "9 cameras for 8 images" in refusal(tmp_path)
    for path in (tmp_path / "image").iterdir():
        path.unlink()
    assert "no images, wanted a folder image or images" in refusal(tmp_path)


def test_truncated_files_are_refused(tmp_path):
    write_dtu(tmp_path)
    file = tmp_path / "cameras_sphere.npz"
    file.write_bytes(file.read_bytes()[:500])
    assert "cannot be read as cameras" in refusal(tmp_path)
