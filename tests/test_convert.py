"""Files of primitives: LinPrim's formulas, exact round trips, meshes of known volume, and files not to be
trusted."""

from __future__ import annotations

import io
import json
import tracemalloc
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from linprim_geo import cli
from linprim_geo.convert import HELD, convert, find_scene_file, save_primitive_mesh
from linprim_geo.errors import LinprimError
from linprim_geo.mesh import Mesh, load_mesh, save_mesh
from linprim_geo.ply import read_ply_header, read_primitive_ply, write_primitive_ply
from linprim_geo.primitives import (
    Primitives,
    load_primitives,
    reference_length,
    save_primitives,
    unit_quaternions,
)
from linprim_geo.texture import Texture, save_textured, unwrap
from linprim_geo.texture_files import load_texture

FIELDS = ("center", "rotation", "extent", "density", "sh")

# LinPrim's 63 properties in the order of its files.
PROPERTIES = (
    "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2".split()
    + [f"f_rest_{index}" for index in range(45)]
    + "opacity dist_0 dist_1 dist_2 rot_0 rot_1 rot_2 rot_3 filter_3D".split()
)


def random_octahedra(count=50, coefficients=9, seed=0, thickness=None):
    """Primitives of any shape; `thickness` is the optical thickness of their shortest diagonals."""
    rng = np.random.default_rng(seed)
    extent = np.exp(rng.normal(-2, 1, (count, 3))).astype(np.float32)
    thickness = np.exp(rng.uniform(-7, 1.5, count)) if thickness is None else np.full(count, thickness)
    return Primitives(
        center=rng.normal(size=(count, 3)),
        rotation=unit_quaternions(rng.normal(size=(count, 4))),
        extent=extent,
        density=thickness / (2.0 * extent.min(axis=1).astype(np.float64)),
        sh=rng.normal(size=(count, coefficients, 3)),
    )


def random_tetrahedra(count=50, coefficients=9, seed=0, thickness=None):
    """Tetrahedra of any shape; `thickness` is that of the diameters of their inscribed spheres."""
    rng = np.random.default_rng(seed)
    extent = np.exp(rng.normal(-2, 1, (count, 4))).astype(np.float32)
    thickness = np.exp(rng.uniform(-7, 1.5, count)) if thickness is None else np.full(count, thickness)
    return Primitives(
        center=rng.normal(size=(count, 3)),
        rotation=unit_quaternions(rng.normal(size=(count, 4))),
        extent=extent,
        density=thickness / reference_length(extent.astype(np.float64), "tetrahedron"),
        sh=rng.normal(size=(count, coefficients, 3)),
        kind="tetrahedron",
    )


def random_gaussians(count=50, coefficients=9, seed=0):
    rng = np.random.default_rng(seed)
    return Primitives(
        center=rng.normal(size=(count, 3)),
        rotation=unit_quaternions(rng.normal(size=(count, 4))),
        extent=np.exp(rng.normal(-4, 1, (count, 3))),
        density=rng.uniform(0, 1, count),
        sh=rng.normal(size=(count, coefficients, 3)),
        kind="gaussian",
    )


def raw_table(count=4, seed=1):
    """Rows as LinPrim writes them: raw distances of either sign, quaternions of any length, a filter."""
    rng = np.random.default_rng(seed)
    table = np.zeros(count, dtype=[(name, "<f4") for name in PROPERTIES])
    for name in PROPERTIES:
        if not name.startswith("n"):
            table[name] = rng.normal(size=count)
    table["filter_3D"] = np.abs(table["filter_3D"]) + 0.01
    return table


