"""Choice of source views."""

from __future__ import annotations

import numpy as np
from helpers.captures import look_at

from linprim_geo.points import view_pairs


def test_more_source_views_cover_every_point():
    """Two walls with five cameras in front of each, and one camera in the middle that sees half of both."""
    rng = np.random.default_rng(0)
    left, right = (rng.uniform([x - 1, 3.9, -1], [x + 1, 4.1, 1], (400, 3)) for x in (-1.2, 1.2))
    cameras = [look_at((0.0, 0.0, 0.0), (0.0, 4.0, 0.0), size=(60, 40))]
    for x in (-1.2, 1.2):
        for k in range(5):
            place = (x + 0.3 * (k - 2), 0.5, 0.0)
            cameras.append(look_at(place, (place[0], 4.0, 0.0), size=(30, 40)))
    points = np.concatenate([left, right])
    few, many = (view_pairs.source_views(cameras, points, most)[0] for most in (view_pairs.SOURCES, 8))
    assert len(few) == view_pairs.SOURCES and many[: len(few)] == few and len(many) == 8
    seen = np.stack([view_pairs.visible_pixels(camera, points)[0] for camera in cameras])
    own = seen[0]
    assert own[:400].sum() > 100 and own[400:].sum() > 100
    times = seen[many][:, own].sum(0)
    assert (times >= 3).mean() > 0.9 > (seen[few][:, own].sum(0) >= 3).mean()


def test_views_without_overlap_or_baseline_are_not_chosen():
    points = np.random.default_rng(0).uniform([-0.3, 1.9, -0.3], [0.3, 2.1, 0.3], (300, 3))
    cameras = [look_at((x, 0.0, 0.0), (x, 2.0, 0.0), size=(40, 30)) for x in (0.0, 0.3, -0.3, 0.02)]
    cameras.append(look_at((0.0, 0.0, 0.0), (0.0, -2.0, 0.0), size=(40, 30)))
    # The fourth is too near, the last looks away.
    assert sorted(view_pairs.source_views(cameras, points, 8)[0]) == [1, 2]
    assert view_pairs.source_views(cameras[:1], points) == [[]]


def test_known_depths_select_views_that_see_past_an_occluder():
    """A wall with a board in front, which hides more of the wall from the cameras on one side."""
    rng = np.random.default_rng(0)
    wall = rng.uniform([-1.5, 4, -1], [1.5, 4, 1], (2000, 3))
    cameras = [look_at((0.0, 0.0, 0.0), (0.0, 4.0, 0.0), size=(60, 40))]
    cameras += [look_at((x, 0.0, 0.0), (x, 4.0, 0.0), size=(60, 40)) for x in (0.4, 0.45, 0.5, 0.55, -0.4, -0.45, -0.5)]

    def depth(camera) -> np.ndarray:
        """The board is at y = 2, from x = 0.2 on."""
        rays = camera.world_rays()
        board = camera.center[0] + (2 - camera.center[1]) * rays[..., 0] / rays[..., 1] > 0.2
        return np.where(board, 2.0, 4.0)

    depths = [depth(camera) for camera in cameras]
    blind, told = (view_pairs.source_views(cameras, wall, 8, known)[0] for known in (None, depths))
    # The part of the wall that the first camera sees right of its middle is seen by the last three only.
    assert sorted(blind) == [1, 2, 3, 4] and sorted(told[:3]) == [5, 6, 7]
    # A view without depth hides no point.
    assert view_pairs.source_views(cameras, wall, 8, [0 * own for own in depths])[0] == blind


def test_angles_of_source_views_grow_if_there_are_few():
    """Cameras on a circle around the points. If too few lie within 30 degrees, views up to 60 degrees are added until a
    depth can be confirmed."""
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (300, 3))

    def compared(degrees: list[float]) -> list[int]:
        eyes = [(2 * np.cos(angle), 2 * np.sin(angle), 0.0) for angle in np.radians(degrees)]
        return sorted(view_pairs.source_views([look_at(eye, (0.0, 0.0, 0.0)) for eye in eyes], points, 8)[0])

    assert compared([0, 50, -50]) == [1, 2]
    assert compared([0, 20, -20, 50, -50]) == [1, 2]
    assert compared([0, 20, 50, 52, 54]) == [1, 2]
    assert compared([0, 75, -75]) == []
