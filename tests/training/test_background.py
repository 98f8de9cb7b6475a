"""Detection of a plain backdrop by colours and points at image borders."""

import numpy as np
import pytest
from PIL import Image

from linprim_geo.capture.types import PointCloud, Scene, View
from linprim_geo.geometry.camera import Camera
from linprim_geo.points.initial_points import VolumePoints
from linprim_geo.training.background import BACKDROP_SHARE, plain_border

WIDTH, HEIGHT, VIEWS = 160, 120, 5


def capture(folder, seed, points, kind=PointCloud, greys=(120,) * VIEWS) -> Scene:
    """Photographs of a colourful object in front of a nearly uniform grey, and points at these (N, 2) pixels."""
    rng, views = np.random.default_rng(seed), []
    for k, grey in enumerate(greys):
        rgb = rng.normal(grey, 6, (HEIGHT, WIDTH, 3))
        rgb[35:85, 45:115] = rng.uniform(0, 255, (50, 70, 3))
        path = folder / f"{k}.png"
        Image.fromarray(np.clip(np.rint(rgb), 0, 255).astype(np.uint8)).save(path)
        camera = Camera(WIDTH, HEIGHT, 150.0, 150.0, WIDTH / 2, HEIGHT / 2, np.eye(4))
        views.append(View(path.name, camera, path))
    xyz = np.concatenate([(points - [WIDTH / 2, HEIGHT / 2]) / 150, np.ones((len(points), 1))], 1) * 4.0
    cloud = kind(xyz, np.zeros((len(xyz), 3), np.uint8))
    return Scene(folder, "test", tuple(views), (), cloud)


def on_object(rng, count=300):
    return rng.uniform([45, 35], [115, 85], (count, 2))


@pytest.mark.parametrize("seed", range(3))
def test_a_uniform_backdrop_with_a_few_wrong_points_is_plain(tmp_path, seed):
    rng = np.random.default_rng(seed)
    wrong = rng.uniform([0, 0], [WIDTH, HEIGHT], (8, 2))
    assert plain_border(capture(tmp_path, seed, np.concatenate([on_object(rng), wrong]))) > BACKDROP_SHARE


@pytest.mark.parametrize("seed", range(3))
def test_a_uniform_carpet_with_points_is_no_backdrop(tmp_path, seed):
    rng = np.random.default_rng(seed)
    carpet = rng.uniform([0, 0], [WIDTH, HEIGHT], (800, 2))  # half as dense as the object
    assert plain_border(capture(tmp_path, seed, np.concatenate([on_object(rng), carpet]))) < 0.3


def test_colour_decides_without_surface_points(tmp_path):
    everywhere = np.random.default_rng(0).uniform([0, 0], [WIDTH, HEIGHT], (400, 2))
    for points, kind in ((everywhere, VolumePoints), (np.zeros((0, 2)), PointCloud)):
        assert plain_border(capture(tmp_path, 0, points, kind)) > 0.95


def test_different_colours_are_no_backdrop(tmp_path):
    scene = capture(tmp_path, 0, np.zeros((0, 2)), greys=(60, 90, 120, 150, 180))
    assert plain_border(scene) < 0.5