def ply_bytes(table, header_changes=()):
    kinds = {"f4": "float", "f8": "double", "i4": "int"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property {kinds[table.dtype[name].str[1:]]} {name}" for name in table.dtype.names]
    header = "\n".join([*lines, "end_header", ""])
    for old, new in header_changes:
        assert old in header
        header = header.replace(old, new, 1)
    return header.encode() + table.tobytes()


def assert_same(a, b, fields=FIELDS):
    for name in fields:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


# --- the formulas ----------------------------------------------------------------------------------------


def test_import_follows_the_formulas_of_linprim(tmp_path):
    table = raw_table()
    (tmp_path / "in.ply").write_bytes(ply_bytes(table))
    octahedra, report = read_primitive_ply(tmp_path / "in.ply")
    assert report == {"rows": 4, "dropped": 0}
    for row, raw in zip(range(4), table, strict=True):
        extent = [abs(float(raw[f"dist_{k}"])) + float(raw["filter_3D"]) / 2 for k in range(3)]
        opacity = 1 / (1 + np.exp(-float(raw["opacity"])))
        density = -np.log(1 - 0.99 * opacity) / (2 * min(extent))
        quaternion = np.array([float(raw[f"rot_{k}"]) for k in range(4)])
        # Half-axes are a float32 sum; the density divides by them: a few units in the last place.
        np.testing.assert_allclose(octahedra.extent[row], extent, rtol=2e-7)
        np.testing.assert_allclose(octahedra.density[row], density, rtol=5e-7)
        unit = quaternion / np.linalg.norm(quaternion)
        np.testing.assert_allclose(octahedra.rotation[row], unit, rtol=2e-7)
        np.testing.assert_array_equal(octahedra.center[row], [raw["x"], raw["y"], raw["z"]])
        for channel in range(3):
            expected = [raw[f"f_dc_{channel}"], *(raw[f"f_rest_{15 * channel + k}"] for k in range(15))]
            np.testing.assert_array_equal(octahedra.sh[row, :, channel], expected)


def test_export_has_the_63_properties_in_order(tmp_path):
    write_primitive_ply(tmp_path / "out.ply", random_octahedra(3))
    header = read_ply_header(tmp_path / "out.ply")
    (vertex,) = header.elements
    assert [name for name, _ in vertex.properties] == PROPERTIES
    assert {kind for _, kind in vertex.properties} == {"f4"}
    assert (tmp_path / "out.ply").stat().st_size == header.data_start + 3 * 252


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_a_round_trip_through_linprims_file(tmp_path, coefficients):
    before = random_octahedra(200, coefficients, thickness=1.25)
    assert write_primitive_ply(tmp_path / "x.ply", before) == {"rows": 200, "clamped": 0}
    after, _ = read_primitive_ply(tmp_path / "x.ply")
    assert_same(before, after, ("center", "extent", "sh"))
    np.testing.assert_allclose(after.rotation, before.rotation, atol=2e-7)
    np.testing.assert_allclose(after.density, before.density, rtol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.floats(-60, np.log(np.log(100.0))))
def test_densities_survive_up_to_the_cap(tmp_path_factory, log_thickness):
    path = tmp_path_factory.getbasetemp() / "density.ply"
    before = random_octahedra(3, 1, thickness=np.exp(log_thickness))
    report = write_primitive_ply(path, before)
    after, _ = read_primitive_ply(path)
    np.testing.assert_allclose(after.density, before.density, rtol=1e-5)
    if log_thickness < np.log(np.log(100.0)) - 1e-5:
        assert report["clamped"] == 0


def test_what_linprim_cannot_hold_is_clamped_and_counted(tmp_path):
    thick, thin = random_octahedra(5, 1, thickness=20.0), random_octahedra(7, 1, thickness=4.6)
    both = Primitives(*(np.concatenate([getattr(thick, name), getattr(thin, name)]) for name in FIELDS))
    assert write_primitive_ply(tmp_path / "x.ply", both) == {"rows": 12, "clamped": 5}
    after, _ = read_primitive_ply(tmp_path / "x.ply")
    thickness = 2.0 * after.density.astype(np.float64) * after.extent.min(axis=1)
    np.testing.assert_allclose(thickness, [np.log(100.0)] * 5 + [4.6] * 7, rtol=1e-5)


def test_an_empty_primitive_stays_invisible(tmp_path):
    write_primitive_ply(tmp_path / "x.ply", random_octahedra(3, thickness=0.0))
    after, _ = read_primitive_ply(tmp_path / "x.ply")
    assert np.isfinite(after.density).all() and (after.alpha < 1e-36).all()


def test_rows_without_volume_are_dropped_and_counted(tmp_path):
    table = raw_table()
    table["dist_1"][2] = table["filter_3D"][2] = 0
    (tmp_path / "x.ply").write_bytes(ply_bytes(table))
    octahedra, report = read_primitive_ply(tmp_path / "x.ply")
    assert len(octahedra) == 3 and report == {"rows": 4, "dropped": 1}


def test_tetrahedra_are_linprims_layout_with_a_fourth_distance(tmp_path):
    before = random_tetrahedra(200, 16, thickness=1.25)
    assert write_primitive_ply(tmp_path / "x.ply", before) == {"rows": 200, "clamped": 0}
    header = read_ply_header(tmp_path / "x.ply")
    at = PROPERTIES.index("rot_0")
    assert [n for n, _ in header.elements[0].properties] == [*PROPERTIES[:at], "dist_3", *PROPERTIES[at:]]
    after, _ = read_primitive_ply(tmp_path / "x.ply")
    assert after.kind == "tetrahedron"
    assert_same(before, after, ("center", "extent", "sh"))
    np.testing.assert_allclose(after.density, before.density, rtol=1e-6)
    assert write_primitive_ply(tmp_path / "x.ply", random_tetrahedra(5, thickness=20.0))["clamped"] == 5


def test_gaussians_follow_the_formulas_of_3dgs(tmp_path):
    table = gaussian_table()
    (tmp_path / "in.ply").write_bytes(ply_bytes(table))
    gaussians, report = read_primitive_ply(tmp_path / "in.ply")
    assert report == {"rows": 4, "dropped": 0} and gaussians.kind == "gaussian"
    for row, raw in enumerate(table):
        np.testing.assert_allclose(
            gaussians.extent[row], [np.exp(float(raw[f"scale_{k}"])) for k in range(3)], rtol=1e-6
        )
        assert gaussians.density[row] == pytest.approx(1 / (1 + np.exp(-float(raw["opacity"]))), rel=1e-6)
        quaternion = np.array([float(raw[f"rot_{k}"]) for k in range(4)])
        np.testing.assert_allclose(
            gaussians.rotation[row], quaternion / np.linalg.norm(quaternion), rtol=1e-6
        )
        for channel in range(3):
            expected = [raw[f"f_dc_{channel}"], *(raw[f"f_rest_{15 * channel + k}"] for k in range(15))]
            np.testing.assert_array_equal(gaussians.sh[row, :, channel], expected)


def test_a_3d_filter_of_gaussians_keeps_their_mass(tmp_path):
    table = gaussian_table()
    filtered = np.zeros(4, dtype=[*table.dtype.descr, ("filter_3D", "<f4")])
    for name in table.dtype.names:
        filtered[name] = table[name]
    filtered["filter_3D"] = 0.3
    (tmp_path / "plain.ply").write_bytes(ply_bytes(table))
    (tmp_path / "filtered.ply").write_bytes(ply_bytes(filtered))
    plain, wide = (read_primitive_ply(tmp_path / f"{name}.ply")[0] for name in ("plain", "filtered"))
    np.testing.assert_allclose(wide.extent, np.hypot(plain.extent, 0.3), rtol=1e-6)
    np.testing.assert_allclose(
        wide.density * wide.extent.prod(1), plain.density * plain.extent.prod(1), rtol=1e-5
    )


def test_a_round_trip_through_3dgs_file(tmp_path):
    before = random_gaussians(200)
    assert write_primitive_ply(tmp_path / "x.ply", before) == {"rows": 200, "clamped": 0}
    (vertex,) = read_ply_header(tmp_path / "x.ply").elements
    assert [name for name, _ in vertex.properties] == list(gaussian_table().dtype.names)
    after, _ = read_primitive_ply(tmp_path / "x.ply")
    assert_same(before, after, ("center", "sh"))
    # Logarithms up to 8 and logits up to 8 in float32.
    np.testing.assert_allclose(after.extent, before.extent, rtol=2e-6)
    np.testing.assert_allclose(after.density, before.density, rtol=1e-5)
    edges = replace(random_gaussians(2), density=np.array([0.0, 1.0]))
    write_primitive_ply(tmp_path / "x.ply", edges)
    after, _ = read_primitive_ply(tmp_path / "x.ply")
    assert after.density[0] < 1e-36 and after.density[1] > 1 - 1e-7


# --- our own file ----------------------------------------------------------------------------------------


def test_npz_is_exact(tmp_path):
    before = random_octahedra(100, 16)
    save_primitives(tmp_path / "x.npz", before)
    after = load_primitives(tmp_path / "x.npz")
    assert_same(before, after)
    assert after.sh_degree == 3


def npz_bytes(**arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def good_arrays():
    octahedra = random_octahedra(4, 1)
    arrays = {name: getattr(octahedra, name) for name in FIELDS}
    return {"format": np.array("linprim-geo octahedra 1"), **arrays}


def enormous_npz():
    """An archive whose header claims 2^40 rows of centres."""
    file = io.BytesIO(npz_bytes(**good_arrays()))
    out = io.BytesIO()
    with zipfile.ZipFile(file) as source, zipfile.ZipFile(out, "w") as target:
        for info in source.infolist():
            data = source.read(info)
            if info.filename == "center.npy":
                data = data.replace(b"(4, 3), }" + b" " * 12, b"(1099511627776, 3), }")
                assert b"1099511627776" in data
            target.writestr(info.filename, data)
    return out.getvalue()


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", "not a complete .npz"),
        (b"PK\x03\x04 nonsense", "not a complete .npz"),
        (npz_bytes(**good_arrays())[:-100], "not a complete .npz"),
        (npz_bytes(a=np.zeros(3)), "holds no primitives"),
        (npz_bytes(**good_arrays() | {"format": np.array("something else")}), "something else"),
        (npz_bytes(**{k: v for k, v in good_arrays().items() if k != "density"}), "density is missing"),
        (npz_bytes(**good_arrays() | {"density": np.zeros(3)}), "density has the shape"),
        (npz_bytes(**good_arrays() | {"density": np.full(4, np.nan)}), "density of row 0 is NaN"),
        (npz_bytes(**good_arrays() | {"density": -np.ones(4)}), "density of row 0"),
        (npz_bytes(**good_arrays() | {"extent": np.zeros((4, 3))}), "extent of row 0"),
        (npz_bytes(**good_arrays() | {"rotation": np.zeros((4, 4))}), "rotation of row 0"),
        (npz_bytes(**good_arrays() | {"sh": np.zeros((4, 5, 3))}), "sh has the shape"),
        (npz_bytes(**good_arrays() | {"center": np.array([[None] * 3] * 4)}), "center claims"),
        (npz_bytes(**good_arrays() | {"center": np.array([["a"] * 3] * 4)}), "center has the type"),
        (enormous_npz(), r"center claims \(1099511627776, 3\)"),
    ],
)
def test_a_bad_npz_is_one_sentence(tmp_path, data, sentence):
    (tmp_path / "x.npz").write_bytes(data)
    tracemalloc.start()
    with pytest.raises(LinprimError, match=rf"x\.npz: .*{sentence}"):
        load_primitives(tmp_path / "x.npz")
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


