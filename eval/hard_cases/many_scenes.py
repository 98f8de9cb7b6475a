"""A float64 reference rasterizer for batches of thousands of tiny scenes.

It computes the same model as `linprim_geo.kernels.reference.rasterize`, which takes one scene at a time, by a different
method. That one uses local frames of primitives and a loop over primitives. This one uses face planes in camera space,
tables over (scene, ray, primitive, face), and depths relative to the point of the ray nearest to the centre, so that
the chord of a small distant primitive keeps its precision.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from linprim_geo.kernels.reference.rasterize import pixel_rays, rotation_matrix

C0 = 0.5 / math.sqrt(math.pi)  # the spherical harmonic of degree 0
CORNERS = torch.tensor([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], dtype=torch.float64) / math.sqrt(3)
FACE_SIGNS = torch.tensor(list(itertools.product((1.0, -1.0), repeat=3)), dtype=torch.float64)

FAR = 1e12  # z-depth at which the core ends every exact ray
EDGE_ON = 1e-6  # least divisor of a face's plane in the core, as a share of its terms; it is 0 for a face seen edge-on
LARGEST_DENSITY = 1e20
TILE = 16  # px along a side
GAUSSIAN_CAP, GAUSSIAN_FLOOR, GAUSSIAN_SINGULAR = 0.99, 1 / 255, 1e-12

PARAMETERS = ("center", "rotation", "extent", "density", "sh")


@dataclass(frozen=True)
class Scenes:
    """B scenes of M primitives of one kind, each scene with its own camera; float64."""

    primitive: str
    ray_model: str
    center: Tensor  # (B, M, 3) world
    rotation: Tensor  # (B, M, 4) w, x, y, z, any length; 0 is no rotation
    extent: Tensor  # (B, M, 3 or 4)
    density: Tensor  # (B, M)
    sh: Tensor  # (B, M, 1, 3)
    pose: Tensor  # (B, 4, 4) world to camera
    focal: Tensor  # (B, 2) px
    middle: Tensor  # (B, 2) principal point, px
    near: Tensor  # (B,)
    width: int
    height: int
    aimed: Tensor  # (B,) index of the pixel whose ray is aimed at the first primitive
    coincident: bool = False  # whether the primitives of a scene are copies that differ in density only

    def __len__(self) -> int:
        return len(self.center)

    def rows(self, index) -> Scenes:
        """Return the scenes of a slice."""
        return replace(self, **{k: v[index] for k, v in vars(self).items() if isinstance(v, Tensor)})


def dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def camera_space(s: Scenes) -> tuple[Tensor, Tensor]:
    """Return centres (B, M, 3) and axes (B, M, 3, 3), as columns, in camera space."""
    turn = s.pose[:, None, :3, :3]
    zero = (s.rotation == 0).all(-1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=s.rotation.dtype).expand_as(s.rotation)
    # Quaternions are scaled first: the square of a length of 1e-18 is a normal number, that of 1e-180 is not.
    size = torch.where(zero, torch.ones_like(s.rotation), s.rotation).detach().abs().amax(-1, keepdim=True)
    q = torch.where(zero, identity, s.rotation / size)
    return (turn @ s.center[..., None])[..., 0] + s.pose[:, None, :3, 3], turn @ rotation_matrix(q)


def rays_of(s: Scenes) -> Tensor:
    """Return (B, R, 3) rays (X, Y, 1) through the pixel centres."""
    grid = pixel_rays(s.width, s.height, 1.0, 1.0, 0.0, 0.0, s.center)
    xy = (grid[None, :, :2] - s.middle[:, None]) / s.focal[:, None]
    return torch.cat([xy, torch.ones_like(xy[..., :1])], -1)


def view_limits(s: Scenes) -> tuple[Tensor, Tensor]:
    """Return (B, 1, 2) least and largest x/z, y/z at which the affine approximation is evaluated: the image with a
    margin of 0.15 of its size, within +-1e4."""
    size = s.center.new_tensor([s.width, s.height])
    return tuple(((share * size - s.middle) / s.focal)[:, None].clamp(-1e4, 1e4) for share in (-0.15, 1.15))


def vertices(s: Scenes) -> tuple[Tensor, Tensor]:
    """Return vertices relative to their centres (B, M, V, 3) and the centres (B, M, 3), camera space."""
    center, axes = camera_space(s)
    if s.primitive == "tetrahedron":
        return s.extent[..., None] * (CORNERS @ axes.mT), center
    half = (axes * s.extent[..., None, :]).mT
    return torch.cat([half, -half], -2), center


def faces(s: Scenes, axes: Tensor) -> Tensor:
    """Return (B, M, F, 3) normals n of the faces n . (x - c) = 1, camera space.

    A tetrahedron's face through the vertices u_j = d_j e_j (j = 1, 2, 3) has n = (sum over cyclic of e_2 x e_3 / d_1) /
    det(e).
    """
    if s.primitive != "tetrahedron":
        return (FACE_SIGNS / s.extent[..., None, :]) @ axes.mT
    rows = []
    for j in range(4):
        a, b, c = (CORNERS[k] for k in range(4) if k != j)
        i, k, m = (k for k in range(4) if k != j)
        det = torch.dot(a, torch.linalg.cross(b, c))
        parts = [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)]
        rows.append(sum(p / det / s.extent[..., v, None] for p, v in zip(parts, (i, k, m), strict=True)))
    return torch.stack(rows, -2) @ axes.mT


def drawn(s: Scenes, center: Tensor) -> Tensor:
    """Return (B, M) bool: whether each primitive is drawn at all."""
    positive = (s.extent >= 0 if s.primitive == "gaussian" else s.extent > 0).all(-1)
    if s.ray_model == "exact" and s.primitive != "gaussian":
        return positive
    return positive & (center[..., 2] > s.near[:, None])


def _lines(s: Scenes, center: Tensor, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return each ray as origin + s direction relative to each centre, both (B, R, M, 3), and the parameter t (exact
    rays) or the distance (affine rays) at its origin, (B, R, M).

    The origin of an exact ray is its point nearest to the centre. The origin of an affine ray lies in the plane through
    the centre perpendicular to the viewing direction, which is limited to `view_limits`.
    """
    c = center[:, None]
    if s.ray_model == "exact":
        v = rays[:, :, None]
        t0 = (dot(c, v) / dot(v, v)).detach()
        return t0[..., None] * v - c, v.expand(-1, -1, c.shape[2], -1), t0
    z, length = c[..., 2:], c.norm(dim=-1, keepdim=True)
    away = (
        torch.cat([rays[:, :, None, :2] - c[..., :2] / z, torch.zeros_like(z).expand(-1, rays.shape[1], -1, -1)], -1)
        * z
    )
    low, high = view_limits(s)
    held = torch.minimum(torch.maximum(c[..., :2] / z, low[:, None]), high[:, None])
    along = torch.cat([held, torch.ones_like(z)], -1)
    along = along / along.norm(dim=-1, keepdim=True)
    return (
        away - along * dot(away, along)[..., None],
        along.expand_as(away),
        length[..., 0].expand(-1, rays.shape[1], -1),
    )


