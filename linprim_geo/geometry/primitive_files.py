"""Read and write primitives in the PLY files of LinPrim (octahedra, tetrahedra) and 3DGS (Gaussians), without trusting
the header.

All properties are float32, in this order: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_0..44 (channel by channel),
opacity (a logit); then LinPrim's dist_0..2, rot_0..3 (w x y z), filter_3D, 63 in all, or 3DGS's scale_0..2
(logarithms), rot_0..3, 62 in all. A tetrahedron has the same layout with a fourth distance, dist_0..3; LinPrim's own
files of tetrahedra are not public. Rendered values follow from them as:

    o             = 1 / (1 + exp(-opacity))
    LinPrim       extent_k = |dist_k| + filter_3D / 2, density = -ln(1 - 0.99 o) / L,
                  L = 2 min_k extent_k of an octahedron, the inscribed sphere's diameter of a tetrahedron (our choice)
    3DGS          standard deviation_k = exp(scale_k), opacity o; where Mip-Splatting has added filter_3D:
                  sqrt(exp(scale_k)^2 + filter_3D^2) and o prod_k exp(scale_k) / prod_k standard deviation_k
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.base.kinds import KINDS, Kind
from linprim_geo.geometry.ply import write_ply
from linprim_geo.geometry.primitives import SH_COEFFICIENTS, Primitives, unit_quaternions

# Logits of the largest float32 below 1 and of the smallest normal float32. Beyond them a float32 sigmoid is 1 or 0.
LARGEST_LOGIT = np.float32(np.log(2.0**24 - 1.0))
SMALLEST_LOGIT = np.float32(np.log(np.finfo(np.float32).tiny))

# Headers longer than this many bytes are rejected. (LinPrim's has 63 properties and takes about 1,500 bytes.)
LONGEST_HEADER = 1 << 16

# This many rows of 252 bytes stay in the cache while their columns are extracted one by one.
ROWS_AT_ONCE = 4096

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}


@dataclass(frozen=True)
class PlyElement:
    """One element of a PLY header: its name, row count, and pairs (property, numpy type, or None for a list)."""

    name: str
    count: int
    properties: tuple[tuple[str, str | None], ...]


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file; `data_start` is the offset of the first byte after it."""

    format: str
    elements: tuple[PlyElement, ...]
    data_start: int

    def element(self, name: str) -> PlyElement | None:
        """Return the element of that name, or None."""
        return next((element for element in self.elements if element.name == name), None)

    @property
    def kind(self) -> str:
        """Return the kind of primitive according to the vertex properties, else `mesh` or `points`."""
        vertex = self.element("vertex")
        names = {name for name, _ in vertex.properties} if vertex else set()
        told = [kind for kind in KINDS.values() if names.issuperset(kind.told_by)]
        if told:
            return max(told, key=lambda kind: len(kind.told_by)).name
        face = self.element("face")
        return "mesh" if face is not None and face.count > 0 else "points"


