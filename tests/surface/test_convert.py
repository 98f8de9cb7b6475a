"""Meshes of primitives with known volume, and the command `convert`."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.primitive_sets import (
    assert_same,
    ply_bytes,
    random_gaussians,
    random_octahedra,
    random_tetrahedra,
    raw_table,
)

from linprim_geo.base.errors import LinprimError
from linprim_geo.cli import main as cli
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.mesh_files import load_mesh, save_mesh
from linprim_geo.geometry.primitive_files import read_primitive_ply, write_primitive_ply
from linprim_geo.geometry.primitives import Primitives, load_primitives, save_primitives
from linprim_geo.surface.convert import HELD, convert, find_scene_file, save_primitive_mesh
from linprim_geo.surface.texture.texture import Texture
from linprim_geo.surface.texture.texture_charts import unwrap
from linprim_geo.surface.texture.texture_files import load_texture, save_textured

# --- meshes ----------------------------------------------------------------------------------------------


def test_triangle_meshes_of_octahedra_are_exact():
    octahedra = random_octahedra(40)
    mesh = octahedra.triangle_mesh()
    assert mesh.vertices.shape == (240, 3) and mesh.faces.shape == (320, 3)
    corners = mesh.vertices[mesh.faces]
    signed = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    volumes = signed.reshape(40, 8).sum(axis=1) / 6
    # Positive, so every face looks outward; 4/3 a b c is the volume of an octahedron.
    np.testing.assert_allclose(volumes, 4 / 3 * octahedra.extent.astype(np.float64).prod(axis=1), rtol=1e-7)
    offset = corners.mean(1) - np.repeat(octahedra.center.astype(np.float64), 8, axis=0)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fi,fi->f", offset, normal) > 0).all()
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    # On the surface the L1 norm in half-axes is 1.
    local = np.einsum("nij,nvi->nvj", octahedra.axes, octahedra.vertices - octahedra.center[:, None])
    np.testing.assert_allclose(np.abs(local / octahedra.extent[:, None]).sum(-1), 1.0, rtol=1e-6)


def test_a_quarter_turn_about_z_takes_x_to_y():
    half = np.sqrt(0.5)
    octahedra = Primitives([[0, 0, 0]], [[half, 0, 0, half]], [[3, 2, 1]], [1.0], np.zeros((1, 1, 3)))
    expected = [[0, -3, 0], [0, 3, 0], [2, 0, 0], [-2, 0, 0], [0, 0, -1], [0, 0, 1]]
    np.testing.assert_allclose(octahedra.vertices[0], expected, atol=1e-6)


def test_colours_and_alpha_of_the_mesh(tmp_path):
    import trimesh

    sh = np.array([[[0.0, 0.5 / 0.28209479177387814, -9.0]]])
    octahedra = Primitives([[1, 2, 3]], [[1, 0, 0, 0]], [[2, 1, 4]], [np.log(2) / 2], sh)
    np.testing.assert_allclose(octahedra.alpha, 0.5, rtol=1e-7)
    save_primitive_mesh(tmp_path / "x.ply", octahedra)
    mesh = trimesh.load(tmp_path / "x.ply", process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(4 / 3 * 8, rel=1e-6)
    assert np.unique(mesh.visual.vertex_colors, axis=0).tolist() == [[128, 255, 0, 128]]
    save_primitive_mesh(tmp_path / "x.glb", octahedra)
    data = (tmp_path / "x.glb").read_bytes()
    description = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert description["materials"][0]["alphaMode"] == "BLEND"
    color = description["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    assert description["accessors"][color]["type"] == "VEC4"


def test_gaussians_convert_to_ellipsoids(tmp_path):
    import trimesh

    gaussians = replace(random_gaussians(1), extent=np.array([[0.3, 0.2, 0.1]]))
    assert save_primitive_mesh(tmp_path / "x.ply", gaussians) == 80
    mesh = trimesh.load(tmp_path / "x.ply", process=False)
    # An icosphere of 80 faces has 0.87 of its sphere's volume.
    assert mesh.is_watertight and mesh.volume == pytest.approx(0.873 * 4 / 3 * np.pi * 0.006, rel=0.01)
    assert np.unique(mesh.visual.vertex_colors[:, 3]) == np.rint(gaussians.density * 255)


# --- the command -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".stl"])
def test_primitives_convert_to_meshes(tmp_path, suffix, capsys):
    import trimesh

    octahedra = random_octahedra(20)
    save_primitives(tmp_path / "x.npz", octahedra)
    target = tmp_path / f"y{suffix}"
    assert cli.main(["convert", str(tmp_path / "x.npz"), str(target), "--as", "mesh", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["wrote"] == "mesh"
    mesh = trimesh.load(target, force="mesh", process=suffix == ".stl")
    # .stl and .ply hold float32, and a centre of size 4 next to half-axes of 0.01 loses digits.
    assert mesh.volume == pytest.approx(4 / 3 * octahedra.extent.astype(np.float64).prod(axis=1).sum(), rel=1e-4)


MESH_FORMATS = (".ply", ".obj", ".glb", ".stl")


def painted_ball() -> Mesh:
    """A sphere with all attributes of meshes."""
    import trimesh

    ball = trimesh.creation.icosphere(2)
    rng = np.random.default_rng(0)
    count = len(ball.vertices)
    return Mesh(
        ball.vertices * 0.3 + [3, -2, 1],
        ball.faces,
        normals=ball.vertices,
        colors=rng.integers(0, 256, (count, 3)),
        quality=rng.random(count),
    )


@pytest.mark.parametrize("first", MESH_FORMATS)
@pytest.mark.parametrize("second", MESH_FORMATS)
def test_meshes_keep_what_both_formats_hold(tmp_path, first, second):
    mesh = painted_ball()
    save_mesh(tmp_path / f"a{first}", mesh)
    report = convert(tmp_path / f"a{first}", tmp_path / f"b{second}")
    assert (report["read"], report["wrote"], report["count"]) == ("mesh", "mesh", len(mesh.faces))
    after = load_mesh(tmp_path / f"b{second}")
    # Corner by corner: an .stl has no shared vertices, and merges them in another order.
    np.testing.assert_allclose(after.vertices[after.faces], mesh.vertices[mesh.faces], rtol=0, atol=5e-7)
    held = set(HELD[first]) & set(HELD[second])
    assert set(report.get("left_out", [])) == set(HELD[first]) - held
    for name in ("normals", "colors", "quality"):
        got = getattr(after, name)
        if name not in held:
            # An .stl of trimesh has a colour per face, but none was given to it.
            assert got is None, name
            continue
        tolerance = {"normals": 2e-6, "colors": 0, "quality": 0}[name]
        np.testing.assert_allclose(
            got[after.faces], getattr(mesh, name)[mesh.faces], rtol=0, atol=tolerance, err_msg=name
        )


def textured_ball(size=32):
    """A sphere of several charts and a texture of noise over it."""
    ball = painted_ball()
    uv, _ = unwrap(ball, size)
    image = np.random.default_rng(1).integers(0, 256, (size, size, 3), dtype=np.uint8)
    return ball, Texture(image, uv / size, {})


@pytest.mark.parametrize("first", [".obj", ".glb"])
@pytest.mark.parametrize("second", [".obj", ".glb"])
def test_textures_are_converted(tmp_path, first, second):
    ball, texture = textured_ball()
    save_textured(tmp_path / f"a{first}", ball, texture)
    report = convert(tmp_path / f"a{first}", tmp_path / f"b{second}")
    assert report["wrote"] == "mesh with a texture" and "left_out" not in report
    mesh, after = load_texture(tmp_path / f"b{second}")
    np.testing.assert_array_equal(after.image, texture.image)
    np.testing.assert_allclose(after.uv, texture.uv, atol=1e-6)
    # Vertices that files split at seams are merged again.
    assert len(mesh.vertices) == len(ball.vertices)
    np.testing.assert_allclose(mesh.vertices[mesh.faces], ball.vertices[ball.faces], rtol=0, atol=5e-7)
    np.testing.assert_allclose(mesh.normals[mesh.faces], ball.normals[ball.faces], rtol=0, atol=2e-6)


@pytest.mark.parametrize("suffix", [".ply", ".stl"])
def test_textures_left_out_are_reported(tmp_path, suffix, capsys):
    ball, texture = textured_ball()
    texture.image[:] = (200, 100, 50)
    save_textured(tmp_path / "a.obj", ball, texture)
    assert cli.main(["convert", str(tmp_path / "a.obj"), str(tmp_path / f"b{suffix}")]) == 0
    shown = capsys.readouterr().out
    assert "left out" in shown and "texture" in shown
    after = load_mesh(tmp_path / f"b{suffix}")
    if suffix == ".ply":
        assert (after.colors == (200, 100, 50)).all()
    assert load_texture(tmp_path / "a.obj") is not None and load_texture(tmp_path / f"b{suffix}") is None


def test_material_colours_multiply_the_texture(tmp_path):
    import trimesh
    from PIL import Image

    white = Image.fromarray(np.full((4, 4, 3), 255, np.uint8))
    box = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=white, baseColorFactor=[255, 128, 0, 255])
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    box.export(tmp_path / "a.glb")
    convert(tmp_path / "a.glb", tmp_path / "b.obj")
    assert np.unique(np.asarray(Image.open(tmp_path / "b.png")).reshape(-1, 3), axis=0).tolist() == [[255, 128, 0]]


@pytest.mark.parametrize(
    ("make", "thickness"), [(random_octahedra, 1.25), (random_tetrahedra, 1.25), (random_gaussians, None)]
)
def test_primitives_survive_round_trips(make, thickness, tmp_path):
    """npz -> ply -> npz -> ply -> ply: equal up to float32, and stable after the first file."""
    before = make(100, 16) if thickness is None else make(100, 16, thickness=thickness)
    save_primitives(tmp_path / "a.npz", before)
    for source, target in (("a.npz", "b.ply"), ("b.ply", "c.npz"), ("c.npz", "d.ply"), ("d.ply", "e.ply")):
        report = convert(tmp_path / source, tmp_path / target)
        assert report["count"] == 100 and not report.keys() & {"dropped", "clamped"}
    after = load_primitives(tmp_path / "c.npz")
    assert after.kind == before.kind
    assert_same(before, after, ("center", "sh") if before.kind == "gaussian" else ("center", "sh", "extent"))
    # Logarithms and logits are of a size up to 10 in float32.
    np.testing.assert_allclose(after.extent, before.extent, rtol=2e-6)
    np.testing.assert_allclose(after.density, before.density, rtol=1e-5)
    np.testing.assert_allclose(after.rotation, before.rotation, atol=2e-7)
    last, _ = read_primitive_ply(tmp_path / "e.ply")
    assert_same(after, last, ("center", "sh") if before.kind == "gaussian" else ("center", "sh", "extent"))
    np.testing.assert_allclose(last.density, after.density, rtol=1e-5)
    np.testing.assert_allclose(last.extent, after.extent, rtol=2e-6)


def test_linprim_files_convert_to_3dgs_gaussians(tmp_path):
    octahedra = random_octahedra(30, 16, thickness=1.0)
    write_primitive_ply(tmp_path / "linprim.ply", octahedra)
    convert(tmp_path / "linprim.ply", tmp_path / "gaussians.ply", "gaussians")
    assert convert(tmp_path / "gaussians.ply", tmp_path / "x.npz")["wrote"] == "Gaussians"
    after = load_primitives(tmp_path / "x.npz")
    np.testing.assert_allclose(after.extent, octahedra.extent / 2.6, rtol=2e-6)
    np.testing.assert_allclose(after.density, octahedra.alpha, rtol=1e-5)
    np.testing.assert_allclose(after.rotation, octahedra.rotation, atol=4e-7)
    assert_same(octahedra, after, ("center", "sh"))


def test_primitives_are_found_in_run_and_model_folders(tmp_path):
    run = tmp_path / "run"
    save_primitives(run / "scene.npz", random_octahedra(3))
    assert find_scene_file(run) == run / "scene.npz"
    model = tmp_path / "model" / "point_cloud"
    for iteration in (7000, 30000, 900):
        write_primitive_ply(model / f"iteration_{iteration}" / "point_cloud.ply", random_octahedra(iteration // 100))
    assert find_scene_file(model.parent) == model / "iteration_30000" / "point_cloud.ply"
    assert convert(model.parent, tmp_path / "y.npz")["count"] == 300
    assert len(load_primitives(tmp_path / "y.npz")) == 300
    with pytest.raises(LinprimError, match="neither scene.npz"):
        find_scene_file(tmp_path)


@pytest.mark.parametrize(("make", "plural"), [(random_tetrahedra, "tetrahedra"), (random_gaussians, "Gaussians")])
def test_tetrahedra_and_gaussians_keep_their_kind(make, plural, tmp_path):
    before = make(20)
    save_primitives(tmp_path / "x.npz", before)
    assert convert(tmp_path / "x.npz", tmp_path / "y.ply")["wrote"].endswith(f"s {plural}")
    report = convert(tmp_path / "y.ply", tmp_path / "z.npz")
    assert (report["read"], report["wrote"], report["count"]) == (plural, plural, 20)
    after = load_primitives(tmp_path / "z.npz")
    assert after.kind == before.kind
    np.testing.assert_allclose(after.extent, before.extent, rtol=2e-6)
    assert convert(tmp_path / "x.npz", tmp_path / "y.glb")["faces"] == 20 * (4 if plural[0] == "t" else 80)


def test_octahedra_convert_to_gaussians_on_request(tmp_path, capsys):
    octahedra = random_octahedra(9)
    save_primitives(tmp_path / "x.npz", octahedra)
    line = ["convert", str(tmp_path / "x.npz"), str(tmp_path / "y.ply"), "--as", "gaussians"]
    assert cli.main(line) == 0 and "3DGS's Gaussians" in capsys.readouterr().out
    after, _ = read_primitive_ply(tmp_path / "y.ply")
    assert after.kind == "gaussian"
    np.testing.assert_allclose(after.extent, octahedra.extent / 2.6, rtol=2e-6)
    np.testing.assert_allclose(after.density, octahedra.alpha, rtol=1e-5)


def test_primitives_that_are_too_thick_are_reported(tmp_path, capsys):
    save_primitives(tmp_path / "x.npz", random_octahedra(6, thickness=9.0))
    assert cli.main(["convert", str(tmp_path / "x.npz"), str(tmp_path / "y.ply")]) == 0
    assert "6 are thicker" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("source", "target", "how", "sentence"),
    [
        ("missing.npz", "y.ply", "auto", "no such file"),
        ("x.npz", "y.xyz", "auto", "suffix"),
        ("x.txt", "y.ply", "auto", "suffix"),
        ("x.npz", "x.npz", "auto", "is the file that is read"),
        ("x.npz", "y.npz", "mesh", "holds primitives"),
        ("x.npz", "y.obj", "primitives", "holds a mesh"),
        ("mesh.ply", "y.npz", "auto", "is a mesh"),
        ("mesh.ply", "y.ply", "primitives", "is a mesh"),
        ("points.ply", "y.npz", "auto", "points alone"),
        ("gaussians.ply", "y.npz", "auto", "3DGS's 62 properties"),
        ("x.npz", "y.obj", "gaussians", "holds a mesh"),
        ("mesh.ply", "y.ply", "gaussians", "is a mesh"),
        ("tetra.npz", "y.ply", "gaussians", "cannot be written as Gaussians"),
        ("short.ply", "y.npz", "auto", "truncated"),
    ],
)
def test_invalid_conversions_are_refused_and_write_nothing(tmp_path, source, target, how, sentence, capsys):
    save_primitives(tmp_path / "x.npz", random_octahedra(3))
    save_primitives(tmp_path / "tetra.npz", random_tetrahedra(3))
    (tmp_path / "x.txt").write_text("text")
    save_primitive_mesh(tmp_path / "mesh.ply", random_octahedra(3))
    points = np.zeros(2, dtype=[(name, "<f4") for name in "xyz"])
    (tmp_path / "points.ply").write_bytes(ply_bytes(points))
    without_one = [("dist_0", "scale_0"), ("dist_1", "scale_1")]
    (tmp_path / "gaussians.ply").write_bytes(ply_bytes(raw_table(), without_one))
    (tmp_path / "short.ply").write_bytes(ply_bytes(raw_table())[:-1])
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert cli.main(["convert", str(tmp_path / source), str(tmp_path / target), "--as", how]) == 1
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and sentence in captured.err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
