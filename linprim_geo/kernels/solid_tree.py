"""Optical depth of many line segments through polyhedra, by a bounding box hierarchy in the compiled core."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from linprim_geo import _core
from linprim_geo.kernels.operators import as_array, check_dtypes, check_finite, scalar_suffix
from linprim_geo.kernels.ops import KINDS


class SolidTree:
    """Polyhedra in a bounding box hierarchy, for the optical depth of many line segments, in closed form and including
    overlaps.

    Args:
        center, rotation, extent, density, primitive: as for `rasterize`, of octahedra or tetrahedra. Copied.

    Raises:
        LinprimError: a non-finite input (the message names tensor and row), or a dtype other than float32 or float64.
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
        """Return the number of primitives that absorb light."""
        return len(self._tree)

    def optical_depth(
        self, origin: Tensor, ends: Tensor, *, begin: Tensor | None = None, most: float = math.inf
    ) -> Tensor:
        """Return (P,) float64 optical depths min(most, sum_i density_i length_i), with length_i the length of the
        segment inside primitive i.

        The transmittance of a segment is exp(-optical depth). There is no camera, no near plane and no order; no
        gradients.

        Args:
            origin: (3,) float64, the common start point of all segments.
            ends: (P, 3) float64 end points. Many times faster if consecutive points are close to each other.
            begin: (P,) float64 share of the way at which a segment begins, to leave out the part before a near plane;
                default 0.
            most: upper limit of the optical depth; the computation of a segment ends there.

        Raises:
            LinprimError: a non-finite input.
            ValueError: shapes or dtypes that do not fit, or `most` not positive.

        Accuracy: each length to 1e-14 of the distance from the origin to the primitive, times 1 / sin of the smallest
        angle between the segment and a face that it meets. Bitwise the same for any number of threads and independent
        of the other segments.
        """
        check_dtypes(torch.float64, origin=origin, ends=ends, **({} if begin is None else {"begin": begin}))
        check_finite("f64", origin=origin, ends=ends, **({} if begin is None else {"begin": begin}))
        depth = torch.empty(ends.shape[:1], dtype=torch.float64)
        start = None if begin is None else as_array(begin)
        self._tree.optical_depth(as_array(origin), as_array(ends), start, float(most), depth.numpy())
        return depth