def read_ply_header(path: str | os.PathLike) -> PlyHeader:
    """Parse the header of any PLY file; nothing after it is read.

    Raises:
        LinprimError: the file is missing, is not a PLY file, or its header is broken.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file:
            start = file.read(LONGEST_HEADER)
    except OSError as error:
        raise LinprimError(f"{path}: cannot be read ({error.strerror}), wanted a PLY file") from None
    if not start.startswith((b"ply\n", b"ply\r")):
        raise LinprimError(f"{path}: not a PLY file, it does not start with 'ply'")
    end = start.find(b"\nend_header")
    newline = start.find(b"\n", end + 1) if end >= 0 else -1
    if newline < 0:
        raise LinprimError(f"{path}: the PLY header has no end within {len(start)} bytes")

    layout: str | None = None
    elements: list[tuple[str, int, list]] = []
    for number, line in enumerate(start[:end].decode("latin-1").splitlines()[1:], start=2):
        words = line.split()
        try:
            match words:
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", layout, _]:
                    pass
                case ["element", name, count] if int(count) >= 0:
                    elements.append((name, int(count), []))
                case ["property", "list", count_type, item_type, name]:
                    _TYPES[count_type], _TYPES[item_type]
                    elements[-1][2].append((name, None))
                case ["property", type_name, name]:
                    elements[-1][2].append((name, _TYPES[type_name]))
                case _:
                    raise ValueError
        except (ValueError, KeyError, IndexError):
            raise LinprimError(f"{path}: line {number} of the PLY header cannot be read: {line[:80]!r}") from None
    if layout not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise LinprimError(f"{path}: the PLY format is {layout!r}, wanted ascii or binary")
    return PlyHeader(layout, tuple(PlyElement(n, c, tuple(p)) for n, c, p in elements), newline + 1)


def read_primitive_ply(path: str | os.PathLike) -> tuple[Primitives, dict]:
    """Read primitives; the properties determine their kind. A 3D filter stored in the file is applied.

    Spherical harmonics bands that are zero in every row are dropped. Rows that cannot be rendered, because an extent is
    zero or infinite, are dropped and counted.

    Returns:
        The primitives, and {"rows": rows in the file, "dropped": rows without volume}.

    Raises:
        LinprimError: the file is truncated, ASCII, of another kind, or a row holds NaN or infinity.
    """
    path = Path(path)
    header = read_ply_header(path)
    if header.kind not in KINDS:
        raise LinprimError(f"{path}: holds no primitives, wanted the properties dist_0.. or scale_0..")
    if header.format != "binary_little_endian":
        raise LinprimError(f"{path}: the PLY format is {header.format}, wanted binary_little_endian")
    table = _vertex_table(path, header)
    present = set(table.dtype.names or ())
    rest = sum(name.startswith("f_rest_") for name in present)
    if rest % 3 or rest // 3 + 1 not in SH_COEFFICIENTS:
        raise LinprimError(f"{path}: has {rest} properties f_rest_*, wanted 0, 9, 24 or 45")
    kind = KINDS[header.kind]

    def columns(*names: str) -> np.ndarray:
        for name in names:
            if name not in present:
                raise LinprimError(
                    f"{path}: the property {name} is missing, wanted {kind.layout}'s {len(_names(kind))} properties"
                )
            if table.dtype[name] != np.dtype("<f4"):
                raise LinprimError(f"{path}: the property {name} is {table.dtype[name]}, wanted float32")
        out = np.empty((len(table), len(names)), dtype=np.float32)
        for first in range(0, len(table), ROWS_AT_ONCE):
            rows = table[first : first + ROWS_AT_ONCE]
            for index, name in enumerate(names):
                out[first : first + ROWS_AT_ONCE, index] = rows[name]
        bad = ~np.isfinite(out).all(axis=1)
        if bad.any():
            raise LinprimError(
                f"{path}: row {int(bad.argmax())} has a NaN or infinite {names[0]}"
                f" ({int(bad.sum())} of {len(table)} rows), wanted finite numbers"
            )
        return out

    center = columns("x", "y", "z")
    lengths = columns(*kind.length_properties)
    logit = columns("opacity")[:, 0].astype(np.float64)
    rotation = columns("rot_0", "rot_1", "rot_2", "rot_3")
    rotation[~(rotation != 0).any(axis=1)] = (1, 0, 0, 0)
    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :]
    if rest:
        higher = columns(*(f"f_rest_{index}" for index in range(rest)))
        sh = np.concatenate([sh, higher.reshape(len(table), 3, rest // 3).transpose(0, 2, 1)], axis=1)

    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        opacity = 1.0 / (1.0 + np.exp(-logit))
        has_filter = "filter_3D" in {*present, *kind.last_properties}
        extent, density = kind.from_file(lengths, opacity, columns("filter_3D") if has_filter else None)
        visible = ((extent > 0) & np.isfinite(extent)).all(axis=1) & (density <= np.finfo(np.float32).max)
    if not visible.any():
        raise LinprimError(f"{path}: none of its {len(table)} primitives has a volume")
    primitives = Primitives(
        center[visible],
        unit_quaternions(rotation[visible]),
        extent[visible],
        density[visible],
        _without_empty_bands(sh[visible]),
        kind.name,
    )
    return primitives, {"rows": len(table), "dropped": int((~visible).sum())}


def write_primitive_ply(path: str | os.PathLike, primitives: Primitives) -> dict:
    """Write primitives with LinPrim's properties, or Gaussians with 3DGS's. The filter is 0, and spherical harmonics
    are padded to degree 3.

    LinPrim's format cannot store an optical thickness above ln(100) along the reference length: such rows get the
    largest opacity that it can store and are counted.

    Accuracy: centres, colours and extents of polyhedra are read back bit by bit; rotations to float32 rounding;
    densities and opacities to 1e-5 relative and standard deviations to 1e-6 times the size of their logarithm, because
    logits and logarithms are rounded to float32. A density of 0 is read back as one that absorbs less than 1e-37 of the
    light.

    Returns:
        {"rows": N, "clamped": rows that are thicker than LinPrim's format can store}.
    """
    count, kind = len(primitives), KINDS[primitives.kind]
    with np.errstate(divide="ignore", invalid="ignore"):
        lengths, logit, clamped = kind.to_file(primitives.extent, primitives.density)
    logit = np.clip(logit, SMALLEST_LOGIT, LARGEST_LOGIT)

    padded = np.zeros((count, SH_COEFFICIENTS[-1], 3), dtype=np.float32)
    padded[:, : primitives.sh.shape[1]] = primitives.sh
    names = _names(kind)
    end = 55 + lengths.shape[1]
    table = np.zeros((count, len(names)), dtype=np.float32)
    table[:, 0:3] = primitives.center
    table[:, 6:9] = padded[:, 0]
    table[:, 9:54] = padded[:, 1:].transpose(0, 2, 1).reshape(count, 45)
    table[:, 54] = logit
    table[:, 55:end] = lengths
    table[:, end : end + 4] = primitives.rotation
    with atomic_write(path) as temporary:
        write_ply(temporary, dict(zip(names, table.T, strict=True)))
    return {"rows": count, "clamped": clamped}


def _names(kind: Kind) -> list[str]:
    """Return all properties of a kind's file, in order."""
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{index}" for index in range(45)),
        *("opacity", *kind.length_properties, "rot_0", "rot_1", "rot_2", "rot_3", *kind.last_properties),
    ]


