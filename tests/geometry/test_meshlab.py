"""MeshLab reads every mesh that the commands write: counts, normals, colours, quality and textures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pymeshlab
import pytest
from conftest import CENTER
from PIL import Image

from linprim_geo.base.options import ExtractOptions
from linprim_geo.eval.mesh import eval_mesh_files
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.runs.run import Run
from linprim_geo.surface.convert import convert
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.surface.texture.texture_files import load_texture

SUFFIXES = (".ply", ".obj", ".glb", ".stl")
TEXTURED = (".obj", ".glb")
# 0.5 + 0.7 Y0 of the one octahedron of `solid`, of 255.
GREY = 178


def opened(path: Path) -> pymeshlab.Mesh:
    """Load a file with MeshLab and return its current mesh, which keeps the owning set alive."""
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.load_new_mesh(str(path))
    assert meshes.mesh_number() == 1
    mesh = meshes.current_mesh()
    opened.alive = meshes
    return mesh


def colors(mesh: pymeshlab.Mesh) -> np.ndarray:
    """(V, 3) whole numbers from 0 to 255."""
    return np.rint(mesh.vertex_color_matrix()[:, :3] * 255).astype(int)


def assert_same_surface(mesh: pymeshlab.Mesh, path: Path) -> None:
    """MeshLab's surface is ours, face by face."""
    ours = load_mesh(path)
    assert mesh.face_number() == len(ours.faces) > 50
    corners = mesh.vertex_matrix()[mesh.face_matrix()]
    np.testing.assert_allclose(corners, ours.vertices[ours.faces], rtol=0, atol=2e-6)


@pytest.fixture(scope="module")
def extracted(solid, tmp_path_factory) -> Path:
    """A folder with part.*, plain, and skin.*, textured, of the opaque octahedron, and their *_visible."""
    folder = tmp_path_factory.mktemp("meshlab")
    for suffix in SUFFIXES:
        extract_mesh(
            solid,
            output=folder / f"part{suffix}",
            options=ExtractOptions(voxel_size=0.15, level=0.5),
            quiet=True,
        )
    for suffix in TEXTURED:
        options = ExtractOptions(voxel_size=0.15, level=0.5, texture=128)
        extract_mesh(solid, output=folder / f"skin{suffix}", options=options, quiet=True)
    return folder


@pytest.mark.parametrize("name", ["part", "part_visible"])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_extracted_meshes(name, suffix, extracted):
    path = extracted / f"{name}{suffix}"
    mesh = opened(path)
    assert_same_surface(mesh, path)
    assert mesh.vertex_number() == len(load_mesh(extracted / f"{name}.ply").vertices)
    if suffix == ".stl":
        return
    assert mesh.has_vertex_color() and np.abs(np.median(colors(mesh), axis=0) - GREY).max() <= 2
    ours = load_mesh(path)
    np.testing.assert_allclose(mesh.vertex_normal_matrix(), ours.normals, atol=1e-5)
    outward = mesh.vertex_matrix() - np.array(CENTER)
    assert (np.einsum("nk,nk->n", mesh.vertex_normal_matrix(), outward) > 0).mean() > 0.99
    if suffix == ".ply":
        assert mesh.has_vertex_scalar()
        np.testing.assert_allclose(mesh.vertex_scalar_array(), ours.quality, rtol=1e-6)


