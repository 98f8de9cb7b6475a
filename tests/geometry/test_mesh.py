"""Mesh files as other programs read them, validation of meshes, and topology of known shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry import mesh as lm
from linprim_geo.geometry import mesh_files, topology
from linprim_geo.geometry.mesh import Mesh

CUBE_VERTICES = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
CUBE_FACES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
)


def cube(offset=0.0, scale=1.0) -> Mesh:
    return Mesh(CUBE_VERTICES * scale + offset, CUBE_FACES)


def sphere(subdivisions=3) -> Mesh:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions)
    return Mesh(ball.vertices, ball.faces)


def joined(*meshes: Mesh) -> Mesh:
    shift = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + s for m, s in zip(meshes, shift, strict=True)]),
    )


def painted(offset=0.0) -> Mesh:
    ball = sphere()
    random = np.random.default_rng(0)
    count = len(ball.vertices)
    return Mesh(
        ball.vertices + offset,
        ball.faces,
        normals=ball.vertices,
        colors=random.integers(0, 256, (count, 3)),
        quality=random.random(count),
    )


# --- files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", mesh_files.SUFFIXES)
def test_mesh_files_round_trip(tmp_path, suffix):
    mesh = painted()
    mesh_files.save_mesh(tmp_path / f"m{suffix}", mesh)
    back = mesh_files.load_mesh(tmp_path / f"m{suffix}")
    if suffix == ".stl":  # keeps triangles only: same faces, vertices merged, in another order
        assert len(back.vertices) == len(mesh.vertices)
        corners = back.vertices[back.faces] - mesh.vertices[mesh.faces]
        assert np.abs(corners).max() < 1e-6
        return
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_array_equal(back.colors, mesh.colors)
    np.testing.assert_allclose(back.normals, mesh.normals, atol=2e-6)
    if suffix == ".ply":
        np.testing.assert_array_equal(back.quality, mesh.quality)


@pytest.mark.parametrize("suffix", mesh_files.SUFFIXES)
def test_meshlab_reads_what_is_written(tmp_path, suffix):
    import pymeshlab

    mesh = painted()
    mesh_files.save_mesh(tmp_path / f"m{suffix}", mesh)
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(tmp_path / f"m{suffix}"))
    read = meshes.current_mesh()
    assert (read.vertex_number(), read.face_number()) == (len(mesh.vertices), len(mesh.faces))
    if suffix == ".stl":
        return
    np.testing.assert_allclose(read.vertex_matrix(), mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(read.face_matrix(), mesh.faces)
    np.testing.assert_array_equal(np.round(read.vertex_color_matrix()[:, :3] * 255), mesh.colors)
    np.testing.assert_allclose(read.vertex_normal_matrix(), mesh.normals, atol=2e-6)
    if suffix == ".ply":
        np.testing.assert_allclose(read.vertex_scalar_array(), mesh.quality, atol=1e-7)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_far_from_the_origin_nothing_is_lost(tmp_path, suffix):
    mesh = painted(offset=1e6)
    mesh_files.save_mesh(tmp_path / f"m{suffix}", mesh)
    back = mesh_files.load_mesh(tmp_path / f"m{suffix}")
    np.testing.assert_allclose(back.vertices, mesh.vertices, rtol=0, atol=1e-7)  # float32 steps by 0.06 there


def test_a_mesh_without_attributes_has_none_after_reading(tmp_path):
    mesh_files.save_mesh(tmp_path / "m.ply", sphere())
    back = mesh_files.load_mesh(tmp_path / "m.ply")
    assert back.normals is None and back.colors is None and back.quality is None


def test_transforms_of_a_scene_are_applied(tmp_path):
    import trimesh

    box = trimesh.creation.box()
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1], None)
    turn[:3, 3] = 5, 0, 0
    scene.add_geometry(trimesh.Trimesh(box.vertices * [1, 3, 1], box.faces, process=False), transform=turn)
    scene.export(tmp_path / "one.glb")
    scene.add_geometry(box)
    scene.export(tmp_path / "two.glb")
    np.testing.assert_allclose(
        mesh_files.load_mesh(tmp_path / "one.glb").bounds, [[3.5, -0.5, -0.5], [6.5, 0.5, 0.5]], atol=1e-6
    )
    assert topology.topology(lm.merge_vertices(mesh_files.load_mesh(tmp_path / "two.glb")))["components"] == 2


def test_damaged_mesh_files_are_refused_by_name(tmp_path):
    with pytest.raises(LinprimError, match="nothing.ply: no such"):
        mesh_files.load_mesh(tmp_path / "nothing.ply")
    mesh_files.save_mesh(tmp_path / "whole.ply", painted())
    data = (tmp_path / "whole.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(data[: len(data) // 2])
    (tmp_path / "noise.ply").write_bytes(bytes(range(256)) * 4)
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n0 0 0\n"
    )
    (tmp_path / "index.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n"
    )
    for name in ("cut", "noise", "points", "index"):
        with pytest.raises(LinprimError, match=f"{name}.ply"):
            mesh_files.load_mesh(tmp_path / f"{name}.ply")


def test_nothing_is_written_for_an_empty_mesh_or_an_unknown_suffix(tmp_path):
    with pytest.raises(LinprimError, match="no faces"):
        mesh_files.save_mesh(tmp_path / "m.ply", Mesh(np.zeros((0, 3)), np.zeros((0, 3))))
    with pytest.raises(LinprimError, match="'.xyz'"):
        mesh_files.save_mesh(tmp_path / "m.xyz", cube())
    assert list(tmp_path.iterdir()) == []


# --- checks ----------------------------------------------------------------------------------------------


def test_bad_faces_are_dropped_and_counted():
    good = cube()
    vertices = np.concatenate([good.vertices, [[np.nan, 0, 0], [0.5, 0, 0], [9, 9, 9]]])
    bad = [
        [0, 1, 8],
        [0, 0, 1],
        [2, 2, 2],
        [0, 9, 4],
        [3, 1, 0],
    ]  # NaN, twice degenerate, collinear, repeated
    mesh, report = lm.clean_mesh(Mesh(vertices, np.concatenate([good.faces, bad])))
    assert report == {"not_finite": 1, "degenerate": 3, "duplicate": 1, "unreferenced": 3}
    np.testing.assert_array_equal(mesh.vertices, good.vertices)
    np.testing.assert_array_equal(mesh.faces, good.faces)


def test_thin_faces_stay_unless_rounding_collapses_them():
    thin = Mesh([[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]], [[0, 1, 2]])
    assert len(lm.validate_mesh(thin).faces) == 1
    # At 1e6 from the origin coordinates step by 1e-10, so 1e-12 is not there any more.
    gone = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-12, 0]]) + 1e6, [[0, 1, 2]])
    with pytest.raises(LinprimError, match="none of its 1 faces"):
        lm.validate_mesh(gone)


def test_unusable_meshes_are_refused():
    with pytest.raises(LinprimError, match="scan.ply: the mesh is empty"):
        lm.validate_mesh(Mesh(np.zeros((0, 3)), np.zeros((0, 3))), "scan.ply")
    with pytest.raises(LinprimError, match=r"face 0 uses vertices \[0, 1, 3\]"):
        lm.validate_mesh(Mesh(np.eye(3), [[0, 1, 3]]))
    with pytest.raises(LinprimError, match="shape"):
        Mesh(np.eye(3), [[0, 1, 2]], colors=np.zeros((2, 3)))


# --- topology --------------------------------------------------------------------------------------------


def test_topology_of_a_cube():
    stats = topology.topology(cube(offset=100.0))
    expected = dict(vertices=8, faces=12, components=1, boundary_edges=0, non_manifold_edges=0, genus=0)
    assert {key: stats[key] for key in expected} == expected
    assert stats["watertight"] and topology.manifold_status(cube()) == "NoError"
    assert stats["area"] == pytest.approx(6.0) and stats["volume"] == pytest.approx(1.0)
    assert topology.topology(replace(cube(), faces=CUBE_FACES[:, ::-1]))["volume"] == pytest.approx(-1.0)


def test_genus_of_a_torus_and_of_joined_surfaces():
    import trimesh

    torus = trimesh.creation.torus(1.0, 0.3)
    ring = Mesh(torus.vertices, torus.faces)
    assert topology.topology(ring)["genus"] == 1
    both = topology.topology(joined(ring, sphere(), cube(5.0)))
    assert (both["genus"], both["components"]) == (1, 3)


def test_bodies_that_touch_at_a_vertex_have_genus_zero():
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]])
    other = np.array([0, 4, 5, 6])[tetrahedron]
    stats = topology.topology(Mesh(vertices, np.concatenate([tetrahedron, other[:, ::-1]])))
    assert (stats["watertight"], stats["components"], stats["genus"]) == (True, 1, 0)
    assert stats["volume"] == pytest.approx(2 / 6)


def test_boundary_and_non_manifold_edges_are_counted():
    open_cube = topology.topology(replace(cube(), faces=CUBE_FACES[1:]))
    assert (open_cube["boundary_edges"], open_cube["watertight"], open_cube["genus"]) == (3, False, None)
    assert open_cube["volume"] is None
    fins = topology.topology(Mesh(np.eye(5, 3), [[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert fins["non_manifold_edges"] == 1
    turned = CUBE_FACES.copy()
    turned[0] = turned[0, ::-1]
    assert topology.topology(replace(cube(), faces=turned))["non_manifold_edges"] == 3
    assert topology.manifold_status(replace(cube(), faces=turned)) != "NoError"


# --- editing ---------------------------------------------------------------------------------------------


def test_boundaries_that_touch_at_a_vertex_are_separate_loops():
    # Two triangles that share vertex 2, and a square of two faces.
    faces = np.array([[0, 1, 2], [2, 3, 4], [5, 6, 7], [5, 7, 8]])
    loops = sorted(tuple(sorted(loop.tolist())) for loop in topology.border_loops(faces))
    assert loops == [(0, 1, 2), (2, 3, 4), (5, 6, 7, 8)]
    directed = {(a, b) for face in faces.tolist() for a, b in zip(face, face[1:] + face[:1], strict=True)}
    for loop in topology.border_loops(faces):
        assert all((int(a), int(b)) in directed for a, b in zip(loop, np.roll(loop, -1), strict=True))


def test_small_components_are_removed_with_their_attributes():
    big, small = painted(), cube(offset=3.0, scale=0.01)
    mesh = joined(big, small)
    mesh = replace(mesh, quality=np.arange(len(mesh.vertices)))
    kept = lm.remove_small_components(mesh, 1e-3)
    np.testing.assert_array_equal(kept.vertices, big.vertices)
    np.testing.assert_array_equal(kept.quality, np.arange(len(big.vertices)))
    assert len(lm.remove_small_components(mesh, 1e-6).faces) == len(mesh.faces)
    assert len(lm.remove_small_components(mesh, 0.1, by="faces").faces) == len(big.faces)


def test_equal_vertices_are_merged():
    soup = Mesh(CUBE_VERTICES[CUBE_FACES].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    assert topology.topology(soup)["components"] == 12
    merged = lm.merge_vertices(soup)
    assert topology.topology(merged)["watertight"] and len(merged.vertices) == 8
