"""Holes no wider than a stereo window are closed, unless photographs see through them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at
from helpers.surfaces import join
from helpers.textured_plane import sheet

from linprim_geo.geometry.mesh import Mesh, select_faces
from linprim_geo.geometry.topology import topology
from linprim_geo.surface.finish.self_intersections import crossings
from linprim_geo.surface.finish.small_holes import WINDOW, without_small_holes

# From 2 above a sheet of side 1 a pixel is 0.01, and a window 0.12.
CAMERAS = [look_at((x, y, 2.0), (x, y, 0.0), (100, 100), 200.0, (0.0, 1.0, 0.0)) for x in (0, 0.1) for y in (0, 0.1)]
UNKNOWN = [np.full((100, 100), np.nan) for _ in CAMERAS]
NOT_FREE = [np.zeros((100, 100), bool) for _ in CAMERAS]


def flat(steps: int = 101) -> Mesh:
    """A flat sheet whose edges are one pixel long."""
    return sheet(lambda x, y: 0 * x, steps=steps)


def pierced(mesh: Mesh, radius: float, middle=(0.0, 0.0)) -> Mesh:
    """Remove faces whose centres lie within `radius` of `middle`."""
    away = np.linalg.norm(mesh.vertices[mesh.faces].mean(1)[:, :2] - middle, axis=1)
    return select_faces(mesh, away > radius)


def closed(mesh: Mesh, known=UNKNOWN, free=NOT_FREE) -> tuple[Mesh, int]:
    return without_small_holes(mesh, CAMERAS, known, free)


def outer_edges() -> int:
    return topology(flat())["boundary_edges"]


def test_a_small_hole_is_closed_without_other_changes():
    holed = replace(pierced(flat(), 0.04), quality=np.linspace(1, 2, len(pierced(flat(), 0.04).vertices)))
    found, holes = closed(holed)
    assert holes == 1 and topology(holed)["boundary_edges"] > outer_edges() == topology(found)["boundary_edges"]
    np.testing.assert_array_equal(found.vertices, holed.vertices)
    np.testing.assert_array_equal(found.quality, holed.quality)
    np.testing.assert_array_equal(found.faces[: len(holed.faces)], holed.faces)
    assert topology(found)["area"] == pytest.approx(topology(flat())["area"])  # patches face up without overlap
    assert topology(found)["non_manifold_edges"] == 0


@pytest.mark.parametrize("seed", range(1, 7))  # seed 0 leaves a triangle connected by one vertex only
def test_patches_of_irregular_holes_do_not_overlap(seed):
    middle = flat().vertices[flat().faces].mean(1)
    away, angle = np.linalg.norm(middle[:, :2], axis=1), np.arctan2(middle[:, 1], middle[:, 0])
    knots = np.random.default_rng(seed).uniform(0.01, 0.045, 12)
    reach = np.interp(angle, np.linspace(-np.pi, np.pi, 12, endpoint=False), knots, period=2 * np.pi)
    hook = (away > 0.02) & (away < 0.045) & (np.abs(angle) < 2.5)
    for lost in (away < reach, hook):
        holed = select_faces(flat(), ~lost)
        found, holes = closed(holed)
        assert holes >= 1 and topology(found)["boundary_edges"] == outer_edges()
        normal = np.cross(*(found.vertices[found.faces[:, k]] - found.vertices[found.faces[:, 0]] for k in (1, 2)))
        assert topology(found)["area"] == pytest.approx(1) and normal[:, 2].min() > -1e-12


def test_a_hole_wider_than_a_window_stays():
    radius = WINDOW * 0.01 / 2
    assert closed(pierced(flat(), radius - 0.015))[1] == 1
    wide = pierced(flat(), radius + 0.015)
    found, holes = closed(wide)
    assert holes == 0 and found is wide
    # Holes that no camera sees stay, too.
    away = [look_at((0, 0, -2.0), (0, 0, -4.0), (100, 100), 200.0, (0.0, 1.0, 0.0))]
    assert without_small_holes(pierced(flat(), 0.02), away, UNKNOWN[:1], NOT_FREE[:1])[1] == 0


@pytest.mark.parametrize("angle", [0, 30, 45])
def test_the_width_of_a_slit_is_measured_across_it(angle):
    mesh, turned = flat(), np.radians(angle)
    middle = mesh.vertices[mesh.faces].mean(1)[:, :2]
    along = middle @ np.array([np.cos(turned), np.sin(turned)])
    across = middle @ np.array([-np.sin(turned), np.cos(turned)])
    for width, holes in ((WINDOW - 3, 1), (WINDOW + 3, 0)):
        slit = select_faces(mesh, ~((np.abs(along) < 0.3) & (np.abs(across) < width * 0.01 / 2)))
        found, count = closed(slit)
        assert count == holes
        assert (topology(found)["boundary_edges"] == outer_edges()) == bool(holes)


def slit_from_the_border(width: float, depth: float) -> Mesh:
    """A sheet with a slit, in pixels, that begins at its border, turns by 90 degrees and ends inside."""
    x, y = (flat().vertices[flat().faces].mean(1)[:, k] for k in (0, 1))
    half = width * 0.01 / 2
    down = (np.abs(x) < half) & (y > 0.5 - depth * 0.01 - half)
    aside = (np.abs(y - 0.5 + depth * 0.01) < half) & (x > 0) & (x < depth * 0.01)
    return select_faces(flat(), ~(down | aside))


def area(mesh: Mesh) -> float:
    return topology(mesh)["area"]


def test_a_bent_slit_open_to_the_border_is_closed():
    slit = slit_from_the_border(WINDOW - 4, 40)
    found, holes = closed(slit)
    assert holes == 0 and area(slit) < 0.95 < area(found) == pytest.approx(1)
    assert topology(found)["boundary_edges"] < outer_edges() and topology(found)["non_manifold_edges"] == 0
    np.testing.assert_array_equal(found.faces[: len(slit.faces)], slit.faces)
    normal = np.cross(*(found.vertices[found.faces[:, k]] - found.vertices[found.faces[:, 0]] for k in (1, 2)))
    assert normal[:, 2].min() > -1e-12 and len(crossings(found)[0]) == 0


@pytest.mark.parametrize("width, depth", [(WINDOW + 4, 40), (WINDOW - 4, 3)])
def test_a_wide_slit_and_a_shallow_notch_of_the_border_stay(width, depth):
    x, y = (flat().vertices[flat().faces].mean(1)[:, k] for k in (0, 1))
    notched = select_faces(flat(), ~((np.abs(x) < width * 0.01 / 2) & (y > 0.5 - depth * 0.01)))
    assert closed(notched)[0] is notched


def test_a_crack_between_a_floor_and_a_slope_is_closed():
    whole = sheet(lambda x, y: 0.4 * np.maximum(x, 0), steps=101)
    x, y = (whole.vertices[whole.faces].mean(1)[:, k] for k in (0, 1))
    crack = select_faces(whole, ~((np.abs(x) < 0.03) & (y > -0.4)))
    assert area(crack) < 0.96 * area(whole) and area(closed(crack)[0]) == pytest.approx(area(whole), rel=2e-3)


@pytest.mark.parametrize("views", [1, 2])
def test_a_slit_that_two_views_see_through_stays(views):
    slit = slit_from_the_border(WINDOW - 4, 40)
    behind = [np.full((100, 100), np.nan) for _ in CAMERAS]
    for depth in behind[:views]:
        depth[:] = 2.5
    found, _ = closed(slit, behind)
    assert (found is slit) == (views == 2)


@pytest.mark.parametrize("views, holes", [(1, 1), (2, 0), (4, 0)])
@pytest.mark.parametrize("is_free", [False, True])
def test_two_views_that_see_through_a_hole_keep_it_open(views, holes, is_free):
    looking = [k < views for k in range(len(CAMERAS))]
    behind = [np.full((100, 100), 2.5 if looks and not is_free else np.nan) for looks in looking]
    free = [np.full((100, 100), looks and is_free) for looks in looking]
    assert closed(pierced(flat(), 0.04), behind, free)[1] == holes


def test_depths_in_front_of_or_at_a_hole_do_not_keep_it_open():
    for depth in (1.5, 2.0):
        assert closed(pierced(flat(), 0.04), [np.full((100, 100), depth) for _ in CAMERAS])[1] == 1


def test_the_rim_of_a_small_piece_is_no_hole():
    away = np.linalg.norm(flat().vertices[flat().faces].mean(1)[:, :2], axis=1)
    piece = select_faces(flat(), away < 0.04)
    found, holes = closed(join(piece, pierced(flat(), 0.2)))
    assert holes == 0 and len(found.faces) == len(piece.faces) + len(pierced(flat(), 0.2).faces)


def test_holes_that_touch_in_a_vertex_are_closed():
    mesh = flat()
    middle = mesh.vertices[mesh.faces].mean(1)
    square = (np.abs(middle[:, :2]) < 0.02).all(1)
    holed = select_faces(mesh, ~(square & (middle[:, 0] * middle[:, 1] > 0)))
    found, holes = closed(holed)
    assert holes >= 1 and topology(found)["boundary_edges"] == outer_edges()


def test_a_hole_with_a_face_through_it_stays():
    thorn = Mesh(np.array([[0.0, 0, -0.1], [0.005, 0, 0.1], [-0.005, 0, 0.1]]), np.array([[0, 1, 2]]))
    holed = join(pierced(flat(), 0.04), thorn)
    found, holes = closed(holed)
    assert holes == 0 and len(crossings(found)[0]) == 0


def test_closed_and_empty_meshes_are_unchanged():
    corners = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    solid = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    for mesh in (solid, nothing):
        assert closed(mesh) == (mesh, 0)
