"""Files of primitives: formulas of LinPrim and 3DGS, exact round trips, and damaged files."""

from __future__ import annotations

import io
import tracemalloc
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from helpers.primitive_sets import (
    FIELDS,
    PROPERTIES,
    assert_same,
    ply_bytes,
    random_gaussians,
    random_octahedra,
    random_tetrahedra,
    raw_table,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.recfunctions import repack_fields

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.primitive_files import read_ply_header, read_primitive_ply, write_primitive_ply
from linprim_geo.geometry.primitives import Primitives, load_primitives, save_primitives

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
def test_densities_round_trip_up_to_the_cap(tmp_path_factory, log_thickness):
    path = tmp_path_factory.getbasetemp() / "density.ply"
    before = random_octahedra(3, 1, thickness=np.exp(log_thickness))
    report = write_primitive_ply(path, before)
    after, _ = read_primitive_ply(path)
    np.testing.assert_allclose(after.density, before.density, rtol=1e-5)
    if log_thickness < np.log(np.log(100.0)) - 1e-5:
        assert report["clamped"] == 0


def test_densities_above_the_cap_are_clamped_and_counted(tmp_path):
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


def test_tetrahedra_use_the_layout_of_linprim_with_a_fourth_distance(tmp_path):
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
        np.testing.assert_allclose(gaussians.rotation[row], quaternion / np.linalg.norm(quaternion), rtol=1e-6)
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
    np.testing.assert_allclose(wide.density * wide.extent.prod(1), plain.density * plain.extent.prod(1), rtol=1e-5)


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


def test_npz_round_trip_is_exact(tmp_path):
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
        (npz_bytes(**good_arrays() | {"center": np.array([[None] * 3] * 4)}), "Python objects"),
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
    return repack_fields(table[[kept for kept in table.dtype.names if kept != name]])


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
def test_invalid_ply_is_refused_with_little_memory(tmp_path, name):
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
def test_damaged_ply_is_read_or_refused_with_one_sentence(tmp_path_factory, changes, length):
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
