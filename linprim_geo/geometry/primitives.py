"""Primitives as plain arrays, for export, conversion and meshing; independent of training."""

from __future__ import annotations

import math
import os
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from linprim_geo.base.arrays import read_member
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.base.kinds import KINDS

if TYPE_CHECKING:
    import torch

    from linprim_geo.geometry.mesh import Mesh


# The rasterizer's inputs: center, rotation, extent, density, sh.
Tensors = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]

# The constant spherical harmonic: 1 / (2 sqrt(pi)).
SH_Y0 = 0.5 / math.sqrt(math.pi)

SH_COEFFICIENTS = (1, 4, 9, 16)

# Formats of saved files. Files of the first format contain octahedra only and no array `kind`.
FORMAT_OF_OCTAHEDRA, FORMAT = "linprim-geo octahedra 1", "linprim-geo primitives 2"
# Limits against zip bombs: an array may be at most _DENSEST times as large as the file, or _SMALL bytes.
_DENSEST, _SMALL = 32, 2**20
ARRAYS = ("center", "rotation", "extent", "density", "sh")


@dataclass(frozen=True)
class Primitives:
    """N transparent primitives of one kind, with view-dependent colour, in some frame.

    `center` (N, 3); `rotation` (N, 4) unit quaternions w, x, y, z, local to world; `extent` (N, 3 or 4) lengths > 0;
    `density` (N,); `sh` (N, K, 3) spherical harmonics in 3DGS's order and signs, K in 1, 4, 9, 16: rgb = max(0, 0.5 +
    sum_k Y_k(direction) sh_k), with the direction from the camera to the centre. All float32; other float types are
    converted. `kind` is one of KINDS:

    octahedron   extent (N, 3) half-axes: { p : sum_k |R^T (p - center)|_k / extent_k <= 1 }. A ray that crosses a
                 length l of it has transmittance exp(-density l); density >= 0 per unit of length.
    tetrahedron  extent (N, 4) distances to the vertices center + extent_j R b_j with b = (1,1,1), (1,-1,-1), (-1,1,-1),
                 (-1,-1,1), each / sqrt 3; density as above.
    gaussian     extent (N, 3) standard deviations along the local axes; `density` is its peak opacity, 0 to 1.

    Raises:
        LinprimError: there is no row, a shape is wrong, or a row holds NaN, infinity, a zero quaternion, an extent that
            is not positive or a density out of its range. The message names the first such row.
    """

    center: np.ndarray
    rotation: np.ndarray
    extent: np.ndarray
    density: np.ndarray
    sh: np.ndarray
    kind: str = "octahedron"

    def __post_init__(self):
        if self.kind not in KINDS:
            raise LinprimError(f"primitives are of the kind {self.kind!r}, wanted one of {', '.join(KINDS)}")
        what, lengths = KINDS[self.kind], {3: "three", 4: "four"}
        count = len(self.center) if np.ndim(self.center) else 0
        if count == 0:
            raise LinprimError(f"{what.plural}: there are none, wanted at least one")
        shapes = {
            "center": (count, 3),
            "rotation": (count, 4),
            "extent": (count, what.extents),
            "density": (count,),
        }
        for name in ARRAYS:
            given = np.asarray(getattr(self, name))
            if given.dtype.kind not in "fiu":
                raise LinprimError(f"{what.plural}: {name} has the type {given.dtype}, wanted float32")
            array = np.ascontiguousarray(given, dtype=np.float32)
            if name == "sh":
                rows, coefficients, channels = array.shape if array.ndim == 3 else (-1, -1, -1)
                if rows != count or coefficients not in SH_COEFFICIENTS or channels != 3:
                    raise LinprimError(
                        f"{what.plural}: sh has the shape {array.shape}, wanted ({count}, K, 3), K in 1, 4, 9, 16"
                    )
            elif array.shape != shapes[name]:
                raise LinprimError(f"{what.plural}: {name} has the shape {array.shape}, wanted {shapes[name]}")
            object.__setattr__(self, name, array)
            bad = ~np.isfinite(array.reshape(count, -1)).all(axis=1)
            if bad.any():
                raise LinprimError(
                    f"{what.plural}: {name} of row {int(bad.argmax())} is NaN or infinite"
                    f" ({int(bad.sum())} of {count} rows), wanted finite numbers"
                )
        dense, wanted_density = self.density < 0, "a number that is not negative"
        if not what.solid:
            dense, wanted_density = dense | (self.density > 1), "an opacity from 0 to 1"
        for name, bad, wanted in (
            ("rotation", ~(self.rotation != 0).any(axis=1), "a quaternion that is not zero"),
            ("extent", (self.extent <= 0).any(axis=1), f"{lengths[what.extents]} positive lengths"),
            ("density", dense, wanted_density),
        ):
            if bad.any():
                row = int(bad.argmax())
                raise LinprimError(
                    f"{what.plural}: {name} of row {row} is {getattr(self, name)[row].tolist()}"
                    f" ({int(bad.sum())} of {count} rows), wanted {wanted}"
                )

    def tensors(
        self, dtype: torch.dtype | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the arrays as tensors for `ops.rasterize`. They share memory unless `dtype` differs from theirs."""
        import torch

        center, rotation, extent, density, sh = (
            torch.from_numpy(getattr(self, name)).to(dtype or torch.float32) for name in ARRAYS
        )
        return center, rotation, extent, density, sh

    def __len__(self) -> int:
        return len(self.center)

    @property
    def sh_degree(self) -> int:
        """Return the spherical harmonics degree, 0 to 3."""
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def axes(self) -> np.ndarray:
        """Return (N, 3, 3) float64 rotation matrices; column k is the local axis k in the world."""
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
        """Return (N, V, 3) float64 vertices: for an octahedron -x, +x, -y, +y, -z, +z along the local axes, for a
        tetrahedron in the order of its extents.

        Raises:
            LinprimError: the primitives are Gaussians, which have no vertices.
        """
        what = KINDS[self.kind]
        if not len(what.directions):
            raise LinprimError(f"{what.plural} have no vertices and no faces, wanted octahedra or tetrahedra")
        arms = self.extent.astype(np.float64)[:, what.columns, None] * what.directions
        return self.center.astype(np.float64)[:, None, :] + arms @ self.axes.transpose(0, 2, 1)

    @property
    def alpha(self) -> np.ndarray:
        """Return (N,) float64 opacities along the reference length, 1 - exp(-density length); for Gaussians, the
        opacity at the centre."""
        return KINDS[self.kind].alpha(self.density.astype(np.float64), self.extent.astype(np.float64))

    @property
    def base_color(self) -> np.ndarray:
        """Return (N, 3) uint8 colours without the view-dependent part."""
        rgb = 0.5 + SH_Y0 * self.sh[:, 0].astype(np.float64)
        return np.rint(np.clip(rgb, 0.0, 1.0) * 255.0).astype(np.uint8)

    def triangle_mesh(self, sigmas: float | None = None) -> Mesh:
        """Return all primitives as one coloured mesh of N V vertices and N F outward faces. Overlaps are not resolved.

        Vertices V i .. V i + V - 1 and faces F i .. F i + F - 1 belong to primitive i. A Gaussian has no surface: with
        `sigmas` it becomes an ellipsoid of that many standard deviations, an icosahedron subdivided once (V = 42, F =
        80) with its vertices on the ellipsoid.

        Raises:
            LinprimError: Gaussians without `sigmas`.
        """
        from linprim_geo.geometry.mesh import Mesh

        if not KINDS[self.kind].solid and sigmas is not None:
            ball, faces = _icosphere()
            arms = (sigmas * self.extent.astype(np.float64))[:, None, :] * ball
            vertices = self.center.astype(np.float64)[:, None, :] + arms @ self.axes.transpose(0, 2, 1)
        else:
            vertices, faces = self.vertices, KINDS[self.kind].faces
        corners = vertices.shape[1]
        first = corners * np.arange(len(self), dtype=np.int64)[:, None, None]
        return Mesh(
            vertices=vertices.reshape(-1, 3),
            faces=(first + faces).reshape(-1, 3),
            colors=np.repeat(self.base_color, corners, axis=0),
        )

    def as_gaussians(self) -> Primitives:
        """Return the primitives as Gaussians for a 3DGS viewer: standard deviations are an octahedron's half-axes /
        2.6, opacity is `alpha`, the rest is unchanged.

        This is an approximation and does not give the same image. Source of the 2.6: LinPrim (see DIST_TO_SCALE).

        Raises:
            LinprimError: the primitives are tetrahedra.
        """
        deviations = KINDS[self.kind].gaussian_deviations(self.extent)
        return replace(self, extent=deviations, density=self.alpha, kind="gaussian")


def _icosphere() -> tuple[np.ndarray, np.ndarray]:
    """Return (42, 3) points on the unit sphere and (80, 3) outward faces: an icosahedron with each face divided in
    four."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=1)
    return np.asarray(ball.vertices, dtype=np.float64), np.asarray(ball.faces, dtype=np.int64)


def unit_quaternions(rotation: np.ndarray) -> np.ndarray:
    """Return (N, 4) float64 normalised quaternions; they are scaled first so that squares neither under- nor
    overflow."""
    q = np.asarray(rotation, dtype=np.float64)
    q = q / np.abs(q).max(axis=1, keepdims=True)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def save_primitives(path: str | os.PathLike, primitives: Primitives) -> None:
    """Write `primitives` as .npz with uncompressed float32 arrays, so that reading returns the same bits."""
    arrays = {name: getattr(primitives, name) for name in ARRAYS}
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, format=np.array(FORMAT), kind=np.array(primitives.kind), **arrays)


