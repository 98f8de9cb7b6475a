"""Objects found by their outlines: a textureless ball in front of a far background is found, a rendered ball that the
photographs do not show is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.visibility import silhouette_bounded as module
from linprim_geo.stereo.visibility.silhouette_bounded import between_silhouettes, silhouette_bounded
from linprim_geo.stereo.visibility.thin_things import RenderedView

# A ball of radius 1 at the origin, seen from a distance of 5, inside of a sphere of radius 30.
RADIUS, AWAY, FAR = 1.0, 5.0, 30.0
NOISE = 2.0
PLAIN, BRIGHT = (40.0, 36.0, 30.0), 150.0


def cameras(count: int = 12, turn: float = 360.0) -> list[Camera]:
    """On an arc of `turn` degrees round the ball."""
    angles = np.radians(np.linspace(0, turn, count, endpoint=False))
    places = [(AWAY * np.cos(a), AWAY * np.sin(a), 1.0 + 0.3 * (-1) ** k) for k, a in enumerate(angles)]
    return [look_at(place, size=(72, 54), focal=80.0) for place in places]


def sphere_depth(camera: Camera, radius: float, near: bool) -> np.ndarray:
    """(H, W) depth of the near or far side of a sphere round the origin, NaN beside it."""
    rays = camera.world_rays()
    square, half = (rays**2).sum(-1), rays @ camera.center
    with np.errstate(invalid="ignore"):
        root = np.sqrt(half**2 - square * (camera.center @ camera.center - radius**2))
    return (-half + (-root if near else root)) / square


def view_of(camera: Camera, seed: int, *, painted: bool = True, ball=PLAIN, stripes: float = 0.0) -> RenderedView:
    """Return a view that renders the ball. The photograph has it if `painted`, with a texture of amplitude
    `stripes`."""
    near, behind = sphere_depth(camera, RADIUS, True), sphere_depth(camera, FAR, False)
    on_ball = np.isfinite(near)
    colors = np.full((*near.shape, 3), BRIGHT)
    if painted:
        place = camera.center + camera.world_rays() * np.where(on_ball, near, 0)[..., None]
        texture = stripes * np.sign(np.sin(14 * place[..., 2]) * np.sin(14 * place[..., 0]))
        colors[on_ball] = (np.asarray(ball) + texture[..., None])[on_ball]
    colors += NOISE * np.random.default_rng(seed).standard_normal(colors.shape)
    rendered = np.where(on_ball, near, behind).astype(np.float32)
    rgb = np.clip(np.rint(colors), 0, 255).astype(np.uint8)
    return RenderedView(camera, rgb, NOISE**2, rendered, np.ones(near.shape, bool), rendered)


def views(count: int = 12, turn: float = 360.0, **options) -> list[RenderedView]:
    return [view_of(camera, seed, **options) for seed, camera in enumerate(cameras(count, turn))]


def share_found(seen: list[RenderedView]) -> tuple[float, float]:
    """Share of found pixels on the ball, and on the sphere behind it."""
    ball = np.stack([np.isfinite(sphere_depth(view.camera, RADIUS, True)) for view in seen])
    found = np.stack(silhouette_bounded(seen))
    return found[ball].mean(), found[~ball].mean()


def test_a_textureless_ball_is_found_by_its_outlines():
    found, wrong = share_found(views())
    assert found > 0.85 and wrong == 0


def test_a_rendered_ball_absent_from_photographs_is_not_found():
    """Every view renders the ball, but the photographs show a plain wall without edges."""
    assert share_found(views(painted=False)) == (0, 0)


def test_a_textured_ball_is_left_to_stereo():
    textured = views(ball=(100.0, 100.0, 100.0), stripes=40.0)
    assert share_found(textured)[0] < 0.05
    # Without the texture the same ball is found.
    assert share_found(views(ball=(100.0, 100.0, 100.0)))[0] > 0.85


@pytest.mark.parametrize(("turn", "known"), [(80.0, False), (130.0, True)])
def test_views_from_a_wide_range_of_directions_are_required(turn, known):
    """Outlines that are seen from one side only do not determine the depth."""
    found, _ = share_found(views(turn=turn))
    assert found == 0 if not known else found > 0.2


def test_two_views_are_not_enough():
    assert share_found(views(2, 180.0))[0] == 0


def test_outlines_missing_in_most_views_find_nothing():
    """Seven of twelve photographs show no edge where the ball ends."""
    seen, plain = views(), views(painted=False)
    assert share_found([plain[k] if k % 2 == 0 or k == 1 else seen[k] for k in range(12)])[0] < 0.05


def test_blurred_depths_are_not_used():
    seen = [replace(view, sharp=np.zeros_like(view.sharp)) for view in views()]
    assert share_found(seen) == (0, 0)


def test_runs_of_pixels_need_an_outline_at_both_ends():
    depth = np.full((8, 40), 9.0, np.float32)
    depth[:, 10:25] = 3.0  # farther depths on both sides
    depth[:, 32:] = 3.0  # reaches the border of the photograph
    depth[:, 38:] = 2.0
    rgb = np.where(depth[..., None] < 5, 40, 160).repeat(3, -1).astype(np.uint8)
    camera = Camera(40, 8, 30.0, 30.0, 20.0, 4.0, np.eye(4))
    view = RenderedView(camera, rgb, 1.0, depth, np.ones(depth.shape, bool), depth)
    expected = np.zeros(depth.shape, bool)
    expected[:, 10:25] = True
    np.testing.assert_array_equal(between_silhouettes(view), expected)
    # An edge may be off by two pixels, not by five.
    for shift, found in ((2, True), (-2, True), (5, False)):
        moved = replace(view, rgb=np.roll(rgb, shift, axis=1))
        assert between_silhouettes(moved)[:, 10:25].all() == found
    # Columns are treated as rows are.
    turned = replace(
        view,
        camera=Camera(8, 40, 30.0, 30.0, 4.0, 20.0, np.eye(4)),
        rgb=rgb.transpose(1, 0, 2),
        rendered=depth.T,
        sharp=view.sharp.T,
    )
    np.testing.assert_array_equal(between_silhouettes(turned), expected.T)
    # A rendered depth of zero counts as farther than any other.
    nothing = replace(view, rendered=np.where(depth > 5, 0, depth))
    np.testing.assert_array_equal(between_silhouettes(nothing), expected)


def test_cubes_agree_with_sets_of_grid_cells():
    """Very distant points are in no cube, and integers do not overflow."""
    rng = np.random.default_rng(3)
    inside, others = rng.normal(size=(500, 3)), rng.normal(size=(500, 3))
    cubes = module._Cubes(np.vstack([inside, [[1e30, 0, -1e30]]]), 0.3)
    cells = [{tuple(cell) for cell in np.floor(points / 0.3)} for points in (inside, others)]
    number = cubes.of(others)
    np.testing.assert_array_equal(number >= 0, [tuple(cell) in cells[0] for cell in np.floor(others / 0.3)])
    assert len(np.unique(number[number >= 0])) == len(cells[0] & cells[1])
    np.testing.assert_array_equal(cubes.of(np.array([[1e30, 0, -1e30], [-1e30, 1e9, 0]])), [-1, -1])