@dataclass(frozen=True)
class Chords:
    """The chords of all rays through all primitives, (B, R, M) each."""

    hit: Tensor
    tau: Tensor
    t_in: Tensor  # z-depth; 0 without a hit
    t_out: Tensor
    # Two results are correct: a Gaussian's alpha is within rounding of a threshold, or the ray lies in a face's plane.
    doubtful: Tensor
    of_entry: Tensor  # tau up to the entry, from an arbitrary origin, so that of_exit - of_entry = tau
    of_exit: Tensor


def chords(s: Scenes, entry: int = 0, leave: int = 0, grazing: bool = False) -> Chords:
    """Clip every ray to every primitive.

    entry, leave: which of several faces met at the same depth (to 1e-9 of the primitive's size) gets the gradient,
    counted from 0; the last if there are fewer.
    """
    center, axes = camera_space(s)
    rays = rays_of(s)
    there = drawn(s, center)[:, None]
    if s.primitive == "gaussian":
        return _splats(s, center, axes, rays, there)
    if s.ray_model == "affine":  # avoids divisions by the depth of primitives that are not drawn
        center = torch.where(there[:, 0, :, None], center, torch.ones_like(center))
    extent = torch.where((s.extent > 0).all(-1, keepdim=True), s.extent, torch.ones_like(s.extent))
    normals = faces(replace(s, extent=extent), axes)[:, None]
    origin, direction, t0 = _lines(s, center, rays)
    slope = (normals * direction[..., None, :]).sum(-1)
    left = 1 - (normals * origin[..., None, :]).sum(-1)
    flat = slope == 0
    t = left / torch.where(flat, torch.ones_like(slope), slope)
    infinite = torch.full_like(t, math.inf)
    tolerance = 1e-9 * s.extent.detach().abs().amax(-1)[:, None]
    # A ray in the plane of a face counts as inside and as outside.
    in_plane = ((slope.abs() * tolerance[..., None] < 1e-18) & (left.abs() < 1e-9)).any(-1) & there
    entries = _ranked(torch.where(slope < 0, t, -infinite), entry, tolerance, largest=True)
    exits = _ranked(torch.where(slope > 0, t, infinite), leave, tolerance, largest=False)
    inside = ~(flat & (left < 0)).any(-1)
    length = rays.norm(dim=-1)[:, :, None]
    if s.ray_model == "exact":
        near = s.near[:, None, None] - t0
        entries = torch.where(entries > near, entries, near)
        exits = torch.minimum(exits, FAR - t0)
    hit = inside & there & (exits > entries - (tolerance if grazing else 0)) & entries.isfinite() & exits.isfinite()
    zero = torch.zeros_like(entries)
    start, end = torch.where(hit, entries, zero), torch.where(hit, exits, zero)
    if s.ray_model == "exact":
        chord, t_in, t_out = length * (end - start), t0 + start, t0 + end
    else:
        chord, t_in, t_out = end - start, (t0 + start) / length, (t0 + end) / length
    density = s.density.clamp(0, LARGEST_DENSITY)[:, None]
    rate = density * length if s.ray_model == "exact" else density
    t_in, t_out = torch.where(hit, t_in, zero), torch.where(hit, t_out, zero)
    return Chords(hit, density * chord, t_in, t_out, in_plane, rate * start, rate * end)


