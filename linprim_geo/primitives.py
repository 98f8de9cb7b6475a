"""Primitives as plain arrays: what is exported, converted and meshed, apart from how they are trained."""

from __future__ import annotations

import math
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .errors import LinprimError
from .files import atomic_write

if TYPE_CHECKING:
    from .mesh import Mesh

# The constant spherical harmonic: 1 / (2 sqrt(pi)).
SH_Y0 = 0.5 / math.sqrt(math.pi)

SH_COEFFICIENTS = (1, 4, 9, 16)

FORMAT = "linprim-geo octahedra 1"

# Vertex 2 k + (0 for -, 1 for +) lies on axis k. One face per octant, counter-clockwise seen from outside:
# the order x, y, z is so where the product of the three signs is positive.
_FACES = np.array(
    [
        (x, 2 + y, 4 + z) if (x + y + z) % 2 == 1 else (x, 4 + z, 2 + y)
        for x in (0, 1)
        for y in (0, 1)
        for z in (0, 1)
    ],
    dtype=np.int64,
)


@dataclass(frozen=True)
class Octahedra:
    """N transparent octahedra of constant density and view-dependent colour, in some frame.

    `center` (N, 3); `rotation` (N, 4) unit quaternions w, x, y, z, local to world; `extent` (N, 3) distance
    from the centre to the vertices along each local axis, > 0; `density` (N,) per unit of length, >= 0; `sh`
    (N, K, 3) spherical harmonics in 3DGS's order and signs, K in 1, 4, 9, 16: rgb = max(0, 0.5 + sum_k
    Y_k(direction) sh_k), the direction from the camera to the centre. All float32; other float types are
    converted.

    The solid is { p : sum_k |R^T (p - center)|_k / extent_k <= 1 }; a ray that crosses a length l of it keeps
    exp(-density l) of its light.

    Raises:
        LinprimError: a shape is wrong, or a row holds NaN, infinity, a zero quaternion, an extent that is not
            positive or a negative density. The message names the first such row.
    """

    center: np.ndarray
    rotation: np.ndarray
    extent: np.ndarray
    density: np.ndarray
    sh: np.ndarray

    def __post_init__(self):
        count = len(self.center)
        shapes = {"center": (count, 3), "rotation": (count, 4), "extent": (count, 3), "density": (count,)}
        for name in ("center", "rotation", "extent", "density", "sh"):
            given = np.asarray(getattr(self, name))
            if given.dtype.kind not in "fiu":
                raise LinprimError(f"octahedra: {name} has the type {given.dtype}, wanted float32")
            array = np.ascontiguousarray(given, dtype=np.float32)
            if name == "sh":
                rows, coefficients, channels = array.shape if array.ndim == 3 else (-1, -1, -1)
                if rows != count or coefficients not in SH_COEFFICIENTS or channels != 3:
                    raise LinprimError(
                        f"octahedra: sh has the shape {array.shape}, wanted ({count}, K, 3), K in 1, 4, 9, 16"
                    )
            elif array.shape != shapes[name]:
                raise LinprimError(f"octahedra: {name} has the shape {array.shape}, wanted {shapes[name]}")
            object.__setattr__(self, name, array)
            bad = ~np.isfinite(array.reshape(count, -1)).all(axis=1)
            if bad.any():
                raise LinprimError(
                    f"octahedra: {name} of row {int(bad.argmax())} is NaN or infinite"
                    f" ({int(bad.sum())} of {count} rows), wanted finite numbers"
                )
        for name, bad, wanted in (
            ("rotation", ~(self.rotation != 0).any(axis=1), "a quaternion that is not zero"),
            ("extent", (self.extent <= 0).any(axis=1), "three positive lengths"),
            ("density", self.density < 0, "a number that is not negative"),
        ):
            if bad.any():
                row = int(bad.argmax())
                raise LinprimError(
                    f"octahedra: {name} of row {row} is {getattr(self, name)[row].tolist()}"
                    f" ({int(bad.sum())} of {count} rows), wanted {wanted}"
                )

    def __len__(self) -> int:
        return len(self.center)

    @property
    def sh_degree(self) -> int:
        """Degree of the view-dependent colour, 0 to 3."""
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def axes(self) -> np.ndarray:
        """(N, 3, 3) float64 rotation matrices; column k is the local axis k in the world."""
        w, x, y, z = unit_quaternions(self.rotation).T
        return np.stack(
            [
                np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
                np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
                np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
            ],
            axis=-2,
        )

    @property
    def vertices(self) -> np.ndarray:
        """(N, 6, 3) float64 vertices: -x, +x, -y, +y, -z, +z along the local axes."""
        arms = (self.axes * self.extent[:, None, :].astype(np.float64)).transpose(0, 2, 1)
        signs = np.array([-1.0, 1.0])[None, None, :, None]
        center = self.center.astype(np.float64)[:, None, :]
        return center + (arms[:, :, None, :] * signs).reshape(len(self), 6, 3)

    @property
    def alpha(self) -> np.ndarray:
        """(N,) float64 share of light taken along the shortest diagonal: 1 - exp(-2 density min(extent))."""
        return -np.expm1(-2.0 * self.density.astype(np.float64) * self.extent.min(axis=1))

    @property
    def base_color(self) -> np.ndarray:
        """(N, 3) uint8 colour without its view-dependent part."""
        rgb = 0.5 + SH_Y0 * self.sh[:, 0].astype(np.float64)
        return np.rint(np.clip(rgb, 0.0, 1.0) * 255.0).astype(np.uint8)

    def triangle_mesh(self) -> Mesh:
        """All octahedra as one mesh of 6 N vertices and 8 N outward faces, coloured; overlaps stay as they
        are.

        Vertices 6 i .. 6 i + 5 and faces 8 i .. 8 i + 7 belong to primitive i.
        """
        from .mesh import Mesh

        first = 6 * np.arange(len(self), dtype=np.int64)[:, None, None]
        return Mesh(
            vertices=self.vertices.reshape(-1, 3),
            faces=(first + _FACES).reshape(-1, 3),
            colors=np.repeat(self.base_color, 6, axis=0),
        )