# --- PLY files not to be trusted -------------------------------------------------------------------------


def without(name):
    table = raw_table()
    return table[[kept for kept in table.dtype.names if kept != name]].copy()


def with_value(name, value):
    table = raw_table()
    table[name][2] = value
    return table


def with_type(name, kind):
    table = raw_table()
    return table.astype([(other, kind if other == name else "<f4") for other in table.dtype.names])


def gaussian_table(count=4, seed=1):
    """Rows as 3DGS writes them."""
    names = [name for name in PROPERTIES if not name.startswith(("dist", "filter"))]
    at = names.index("rot_0")
    names[at:at] = ["scale_0", "scale_1", "scale_2"]
    rng = np.random.default_rng(seed)
    table = np.zeros(count, dtype=[(name, "<f4") for name in names])
    for name in names:
        if not name.startswith("n"):
            table[name] = rng.normal(size=count)
    return table


def gaussian_bytes(values):
    table = gaussian_table()
    for name, value in values.items():
        table[name] = value
    return ply_bytes(table)


GOOD = ply_bytes(raw_table())

BAD_PLY = {
    "empty": (b"", "not a PLY"),
    "other": (b"solid stl\n", "not a PLY"),
    "no end": (b"ply\nformat binary_little_endian 1.0\n", "no end"),
    "endless": (b"ply\n" + b"comment x\n" * 10_000, "no end"),
    "one row short": (GOOD[:-252], "truncated, it has 3 of the 4 rows"),
    "one byte short": (GOOD[:-1], "truncated, it has 3 of the 4 rows"),
    "header alone": (GOOD[: GOOD.index(b"end_header") + 11], "truncated, it has 0 of the 4 rows"),
    "absurd count": (ply_bytes(raw_table(), [("vertex 4", "vertex 999999999999999")]), "truncated"),
    "more than 64 bits": (ply_bytes(raw_table(), [("vertex 4", "vertex " + "9" * 40)]), "truncated"),
    "negative count": (ply_bytes(raw_table(), [("vertex 4", "vertex -4")]), "line 3"),
    "no number": (ply_bytes(raw_table(), [("vertex 4", "vertex four")]), "line 3"),
    "no rows": (ply_bytes(raw_table(), [("vertex 4", "vertex 0")]), "no primitives"),
    "ascii": (ply_bytes(raw_table(), [("binary_little_endian", "ascii")]), "format is ascii"),
    "big endian": (ply_bytes(raw_table(), [("little", "big")]), "binary_big_endian"),
    "unknown format": (ply_bytes(raw_table(), [("binary_little_endian", "xml")]), "format is 'xml'"),
    "unknown type": (ply_bytes(raw_table(), [("float opacity", "quad opacity")]), "quad opacity"),
    "repeated": (ply_bytes(raw_table(), [("float y", "float x")]), "repeated"),
    "list": (ply_bytes(raw_table(), [("float nx", "list uchar float nx")]), "lists"),
    "property first": (ply_bytes(raw_table(), [("element vertex 4\n", "")]), "line 3"),
    "other first": (ply_bytes(raw_table(), [("element", "element face 0\nelement")]), "first PLY element"),
    "no opacity": (ply_bytes(without("opacity")), "opacity is missing"),
    "no filter": (ply_bytes(without("filter_3D")), "filter_3D is missing"),
    "no rotation": (ply_bytes(without("rot_3")), "rot_3 is missing"),
    "44 coefficients": (ply_bytes(without("f_rest_44")), "44 properties f_rest"),
    "double": (ply_bytes(with_type("x", "<f8")), "x is float64"),
    "int": (ply_bytes(with_type("opacity", "<i4")), "opacity is int32"),
    "nan centre": (ply_bytes(with_value("y", np.nan)), "row 2 has a NaN or infinite x"),
    "inf extent": (ply_bytes(with_value("dist_2", np.inf)), "row 2 has a NaN or infinite dist_0"),
    "nan opacity": (ply_bytes(with_value("opacity", np.nan)), "row 2 has a NaN or infinite opacity"),
    "gaussians": (
        ply_bytes(raw_table(), [("dist_0", "scale_0"), ("dist_1", "scale_1")]),
        "scale_2 is missing, wanted 3DGS's 62",
    ),
    "tetrahedra": (
        ply_bytes(raw_table(), [("float filter_3D", "float dist_3")]),
        "filter_3D is missing, wanted LinPrim's 64",
    ),
    "mesh": (ply_bytes(raw_table(), [("float dist_0", "float other")]), "holds no primitives"),
    "flat gaussians": (
        gaussian_bytes({"scale_1": -np.inf}),
        "row 0 has a NaN or infinite scale_0",
    ),
    "gaussians without size": (gaussian_bytes({"scale_1": -1e4}), "none of its 4 primitives has a volume"),
    "huge gaussians": (gaussian_bytes({"scale_1": 1e4}), "none of its 4 primitives has a volume"),
}


