"""COLMAP models, binary and text, with and without rigs: contents, and errors for damaged files."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from helpers.captures import picture, reconstruction, ring, write_colmap

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.readers.colmap import find_model, read_model
from linprim_geo.geometry.lens import model_parameter_counts


def refusal(path, **options) -> str:
    with pytest.raises(LinprimError) as caught:
        load_scene(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("rigs", [False, True])
def test_points_reproject_to_the_keypoints_of_their_tracks(tmp_path, text, rigs):
    cameras, xyz = write_colmap(tmp_path, 9, text=text)
    if not rigs:  # as models were before COLMAP had them
        for path in (tmp_path / "sparse/0").glob("[rf]*"):
            path.unlink()
    scene = load_scene(tmp_path)
    np.testing.assert_allclose(scene.points.xyz, xyz, atol=1e-12)
    np.testing.assert_array_equal(scene.points.rgb[:, 0], np.arange(20))
    assert scene.points.error_px.shape == (20,)
    import pycolmap

    model = pycolmap.Reconstruction(str(tmp_path / "sparse/0"))
    by_name = {view.name: view for view in scene.views}
    for number in (1, 2):
        image = model.image(number)
        pixels, depth = by_name[image.name[:2]].camera.project(scene.points.xyz)
        measured = np.array([point.xy for point in image.points2D])
        assert (depth > 0).all()
        np.testing.assert_allclose(pixels, measured, atol=1e-8)
    for camera, view in zip(cameras, sorted(scene.views, key=lambda view: view.name), strict=True):
        np.testing.assert_allclose(view.camera.world_to_camera, camera.world_to_camera, atol=1e-12)


@pytest.mark.parametrize("folder", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_models_are_found_in_the_usual_places(tmp_path, folder):
    write_colmap(tmp_path, 3, folder=folder)
    assert len(load_scene(tmp_path).views) == 3


def test_sparse_option_names_a_model_elsewhere(tmp_path):
    write_colmap(tmp_path, 3, folder="elsewhere/0")
    assert "no camera poses found" in refusal(tmp_path)
    assert len(load_scene(tmp_path, sparse="elsewhere").views) == 3
    assert "no cameras.bin or cameras.txt" in refusal(tmp_path, sparse="images")


def test_images_of_a_distorted_camera_are_undistorted_to_a_pinhole(tmp_path):
    write_colmap(tmp_path, 3, model="SIMPLE_RADIAL", params=[30.0, 16.0, 12.0, -0.1])
    view = load_scene(tmp_path, cache=tmp_path / "cache").train[0]
    assert view.lens.model == "SIMPLE_RADIAL" and view.file_size == (32, 24)
    assert view.load().rgb.shape == (view.camera.height, view.camera.width, 3) != (24, 32, 3)
    assert len(list((tmp_path / "cache").rglob("*.png"))) == 1
    half = load_scene(tmp_path, cache=tmp_path / "cache", downscale=2).train[0]
    assert half.load().rgb.shape == (view.camera.height // 2, view.camera.width // 2, 3)
    assert half.camera.cx * 2 == view.camera.cx


@pytest.mark.parametrize("text", [False, True])
def test_every_camera_model_is_read_with_its_parameters(tmp_path, text):
    import pycolmap

    for model in sorted(model_parameter_counts()):
        params = list(pycolmap.Camera.create_from_model_name(1, model, 30.0, 32, 24).params)
        write_colmap(tmp_path / model, 3, points=0, text=text, model=model, params=params)
        if model == "EQUIRECTANGULAR":
            assert "camera model EQUIRECTANGULAR is a panorama" in refusal(tmp_path / model)
            continue
        (lens,) = {image.lens for image in read_model(tmp_path / model / "sparse/0").images}
        assert (lens.model, lens.width, lens.height) == (model, 32, 24)
        np.testing.assert_allclose(lens.params, params, rtol=1e-12)
        camera = load_scene(tmp_path / model).train[0].camera
        assert abs(camera.cx - camera.width / 2) <= 1 and camera.width > 20


def test_several_cameras_keep_their_own_intrinsics(tmp_path):
    cameras = ring(2, focal=30.0) + ring(3, focal=45.0, size=(40, 20))[2:]
    names = ["a.png", "b.png", "sub/c.png"]
    (tmp_path / "images" / "sub").mkdir(parents=True)
    for i, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        picture(i, size=(camera.width, camera.height)).save(tmp_path / "images" / name)
    (tmp_path / "sparse").mkdir()
    reconstruction(cameras, names, [[0, 0, 0]]).write_binary(str(tmp_path / "sparse"))
    views = {view.name: view.camera for view in load_scene(tmp_path).views}
    assert views["a"].fx == 30.0 and views["c"].fx == 45.0 and views["c"].width == 40


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("table", ["cameras", "images", "points3D", "rigs", "frames"])
def test_truncated_tables_are_named(tmp_path, table, text):
    write_colmap(tmp_path, 4, text=text)
    file = tmp_path / "sparse/0" / f"{table}{'.txt' if text else '.bin'}"
    content = file.read_bytes()
    for share in (0.99, 0.6, 0.3):
        file.write_bytes(content[: int(len(content) * share)])
        last_words_only = share == 0.99 and table in ("cameras", "points3D", "rigs")
        comments_only = b"\n1 " not in file.read_bytes()
        if text and (last_words_only or comments_only):
            continue  # missing digits leave no trace in a text; what is left of such a file is valid
        assert file.name in refusal(tmp_path), share
    file.write_bytes(b"")
    if not text:
        assert "the file is empty" in refusal(tmp_path)
    elif table != "points3D":
        assert refusal(tmp_path)


def test_trailing_bytes_are_refused(tmp_path):
    write_colmap(tmp_path, 3)
    with open(tmp_path / "sparse/0/images.bin", "ab") as file:
        file.write(b"\0\0\0\0\0")
    assert "5 bytes after the last of 3 records" in refusal(tmp_path)


@pytest.mark.parametrize("missing", ["cameras", "images", "points3D"])
def test_missing_tables_are_named(tmp_path, missing):
    write_colmap(tmp_path, 3)
    (tmp_path / f"sparse/0/{missing}.bin").unlink()
    assert f"lacks {missing}" in refusal(tmp_path)


def test_unknown_camera_models_are_refused(tmp_path):
    write_colmap(tmp_path / "a", 3)
    file = tmp_path / "a/sparse/0/cameras.bin"
    content = bytearray(file.read_bytes())
    content[12:16] = struct.pack("<i", 77)
    file.write_bytes(content)
    assert "unknown camera model 77" in refusal(tmp_path / "a")
    write_colmap(tmp_path / "b", 3, text=True)
    file = tmp_path / "b/sparse/0/cameras.txt"
    file.write_text(file.read_text().replace("PINHOLE", "PANORAMIX"))
    assert "unknown camera model PANORAMIX" in refusal(tmp_path / "b")


def test_poses_with_nan_are_refused(tmp_path):
    write_colmap(tmp_path, 3)
    for name in ("rigs", "frames"):
        (tmp_path / f"sparse/0/{name}.bin").unlink()
    file = tmp_path / "sparse/0/images.bin"
    content = bytearray(file.read_bytes())
    content[12:20] = struct.pack("<d", float("nan"))
    file.write_bytes(content)
    assert "not finite numbers" in refusal(tmp_path)


def test_an_empty_reconstruction_is_refused(tmp_path):
    (tmp_path / "sparse/0").mkdir(parents=True)
    reconstruction([], [], []).write_binary(str(tmp_path / "sparse/0"))
    assert "reconstruction is empty" in refusal(tmp_path)


def test_a_model_without_points_is_a_scene_without_points(tmp_path):
    write_colmap(tmp_path, 3, points=0)
    assert load_scene(tmp_path).points is None


def test_registered_images_missing_on_disk_are_named(tmp_path):
    write_colmap(tmp_path, 5)
    for name in ("01", "03"):
        (tmp_path / "images" / f"{name}.png").unlink()
    message = refusal(tmp_path)
    assert "2 of the 5 images" in message and "the first is 01.png" in message


def test_unregistered_images_are_no_views(tmp_path):
    write_colmap(tmp_path, 3)
    picture(9).save(tmp_path / "images" / "extra.png")
    assert len(load_scene(tmp_path).views) == 3


def test_read_model_reads_images_and_points(tmp_path):
    _, xyz = write_colmap(tmp_path, 3)
    model = read_model(find_model(tmp_path))
    assert [image.name for image in model.images] == ["00.png", "01.png", "02.png"]
    assert len(model.points.xyz) == len(xyz)