def _ranked(t: Tensor, rank: int, tolerance: Tensor, largest: bool) -> Tensor:
    # Selects one of several equal values: `amax` would share the gradient among them.
    values, index = t.detach().topk(rank + 1, dim=-1, largest=largest)
    tied = (values - values[..., :1]).abs() <= tolerance[..., None]
    place = tied.sum(-1, keepdim=True).clamp(min=1) - 1
    return t.gather(-1, index.gather(-1, place))[..., 0]


def _splats(s: Scenes, center: Tensor, axes: Tensor, rays: Tensor, there: Tensor) -> Chords:
    center = torch.where(there[:, 0, :, None], center, torch.ones_like(center))
    (half_x, half_y), (xx, xy, yy, det, place) = gaussian_ellipse(s, center, axes)
    flat = ~(det > GAUSSIAN_SINGULAR * (xx + yy) ** 2)
    det = torch.where(flat, torch.ones_like(det), det)
    d = (rays[:, :, None, :2] - place[:, None]) * s.focal[:, None, None]
    dx, dy = d[..., 0], d[..., 1]
    # d^T M^-1 d for M = H H^T, as a sum of squares: the expanded form cancels for a long ellipse.
    across = half_y[:, None] * dx[..., None] - half_x[:, None] * dy[..., None]
    power = -0.5 * dot(across, across) / det[:, None]
    alpha = (s.density.clamp(0, 1)[:, None] * torch.exp(power)).clamp(max=GAUSSIAN_CAP)
    hit = there & ~flat[:, None] & (alpha >= GAUSSIAN_FLOOR)
    tau = torch.where(hit, -torch.log1p(-torch.where(hit, alpha, torch.zeros_like(alpha))), torch.zeros_like(alpha))
    depth = torch.where(hit, center[:, None, :, 2], torch.zeros_like(tau))
    near_floor = (alpha / GAUSSIAN_FLOOR - 1).abs() < 1e-3
    near_cap = (s.density.clamp(0, 1)[:, None] * torch.exp(power) / GAUSSIAN_CAP - 1).abs() < 1e-3
    near_flat = (det / (GAUSSIAN_SINGULAR * (xx + yy) ** 2) - 1).abs() < 1e-3
    doubtful = (near_floor | near_cap | near_flat[:, None]) & there
    return Chords(
        hit,
        tau,
        depth,
        depth,
        doubtful,
        torch.zeros_like(tau),
        torch.where(hit, alpha, torch.zeros_like(alpha)),
    )


