"""The picture of a mesh before and after it was smoothed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.surface.shaded_views import PIXELS, apart, save_shaded, shaded_file

SQUARE = Mesh(np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 2, 1], [0, 3, 2]]))


def facing(x: float, tilt: float = 0.0, size: tuple[int, int] = (40, 30)) -> Camera:
    """At (x, 0, -3), looking along z, turned about y by `tilt`."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(tilt), 0, -np.sin(tilt)], [0, 1, 0], [np.sin(tilt), 0, np.cos(tilt)]]
    pose[:3, 3] = -pose[:3, :3] @ [x, 0, -3]
    return Camera(*size, 40.0, 40.0, size[0] / 2, size[1] / 2, pose)


def test_a_row_for_each_mesh_from_the_same_cameras(tmp_path):
    half = replace(SQUARE, vertices=SQUARE.vertices * [0.5, 1, 1])
    cameras = [facing(0), facing(0.1), facing(-0.1, size=(30, 40))]
    target = tmp_path / "part.obj"
    path = save_shaded(target, [(each, RayCaster(each.vertices, each.faces)) for each in (SQUARE, half)], cameras)
    assert path == shaded_file(target) == tmp_path / "part_shaded.png"
    picture = np.asarray(Image.open(path))
    assert picture.shape == (2 * 40, 40 + 40 + 30, 3)
    there = (picture != 255).any(2)
    # The square is 2 at a distance of 3, so 26.7 pixels wide, or 28 with those that it covers in part; the other is
    # half as wide, and as high.
    for row, width in ((0, 28), (40, 14)):
        sizes = [28 * width] * 3
        parts = [there[row : row + 40, left : left + 40] for left in (0, 40, 80)]
        assert [part.sum() for part in parts] == pytest.approx(sizes, abs=2 * 28)
        assert sum(not part[30:].any() for part in parts) == 2  # white below those that are lower
    assert picture[15, 20] == pytest.approx(205, abs=1)  # lit from the camera, seen from straight ahead


def test_large_photographs_have_small_pictures(tmp_path):
    small = facing(0)
    large = small.magnified(100)
    path = save_shaded(tmp_path / "m.ply", [(SQUARE, RayCaster(SQUARE.vertices, SQUARE.faces))], [large])
    picture = np.asarray(Image.open(path))
    assert picture.shape == (PIXELS * 30 // 40, PIXELS, 3)
    assert (picture != 255).any(2).sum() / picture[..., 0].size == pytest.approx(26.7**2 / 1200, rel=0.02)


def test_cameras_are_apart_by_place_and_by_look():
    assert apart([facing(0)]) == [0] and apart([facing(0), facing(0)]) == [0, 0]
    line = [facing(x) for x in (-2.0, -1.9, 0.0, 1.9, 2.3)]
    assert apart(line) == [2, 4, 0]
    turned = [facing(0.0, tilt) for tilt in (0.0, 0.1, 1.0, -0.9)]
    assert sorted(apart(turned)[1:]) == [2, 3]