@pytest.mark.parametrize("name", BAD_PLY)
def test_a_bad_ply_is_one_sentence(tmp_path, name):
    data, sentence = BAD_PLY[name]
    (tmp_path / "x.ply").write_bytes(data)
    tracemalloc.start()
    with pytest.raises(LinprimError, match=rf"x\.ply: .*{sentence}"):
        read_primitive_ply(tmp_path / "x.ply")
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


@settings(max_examples=300, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, len(GOOD) - 1), st.integers(0, 255)), max_size=4),
    st.integers(0, len(GOOD)),
)
def test_no_damage_ends_in_anything_but_a_sentence(tmp_path_factory, changes, length):
    path = tmp_path_factory.getbasetemp() / "damaged.ply"
    data = bytearray(GOOD)
    for position, value in changes:
        data[position] = value
    path.write_bytes(data[:length] if length % 3 == 0 else data)
    try:
        octahedra, _ = read_primitive_ply(path)
    except LinprimError as error:
        assert "\n" not in str(error)
    else:
        assert 1 <= len(octahedra) <= 4


# --- meshes ----------------------------------------------------------------------------------------------


def test_the_mesh_of_the_primitives_is_the_primitives():
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


def test_gaussians_become_ellipsoids(tmp_path):
    import trimesh

    gaussians = replace(random_gaussians(1), extent=np.array([[0.3, 0.2, 0.1]]))
    assert save_primitive_mesh(tmp_path / "x.ply", gaussians) == 80
    mesh = trimesh.load(tmp_path / "x.ply", process=False)
    # An icosphere of 80 faces has 0.87 of its sphere's volume.
    assert mesh.is_watertight and mesh.volume == pytest.approx(0.873 * 4 / 3 * np.pi * 0.006, rel=0.01)
    assert np.unique(mesh.visual.vertex_colors[:, 3]) == np.rint(gaussians.density * 255)


