"""The courtyard: shapes of its masonry, closed walls, and cameras clear of surfaces."""

import numpy as np
import pytest
from helpers.traced import nearest_surface, pixel_rays, unit_normals

from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic.options import SynthOptions
from linprim_geo.synthetic.realism import courtyard, courtyard_things, masonry, parts, render, scenes
from linprim_geo.synthetic.realism.parts import Material

SMALL_WALL = (2.0, 1.6)
"""Metres."""

GREY = Material(color=(0.5, 0.5, 0.5))


@pytest.fixture(scope="module")
def yard():
    """The courtyard with 45 training views, and its ray caster."""
    options = SynthOptions(views=45, test_views=4, size=(64, 48), realism="courtyard")
    traced = scenes.TracedScene("courtyard", None, options)
    return traced, RayCaster(traced.surface.vertices, traced.surface.faces)


# Masonry


@pytest.mark.parametrize(
    "make",
    [
        lambda seed: masonry.old_plaster(
            SMALL_WALL, (0.8, 0.7, 0.5), seed, [(1.0, 0.8, 0.5, 0.5)], [(0.4, 1, 0.05, 0.4)]
        ),
        lambda seed: masonry.rubble(SMALL_WALL, seed),
        lambda seed: masonry.flagstones(SMALL_WALL, seed),
    ],
)
def test_masonry_depends_on_its_seed_has_contrast_and_is_nearly_flat(make):
    first, again, other = make(1), make(1), make(2)
    assert np.array_equal(first.image, again.image) and np.array_equal(first.relief, again.relief)
    assert not np.array_equal(first.image, other.image)
    assert first.image.shape[:2] == first.relief.shape == masonry.shape_of(SMALL_WALL)
    assert first.image.dtype == np.uint8 and first.image.std() > 5.0
    assert 0.001 < first.relief.std() and np.abs(first.relief).max() < 0.06


def test_sound_plaster_has_little_contrast_and_exposed_bricks_lie_deeper():
    skin = masonry.old_plaster((3.0, 3.0), (0.8, 0.7, 0.5), 0, [(0.8, 1.6, 0.5, 0.5)])
    x, z = masonry.places(skin.size)
    inside, sound = np.hypot(x - 0.8, z - 1.6) < 0.1, (x > 1.7) & (z > 1.0) & (z < 2.3)
    assert skin.image[sound].std(0).max() < 12.0 < 2.0 * skin.image[inside].std(0).max()
    assert skin.relief[inside].mean() < skin.relief[sound].mean() - 0.006


def test_uneven_wall_has_open_holes_straight_edges_and_outward_normals():
    skin = masonry.rubble(SMALL_WALL, 3)
    hole = (0.7, 1.2, 0.4, 1.1)
    wall = masonry.uneven_wall("wall", skin, [hole])
    caster = RayCaster(wall.vertices, wall.faces)
    at = np.array([(0.3, 0.8), (1.6, 0.2), (0.71, 0.41), (1.19, 1.09), (0.95, 0.7)])
    starts = np.insert(at, 1, -1.0, axis=1)
    distance, face, _ = caster.cast(starts, np.tile([0.0, 1.0, 0.0], (len(at), 1)))
    assert np.isfinite(distance).tolist() == [True, True, False, False, False]
    assert (unit_normals(wall.vertices, wall.faces)[:, 1] < 0).all() and (face[:2] >= 0).all()
    # Reliefs end at the outer edges and at those of openings, so that other walls and reveals fit.
    x, y, z = wall.vertices.T
    rim = (x == 0) | (x == SMALL_WALL[0]) | (np.isin(x, hole[:2]) & (z > hole[2]) & (z < hole[3]))
    assert rim.sum() > 100 and (y[rim] == 0).all() and y.std() > 0.002


def test_slabs_are_numbered_and_edge_distance_is_small_between_slabs():
    number, edge, middles = masonry.slabs((2.0, 1.6), (0.3, 0.5), (0.4, 0.8), 0)
    assert 0 <= number.min() and number.max() < len(middles) and (edge >= -1e-9).all()
    changes = (number[:, 1:] != number[:, :-1]).nonzero()
    assert len(changes[0]) > 0 and edge[changes].max() < 2.5 * masonry.TEXEL
    assert edge.max() > 0.12


def test_arch_fills_its_rectangle_and_faces_outward():
    skin = masonry.rubble((4.0, 3.6), 0)
    _, above, below = masonry.round_arches(1.6, 0.4, 0.5, 2, 2.0)
    assert above[0] == pytest.approx((0.5, 2.1, 2.0, 2.85)) and above[1] == pytest.approx((2.5, 4.1, 2.0, 2.85))
    assert below == pytest.approx((0.5, 4.1, masonry.FOOT, 2.0))
    pieces = masonry.arch(1.3, 0.8, 2.0, 0.4, skin, GREY)
    whole = scenes.surface_of(render.Stage(pieces), "arch")
    caster = RayCaster(whole.vertices, whole.faces)
    normal = unit_normals(whole.vertices, whole.faces)
    # From the yard above the arch, through it, from behind, and from below it up.
    starts = np.array([(0.55, -1, 2.8), (1.3, -1, 2.7), (0.55, 1.4, 2.8), (1.3, 0.2, 1.0)])
    ways = np.array([(0.0, 1, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)])
    distance, face, _ = caster.cast(starts, ways)
    np.testing.assert_allclose(distance, [1.0, np.inf, 1.0, 1.8], atol=0.002)
    assert ((normal[face] * ways).sum(1)[[0, 2, 3]] < -0.99).all()


