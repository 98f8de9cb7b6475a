"""Write PLY files: named columns of numbers, and triangles. All PLY files are written here."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

TYPES = {"f8": "double", "f4": "float", "i4": "int", "u1": "uchar"}
# Rows are assembled in parts of this many, so that a large table is not in memory twice.
PART = 65536


def write_ply(
    path: Path,
    vertices: Mapping[str, np.ndarray],
    faces: np.ndarray | None = None,
    face_columns: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write a binary little-endian PLY file.

    Args:
        vertices: (V,) columns by their names in the file. The type in the file is the array's: float64, float32, int32
            or uint8.
        faces: (F, 3) triangles; None for points alone.
        face_columns: (F,) columns of the faces, written after `vertex_indices`.
    """
    header = ["ply", "format binary_little_endian 1.0", *_element("vertex", vertices)]
    if faces is not None:
        corners = {"count": np.full(len(faces), 3, np.uint8)} | {
            f"corner{k}": faces[:, k].astype(np.int32) for k in range(3)
        }
        of_faces = dict(face_columns or {})
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices", *_properties(of_faces)]
    with open(path, "wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        _write_rows(file, vertices)
        if faces is not None:
            _write_rows(file, corners | of_faces)


def xyz_columns(points: np.ndarray, names: str = "x y z") -> dict[str, np.ndarray]:
    """Return the columns of (V, 3) coordinates by name."""
    return dict(zip(names.split(), points.T, strict=True))


def color_columns(colors: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of (V, 3) or, with alpha, (V, 4) uint8 colours by name."""
    return dict(zip(("red", "green", "blue", "alpha"), colors.T, strict=False))


def _element(name: str, columns: Mapping[str, np.ndarray]) -> list[str]:
    return [f"element {name} {len(next(iter(columns.values())))}", *_properties(columns)]


def _properties(columns: Mapping[str, np.ndarray]) -> list[str]:
    return [f"property {TYPES[column.dtype.str[1:]]} {name}" for name, column in columns.items()]


def _write_rows(file: BinaryIO, columns: Mapping[str, np.ndarray]) -> None:
    layout = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    count = len(next(iter(columns.values())))
    for start in range(0, count, PART):
        rows = np.empty(min(PART, count - start), dtype=layout)
        for name, column in columns.items():
            rows[name] = column[start : start + PART]
        file.write(rows.tobytes())
