"""Optical depth of many straight segments through polyhedra, by a hierarchy of boxes in the compiled core."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from linprim_geo import _core
from linprim_geo.kernels.operators import as_array, check_dtypes, check_finite, scalar_suffix
from linprim_geo.kernels.ops import KINDS


class SolidTree:
    """Polyhedra in a hierarchy of boxes, for the optical depth of many straight segments: closed form, overlaps
    included.

    Args:
        center, rotation, extent, density, primitive: as for `rasterize`, of octahedra or tetrahedra. Copied.

    Raises:
        LinprimError: a non-finite input, naming tensor and row, or a dtype other than float32, float64.
        ValueError: shapes or dtypes that do not fit, or Gaussians, which have no inside.
    """

    def __init__(
        self,
        center: Tensor,
        rotation: Tensor,
        extent: Tensor,
        density: Tensor,
        *,
        primitive: str = "octahedron",
    ):
        if primitive not in KINDS:
            raise ValueError(f"primitive is {primitive!r}, wanted octahedron or tetrahedron")
        given = dict(center=center, rotation=rotation, extent=extent, density=density)
        suffix = scalar_suffix(center.dtype)
        check_dtypes(center.dtype, **given)
        check_finite(suffix, **given)
        self._tree = _core.SolidTree(KINDS.index(primitive), *[as_array(tensor) for tensor in given.values()])

    def __len__(self) -> int:
        """Number of primitives that absorb at all."""
        return len(self._tree)

    def optical_depth(
        self, origin: Tensor, ends: Tensor, *, begin: Tensor | None = None, most: float = math.inf
    ) -> Tensor:
        """(P,) float64 optical depths min(most, sum_i density_i length_i), length_i that of the part of a segment
        inside primitive i.

        The transmittance of a segment is exp of minus that. No camera, no near plane, no order; no gradients.

        Args:
            origin: (3,) float64, the point that all segments start from.
            ends: (P, 3) float64. Where neighbours lie near each other this is many times faster.
            begin: (P,) float64 share of the way at which a segment begins, to leave out what is before a near plane;
                default 0.
            most: optical depth above which none is needed: walks end there.

        Raises:
            LinprimError: a non-finite input.
            ValueError: shapes or dtypes that do not fit, or `most` not positive.

        Accuracy: each length to 1e-14 of the distance from the origin to the primitive, times 1 / sin of the angle
            between the segment and the nearest to parallel of the faces it meets. Bitwise the same at any number of
            threads and for any other ends.
        """
        check_dtypes(torch.float64, origin=origin, ends=ends, **({} if begin is None else {"begin": begin}))
        check_finite("f64", origin=origin, ends=ends, **({} if begin is None else {"begin": begin}))
        depth = torch.empty(ends.shape[:1], dtype=torch.float64)
        start = None if begin is None else as_array(begin)
        self._tree.optical_depth(as_array(origin), as_array(ends), start, float(most), depth.numpy())
        return depth