def test_roof_tiles_lie_above_the_wall_and_overhang_the_yard():
    pieces = masonry.eaves((0.0, 3.0), 4.0, GREY, 0, out=0.3, depth=1.2)
    points = np.concatenate([part.vertices for part in pieces])
    assert points[:, 1].min() == pytest.approx(-0.3) and points[:, 1].max() > 1.2
    (tiles,) = (part for part in pieces if part.name == "tiles")
    assert tiles.vertices[:, 2].min() > 4.0 and unit_normals(tiles.vertices, tiles.faces)[:, 2].min() > -1e-9


def test_merged_parts_share_a_material_and_keep_shapes_and_colors():
    image = Material(color=np.full((2, 2, 3), 90, np.uint8))
    some = [
        parts.quad("a", (0, 0, 0), (1, 0, 0), (0, 1, 0), image),
        parts.quad("b", (0, 0, 1), (1, 0, 0), (0, 1, 0), Material(color=(0.8, 0.1, 0.1))),
        parts.quad("c", (0, 0, 2), (1, 0, 0), (0, 1, 0), image),
        parts.quad("d", (0, 0, 3), (1, 0, 0), (0, 1, 0), GREY),
        parts.quad("e", (0, 0, 4), (1, 0, 0), (0, 1, 0), Material("plastic", (0.2, 0.2, 0.2))),
    ]
    whole = parts.merged(some)
    assert [part.name for part in whole] == ["a", "b", "e"]
    assert [len(part.faces) for part in whole] == [4, 4, 2]
    assert whole[0].material is image and whole[0].uv is not None and len(whole[0].uv) == 8
    np.testing.assert_array_equal(whole[1].colors, np.repeat([(0.8, 0.1, 0.1), (0.5, 0.5, 0.5)], 4, axis=0))
    before, after = (np.concatenate([part.vertices[part.faces] for part in group]) for group in (some, whole))
    assert {corners.tobytes() for corners in before} == {corners.tobytes() for corners in after}


def test_shutter_has_the_given_size():
    leaf = courtyard_things.shutter(0.45, 1.3, GREY)
    low, high = leaf.vertices.min(0), leaf.vertices.max(0)
    np.testing.assert_allclose([*low, *high], [0, -0.04, 0, 0.45, 0, 1.3], atol=0.005)


# The scene


def test_courtyard_cameras_are_clear_of_surfaces(yard):
    traced, caster = yard
    assert nearest_surface(traced, caster) > 0.5


def test_most_steps_between_courtyard_cameras_are_short_with_small_turns(yard):
    views = yard[0].train
    eyes, ahead = np.array([view.center for view in views]), np.array([view.world_to_camera[2, :3] for view in views])
    step = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    turn = np.rad2deg(np.arccos((ahead[1:] * ahead[:-1]).sum(1)))
    assert ((step < 0.9) & (turn < 22.0)).mean() > 2 / 3 and turn.max() < 45.0
    assert (eyes[:, 2] > 1.1).all() and (eyes[:, 2] < 1.8).all()


def test_courtyard_surfaces_face_the_camera_and_only_sky_rays_miss(yard):
    traced, caster = yard
    normals = unit_normals(caster.vertices, caster.faces)
    facing = []
    for view in traced.train[::3]:
        _, face, _ = caster.render_depth(view)
        ray = pixel_rays(view)
        met = face >= 0
        # The lowest wall is 1.8 m above the eyes and at most 8 m away.
        assert (ray[~met][:, 2] > 0.16 * np.linalg.norm(ray[~met], axis=1)).all()
        facing.append(((ray * normals[face]).sum(-1)[met] < 0).mean())
    # Leaves are seen from both sides.
    assert np.min(facing) > 0.9 and np.mean(facing) > 0.985


def test_paving_is_uneven_by_centimetres_and_stays_above_the_foot_of_walls():
    floor = masonry.uneven_floor("paving", masonry.flagstones((3.0, 2.0), 0))
    height = floor.vertices[:, 2]
    assert 0.003 < height.std() < 0.02 and height.min() > masonry.FOOT
    assert (unit_normals(floor.vertices, floor.faces)[:, 2] > 0.5).all()
    np.testing.assert_allclose([floor.vertices[:, i].min() for i in (0, 1)], [0.0, -2.0], atol=1e-9)


def test_courtyard_backdrop_is_outside_the_walls_and_not_in_the_surface(yard):
    traced, caster = yard
    points = np.concatenate([part.vertices for part in traced.backdrop])
    beyond = (points[:, 0] > courtyard.LENGTH + courtyard.ASIDE) | (points[:, 0] < -courtyard.ASIDE)
    assert beyond.all()
    assert len(caster.faces) == sum(len(part.faces) for part in traced.stage.parts)
    assert caster.diagonal < 30.0
