"""Read the vertices of a PLY file, ASCII or binary, as a point cloud; truncated files are rejected."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.types import PointCloud
from linprim_geo.geometry.primitive_files import read_ply_header

_COLORS = ("red", "green", "blue")
_GREY = 128


def read_points_ply(path: Path) -> PointCloud | None:
    """Return the positions and colours of the vertices (`red green blue`, 8-bit or float in [0, 1]; grey if there are
    none).

    Points that are not finite are left out; None if none is left.

    Raises:
        LinprimError: not a PLY file, no x y z, or fewer vertices than the header states.
    """
    header = read_ply_header(path)
    vertex = header.element("vertex")
    if vertex is None or header.elements[0] is not vertex:
        raise LinprimError(f"{path}: the PLY file does not begin with vertices, wanted a file of points")
    kinds = {name: kind for name, kind in vertex.properties if kind is not None}
    if not {"x", "y", "z"} <= set(kinds) or len(kinds) < len(vertex.properties):
        found = ", ".join(name for name, _ in vertex.properties) or "no properties"
        raise LinprimError(f"{path}: vertices have {found}, wanted x, y, z, no lists and nothing twice")
    with open(path, "rb") as file:
        file.seek(header.data_start)
        data = file.read()
    if header.format == "ascii":
        table = _ascii(path, data, list(kinds), vertex.count)
    else:
        order = "<" if header.format == "binary_little_endian" else ">"
        table = _binary(path, data, np.dtype([(name, order + kind) for name, kind in kinds.items()]), vertex.count)
    xyz = np.stack([np.asarray(table[axis], dtype=np.float64) for axis in "xyz"], axis=1)
    rgb = np.full((vertex.count, 3), _GREY, dtype=np.uint8)
    if set(_COLORS) <= set(kinds):
        values = np.stack([np.asarray(table[name], dtype=np.float64) for name in _COLORS], axis=1)
        scale = 255.0 if kinds["red"].startswith("f") else 1.0
        rgb = np.clip(np.nan_to_num(values) * scale + 0.5, 0, 255).astype(np.uint8)
    finite = np.isfinite(xyz).all(axis=1)
    return PointCloud(xyz[finite], rgb[finite]) if finite.any() else None


def _binary(path: Path, data: bytes, layout: np.dtype, count: int) -> np.ndarray:
    if len(data) < count * layout.itemsize:
        raise _cut_short(path, len(data) // layout.itemsize, count)
    return np.frombuffer(data, dtype=layout, count=count)


def _ascii(path: Path, data: bytes, names: list[str], count: int) -> dict[str, np.ndarray]:
    lines = [line for line in data.split(b"\n") if line.strip()][:count]
    try:
        rows = [[float(word) for word in line.split()[: len(names)]] for line in lines]
    except ValueError as error:
        raise LinprimError(f"{path}: a point holds something that is not a number ({error})") from error
    whole = sum(len(row) == len(names) for row in rows)
    if whole < count:
        raise _cut_short(path, whole, count)
    values = np.array(rows, dtype=np.float64).reshape(count, len(names))
    return {name: values[:, i] for i, name in enumerate(names)}


def _cut_short(path: Path, there: int, wanted: int) -> LinprimError:
    return LinprimError(f"{path}: cut short, {there} of {wanted} points are there, wanted the complete file")
