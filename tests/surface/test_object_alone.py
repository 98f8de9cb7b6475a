"""`--object`: the supporting plane is found and cut off, surroundings are removed, and openings closed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers.captures import ring

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions
from linprim_geo.geometry.mesh import Mesh, face_areas
from linprim_geo.geometry.topology import topology
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.surface.object_alone import closed_by, object_alone, supporting_plane

BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
CAMERAS = ring(12, radius=3.0)
TABLE = -0.3


def above(mesh, height):
    """The faces of a mesh above a height."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces[mesh.vertices[mesh.faces][..., 2].min(1) > height])


def dome():
    """The part of a ball at the origin that is above the table."""
    return above(trimesh.creation.icosphere(6, 0.4), TABLE)


def sheet(reach, hole=None, noise=0.0, spacing=0.02):
    """A square of the table around the z axis, with a round hole in its centre if `hole` is given."""
    across = np.arange(-reach, reach + 1e-9, spacing)
    x, y = np.meshgrid(across, across)
    count = len(across)
    z = TABLE + noise * np.random.default_rng(0).standard_normal(x.shape)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + count + 1], 1),
            np.stack([corner, corner + count + 1, corner + count], 1),
        ]
    )
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    if hole is not None:
        faces = faces[np.linalg.norm(vertices[faces].mean(1)[:, :2], axis=1) > hole]
    return trimesh.Trimesh(vertices, faces, process=False)


def together(*parts):
    whole = trimesh.util.concatenate([trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts])
    return Mesh(whole.vertices, whole.faces, quality=np.full(len(whole.vertices), 0.01))


def shown(mesh, box=BOX):
    middles = mesh.vertices[mesh.faces].mean(1)
    keep = ((middles >= box[0]) & (middles <= box[1])).all(1)
    return replace(mesh, faces=mesh.faces[keep])


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_a_dome_on_a_table_becomes_a_closed_solid(noise):
    foot = np.sqrt(0.4**2 - TABLE**2)
    mesh = shown(together(dome(), sheet(1.5, foot, noise)))
    alone, about = object_alone(mesh, CAMERAS, BOX)
    np.testing.assert_allclose(about["stands_on"], [0, 0, 1, TABLE], atol=0.004)
    assert about["closed"] == 1 and about["cut"] > 0.5
    found = topology(alone)
    assert found["watertight"] and found["components"] == 1
    solid = trimesh.Trimesh(alone.vertices, alone.faces)
    height = 0.4 - TABLE
    volume = np.pi * height**2 * (3 * 0.4 - height) / 3
    assert solid.is_winding_consistent and solid.volume == pytest.approx(volume, rel=0.03)
    assert alone.vertices[:, 2].min() == pytest.approx(TABLE, abs=0.004)
    # New vertices have the margin of the plane as predicted error.
    assert alone.quality[0] == np.float32(0.01)
    assert alone.quality[-1] == pytest.approx(supporting_plane(mesh, CAMERAS, BOX).margin)


def test_a_ring_and_a_foot_are_closed_by_the_plane():
    tube = trimesh.creation.annulus(0.2, 0.3, 0.4, sections=64)
    tube.apply_translation([0, 0, TABLE + 0.2])
    tube = above(tube.subdivide_to_size(0.01), TABLE + 0.01)
    foot = above(trimesh.creation.icosphere(5, 0.15).apply_translation([0.6, 0, TABLE]), TABLE + 0.01)
    mesh = together(tube, foot)
    plane = supporting_plane(together(sheet(1.0), tube), CAMERAS, BOX)
    assert plane is not None
    closed, count = closed_by(merged(mesh), replace(plane, margin=0.03))
    assert count == 3
    solid = trimesh.Trimesh(closed.vertices, closed.faces, process=False)
    assert topology(closed)["watertight"] and solid.is_winding_consistent
    assert solid.volume == pytest.approx(np.pi * (0.3**2 - 0.2**2) * 0.4 + 2 / 3 * np.pi * 0.15**3, rel=0.03)


def merged(mesh):
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces)
    return Mesh(whole.vertices, whole.faces, quality=np.zeros(len(whole.vertices)))


