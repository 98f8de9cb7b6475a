"""Decoding, downscaling and undistortion of pixels compared with closed forms, with and without alpha."""

from __future__ import annotations

import io
import sys
import zipfile
from functools import partial

import numpy as np
import pytest
from helpers.captures import look_at
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import forget_peak, memory_gib, peak_gib
from linprim_geo.capture.types import View
from linprim_geo.geometry.lens import Lens, undistorted
from linprim_geo.imaging import photos


def test_box_downscale_weights_colours_by_alpha():
    rgb = np.array([[[200, 0, 0], [0, 100, 0]], [[0, 0, 50], [9, 9, 9]]], dtype=np.uint8)
    alpha = np.array([[255, 85], [0, 0]], dtype=np.uint8)
    small, small_alpha = photos.box_downscale(rgb, alpha, 2)
    # weights 3 : 1 : 0 : 0; alpha (255 + 85) / 4
    np.testing.assert_array_equal(small[0, 0], [150, 25, 0])
    assert small_alpha[0, 0] == 85
    # premultiplied, nothing is lost: sum of rgb * alpha is the same
    np.testing.assert_allclose(small[0, 0] * 85.0 * 4, (rgb * alpha[..., None].astype(float)).sum((0, 1)), atol=170)


def test_transparent_blocks_keep_their_unweighted_mean():
    rgb = np.full((2, 2, 3), 40, np.uint8)
    small, alpha = photos.box_downscale(rgb, np.zeros((2, 2), np.uint8), 2)
    assert alpha[0, 0] == 0 and (small == 40).all()


def test_box_downscale_crops_incomplete_blocks():
    rgb = np.random.default_rng(0).integers(0, 256, (7, 8, 3), dtype=np.uint8)
    small, _ = photos.box_downscale(rgb, None, 3)
    assert small.shape == (2, 2, 3)
    expected = rgb[3:6, 3:6].reshape(9, 3).astype(float).mean(0)
    assert np.abs(small[1, 1] - expected).max() <= 0.5


@pytest.mark.parametrize("factor", [2, 3, 4, 5])
def test_depth_of_a_plane_is_exact_at_the_new_pixel_centres(factor):
    camera = look_at((0, -3, 0), size=(40, 30), focal=35.0, shift=(1.3, -0.7))
    normal, offset = np.array([0.3, -0.2, 1.0]), 4.0  # n . x = offset in the camera's axes

    def plane(cam):
        return (offset / (cam.ray_grid() @ normal)).astype(np.float32)

    small = photos.downscale_depth(plane(camera), factor)
    k = factor
    half = type(camera)(40 // k, 30 // k, 35 / k, 35 / k, camera.cx / k, camera.cy / k, camera.world_to_camera)
    np.testing.assert_allclose(small, plane(half), rtol=1e-6)


def test_depth_is_not_averaged_across_an_edge():
    depth = np.ones((4, 4), np.float32)
    depth[:, 2:] = 3.0
    depth[0, 0] = 0.0
    np.testing.assert_array_equal(photos.downscale_depth(depth, 2), [[0, 3], [1, 3]])
    np.testing.assert_array_equal(photos.downscale_depth(depth[:, 1:], 2)[:, 0], [0, 0])


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "RGBA", "CMYK", "1"])
def test_every_image_mode_is_converted_to_rgb(tmp_path, mode):
    image = Image.new("RGB", (6, 4), (255, 255, 255)).convert(mode)
    suffix = "tif" if mode == "CMYK" else "png"
    image.save(tmp_path / f"a.{suffix}")
    rgb, alpha = photos.read_photo(tmp_path / f"a.{suffix}", (6, 4))
    assert rgb.shape == (4, 6, 3) and rgb.dtype == np.uint8 and (rgb == 255).all()
    assert (alpha is not None) == (mode in ("LA", "RGBA"))


def test_sixteen_bit_grey_keeps_its_range(tmp_path):
    values = np.array([[0, 256, 65535]], dtype=np.uint16)
    Image.fromarray(values).save(tmp_path / "a.png")
    np.testing.assert_array_equal(photos.read_photo(tmp_path / "a.png")[0][0, :, 0], [0, 1, 255])


