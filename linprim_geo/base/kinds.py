"""The kinds of primitives: everything in training, files and meshes that differs between octahedra, tetrahedra and
Gaussians.

A new kind is a subclass of `Kind` in `KINDS`. The parts that only rendering needs are in the compiled core
(csrc/base/kinds.h) and in its slow reference implementation.
"""

from __future__ import annotations

import math
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING

from linprim_geo.base.errors import LinprimError

if TYPE_CHECKING:
    import numpy as np
else:

    class _Numpy:
        """numpy, imported at the first use, so that the help of a command, which names the kinds, is fast."""

        def __getattr__(self, name: str):
            return getattr(import_module("numpy"), name)

    np = _Numpy()

# An octahedron of half-axes d corresponds to a Gaussian of standard deviations d / 2.6: LinPrim's constant, chosen by
# eye (DIST_TO_SCALE of its MCMC variant).
DIST_TO_SCALE = 2.6
# Factor on the opacity in LinPrim's files, which keeps the logarithm finite.
OPACITY_CAP = 0.99
# Largest optical thickness of a reference length in such files, ln(100).
THICKEST = -math.log1p(-OPACITY_CAP)


class Kind:
    """One kind of primitive: a polyhedron of constant density, which transmits exp(-density l) along a chord l.

    Vertex v is at center + extent[column[v]] R direction[v], where R is the primitive's rotation matrix. Extents are
    (N, `extents`) lengths > 0. Methods that accept numpy or torch are differentiable in torch.
    """

    name: str
    plural: str
    extents: int
    # The extent that appears as large as an octahedron of half-axes 1.
    size: float
    # Depth at which rays begin, in the training frame. A polyhedron is cut exactly there.
    near = 0.01
    # Filter width for --filter 3d+screen, in pixels: LinPrim's kernel_size.
    screen_filter = 0.1
    # In PLY files: the name of the layout, the prefix of the lengths' properties, the properties that identify this
    # kind, and those after the rotation.
    layout, length_prefix = "LinPrim", "dist_"
    told_by: tuple[str, ...] = ("dist_0",)
    last_properties: tuple[str, ...] = ("filter_3D",)

    @cached_property
    def directions(self) -> np.ndarray:
        """(V, 3) directions of the vertices; V = 0 for kinds without vertices."""
        return np.zeros((0, 3))

    @cached_property
    def columns(self) -> np.ndarray:
        """(V,) int64, the extent of each vertex."""
        return np.zeros(0, np.int64)

    @cached_property
    def faces(self) -> np.ndarray:
        """(F, 3) int64 vertex indices, counter-clockwise seen from outside."""
        return np.zeros((0, 3), np.int64)

    @property
    def solid(self) -> bool:
        """Whether it has faces, at which rays enter and leave."""
        return len(self.faces) > 0

    @property
    def deviation(self) -> float:
        """Standard deviations per extent of the corresponding Gaussian."""
        return 1 / (DIST_TO_SCALE * self.size)

    def screen_filter_at(self, magnification: int, width: float) -> float:
        """Return the screen filter that corresponds to `width` when pixels are `magnification` times as large."""
        return magnification * width

    # --- training ---

    def start_extent(self, spacing: np.ndarray) -> np.ndarray:
        """Return (N,) extents of primitives created at points with this spacing: the half-axes of octahedra are the
        spacing, other kinds appear as large."""
        return spacing * self.size

    def reference_length(self, extent):
        """Return (N,) the length to which opacity refers, density = softplus(raw) / length: the shortest way through
        the primitive, as in LinPrim.

        `extent` (N, extents) is a numpy array or a torch tensor.
        """
        raise NotImplementedError

    def widened(self, extent, filter_3d):
        """Return extents, in torch, enlarged by the 3D filter (N,), which is a constant."""
        return extent + filter_3d[:, None] / 2

    def density(self, raw_opacity, extent):
        """Return (N,) densities of raw opacities, in torch.

        A ray along the reference length has alpha = 1 - exp(-softplus(raw)) = sigmoid(raw), without a cap and without
        a logarithm of 0.
        """
        from torch.nn.functional import softplus

        return softplus(raw_opacity) / self.reference_length(extent)

    def alpha(self, density: np.ndarray, extent: np.ndarray) -> np.ndarray:
        """Return (N,) the share of light absorbed along the reference length, 1 - exp(-density length)."""
        return -np.expm1(-density * self.reference_length(extent))

    # --- splitting ---

    def halves(
        self,
        center: np.ndarray,
        rotation: np.ndarray,
        log_extent: np.ndarray,
        raw_opacity: np.ndarray,
        rng: np.random.Generator,
    ) -> dict[str, np.ndarray]:
        """Return the parameters of the two halves of each of P parents that differ from the parent's: {"center": (2, P,
        3), "log_extent": (2, P, extents)} and possibly "raw_opacity": (2, P)."""
        raise NotImplementedError

    def draw(self, extent: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return (P, 3) normally distributed vectors in the local frame, with the covariance of `times_covariance`. If
        all extents are equal, they are its standard deviations."""
        return extent * rng.normal(size=extent.shape)

    def times_covariance(self, extent: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Return (P, 3) local vectors multiplied by the covariance."""
        return extent**2 * vector

    # --- storage, see primitive_files.py ---

    @property
    def length_properties(self) -> list[str]:
        """The properties of a PLY file that store the extents."""
        return [self.length_prefix + str(k) for k in range(self.extents)]

    def from_file(
        self, lengths: np.ndarray, opacity: np.ndarray, filter_3d: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return extents (N, extents), float32, and densities (N,), float64, from a file's lengths, opacities and
        filter (N, 1).

        Here they are |length| + filter / 2 and -ln(1 - 0.99 opacity) / reference length. They may be infinite; nothing
        is raised.
        """
        assert filter_3d is not None
        extent = np.abs(lengths) + filter_3d / np.float32(2)
        return extent, -np.log1p(-OPACITY_CAP * opacity) / self.reference_length(extent.astype(np.float64))

    def to_file(self, extent: np.ndarray, density: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the lengths and logits from which `from_file` computes `extent` and `density` with a filter of 0, and
        the number of rows that are too dense for that. A logit may be infinite."""
        thickness = density.astype(np.float64) * self.reference_length(extent.astype(np.float64))
        # logit(o) with o = (1 - exp(-thickness)) / 0.99, without the difference 1 - o of nearly equal numbers.
        taken = -np.expm1(-thickness)
        left = np.exp(-thickness) - (1.0 - OPACITY_CAP)
        logit = np.where(left > 0, np.log(taken) - np.log(np.maximum(left, 0.0)), np.inf)
        return extent, logit, int((thickness > THICKEST * (1.0 + 1e-6)).sum())

    def gaussian_deviations(self, extent: np.ndarray) -> np.ndarray:
        """Return (N, 3) standard deviations of the Gaussians that represent these primitives in another viewer.

        Raises:
            LinprimError: Gaussians cannot represent this kind.
        """
        raise LinprimError(f"{self.plural} cannot be written as Gaussians, wanted octahedra: only they have three axes")


class Octahedron(Kind):
    """{ p : sum_k |R^T (p - center)|_k / extent_k <= 1 }; the extents are its half-axes."""

    name, plural, extents, size = "octahedron", "octahedra", 3, 1.0
    # The halves have centres at +-0.4 of the half-axis that is cut; it becomes 0.6 of its length, the others 0.8.
    OFFSET, ALONG, ACROSS = 0.4, 0.6, 0.8

    @cached_property
    def directions(self):
        """Vertex 2 k + (0 for -, 1 for +) is on axis k."""
        return np.repeat(np.eye(3), 2, axis=0) * np.tile([-1.0, 1.0], 3)[:, None]

    @cached_property
    def columns(self):
        return np.repeat(np.arange(3), 2)

    @cached_property
    def faces(self):
        """One face per octant: the order x, y, z is counter-clockwise if the product of the three signs is positive."""
        octants = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
        turned = [(x, 2 + y, 4 + z) if (x + y + z) % 2 == 1 else (x, 4 + z, 2 + y) for x, y, z in octants]
        return np.array(turned, dtype=np.int64)

    def reference_length(self, extent):
        """Return 2 min_k extent_k, LinPrim's shortest diagonal."""
        return 2 * (extent.min(1) if isinstance(extent, np.ndarray) else extent.amin(1))

    def halves(self, center, rotation, log_extent, raw_opacity, rng):
        """Cut across an axis, drawn with probabilities proportional to the squared extents."""
        return _cut_along_axis(center, rotation, log_extent, rng, self.OFFSET, self.ALONG, self.ACROSS)

    def gaussian_deviations(self, extent):
        return extent / DIST_TO_SCALE


class Tetrahedron(Kind):
    """Vertices center + extent_j R b_j with b = (1,1,1), (1,-1,-1), (-1,1,-1), (-1,-1,1), each / sqrt 3."""

    name, plural, extents = "tetrahedron", "tetrahedra", 4
    # The size with the volume of an octahedron of half-axes 1: 8 sqrt(3) / 27 size^3 = 4 / 3.
    size = (4.5 / math.sqrt(3)) ** (1 / 3)
    told_by = ("dist_0", "dist_3")
    # Each half keeps one vertex of the longest edge: it is the tetrahedron scaled by SHRUNK about that vertex, with the
    # vertex at the other end of the edge at OTHER of its distance. All its vertices are convex combinations of the
    # parent's, so a half never extends beyond the parent.
    SHRUNK, OTHER = 0.82, 0.6

    @cached_property
    def directions(self):
        return np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3)

    @cached_property
    def columns(self):
        return np.arange(4)

    @cached_property
    def faces(self):
        """Face j omits vertex j."""
        return np.array([[1, 3, 2], [0, 2, 3], [0, 3, 1], [0, 1, 2]], dtype=np.int64)

    def reference_length(self, extent):
        """Return the diameter 6 V / A of the inscribed sphere; 2 d / 3 for a regular tetrahedron of distances d.

        With e3 the sum of the products of three of the four distances, V = 2 e3 / (9 sqrt 3). A face whose vertices
        have distances p, q, r has the area sqrt(2)/3 sqrt(x^2 + y^2 + z^2 + x y + y z + z x) with x = p q, y = q r, z =
        r p, because the cross products of directions that meet at cos = -1/3 have inner products 8/9 and 4/9.
        """
        distance = [extent[:, j] for j in range(4)]
        products, area = 0, 0
        for j in range(4):
            p, q, r = distance[:j] + distance[j + 1 :]
            x, y, z = p * q, q * r, r * p
            products = products + x * r
            square = x * x + y * y + z * z + x * y + y * z + z * x
            # The last bits of torch's square root differ between processors of different makers (see
            # `ops.exponential`).
            area = area + (square**0.5 if isinstance(square, np.ndarray) else square * square.rsqrt())
        return (6 * 2 / (9 * math.sqrt(3)) / (math.sqrt(2) / 3)) * products / area

    def halves(self, center, rotation, log_extent, raw_opacity, rng):
        """Place the halves at the two ends of the longest edge.

        Cuts at the middle of the edge would tile the parent, but such a half has no centre with these four directions
        (12 degrees of freedom against 10): the best least-squares fits have 13 to 28 % of their volume outside of the
        parent and leave 19 to 30 % of it empty. These halves are inside, leave 25 to 27 % empty, keep the rotation, and
        have together 0.85 to 0.88 of the volume (the halves of an octahedron 0.77); measured for ratios of distances up
        to 1 : 8.
        """
        rows = np.arange(len(center))
        corners = np.exp(log_extent)[:, :, None] * self.directions
        one, other = np.triu_indices(4, 1)
        longest = np.argmax(np.linalg.norm(corners[:, one] - corners[:, other], axis=2), axis=1)
        ends = np.stack([one[longest], other[longest]])
        centers, extents = [], []
        for kept, opposite in (ends, ends[::-1]):
            part = np.full(log_extent.shape, np.log(self.SHRUNK))
            part[rows, opposite] = np.log(self.OTHER)
            centers.append(center + rotate(rotation, (1 - self.SHRUNK) * corners[rows, kept]))
            extents.append(log_extent + part)
        return {"center": np.stack(centers), "log_extent": np.stack(extents)}

    def draw(self, extent, rng):
        return math.sqrt(0.75) / self.size * (extent * rng.normal(size=extent.shape)) @ self.directions

    def times_covariance(self, extent, vector):
        """Return vectors times the covariance 3/4 sum_j extent_j^2 b_j b_j^T, which is extent^2 if all are equal."""
        return 0.75 * (extent**2 * (vector @ self.directions.T)) @ self.directions


class Gaussian(Kind):
    """A primitive of 3D Gaussian splatting: extents are standard deviations along the local axes, the density is the
    opacity at its centre, 0 to 1."""

    name, plural, extents, size = "gaussian", "Gaussians", 3, 1 / DIST_TO_SCALE
    # 3DGS's near plane. Nearer to the camera's plane, the projection would cover everything.
    near = 0.2
    # 3DGS's screen filter, a variance in px^2.
    screen_filter = 0.3
    layout, length_prefix, told_by, last_properties = "3DGS", "scale_", ("scale_0", "f_dc_0"), ()
    # Initial standard deviation, in mean distances to the 3 nearest points. (3DGS starts with 1 and an opacity of 0.1,
    # which scores 0.4 to 2 dB less with every rule of densification, and MCMC's noise tears such Gaussians apart.)
    START = 0.5
    # The halves have centres at +-0.6 of the standard deviation that is cut; it becomes 0.8 of its length, so that the
    # second moment is kept (0.6^2 + 0.8^2 = 1). -ln(1 - opacity) is multiplied by 1 / (2 * 0.8), so that its integral
    # is kept.
    OFFSET, ALONG, ACROSS = 0.6, 0.8, 1.0

    def screen_filter_at(self, magnification, width):
        return magnification**2 * width

    def start_extent(self, spacing):
        return spacing * self.START

    def reference_length(self, extent):
        """Not defined for Gaussians.

        Raises:
            LinprimError: always.
        """
        raise LinprimError("a gaussian has no reference length, its opacity is that of its middle")

    def widened(self, extent, filter_3d):
        """Return sqrt(extent^2 + filter^2)."""
        import torch

        return torch.hypot(extent, filter_3d[:, None])

    def density(self, raw_opacity, extent):
        """Return the opacity itself, sigmoid(raw)."""
        import torch

        return torch.sigmoid(raw_opacity)

    def alpha(self, density, extent):
        return density

    def halves(self, center, rotation, log_extent, raw_opacity, rng):
        """Cut across an axis, drawn with probabilities proportional to the squared extents."""
        halves = _cut_along_axis(center, rotation, log_extent, rng, self.OFFSET, self.ALONG, self.ACROSS)
        thinner = thinned(raw_opacity, 1 / (2 * self.ALONG))
        return halves | {"raw_opacity": np.stack([thinner, thinner])}

    def from_file(self, lengths, opacity, filter_3d):
        """Return extents exp(length), or with a filter of Mip-Splatting sqrt(exp(length)^2 + filter^2), and the opacity
        times the product of the ratios."""
        spread = np.exp(lengths.astype(np.float64))
        wide = spread if filter_3d is None else np.hypot(spread, filter_3d)
        return wide.astype(np.float32), opacity * (spread / wide).prod(axis=1)

    def to_file(self, extent, density):
        opacity = density.astype(np.float64)
        return np.log(extent.astype(np.float64)), np.log(opacity) - np.log1p(-opacity), 0

    def gaussian_deviations(self, extent):
        return extent


# By name, in the order of `PrimitiveKind` in the core.
KINDS: dict[str, Kind] = {kind.name: kind for kind in (Octahedron(), Tetrahedron(), Gaussian())}


def _cut_along_axis(center, rotation, log_extent, rng, offset: float, along: float, across: float) -> dict:
    """Return halves of (P, 3) extents along local axes. One axis is drawn with probabilities proportional to the
    squared extents; centres are at +-`offset` of its extent, which is scaled by `along`, the others by `across`."""
    extent = np.exp(log_extent)
    draws = rng.random((len(center), 1))
    axis = (draws > np.cumsum(extent**2, 1)[:, :2] / (extent**2).sum(1, keepdims=True)).sum(1)
    chosen = np.eye(3)[axis]
    moved = rotate(rotation, offset * extent * chosen)
    shrunk = log_extent + np.log(np.where(chosen == 1, along, across))
    return {"center": np.stack([center + moved, center - moved]), "log_extent": np.stack([shrunk, shrunk])}


def thinned(raw_opacity: np.ndarray, part: float) -> np.ndarray:
    """Return raw opacity, float64, with `part` times the optical thickness softplus(raw) = -ln(1 - opacity) of
    `raw_opacity`."""
    thickness = part * np.logaddexp(0.0, raw_opacity.astype(np.float64))
    return thickness + np.log(-np.expm1(-thickness))  # ln(e^t - 1)


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate (P, 3) vectors by (P, 4) quaternions w, x, y, z of any length."""
    q = quaternion / np.maximum(np.linalg.norm(quaternion, axis=1, keepdims=True), 1e-30)
    w, u = q[:, :1], q[:, 1:]
    twice = 2 * np.cross(u, vector)
    return vector + w * twice + np.cross(u, twice)
