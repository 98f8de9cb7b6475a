"""Points on surfaces by stereo of small photographs: on the walls of a textured room, and inside masks."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at
from helpers.textured_room import HALF, photograph, wall_texture
from PIL import Image

from linprim_geo.capture.types import View
from linprim_geo.stereo import surface_points as module
from linprim_geo.stereo.depth_maps import CONFIRMING, DepthMap
from linprim_geo.stereo.surface_points import SurfaceMap, small_copies, surface_maps, surface_points

CENTERS = [(x, y, 0.0) for y in (-0.35, 0.0) for x in (-0.7, -0.35, 0.0)]
SIZE = (96, 72)
# Centre and normal of a plate in front of a corner of the room, and half of its side length.
PLATE, HALF_PLATE = (np.array([0.5, 0.8, 0.0]), np.array([0.6, 0.8, 0.0])), 0.35
# A pixel at the corner of the room is 2.6 / 80 there, and the best parallax 0.78: a tenth of a pixel of disparity
# is 1 % of the depth. Depths are confirmed within CONFIRMED_DEPTH, 1 %.
TOLERANCE = 0.03 * 2.6


@pytest.fixture(scope="module")
def views(tmp_path_factory) -> list[View]:
    root = tmp_path_factory.mktemp("room")
    taken = [look_at(center, target=(1.6, 2.0, 0.1), size=SIZE, focal=80.0) for center in CENTERS]
    for number, camera in enumerate(taken):
        Image.fromarray(photograph(camera)).save(root / f"{number}.png")
    return [View(f"{number}.png", camera, root / f"{number}.png") for number, camera in enumerate(taken)]


@pytest.fixture(scope="module")
def known(views) -> np.ndarray:
    """Some points of the walls."""
    rays = views[0].camera.world_rays()
    with np.errstate(divide="ignore"):
        depth = ((np.sign(rays) * HALF - views[0].camera.center) / rays).min(axis=-1)
    return (views[0].camera.center + rays * depth[..., None])[::6, ::6].reshape(-1, 3)


def off_the_walls(points: np.ndarray) -> np.ndarray:
    return np.abs(np.abs(points).max(1) - HALF)


def share_known(maps: list[SurfaceMap]) -> float:
    return float(np.mean([found.known.mean() for found in maps]))


def test_points_lie_on_the_walls(views, known):
    maps = surface_maps(small_copies(views), known, 0)
    found = surface_points(maps, 500, 0)
    assert share_known(maps) > 0.5 and found.xyz.shape == found.rgb.shape == (500, 3)
    assert np.median(off_the_walls(found.xyz)) < TOLERANCE / 3
    assert (off_the_walls(found.xyz) < TOLERANCE).mean() > 0.95
    # Colours agree with the nearest pixel of a photograph; they are means over views.
    camera = views[0].camera
    pixels, depth = camera.project(found.xyz)
    inside = (depth > 0) & ((pixels > 1) & (pixels < np.array(SIZE) - 1)).all(1)
    column, row = pixels[inside].astype(int).T
    shown = views[0].load().rgb[row, column].astype(float)
    assert np.abs(shown - found.rgb[inside]).mean() < 15


def test_points_are_a_reproducible_subset_of_known_depths(views, known):
    maps, same = (surface_maps(small_copies(views), known, 3) for _ in range(2))
    few, again, every = surface_points(maps, 100, 3), surface_points(same, 100, 3), surface_points(maps, 10**6, 3)
    assert len(few.xyz) == 100 and (few.xyz == again.xyz).all()
    assert len(every.xyz) == sum(int(found.known.sum()) for found in maps)
    rows = {tuple(point) for point in every.xyz}
    assert all(tuple(point) in rows for point in few.xyz)


def test_skies_are_detected_only_on_request(views, known, monkeypatch):
    seen = [number % 2 == 0 for number in range(len(views))]
    monkeypatch.setattr(module, "shows_sky", lambda maps: seen)
    assert [found.shows_sky for found in surface_maps(small_copies(views), known, 0, skies=True)] == seen
    monkeypatch.setattr(module, "shows_sky", lambda maps: pytest.fail("nobody asks"))
    assert not any(found.shows_sky for found in surface_maps(small_copies(views), known, 0))


def test_masked_pixels_give_no_points(views, known, tmp_path):
    kept = []
    for view in views:
        alpha = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        alpha[: SIZE[1] // 2] = 255
        Image.fromarray(alpha).save(tmp_path / view.name)
        kept.append(View(view.name, view.camera, view.image_path, mask_path=tmp_path / view.name, has_alpha=True))
    maps = surface_maps(small_copies(kept), known, 0)
    found = surface_points(maps, 10**6, 0)
    assert 0 < share_known(maps) <= 0.5 and len(found.xyz)
    # Every point lies in the unmasked upper half of at least one view.
    shown = np.zeros(len(found.xyz), bool)
    for view in views:
        pixels, depth = view.camera.project(found.xyz)
        shown |= (depth > 0) & (pixels[:, 1] < SIZE[1] / 2 + 1)
    assert shown.all()


def with_a_plate(camera) -> np.ndarray:
    """The room with a textured plate in it."""
    rays = camera.world_rays()
    along = rays @ PLATE[1]
    t = (PLATE[0] - camera.center) @ PLATE[1] / along
    points = camera.center + t[..., None] * rays
    on = on_the_plate(points, 0.0) & (t > 0)
    return np.where(on[..., None], wall_texture(points[..., [1, 2, 0]]), photograph(camera)).astype(np.uint8)


def on_the_plate(points: np.ndarray, margin: float) -> np.ndarray:
    middle, normal = PLATE
    across = points - middle
    off = across @ normal
    inside = np.abs(across - off[..., None] * normal).max(-1) < HALF_PLATE + margin
    return inside & (np.abs(off) < 0.03)


def test_depths_without_support_give_no_points(known, tmp_path, monkeypatch):
    """Beside edges of the plate windows contain plate and wall, and stereo gives depths in front of the wall."""
    kept = []
    for number, center in enumerate(CENTERS):
        camera, path = look_at(center, target=(1.6, 2.0, 0.1), size=SIZE, focal=80.0), tmp_path / f"{number}.png"
        Image.fromarray(with_a_plate(camera)).save(path)
        kept.append(View(path.name, camera, path))

    def share_in_the_air() -> tuple[float, int]:
        xyz = surface_points(surface_maps(small_copies(kept), known, 0), 10**6, 0).xyz
        air = (off_the_walls(xyz) > TOLERANCE) & ~on_the_plate(xyz, 0.0)
        return air.mean(), int(on_the_plate(xyz, 0.0).sum())

    share, on_plate = share_in_the_air()
    monkeypatch.setattr(module, "LEAST_SUPPORT", 0.0)
    monkeypatch.setattr(DepthMap, "is_confirmed", lambda self, *_: self.confirming >= CONFIRMING)
    share_of_all, on_plate_of_all = share_in_the_air()
    assert share_of_all > 0.001 and share < 0.3 * share_of_all and on_plate > 0.6 * on_plate_of_all > 1000


def test_small_copies_average_pixels_and_are_limited_in_number(views, monkeypatch):
    monkeypatch.setattr(module, "LONGER_SIDE", 40)
    monkeypatch.setattr(module, "MOST_VIEWS", 3)
    small = small_copies(views)
    assert [view.name for view in small] == ["0.png", "2.png", "5.png"]
    photo, full = small[0].load().rgb, views[0].load().rgb.astype(float)
    assert photo.shape == (24, 32, 3) and (small[0].camera.width, small[0].camera.height) == (32, 24)
    assert np.abs(photo - full.reshape(24, 3, 32, 3, 3).mean((1, 3))).max() <= 1
    assert small[0].camera.fx == pytest.approx(views[0].camera.fx / 3)