# --- the command -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".stl"])
def test_primitives_become_meshes(tmp_path, suffix, capsys):
    import trimesh

    octahedra = random_octahedra(20)
    save_primitives(tmp_path / "x.npz", octahedra)
    target = tmp_path / f"y{suffix}"
    assert cli.main(["convert", str(tmp_path / "x.npz"), str(target), "--as", "mesh", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["wrote"] == "mesh"
    mesh = trimesh.load(target, force="mesh", process=suffix == ".stl")
    # .stl and .ply hold float32, and a centre of size 4 next to half-axes of 0.01 loses digits.
    assert mesh.volume == pytest.approx(
        4 / 3 * octahedra.extent.astype(np.float64).prod(axis=1).sum(), rel=1e-4
    )


MESH_FORMATS = (".ply", ".obj", ".glb", ".stl")


def painted_ball() -> Mesh:
    """A sphere with everything that a mesh can have."""
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
def test_a_texture_goes_along(tmp_path, first, second):
    ball, texture = textured_ball()
    save_textured(tmp_path / f"a{first}", ball, texture)
    report = convert(tmp_path / f"a{first}", tmp_path / f"b{second}")
    assert report["wrote"] == "mesh with a texture" and "left_out" not in report
    mesh, after = load_texture(tmp_path / f"b{second}")
    np.testing.assert_array_equal(after.image, texture.image)
    np.testing.assert_allclose(after.uv, texture.uv, atol=1e-6)
    # Seams have split vertices on the way; they are whole again.
    assert len(mesh.vertices) == len(ball.vertices)
    np.testing.assert_allclose(mesh.vertices[mesh.faces], ball.vertices[ball.faces], rtol=0, atol=5e-7)
    np.testing.assert_allclose(mesh.normals[mesh.faces], ball.normals[ball.faces], rtol=0, atol=2e-6)


@pytest.mark.parametrize("suffix", [".ply", ".stl"])
def test_where_a_texture_has_no_place_that_is_said(tmp_path, suffix, capsys):
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


def test_the_colour_of_a_material_is_in_the_texture(tmp_path):
    import trimesh
    from PIL import Image

    white = Image.fromarray(np.full((4, 4, 3), 255, np.uint8))
    box = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=white, baseColorFactor=[255, 128, 0, 255])
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    box.export(tmp_path / "a.glb")
    convert(tmp_path / "a.glb", tmp_path / "b.obj")
    assert np.unique(np.asarray(Image.open(tmp_path / "b.png")).reshape(-1, 3), axis=0).tolist() == [
        [255, 128, 0]
    ]


@pytest.mark.parametrize(
    ("make", "thickness"), [(random_octahedra, 1.25), (random_tetrahedra, 1.25), (random_gaussians, None)]
)
def test_scenes_go_from_file_to_file_unchanged(make, thickness, tmp_path):
    """npz -> ply -> npz -> ply -> ply: to float32, and what has been through a file once stays as it is."""
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


def test_linprims_file_becomes_3dgs_gaussians(tmp_path):
    octahedra = random_octahedra(30, 16, thickness=1.0)
    write_primitive_ply(tmp_path / "linprim.ply", octahedra)
    convert(tmp_path / "linprim.ply", tmp_path / "gaussians.ply", "gaussians")
    assert convert(tmp_path / "gaussians.ply", tmp_path / "x.npz")["wrote"] == "Gaussians"
    after = load_primitives(tmp_path / "x.npz")
    np.testing.assert_allclose(after.extent, octahedra.extent / 2.6, rtol=2e-6)
    np.testing.assert_allclose(after.density, octahedra.alpha, rtol=1e-5)
    np.testing.assert_allclose(after.rotation, octahedra.rotation, atol=4e-7)
    assert_same(octahedra, after, ("center", "sh"))


def test_a_run_and_a_model_folder_stand_for_their_primitives(tmp_path):
    run = tmp_path / "run"
    save_primitives(run / "scene.npz", random_octahedra(3))
    assert find_scene_file(run) == run / "scene.npz"
    model = tmp_path / "model" / "point_cloud"
    for iteration in (7000, 30000, 900):
        write_primitive_ply(
            model / f"iteration_{iteration}" / "point_cloud.ply", random_octahedra(iteration // 100)
        )
    assert find_scene_file(model.parent) == model / "iteration_30000" / "point_cloud.ply"
    assert convert(model.parent, tmp_path / "y.npz")["count"] == 300
    assert len(load_primitives(tmp_path / "y.npz")) == 300
    with pytest.raises(LinprimError, match="neither scene.npz"):
        find_scene_file(tmp_path)


@pytest.mark.parametrize(
    ("make", "plural"), [(random_tetrahedra, "tetrahedra"), (random_gaussians, "Gaussians")]
)
def test_other_kinds_stay_what_they_are(make, plural, tmp_path):
    before = make(20)
    save_primitives(tmp_path / "x.npz", before)
    assert convert(tmp_path / "x.npz", tmp_path / "y.ply")["wrote"].endswith(f"s {plural}")
    report = convert(tmp_path / "y.ply", tmp_path / "z.npz")
    assert (report["read"], report["wrote"], report["count"]) == (plural, plural, 20)
    after = load_primitives(tmp_path / "z.npz")
    assert after.kind == before.kind
    np.testing.assert_allclose(after.extent, before.extent, rtol=2e-6)
    assert convert(tmp_path / "x.npz", tmp_path / "y.glb")["faces"] == 20 * (4 if plural[0] == "t" else 80)


def test_octahedra_become_gaussians_when_asked(tmp_path, capsys):
    octahedra = random_octahedra(9)
    save_primitives(tmp_path / "x.npz", octahedra)
    line = ["convert", str(tmp_path / "x.npz"), str(tmp_path / "y.ply"), "--as", "gaussians"]
    assert cli.main(line) == 0 and "3DGS's Gaussians" in capsys.readouterr().out
    after, _ = read_primitive_ply(tmp_path / "y.ply")
    assert after.kind == "gaussian"
    np.testing.assert_allclose(after.extent, octahedra.extent / 2.6, rtol=2e-6)
    np.testing.assert_allclose(after.density, octahedra.alpha, rtol=1e-5)


def test_thick_rows_are_reported_by_the_command(tmp_path, capsys):
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
def test_what_cannot_be_converted_writes_nothing(tmp_path, source, target, how, sentence, capsys):
    save_primitives(tmp_path / "x.npz", random_octahedra(3))
    save_primitives(tmp_path / "tetra.npz", random_tetrahedra(3))
    (tmp_path / "x.txt").write_text("text")
    save_primitive_mesh(tmp_path / "mesh.ply", random_octahedra(3))
    points = np.zeros(2, dtype=[(name, "<f4") for name in "xyz"])
    (tmp_path / "points.ply").write_bytes(ply_bytes(points))
    (tmp_path / "gaussians.ply").write_bytes(BAD_PLY["gaussians"][0])
    (tmp_path / "short.ply").write_bytes(GOOD[:-1])
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert cli.main(["convert", str(tmp_path / source), str(tmp_path / target), "--as", how]) == 1
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and sentence in captured.err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