def gaussian_ellipse(s: Scenes, center: Tensor, axes: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, ...]]:
    """Return the rows of H (B, M, 3), px, where M = H H^T is the projected covariance; and M's entries xx, xy, yy, its
    determinant by Cauchy and Binet, (B, M) each, and the projected centre x/z, y/z (B, M, 2). H is evaluated at the
    centre, limited to `view_limits`."""
    z = center[..., 2:]
    place = center[..., :2] / z
    held = torch.minimum(torch.maximum(place, view_limits(s)[0]), view_limits(s)[1])
    half = (
        (axes[..., :2, :] - held[..., None] * axes[..., 2:, :])
        / z[..., None]
        * s.extent[..., None, :]
        * s.focal[:, None, :, None]
    )
    x, y = half[..., 0, :], half[..., 1, :]
    area = torch.linalg.cross(x, y)
    return (x, y), (dot(x, x), dot(x, y), dot(y, y), dot(area, area), place)


def render(s: Scenes, order: str, entry: int = 0, leave: int = 0, found: Chords | None = None) -> tuple[Tensor, Tensor]:
    """Return rgb over black (B, 3, R) and opacity (B, R) of every scene; rays are never stopped early."""
    found = found or chords(s, entry, leave)
    color = torch.relu(C0 * s.sh[:, :, 0] + 0.5)[:, None]  # (B, 1, M, 3)
    if order == "overlap" and s.coincident:
        # Copies of one colour: their thicknesses add up.
        total = found.tau.sum(-1, keepdim=True)
        rgb = (
            (-torch.expm1(-total))
            * (found.tau[..., None] * color).sum(2)
            / torch.where(total > 0, total, torch.ones_like(total))
        )
        return rgb.mT, -torch.expm1(-total[..., 0])
    if order == "overlap" and found.tau.shape[2] > 1:
        return _overlapping(found, color)
    key = found.t_in if order == "entry" else camera_space(s)[0][:, None, :, 2].expand_as(found.tau)
    index = torch.where(found.hit, key, torch.full_like(key, math.inf)).detach().argsort(dim=-1, stable=True)
    tau = found.tau.gather(-1, index)
    color = color.expand(-1, tau.shape[1], -1, -1).gather(2, index[..., None].expand(-1, -1, -1, 3))
    weight = torch.exp(-_before(tau)) * -torch.expm1(-tau)
    return (weight[..., None] * color).sum(2).mT, -torch.expm1(-tau.sum(-1))


def _before(tau: Tensor) -> Tensor:
    """Return exclusive cumulative sums, computed without subtraction."""
    return torch.cat([torch.zeros_like(tau[..., :1]), torch.cumsum(tau[..., :-1], -1)], -1)


def _overlapping(found: Chords, color: Tensor) -> tuple[Tensor, Tensor]:
    """Return rgb and opacity by emission and absorption over the segments between all entries and exits."""
    none = torch.where(found.hit, 0.0, math.inf)
    edges = torch.sort(torch.cat([(found.t_in + none), (found.t_out + none)], -1), -1).values
    edges = torch.where(edges.isinf(), torch.zeros_like(edges), edges)
    low, high = edges[..., :-1], edges[..., 1:]
    length = (high - low).clamp(min=0)
    middle = (0.5 * (low + high)).detach()[..., None]
    within = (found.hit[..., None, :] & (found.t_in[..., None, :] <= middle) & (middle < found.t_out[..., None, :])).to(
        length.dtype
    )
    span = torch.where(found.t_out > found.t_in, found.t_out - found.t_in, torch.ones_like(found.tau))
    rate = found.tau / span
    tau = (within * rate[..., None, :]).sum(-1) * length  # (B, R, E)
    before = _before(tau)
    safe = torch.where(tau > 0, tau, torch.ones_like(tau))
    mean = torch.where(tau > 0, -torch.expm1(-safe) / safe, torch.ones_like(tau))
    covered = torch.exp(-before) * length * mean
    weight = (within * covered[..., None]).sum(-2) * rate
    return (weight[..., None] * color).sum(2).mT, -torch.expm1(-tau.sum(-1))


@torch.no_grad()
def aimed_chord(s: Scenes) -> Tensor:
    """Return (B, M) chord length of the aimed ray (thickness at density 1), 0 where it misses."""
    found = chords(replace(s, density=torch.ones_like(s.density)))
    return found.tau[torch.arange(len(s)), s.aimed]