def test_surroundings_and_small_pieces_are_removed():
    wall = trimesh.creation.box((0.05, 4.0, 4.0)).apply_translation([0.8, 0, 0]).subdivide_to_size(0.1)
    crumb = trimesh.creation.icosphere(2, 0.02).apply_translation([-0.7, 0.5, 0.3])
    foot = np.sqrt(0.4**2 - TABLE**2)
    mesh = shown(together(dome(), sheet(1.5, foot), wall, crumb))
    alone, about = object_alone(mesh, CAMERAS, BOX)
    assert np.abs(alone.vertices[:, :2]).max() < 0.41
    assert about["stands_on"][2] == pytest.approx(1.0, abs=1e-6)


def test_a_wall_is_no_supporting_plane():
    wall = sheet(1.0)
    wall.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    before = [camera for camera in ring(24, radius=3.0) if camera.center[1] * wall.face_normals[0][1] > 0.5]
    assert supporting_plane(together(wall, dome()), before, BOX) is None
    # The same with rotated photographs.
    turn = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    turned = [replace(camera, world_to_camera=turn @ camera.world_to_camera) for camera in before]
    assert supporting_plane(together(wall, dome()), turned, BOX) is None


@pytest.mark.parametrize("turn", [1, -1, 0])
def test_the_plane_is_found_in_rotated_photographs(turn):
    """Phones held upright write photographs that are rotated by 90 degrees."""
    across = {1: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], -1: [[0, -1, 0], [1, 0, 0], [0, 0, 1]], 0: np.eye(3)}[turn]
    pose = np.eye(4)
    pose[:3, :3] = across
    cameras = [replace(camera, world_to_camera=pose @ camera.world_to_camera) for camera in CAMERAS]
    plane = supporting_plane(together(sheet(0.9), dome()), cameras, BOX)
    assert plane is not None
    np.testing.assert_allclose(plane.normal, [0, 0, 1], atol=1e-6)


def test_an_object_that_extends_out_of_the_box_is_kept():
    """Pieces that lie within the box are removed as crumbs."""
    column = trimesh.creation.cylinder(0.3, 3.0, sections=64).subdivide_to_size(0.05)
    crumb = trimesh.creation.icosphere(2, 0.05).apply_translation([-0.7, 0.5, 0.3])
    alone, about = object_alone(shown(together(column, crumb)), CAMERAS, BOX)
    assert about["stands_on"] is None and np.abs(alone.vertices[:, 2]).max() > 0.9
    assert np.linalg.norm(alone.vertices[:, :2], axis=1).max() < 0.31


def test_an_object_without_a_plane_is_unchanged():
    ball = trimesh.creation.icosphere(4, 0.4)
    alone, about = object_alone(together(ball), CAMERAS, BOX)
    assert about == {"stands_on": None, "cut": 0.0, "closed": 0}
    assert len(alone.faces) == len(ball.faces)


def test_a_table_without_an_object_is_refused():
    with pytest.raises(LinprimError, match="nothing stands on the plane"):
        object_alone(together(sheet(0.9)), CAMERAS, BOX)


def test_openings_far_from_the_plane_stay_open():
    """A ball touches the table; its lower part is unseen, and its border is far above the table."""
    ball = trimesh.creation.icosphere(5, 0.3)
    upper = above(ball, -0.05)
    alone, about = object_alone(shown(together(upper, sheet(1.5))), CAMERAS, BOX)
    assert about["closed"] == 0 and topology(alone)["boundary_edges"] > 0
    assert face_areas(alone).sum() == pytest.approx(upper.area, rel=0.01)


def test_extraction_with_object_uses_the_focus_box(solid, tmp_path):
    options = ExtractOptions(level=0.5, refine=0, denoise="off", voxel_size=0.05, object=True)
    stats = extract_mesh(solid, output=tmp_path / "mesh.ply", options=options, quiet=True)
    assert stats["object"]["stands_on"] is None and stats["options"]["box"]
    whole = extract_mesh(solid, output=tmp_path / "whole.ply", options=replace(options, object=False), quiet=True)
    assert stats["area"] == pytest.approx(whole["area"], rel=0.05)