def unit_quaternions(rotation: np.ndarray) -> np.ndarray:
    """(N, 4) float64 quaternions divided by their lengths; scaled first, so that none under- or overflows."""
    q = np.asarray(rotation, dtype=np.float64)
    q = q / np.abs(q).max(axis=1, keepdims=True)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def save_octahedra(path: str | os.PathLike, octahedra: Octahedra) -> None:
    """Writes `octahedra` as .npz: uncompressed float32 arrays, so that reading gives the same bits."""
    arrays = {name: getattr(octahedra, name) for name in ("center", "rotation", "extent", "density", "sh")}
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, format=np.array(FORMAT), **arrays)


def load_octahedra(path: str | os.PathLike) -> Octahedra:
    """Reads what `save_octahedra` wrote. Nothing in the file is executed, and a false header costs no memory.

    Raises:
        LinprimError: the file is missing, truncated, of another kind, or its values are not valid primitives.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename: info for info in archive.infolist()}
            if "format.npy" not in members:
                raise LinprimError(f"{path}: holds no octahedra, wanted a file that linprim-geo has written")
            found = _read_member(path, archive, members, "format").item()
            if found != FORMAT:
                raise LinprimError(f"{path}: the format is {found!r}, wanted {FORMAT!r}")
            names = ("center", "rotation", "extent", "density", "sh")
            arrays = {name: _read_member(path, archive, members, name) for name in names}
    except FileNotFoundError:
        raise LinprimError(f"{path}: no such file, wanted an .npz of octahedra") from None
    except IsADirectoryError:
        raise LinprimError(f"{path}: is a folder, wanted an .npz of octahedra") from None
    except (zipfile.BadZipFile, EOFError, ValueError, NotImplementedError) as error:
        raise LinprimError(f"{path}: not a complete .npz file ({error})") from None
    try:
        return Octahedra(**arrays)
    except LinprimError as error:
        raise LinprimError(f"{path}: {error}") from None


def _read_member(path: Path, archive: zipfile.ZipFile, members: dict, name: str) -> np.ndarray:
    info = members.get(f"{name}.npy")
    if info is None:
        raise LinprimError(f"{path}: the array {name} is missing")
    if info.compress_type == zipfile.ZIP_STORED and info.file_size > path.stat().st_size:
        raise LinprimError(f"{path}: {name} claims {info.file_size} bytes, more than the file has")
    with archive.open(info) as file:
        version = np.lib.format.read_magic(file)
        if version != (1, 0):
            raise LinprimError(f"{path}: {name} has the array format {version}, wanted (1, 0)")
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        claimed = math.prod(shape) * dtype.itemsize + file.tell()
        if claimed != info.file_size or dtype.hasobject:
            raise LinprimError(f"{path}: {name} claims {shape} {dtype}, but has {info.file_size} bytes")
    with archive.open(info) as file:
        return np.lib.format.read_array(file, allow_pickle=False)
