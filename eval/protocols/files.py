"""Readers of the files of published mesh protocols: observation masks, planes, crop volumes, transforms, scans."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.eval.protocols.mat_files import read_arrays
from linprim_geo.geometry.mesh import Mesh, clean_mesh
from linprim_geo.geometry.mesh_files import load_mesh


@dataclass(frozen=True)
class ObservedVolume:
    """The observed part of the reference: a box `low`..`high` (3,) and, if known, which of its cells.

    `cells` is a bool grid, or None; the centre of cell (i, j, k) is `low` + (i, j, k) `edge`.
    """

    low: np.ndarray
    high: np.ndarray
    cells: np.ndarray | None = None
    edge: float = 0.0

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return (P,) bool: which of (P, 3) points lie in an observed cell; all if the cells are unknown."""
        if self.cells is None:
            return np.ones(len(points), bool)
        index = np.rint((points - self.low) / self.edge).astype(np.int64)
        inside = ((index >= 0) & (index < self.cells.shape)).all(axis=1)
        found = np.zeros(len(points), bool)
        found[inside] = self.cells[tuple(index[inside].T)]
        return found


@dataclass(frozen=True)
class CropVolume:
    """A prism: a polygon (K, 2) over two axes, and an interval along the third one, `axis`."""

    axis: int
    low: float
    high: float
    polygon: np.ndarray

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return (P,) bool: which of (P, 3) points lie inside, by the even-odd rule."""
        along = points[:, self.axis]
        x, y = np.delete(points, self.axis, axis=1).T
        inside = np.zeros(len(points), bool)
        for (x0, y0), (x1, y1) in zip(self.polygon, np.roll(self.polygon, -1, axis=0), strict=True):
            if y0 != y1:
                crosses = (y0 > y) != (y1 > y)
                inside ^= crosses & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
        return inside & (along >= self.low) & (along <= self.high)


def read_reference(path: str | os.PathLike, points_allowed: bool) -> tuple[Mesh | np.ndarray, dict]:
    """Read a clean mesh and what was dropped from it, or (P, 3) finite points from a PLY file without faces.

    Raises:
        LinprimError: the file is unreadable or empty, or holds points where they are not allowed.
    """
    path = Path(path)
    if points_allowed and path.suffix.lower() == ".ply" and path.is_file():
        from linprim_geo.capture.readers.ply_points import read_points_ply
        from linprim_geo.geometry.primitive_files import read_ply_header

        faces = read_ply_header(path).element("face")
        if faces is None or faces.count == 0:
            cloud = read_points_ply(path)
            if cloud is None:
                raise LinprimError(f"{path}: holds no finite points, wanted a scan")
            return cloud.xyz, {}
    return clean_mesh(load_mesh(path), os.fspath(path))


def read_observed_volume(mask: str | os.PathLike | None, box: str | None) -> ObservedVolume | None:
    """Read the observation mask of a DTU scan, or parse a box; return None without either.

    Args:
        mask: MATLAB file with `ObsMask` (a grid), `BB` (its two corners) and `Res` (its cells' edge).
        box: "x0,y0,z0,x1,y1,z1".

    Raises:
        LinprimError: the file or the text does not have that form, or both are given.
    """
    if mask is not None and box is not None:
        raise LinprimError(f"--box is {box}, but {mask} brings a box of its own; give one of them")
    if box is not None:
        corners = np.array(_numbers(box, 6, "--box")).reshape(2, 3)
        if not (corners[0] < corners[1]).all():
            raise LinprimError(f"--box is {box}, expected the smaller corner first")
        return ObservedVolume(*corners)
    if mask is None:
        return None
    values = read_arrays(mask, ("ObsMask", "BB", "Res"))
    cells, bounds, edge = values["ObsMask"], values["BB"].astype(np.float64), np.ravel(values["Res"]).astype(np.float64)
    usable = cells.ndim == 3 and bounds.shape == (2, 3) and edge.size == 1
    if not usable or not (np.isfinite(bounds).all() and 0 < edge[0] < np.inf):
        raise LinprimError(
            f"{mask}: ObsMask is {cells.shape}, BB {bounds.shape} and Res {edge.shape}, "
            "expected a grid, two corners and one positive length"
        )
    return ObservedVolume(bounds[0], bounds[1], cells != 0, float(edge[0]))


def read_plane(plane: str | os.PathLike) -> np.ndarray:
    """Return (4,) a, b, c, d of a plane, from `P` in a MATLAB file or from text.

    The upper side is where a x + b y + c z + d > 0.

    Raises:
        LinprimError: neither a file with four numbers nor four numbers, or a, b, c are all zero.
    """
    text = os.fspath(plane)
    if Path(text).suffix.lower() == ".mat" or not _is_number(text.split(",")[0]):
        values = np.ravel(read_arrays(text, ("P",))["P"]).astype(np.float64)
    else:
        values = np.array(_numbers(text, 4, "--plane"))
    if values.size != 4 or not np.isfinite(values).all() or not values[:3].any():
        raise LinprimError(f"{text}: the plane is {values.tolist()}, expected a,b,c,d with a direction a,b,c")
    return values


def read_crop(path: str | os.PathLike) -> CropVolume:
    """Read the crop volume of a Tanks and Temples scene, JSON as Open3D's `SelectionPolygonVolume` writes it.

    Its keys are `orthogonal_axis` ("X", "Y" or "Z"), `axis_min`, `axis_max`, and `bounding_polygon`, a list of points
    with three coordinates, of which the one along the axis is ignored.

    Raises:
        LinprimError: the file is unreadable, or a key is missing or has an unusable value.
    """
    try:
        values = json.loads(Path(path).read_text())
        axis = "XYZ".index(str(values["orthogonal_axis"]).upper())
        low, high = float(values["axis_min"]), float(values["axis_max"])
        polygon = np.array(values["bounding_polygon"], dtype=np.float64)
    except OSError as error:
        raise LinprimError(f"{path}: cannot be read as a crop volume ({error.strerror})") from error
    except KeyError as error:
        raise LinprimError(f"{path}: has no {error.args[0]}, expected a crop volume") from error
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise LinprimError(f"{path}: is not a crop volume in JSON ({error})") from error
    if polygon.ndim != 2 or polygon.shape[1] != 3 or len(polygon) < 3 or not np.isfinite(polygon).all():
        raise LinprimError(f"{path}: bounding_polygon is {polygon.shape}, expected at least three points (x, y, z)")
    if not -np.inf < low < high < np.inf:
        raise LinprimError(f"{path}: axis_min is {low:g} and axis_max {high:g}, expected an interval")
    return CropVolume(axis, low, high, np.delete(polygon, axis, axis=1))


def read_transform(path: str | os.PathLike) -> np.ndarray:
    """Read a (4, 4) similarity or affine map from a text file of four rows, the last one 0 0 0 1.

    Raises:
        LinprimError: the file is unreadable, or the matrix has another shape or is singular.
    """
    try:
        matrix = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except OSError as error:
        raise LinprimError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise LinprimError(f"{path}: is not a table of numbers ({error})") from error
    if (
        matrix.shape != (4, 4)
        or not np.isfinite(matrix).all()
        or (matrix[3] != (0, 0, 0, 1)).any()
        or np.linalg.matrix_rank(matrix) < 4
    ):
        raise LinprimError(f"{path}: is {matrix.shape}, expected an invertible 4x4 matrix with last row 0 0 0 1")
    return matrix


def _numbers(text: str, count: int, option: str) -> list[float]:
    words = text.split(",")
    if len(words) != count or not all(_is_number(word) for word in words):
        raise LinprimError(f"{option} is {text}, expected {count} numbers with commas between them")
    return [float(word) for word in words]


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False
