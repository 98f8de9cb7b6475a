"""Shaded pictures of a mesh before and after smoothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.surface.shaded_views import GREY, PIXELS, most_different, save_shaded, shaded_file, shaded_row

SQUARE = Mesh(np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 2, 1], [0, 3, 2]]))


def facing(x: float, tilt: float = 0.0, size: tuple[int, int] = (40, 30)) -> Camera:
    """A camera at (x, 0, -3) that looks along z, turned about y by `tilt`."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(tilt), 0, -np.sin(tilt)], [0, 1, 0], [np.sin(tilt), 0, np.cos(tilt)]]
    pose[:3, 3] = -pose[:3, :3] @ [x, 0, -3]
    return Camera(*size, 40.0, 40.0, size[0] / 2, size[1] / 2, pose)


def test_each_mesh_has_a_row_of_views(tmp_path):
    half = replace(SQUARE, vertices=SQUARE.vertices * [0.5, 1, 1])
    cameras = [facing(0), facing(0.1), facing(-0.1, size=(30, 40))]
    rows = [shaded_row(each, RayCaster(each.vertices, each.faces), cameras) for each in (SQUARE, half)]
    save_shaded(tmp_path / "part.obj", rows)
    assert shaded_file(tmp_path / "part.obj") == tmp_path / "part_shaded.png"
    picture = np.asarray(Image.open(tmp_path / "part_shaded.png"))
    assert picture.shape == (2 * 40, 40 + 40 + 30, 3)
    there = (picture != 255).any(2)
    # The square is 2 at a distance of 3, so 26.7 pixels wide, or 28 with those that it covers in part; the other is
    # half as wide, and as high.
    for row, width in ((0, 28), (40, 14)):
        sizes = [28 * width] * 3
        parts = [there[row : row + 40, left : left + 40] for left in (0, 40, 80)]
        assert [part.sum() for part in parts] == pytest.approx(sizes, abs=2 * 28)
        assert sum(not part[30:].any() for part in parts) == 2  # white below those that are lower
    assert picture[15, 20] == pytest.approx(GREY, abs=1)  # lit from the camera, seen from straight ahead


def test_large_photographs_are_averaged_down():
    large = facing(0).magnified(100)
    picture = shaded_row(SQUARE, RayCaster(SQUARE.vertices, SQUARE.faces), [large])
    factor = 9  # the least by which 4,000 pixels are PIXELS at most
    assert 4000 / factor <= PIXELS < 4000 / (factor - 1) and picture.shape == (3000 // factor, 4000 // factor, 3)
    assert (picture != 255).any(2).sum() / picture[..., 0].size == pytest.approx(26.7**2 / 1200, rel=0.02)


def test_most_different_uses_position_and_direction():
    assert most_different([facing(0)]) == [0] and most_different([facing(0), facing(0)]) == [0, 0]
    line = [facing(x) for x in (-2.0, -1.9, 0.0, 1.9, 2.3)]
    assert most_different(line) == [2, 4, 0]
    turned = [facing(0.0, tilt) for tilt in (0.0, 0.1, 1.0, -0.9)]
    assert sorted(most_different(turned)[1:]) == [2, 3]
    # Rounding differences between equal positions are ignored.
    for k, camera in enumerate(turned):
        camera.world_to_camera[0, 3] += 1e-15 * (-1) ** k
    assert sorted(most_different(turned)[1:]) == [2, 3]