@pytest.mark.parametrize("name", ["skin", "skin_visible"])
@pytest.mark.parametrize("suffix", TEXTURED)
def test_textured_meshes(name, suffix, extracted):
    mesh = opened(extracted / f"{name}{suffix}")
    plain = load_mesh(extracted / f"{name.replace('skin', 'part')}.ply")
    assert mesh.face_number() == len(plain.faces)
    corners = mesh.vertex_matrix()[mesh.face_matrix()]
    np.testing.assert_allclose(corners, plain.vertices[plain.faces], rtol=0, atol=2e-6)
    assert mesh.texture_number() == 1
    (texture,) = mesh.textures().values()
    assert (texture.width(), texture.height()) == (128, 128)
    if mesh.has_wedge_tex_coord():
        uv = mesh.wedge_tex_coord_matrix().reshape(-1, 3, 2)
    else:
        uv = mesh.vertex_tex_coord_matrix()[mesh.face_matrix()]
    # Where the middles of the faces are in the image it has the colour of the octahedron; the two files hold the same
    # image.
    image = np.asarray(Image.open(extracted / f"{name}.png")).astype(int)
    middle = uv.mean(1)
    texels = image[((1 - middle[:, 1]) * 128).astype(int), (middle[:, 0] * 128).astype(int)]
    assert (np.abs(texels - GREY).max(1) < 12).mean() > 0.95
    expected = load_texture(extracted / f"{name}.obj")[1].uv
    np.testing.assert_allclose(uv, expected, atol=1e-5)
    assert uv.min() >= 0 and uv.max() <= 1 and np.ptp(uv) > 0.3


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_primitives_as_triangles(suffix, solid, tmp_path):
    path = tmp_path / f"primitives{suffix}"
    convert(solid, path, "mesh")
    mesh, one = opened(path), Run.open(solid).primitives()
    assert (mesh.vertex_number(), mesh.face_number()) == (6, 8)
    found = np.sort(mesh.vertex_matrix().round(4), axis=0)
    np.testing.assert_allclose(found, np.sort(one.vertices[0].round(4), axis=0), atol=2e-4)
    middle = mesh.vertex_matrix()[mesh.face_matrix()].mean(1) - one.center[0]
    assert (np.einsum("nk,nk->n", mesh.face_normal_matrix(), middle) > 0).all()
    if suffix != ".stl":
        assert (colors(mesh) == one.base_color[0]).all()
    if suffix in (".ply", ".glb"):
        assert (mesh.vertex_color_matrix()[:, 3] == 1).all()  # opaque, as it is


def test_primitives_as_their_properties_are_points(solid, tmp_path):
    convert(solid, tmp_path / "primitives.ply")
    mesh = opened(tmp_path / "primitives.ply")
    assert (mesh.vertex_number(), mesh.face_number()) == (1, 0)
    np.testing.assert_allclose(mesh.vertex_matrix(), Run.open(solid).primitives().center, atol=1e-6)


@pytest.mark.parametrize("source", SUFFIXES)
@pytest.mark.parametrize("target", SUFFIXES)
def test_converted_meshes(source, target, extracted, tmp_path):
    path = tmp_path / f"converted{target}"
    convert(extracted / f"part{source}", path)
    mesh = opened(path)
    assert_same_surface(mesh, extracted / f"part{source}")
    if ".stl" not in (source, target):
        assert np.abs(np.median(colors(mesh), axis=0) - GREY).max() <= 2
        np.testing.assert_allclose(mesh.vertex_normal_matrix(), load_mesh(extracted / "part.ply").normals, atol=1e-5)
    if source == target == ".ply":
        np.testing.assert_allclose(mesh.vertex_scalar_array(), load_mesh(extracted / "part.ply").quality, rtol=1e-6)


@pytest.mark.parametrize(("source", "target"), [(".obj", ".glb"), (".glb", ".obj")])
def test_converted_textures(source, target, extracted, tmp_path):
    path = tmp_path / f"converted{target}"
    convert(extracted / f"skin{source}", path)
    mesh = opened(path)
    assert mesh.face_number() == len(load_mesh(extracted / "part.ply").faces)
    (texture,) = mesh.textures().values()
    assert (texture.width(), texture.height()) == (128, 128)


def test_error_colours(extracted, solid, tmp_path):
    reference = solid.parent / "scene" / "reference.ply"
    scores = eval_mesh_files(extracted / "part.ply", reference, tmp_path, samples=5000)
    for name in ("error_pred", "error_ref"):
        mesh = opened(tmp_path / f"{name}.ply")
        assert_same_surface(mesh, tmp_path / f"{name}.ply")
        quality, shown = mesh.vertex_scalar_array(), colors(mesh)
        assert mesh.has_vertex_scalar() and mesh.has_vertex_color()
        np.testing.assert_allclose(quality, load_mesh(tmp_path / f"{name}.ply").quality, rtol=1e-6)
        assert np.isclose(np.median(quality), scores["accuracy" if name == "error_pred" else "completeness"], rtol=0.5)
        # From dark violet to yellow: where the error is larger, there is more green.
        order = np.argsort(quality)
        tenth = len(order) // 10
        assert shown[order[-tenth:], 1].mean() > shown[order[:tenth], 1].mean() + 40
