"""Random primitives of every kind, and the bytes of PLY files in LinPrim's format."""

from __future__ import annotations

import numpy as np

from linprim_geo.base.kinds import KINDS
from linprim_geo.geometry.primitives import Primitives, unit_quaternions

FIELDS = ("center", "rotation", "extent", "density", "sh")

# LinPrim's 63 properties in the order of its files.
PROPERTIES = (
    "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2".split()
    + [f"f_rest_{index}" for index in range(45)]
    + "opacity dist_0 dist_1 dist_2 rot_0 rot_1 rot_2 rot_3 filter_3D".split()
)


def random_octahedra(count=50, coefficients=9, seed=0, thickness=None):
    """Returns random octahedra; `thickness` is the optical thickness of their shortest diagonals."""
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
    """Returns random tetrahedra; `thickness` is the optical thickness of the diameters of their inscribed spheres."""
    rng = np.random.default_rng(seed)
    extent = np.exp(rng.normal(-2, 1, (count, 4))).astype(np.float32)
    thickness = np.exp(rng.uniform(-7, 1.5, count)) if thickness is None else np.full(count, thickness)
    return Primitives(
        center=rng.normal(size=(count, 3)),
        rotation=unit_quaternions(rng.normal(size=(count, 4))),
        extent=extent,
        density=thickness / KINDS["tetrahedron"].reference_length(extent.astype(np.float64)),
        sh=rng.normal(size=(count, coefficients, 3)),
        kind="tetrahedron",
    )


def random_gaussians(count=50, coefficients=9, seed=0):
    """Returns random Gaussians."""
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
    """Returns rows as LinPrim writes them: raw distances of either sign, quaternions of any length, a filter."""
    rng = np.random.default_rng(seed)
    table = np.zeros(count, dtype=[(name, "<f4") for name in PROPERTIES])
    for name in PROPERTIES:
        if not name.startswith("n"):
            table[name] = rng.normal(size=count)
    table["filter_3D"] = np.abs(table["filter_3D"]) + 0.01
    return table


def ply_bytes(table, header_changes=()):
    """Returns a binary PLY file of the table; `header_changes` are (old, new) replacements in its header."""
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
