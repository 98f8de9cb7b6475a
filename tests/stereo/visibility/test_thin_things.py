"""Thin objects in front of a wall: a rendered wire is kept, fog is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.stereo.visibility.thin_things import DEVIATIONS, RenderedView, channel_gains, thin_things

# A wall at z = 0, seen from z = -3, and an upright wire of about four pixels, 0.4 in front of it.
WIRE, HALF_WIDTH = 0.4, 0.055
CAMERAS = [
    look_at((x, y, -3.0), (0.3 * x, 0.3 * y, 0.0), size=(96, 64), focal=110.0, up=(0.0, 1.0, 0.0))
    for x, y in [(0, 0), (0.5, 0.1), (-0.5, 0), (0.25, -0.3), (-0.25, 0.3), (0.8, 0), (-0.8, -0.1), (0, 0.4)]
]


def wall_colors(points):
    """(..., 3) colours of a texture fine enough for stereo."""
    x, y = points[..., 0], points[..., 1]
    value = 110 + 30 * np.sin(9 * x + 2 * y) * np.cos(7 * y - x) + 20 * np.sin(23 * x) * np.sin(19 * y)
    return np.stack([value, 0.8 * value, 0.7 * value], -1)


def depth_at(camera, z):
    """(H, W) depth of the plane at z."""
    return (z - camera.center[2]) / camera.world_rays()[..., 2]


def view_of(camera, noise=0.0, seed=0, wire=(20, 30, 140)):
    """Return a view in which the wire is rendered and stereo knows only the wall, and the mask of the wire."""
    wall, front = depth_at(camera, 0.0), depth_at(camera, -WIRE)
    rays = camera.world_rays()
    on_wire = np.abs((camera.center + rays * front[..., None])[..., 0]) < HALF_WIDTH
    colors = wall_colors(camera.center + rays * wall[..., None])
    colors[on_wire] = np.asarray(wire)
    colors += noise * np.random.default_rng(seed).standard_normal(colors.shape)
    rgb = np.clip(np.rint(colors), 0, 255).astype(np.uint8)
    rendered = np.where(on_wire, front, wall).astype(np.float32)
    sharp = np.ones(wall.shape, bool)
    return RenderedView(camera, rgb, max(1.0, noise**2 / 2), rendered, sharp, wall.astype(np.float32)), on_wire


@pytest.fixture(scope="module")
def scene():
    pairs = [view_of(camera, seed=k) for k, camera in enumerate(CAMERAS)]
    return [view for view, _ in pairs], [wire for _, wire in pairs]


def found_share(views, wires):
    """Share of the wire that is found, and share of found pixels that are not on the wire."""
    found, wires = np.stack(thin_things(views)), np.stack(wires)
    return (found & wires).sum() / wires.sum(), (found & ~wires).sum() / max(found.sum(), 1)


def test_a_wire_in_front_of_a_wall_is_found(scene):
    found, wrong = found_share(*scene)
    assert found > 0.7 and wrong == 0


def test_a_wire_is_found_under_noise_and_drifting_exposure(scene):
    pairs = [view_of(camera, 3.0, k, wire=(160, 130, 50)) for k, camera in enumerate(CAMERAS)]
    gains = np.exp(np.linspace(-0.2, 0.2, len(CAMERAS)))
    dimmed = [
        replace(v, rgb=np.clip(v.rgb * g, 0, 255).astype(np.uint8)) for (v, _), g in zip(pairs, gains, strict=True)
    ]
    np.testing.assert_allclose(channel_gains(dimmed), np.repeat(gains[:, None], 3, 1), rtol=0.03)
    found, wrong = found_share(dimmed, [wire for _, wire in pairs])
    assert found > 0.6 and wrong == 0


def test_fog_is_rejected_where_photographs_show_the_wall():
    """All views render the wire, but the photographs show the wall only."""
    views = []
    for camera in CAMERAS:
        view, _ = view_of(camera)
        seen = wall_colors(camera.center + camera.world_rays() * depth_at(camera, 0.0)[..., None])
        views.append(replace(view, rgb=np.rint(seen).astype(np.uint8)))
    assert not np.stack(thin_things(views)).any()


def test_four_views_must_render_the_wire(scene):
    views, _ = scene

    def rendered_by(count):
        nothing = [replace(view, rendered=np.zeros_like(view.rendered)) for view in views]
        return np.stack(thin_things([*views[:count], *nothing[count:]]))

    # With three views only two others agree with each; the remaining views render nothing.
    assert not rendered_by(3).any() and rendered_by(4).any()


def test_a_wire_that_many_views_see_through_is_rejected(scene):
    views, wires = scene
    # Four of eight views render it: for each of them three others agree and four see through it.
    half = [view if k % 2 else replace(view, rendered=view.known) for k, view in enumerate(views)]
    assert np.stack(thin_things(half)).sum() < 0.05 * np.stack(wires)[1::2].sum()
    most = [view if k < 7 else replace(view, rendered=view.known) for k, view in enumerate(views)]
    assert np.stack(thin_things(most)).sum() > 0.5 * np.stack(wires)[:7].sum()


def test_blurred_depths_are_rejected(scene):
    views, _ = scene
    fog = [replace(view, sharp=~view.sharp) for view in views]
    first, *others = thin_things([fog[0], *views[1:]])
    assert not first.any() and all(other.any() for other in others)
    assert not np.stack(thin_things([views[0], *fog[1:]])).any()


@pytest.mark.parametrize(("part", "found"), [(0.5, False), (2.0, True)])
def test_contrast_must_exceed_the_noise(part, found):
    """The difference of two means of nine pixels has 2/3 of the deviation of grey values; channels have twice their
    variance."""
    views, noise = [], 8.0
    for camera in CAMERAS:
        view, on_wire = view_of(camera)
        colors = np.full((*on_wire.shape, 3), 100.0)
        colors[on_wire] += part * DEVIATIONS * np.sqrt(noise) * 2 / 3
        views.append(replace(view, rgb=np.rint(colors).astype(np.uint8), noise=noise))
    assert np.stack(thin_things(views)).any() == found


def test_isolated_agreeing_pixels_are_rejected(scene):
    """A surface is rendered in front of the wall, but photographs agree with it in one row of twelve only."""
    views, _ = scene
    changed, lone = [], 0
    for view in views:
        wall = depth_at(view.camera, 0.0)
        front = depth_at(view.camera, -WIRE)
        colors = wall_colors(view.camera.center + view.camera.world_rays() * wall[..., None])
        place = view.camera.center + view.camera.world_rays() * front[..., None]
        stripes = (np.abs(place[..., 0]) < 0.3) & (np.floor(place[..., 1] / 0.025) % 12 == 0)
        colors[stripes] = (20, 30, 140)
        lone += stripes.sum()
        rendered = np.where(np.abs(place[..., 0]) < 0.3, front, wall).astype(np.float32)
        changed.append(replace(view, rgb=np.rint(colors).astype(np.uint8), rendered=rendered))
    assert np.stack(thin_things(changed)).sum() < 0.1 * lone


def test_unknown_depths_and_black_photographs_find_nothing(scene):
    views, _ = scene
    unknown = [replace(view, known=np.full_like(view.known, np.nan)) for view in views]
    assert not np.stack(thin_things(unknown)).any()
    np.testing.assert_array_equal(channel_gains(unknown), 1.0)
    dark = [replace(view, rgb=np.zeros_like(view.rgb)) for view in views]
    assert not np.stack(thin_things(dark)).any()