def test_eight_bit_depth_is_refused(tmp_path):
    Image.new("L", (6, 4)).save(tmp_path / "d.png")
    with pytest.raises(LinprimError, match="8 bits, wanted 16-bit"):
        photos.read_depth(tmp_path / "d.png", 1.0, (6, 4))
    (tmp_path / "d.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(LinprimError, match="d.npy: cannot be read as a depth map"):
        photos.read_depth(tmp_path / "d.npy", 1.0, (6, 4))


def enormous(shape, descr) -> bytes:
    """The start of a .npy file that claims an array of 400 MB or more, and 400 MB of zeros."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00\x76\x00" + header + bytes(400_000_000)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the peak cannot be set back")
@pytest.mark.parametrize("suffix", ["npz", "npy", "png", "tif"])
@pytest.mark.parametrize("what", ["depth", "normals", "mask"])
def test_file_of_another_size_is_refused_without_reading_it(tmp_path, suffix, what):
    path = tmp_path / f"a.{suffix}"
    if suffix in ("npz", "npy") and (what == "mask" or (what, suffix) == ("normals", "npz")):
        pytest.skip("masks are read from images alone, and normals not from .npz")
    if suffix in ("npz", "npy"):
        shape, descr = ((10_000, 10_000), "<f4") if what == "depth" else ((8_000, 8_000, 3), "<f2")
        if suffix == "npz":
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr("depth.npy", enormous(shape, descr))
        else:
            path.write_bytes(enormous(shape, descr))
    else:
        Image.fromarray(np.zeros((6000, 6000), np.uint16)).save(path, compression="tiff_deflate")
    read = {"depth": partial(photos.read_depth, scale=1.0), "normals": photos.read_normals, "mask": photos.read_mask}
    forget_peak()
    before = memory_gib()
    with pytest.raises(LinprimError, match="wanted .*6"):
        read[what](path, size=(6, 4))
    assert peak_gib() < before + 0.02


def test_npz_with_unsupported_compression_is_refused(tmp_path):
    content = io.BytesIO()
    np.save(content, np.ones((4, 6), np.float32))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("depth.npy", content.getvalue())
    with pytest.raises(LinprimError, match="packed by the method 14"):
        photos.read_depth(tmp_path / "a.npz", 1.0, (6, 4))


BARREL = Lens("OPENCV", 60, 44, (50.0, 51.0, 31.0, 21.5, -0.2, 0.05, 0.001, -0.002))


def distorted_view(tmp_path, **options) -> View:
    target = undistorted(BARREL)
    camera = look_at((0, -3, 0), size=(target.width, target.height))
    camera = type(camera)(**{**vars(target), "world_to_camera": camera.world_to_camera})
    return View("a", camera, tmp_path / "a.png", file_size=(60, 44), lens=BARREL, cache=tmp_path / "cache", **options)


def test_undistortion_does_not_mix_in_colours_of_transparent_pixels(tmp_path):
    pixels = np.zeros((44, 60, 4), np.uint8)
    pixels[..., :3] = (255, 0, 255)  # what a transparent background hides
    pixels[10:30, 15:45] = (10, 200, 30, 255)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    photo = distorted_view(tmp_path, has_alpha=True).load()
    assert ((photo.alpha > 0) & (photo.alpha < 255)).any()  # edges were resampled
    np.testing.assert_array_equal(np.unique(photo.rgb[photo.alpha > 8], axis=0), [[10, 200, 30]])


def test_cache_returns_the_same_pixels_and_depends_on_the_content(tmp_path):
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (44, 60, 3), dtype=np.uint8)).save(tmp_path / "a.png")
    view = distorted_view(tmp_path)
    first, again = view.load(), view.load()
    stored = list((tmp_path / "cache").rglob("*.png"))
    assert len(stored) == 1
    np.testing.assert_array_equal(first.rgb, again.rgb)
    stored[0].write_bytes(b"half")  # a damaged entry is made again
    np.testing.assert_array_equal(view.load().rgb, first.rgb)
    Image.fromarray(rng.integers(0, 256, (44, 60, 3), dtype=np.uint8)).save(tmp_path / "a.png")
    assert (view.load().rgb != first.rgb).any()
    assert len(list((tmp_path / "cache").rglob("*.png"))) == 2


def test_cache_that_cannot_be_written_is_ignored(tmp_path):
    Image.new("RGB", (60, 44), (9, 8, 7)).save(tmp_path / "a.png")
    (tmp_path / "cache").write_text("a file where the folder should be")
    assert (distorted_view(tmp_path).load().rgb == (9, 8, 7)).all()


def test_cache_folder_from_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("LINPRIM_GEO_CACHE", str(tmp_path))
    assert photos.cache_folder() == tmp_path
    assert photos.cache_folder(tmp_path / "x") == tmp_path / "x"
    monkeypatch.delenv("LINPRIM_GEO_CACHE")
    assert photos.cache_folder().parts[-2:] == (".cache", "linprim-geo")
