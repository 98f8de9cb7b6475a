"""Undistorted photographs compared with projections of their pinhole camera, for every camera model of COLMAP."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.types import View
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.lens import Lens, check_lens, model_parameter_counts, undistorted

SIZE = (160, 120)
F, X, Y = 130.0, 83.0, 57.5  # a principal point off the middle shows an exchange of x and y, or of sizes
LENSES = {
    "SIMPLE_PINHOLE": (F, X, Y),
    "PINHOLE": (F, F * 1.02, X, Y),
    "SIMPLE_RADIAL": (F, X, Y, -0.15),
    "SIMPLE_RADIAL_FISHEYE": (F, X, Y, 0.05),
    "RADIAL": (F, X, Y, 0.12, 0.03),
    "RADIAL_FISHEYE": (F, X, Y, 0.03, -0.01),
    "OPENCV": (F, F * 1.02, X, Y, -0.2, 0.05, 0.002, -0.003),
    "OPENCV_FISHEYE": (F, F * 1.02, X, Y, 0.04, -0.01, 0.003, 0.001),
    "FULL_OPENCV": (F, F * 1.02, X, Y, -0.2, 0.05, 0.002, -0.003, 0.01, 0.02, 0.01, 0.003),
    "FOV": (F, F * 1.02, X, Y, 0.8),
    "THIN_PRISM_FISHEYE": (F, F, X, Y, 0.03, 0.01, 0.001, -0.001, 0.002, 0.001, 0.001, -0.001),
    "RAD_TAN_THIN_PRISM_FISHEYE": (F, F, X, Y, 0.03, 0.01, 0, 0, 0, 0, 0.001, -0.001, 0.001, 0, 0.001, 0),
    "SIMPLE_DIVISION": (F, X, Y, -0.15),
    "DIVISION": (F, F * 1.02, X, Y, -0.15),
    "SIMPLE_FISHEYE": (F, X, Y),
    "FISHEYE": (F, F * 1.02, X, Y),
    "EUCM": (F, F, X, Y, 0.6, 1.1),
}
# Blobs of this many pixels are seen by their centroid. Where the scale changes by s per pixel the centroid
# is off by about s sigma^2 (0.03 px here), the tenth of a pixel is above it and below what half a pixel
# would do.
SIGMA_PX = 1.2
TOLERANCE_PX = 0.1


def test_every_model_is_covered():
    assert set(LENSES) == set(model_parameter_counts()) - {"EQUIRECTANGULAR"}


@pytest.mark.parametrize("model", list(LENSES))
def test_blobs_of_undistorted_images_lie_at_pinhole_projections(tmp_path, model):
    import pycolmap

    lens = Lens(model, *SIZE, tuple(float(value) for value in LENSES[model]))
    check_lens(lens, "test")
    target = undistorted(lens)
    pose = look_at((1.0, -4.0, 0.5)).world_to_camera
    camera = Camera(**vars(target), world_to_camera=pose)
    # points on a grid of the final image, at different depths
    u, v = np.meshgrid(np.linspace(15, target.width - 15, 6), np.linspace(15, target.height - 15, 5))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1).reshape(-1, 3)
    local = rays * np.random.default_rng(0).uniform(2, 6, (len(rays), 1))
    world = camera.center + local @ camera.rotation
    taken = np.asarray(
        pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=list(lens.params)).img_from_cam(local)
    )
    assert ((taken > 0) & (taken < SIZE)).all()
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    image = np.zeros(SIZE[::-1])
    for p in taken:
        image += 230 * np.exp(-((x - p[0]) ** 2 + (y - p[1]) ** 2) / (2 * SIGMA_PX**2))
    Image.fromarray(np.repeat(image.clip(0, 255).astype(np.uint8)[..., None], 3, 2)).save(tmp_path / "a.png")
    view = View("a", camera, tmp_path / "a.png", file_size=SIZE, lens=None if lens.is_pinhole else lens)
    seen = view.load().rgb[..., 0].astype(float)
    assert seen.shape == (camera.height, camera.width)
    predicted, _ = camera.project(world)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    for p in predicted:
        near = (np.abs(x - p[0]) < 4 * SIGMA_PX) & (np.abs(y - p[1]) < 4 * SIGMA_PX)
        weight = seen[near]
        assert weight.max() > 150
        centroid = np.array([(x[near] * weight).sum(), (y[near] * weight).sum()]) / weight.sum()
        assert np.linalg.norm(centroid - p) < TOLERANCE_PX


def test_lens_without_distortion_keeps_its_parameters():
    for model, params in (("OPENCV", (F, F, X, Y, 0, 0, 0, 0)), ("SIMPLE_RADIAL", (F, X, Y, 0))):
        target = undistorted(Lens(model, *SIZE, tuple(map(float, params))))
        assert (target.width, target.height, target.cx, target.cy) == (*SIZE, X, Y)
    assert not Lens("FISHEYE", *SIZE, (F, F, X, Y)).is_pinhole


@pytest.mark.parametrize(
    "lens, said",
    [
        (Lens("PANORAMIX", 4, 4, (1.0,)), "unknown camera model 'PANORAMIX'"),
        (Lens("EQUIRECTANGULAR", 4, 4, (4.0, 4.0)), "is a panorama"),
        (Lens("OPENCV", 4, 4, (1.0, 1.0, 2.0, 2.0)), "has 4 parameters, wanted 8"),
        (Lens("PINHOLE", 4, 4, (1.0, -1.0, 2.0, 2.0)), "focal length that is not positive"),
        (Lens("PINHOLE", 4, 4, (1.0, float("nan"), 2.0, 2.0)), "not all finite"),
        (Lens("PINHOLE", 0, 4, (1.0, 1.0, 2.0, 2.0)), "image size 0x4"),
    ],
)
def test_invalid_camera_parameters_are_refused(lens, said):
    with pytest.raises(LinprimError, match=said):
        check_lens(lens, "cameras.bin camera 3")


def test_distortion_that_folds_the_image_is_refused():
    with pytest.raises(LinprimError, match="folds over|cannot be undistorted"):
        undistorted(Lens("OPENCV", *SIZE, (F, F, X, Y, -3.0, 9.0, 0.5, 0.5)))
