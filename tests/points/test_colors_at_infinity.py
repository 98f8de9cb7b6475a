"""Share of what photographs show at infinity, for a panorama, edges, noise and different exposures."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
from helpers.captures import look_at, transforms
from PIL import Image

from linprim_geo.capture.load import load_scene
from linprim_geo.points.colors_at_infinity import OPEN_SHARE, far_share

VIEWS, SIZE, FOCAL = 16, (160, 120), 120.0


def cameras():
    """On a circle of radius 1, looking across its middle."""
    angles = 2 * np.pi * np.arange(VIEWS) / VIEWS
    return [look_at((np.cos(a), np.sin(a), 0.0), (0.0, 0.0, 0.0), size=SIZE, focal=FOCAL) for a in angles]


def panorama(rays):
    """(H, W, 3) colours of directions, as fine as some pixels."""
    way = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    value = 120 + 60 * np.sin(14 * way[..., 0] + 3 * way[..., 2]) * np.cos(12 * way[..., 1] - 9 * way[..., 2])
    return np.stack([value, 0.9 * value, 0.8 * value], -1)


def scene_of(folder, pictures, of_cameras=None):
    paths = []
    for number, picture in enumerate(pictures):
        paths.append(f"{number}.png")
        Image.fromarray(np.clip(np.rint(picture), 0, 255).astype(np.uint8)).save(folder / paths[-1])
    (folder / "transforms.json").write_text(json.dumps(transforms(of_cameras or cameras(), paths)))
    return load_scene(folder)


def test_panorama_is_recognised(tmp_path):
    scene = scene_of(tmp_path, [panorama(camera.world_rays()) for camera in cameras()])
    assert far_share(scene, None) > 0.5


def test_edges_along_the_motion_are_not_taken_for_a_panorama(tmp_path):
    """Cameras move along a near wall with horizontal stripes, which would look the same at infinity."""
    passing = [look_at((x, -3.0, 0.0), (x, 0.0, 0.0), size=SIZE, focal=FOCAL) for x in np.linspace(-1, 1, VIEWS)]
    height = passing[0].world_rays()[..., 2]
    picture = np.repeat((120 + 60 * np.sin(25 * height))[..., None], 3, -1)
    assert far_share(scene_of(tmp_path, [picture] * VIEWS, passing), None) < OPEN_SHARE


def test_unrelated_textures_are_not_taken_for_a_panorama(tmp_path):
    """Every photograph shows a texture that no other photograph shows."""
    rng = np.random.default_rng(0)
    pictures = [panorama(camera.world_rays() + rng.uniform(-9, 9, 3)) for camera in cameras()]
    assert far_share(scene_of(tmp_path, pictures), None) < OPEN_SHARE


def test_uniform_photographs_have_no_far_share(tmp_path):
    scene = scene_of(tmp_path, [np.full((SIZE[1], SIZE[0], 3), 130.0) for _ in cameras()])
    assert far_share(scene, None) == 0


def test_known_gains_increase_the_far_share(tmp_path):
    gains = np.exp(np.random.default_rng(1).uniform(-0.4, 0.4, (VIEWS, 1)))
    scene = scene_of(tmp_path, [gain * panorama(c.world_rays()) for gain, c in zip(gains, cameras(), strict=True)])
    trained = [int(view.name.split("/")[-1].split(".")[0]) for view in scene.train]
    even = SimpleNamespace(gains=np.repeat(gains[trained], 3, 1))
    assert far_share(scene, even) > 2 * far_share(scene, None)
