"""The writer of PLY files: types in the header, and rows that other readers read back."""

from __future__ import annotations

import numpy as np
import trimesh

from linprim_geo.geometry.ply import PART, color_columns, write_ply, xyz_columns


def test_columns_are_written_with_their_types(tmp_path):
    points = np.array([[0.0, 1, 2], [3, 4, 1 / 3]])
    colors = np.array([[1, 2, 3, 4], [250, 251, 252, 253]], np.uint8)
    columns = xyz_columns(points) | color_columns(colors) | {"quality": np.array([0.5, np.nan], np.float32)}
    write_ply(tmp_path / "a.ply", columns | {"label": np.array([-1, 7], np.int32)})
    data = (tmp_path / "a.ply").read_bytes()
    head, _, rows = data.partition(b"end_header\n")
    assert head.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 2",
        *(f"property double {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue", "alpha")),
        "property float quality",
        "property int label",
    ]
    wanted = [
        *((name, "<f8") for name in "xyz"),
        *((name, "u1") for name in "rgba"),
        ("quality", "<f4"),
        ("label", "<i4"),
    ]
    found = np.frombuffer(rows, np.dtype(wanted))
    assert np.array_equal(np.stack([found[name] for name in "xyz"], 1), points)
    assert np.array_equal(np.stack([found[name] for name in "rgba"], 1), colors)
    assert np.array_equal(found["quality"], columns["quality"], equal_nan=True) and found["label"].tolist() == [-1, 7]


def test_tables_longer_than_one_part_and_columns_of_faces_are_read_back(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(PART + 10, 3)).astype(np.float32)
    faces = rng.integers(0, len(points), (2 * PART + 3, 3))
    write_ply(tmp_path / "a.ply", xyz_columns(points), faces, {"primitive": faces[:, 0].astype(np.int32)})
    read = trimesh.load(tmp_path / "a.ply", process=False)
    assert np.array_equal(read.vertices.astype(np.float32), points) and np.array_equal(read.faces, faces)
    assert np.array_equal(read.metadata["_ply_raw"]["face"]["data"]["primitive"].ravel(), faces[:, 0])