def load_primitives(path: str | os.PathLike) -> Primitives:
    """Read what `save_primitives` wrote. Nothing in the file is executed, and a false header cannot cause large
    allocations.

    Raises:
        LinprimError: the file is missing, truncated, of another kind, or its values are not valid primitives.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename: info for info in archive.infolist()}
            if "format.npy" not in members:
                raise LinprimError(f"{path}: holds no primitives, wanted a file that linprim-geo has written")
            found = _read_member(path, archive, members, "format").item()
            if found not in (FORMAT, FORMAT_OF_OCTAHEDRA):
                raise LinprimError(f"{path}: the format is {found!r}, wanted {FORMAT!r}")
            kind = "octahedron"
            if found == FORMAT:
                kind = str(_read_member(path, archive, members, "kind").item())
            arrays = {name: _read_member(path, archive, members, name) for name in ARRAYS}
    except FileNotFoundError:
        raise LinprimError(f"{path}: no such file, wanted an .npz of primitives") from None
    except IsADirectoryError:
        raise LinprimError(f"{path}: is a folder, wanted an .npz of primitives") from None
    except LinprimError:
        raise
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds for damaged files
        raise LinprimError(f"{path}: not a complete .npz file ({error})") from None
    try:
        return Primitives(**arrays, kind=kind)
    except LinprimError as error:
        raise LinprimError(f"{path}: {error}") from None


def _read_member(path: Path, archive: zipfile.ZipFile, members: dict, name: str) -> np.ndarray:
    info = members.get(f"{name}.npy")
    if info is None:
        raise LinprimError(f"{path}: the array {name} is missing")
    packed = 1 if info.compress_type == zipfile.ZIP_STORED else _DENSEST
    if info.file_size > max(_SMALL, packed * path.stat().st_size):
        raise LinprimError(f"{path}: {name} claims {info.file_size} bytes, more than the file has")

    def check(shape: tuple[int, ...], dtype: np.dtype) -> None:
        if not 0 <= math.prod(shape) * dtype.itemsize <= info.file_size:
            raise LinprimError(f"{path}: {name} claims {shape} {dtype}, but has {info.file_size} bytes")

    return read_member(archive, info, check)