def _vertex_table(path: Path, header: PlyHeader) -> np.ndarray:
    """Return the vertex rows as a structured array mapped from the file, after checking that the file is long
    enough."""
    if not header.elements or header.elements[0].name != "vertex":
        raise LinprimError(f"{path}: the first PLY element is not vertex")
    vertex = header.elements[0]
    kinds = {name: kind for name, kind in vertex.properties if kind is not None}
    if len(kinds) < len(vertex.properties) or not kinds:
        raise LinprimError(f"{path}: the vertices have lists, repeated properties or none, wanted plain numbers")
    dtype = np.dtype([(name, "<" + kind) for name, kind in kinds.items()])
    size = path.stat().st_size
    wanted = header.data_start + vertex.count * dtype.itemsize
    if size < wanted:
        complete = max(0, size - header.data_start) // dtype.itemsize
        raise LinprimError(f"{path}: is truncated, it has {complete} of the {vertex.count} rows that its header names")
    if vertex.count == 0:
        raise LinprimError(f"{path}: holds no primitives")
    return np.memmap(path, dtype=dtype, mode="r", offset=header.data_start, shape=(vertex.count,))


def _without_empty_bands(sh: np.ndarray) -> np.ndarray:
    """Return the coefficients without the bands that are zero everywhere."""
    for count in SH_COEFFICIENTS:
        if not sh[:, count:].any():
            return sh[:, :count]
    return sh
