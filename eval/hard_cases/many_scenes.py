"""A float64 reference for thousands of tiny scenes at once, with the rounding that a rung may add to each ray.

The same model as `linprim_geo.kernels.reference.rasterize`, which takes one scene at a time: there, frames at the
primitive and a walk over primitives; here, planes in camera space, tables over (scene, ray, primitive, face), and
depths counted from the point of the ray that is nearest to the centre, so that a chord of a small primitive far away
keeps its digits.
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

FAR = 1e12  # z-depth where the core ends every exact ray
EDGE_ON = 1e-6  # a face nearer to edge-on than this part of its terms is moved to it by the core
LARGEST_DENSITY = 1e20
TILE = 16  # px along a side
GAUSSIAN_CAP, GAUSSIAN_FLOOR, GAUSSIAN_SINGULAR = 0.99, 1 / 255, 1e-12

PARAMETERS = ("center", "rotation", "extent", "density", "sh")


@dataclass(frozen=True)
class Scenes:
    """B scenes of M primitives of one kind, each with a camera of its own; float64."""

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
    coincident: bool = False  # the primitives of each scene are copies of one but for their densities

    def __len__(self) -> int:
        return len(self.center)

    def rows(self, index) -> Scenes:
        """The scenes of a slice."""
        return replace(self, **{k: v[index] for k, v in vars(self).items() if isinstance(v, Tensor)})


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def camera_space(s: Scenes) -> tuple[Tensor, Tensor]:
    """Centres (B, M, 3) and axes (B, M, 3, 3), columns, in camera space."""
    turn = s.pose[:, None, :3, :3]
    zero = (s.rotation == 0).all(-1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=s.rotation.dtype).expand_as(s.rotation)
    # A scale of its own first: the square of a length of 1e-18 is a normal number, that of 1e-180 is none.
    size = torch.where(zero, torch.ones_like(s.rotation), s.rotation).detach().abs().amax(-1, keepdim=True)
    q = torch.where(zero, identity, s.rotation / size)
    return (turn @ s.center[..., None])[..., 0] + s.pose[:, None, :3, 3], turn @ rotation_matrix(q)


def rays_of(s: Scenes) -> Tensor:
    """(B, R, 3) rays (X, Y, 1) through the pixel centres."""
    grid = pixel_rays(s.width, s.height, 1.0, 1.0, 0.0, 0.0, s.center)
    xy = (grid[None, :, :2] - s.middle[:, None]) / s.focal[:, None]
    return torch.cat([xy, torch.ones_like(xy[..., :1])], -1)


def view_limits(s: Scenes) -> tuple[Tensor, Tensor]:
    """(B, 1, 2) least and largest x/z, y/z at which an affine approximation is taken: the image and 0.15 of its size
    around it, in 1e4."""
    size = s.center.new_tensor([s.width, s.height])
    return tuple(((share * size - s.middle) / s.focal)[:, None].clamp(-1e4, 1e4) for share in (-0.15, 1.15))


def vertices(s: Scenes) -> tuple[Tensor, Tensor]:
    """Vertices relative to their centres (B, M, V, 3) and the centres (B, M, 3), camera space."""
    center, axes = camera_space(s)
    if s.primitive == "tetrahedron":
        return s.extent[..., None] * (CORNERS @ axes.mT), center
    half = (axes * s.extent[..., None, :]).mT
    return torch.cat([half, -half], -2), center


def faces(s: Scenes, axes: Tensor) -> Tensor:
    """(B, M, F, 3) normals n of the faces n . (x - c) = 1, camera space.

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
    """(B, M) whether a primitive is drawn at all."""
    positive = (s.extent >= 0 if s.primitive == "gaussian" else s.extent > 0).all(-1)
    if s.ray_model == "exact" and s.primitive != "gaussian":
        return positive
    return positive & (center[..., 2] > s.near[:, None])


def _lines(s: Scenes, center: Tensor, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Each ray as origin + s direction relative to each centre, (B, R, M, 3) both, and the t or distance at its origin,
    (B, R, M).

    The origin is the point of an exact ray nearest to the centre; that of an affine one lies in the plane through the
    centre square to the view, which is taken within `view_limits`.
    """
    c = center[:, None]
    if s.ray_model == "exact":
        v = rays[:, :, None]
        t0 = (_dot(c, v) / _dot(v, v)).detach()
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
        away - along * _dot(away, along)[..., None],
        along.expand_as(away),
        length[..., 0].expand(-1, rays.shape[1], -1),
    )


@dataclass(frozen=True)
class Chords:
    """What each ray crosses of each primitive, (B, R, M)."""

    hit: Tensor
    tau: Tensor
    t_in: Tensor  # z-depth; 0 without a hit
    t_out: Tensor
    # Both answers are right: a Gaussian's alpha within rounding of a threshold, a ray in the plane of a face.
    doubtful: Tensor
    of_entry: Tensor  # tau as far as the entry has made it, from an arbitrary point: of_exit - of_entry = tau
    of_exit: Tensor


def chords(s: Scenes, entry: int = 0, leave: int = 0, grazing: bool = False) -> Chords:
    """Clips every ray to every primitive.

    entry, leave: of several faces met at the same depth (to 1e-9 of the primitive's size), the one that the gradient
    goes through, counted from 0; where there are fewer, the last.
    """
    center, axes = camera_space(s)
    rays = rays_of(s)
    there = drawn(s, center)[:, None]
    if s.primitive == "gaussian":
        return _splats(s, center, axes, rays, there)
    if s.ray_model == "affine":  # what is not drawn must not divide by its depth
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
    # A ray in the plane of a face is inside and outside.
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
    # One of several equal ones: `amax` would share the gradient among them.
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
    power = -0.5 * _dot(across, across) / det[:, None]
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
    """The rows of H (B, M, 3), px, with the covariance M = H H^T; and M's xx, xy, yy, its determinant by Cauchy and
    Binet, and the projected centre x/z, y/z; (B, M). H is taken where the centre is, but within `view_limits`."""
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
    return (x, y), (_dot(x, x), _dot(x, y), _dot(y, y), _dot(area, area), place)


def render(s: Scenes, order: str, entry: int = 0, leave: int = 0, found: Chords | None = None) -> tuple[Tensor, Tensor]:
    """rgb over black (B, 3, R) and opacity (B, R) of every scene; no ray is stopped."""
    found = found or chords(s, entry, leave)
    color = torch.relu(C0 * s.sh[:, :, 0] + 0.5)[:, None]  # (B, 1, M, 3)
    if order == "overlap" and s.coincident:
        # Copies of one colour: the sum of the thicknesses.
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
    """Sums of what comes before each, without a subtraction."""
    return torch.cat([torch.zeros_like(tau[..., :1]), torch.cumsum(tau[..., :-1], -1)], -1)


def _overlapping(found: Chords, color: Tensor) -> tuple[Tensor, Tensor]:
    """Emission and absorption over the segments between all entries and exits."""
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
    """(B, M) thickness per density of the aimed ray, 0 where it misses."""
    found = chords(replace(s, density=torch.ones_like(s.density)))
    return found.tau[torch.arange(len(s)), s.aimed]


@torch.no_grad()
def _distances(
    s: Scenes, center: Tensor, place: Tensor, rays: Tensor, moved: Tensor, eps: float
) -> tuple[Tensor, Tensor, Tensor]:
    """|dx| and |dy| (B, R, M) of pixels from projected centres, and by how much they may be off (B, R, 2, M)."""
    tiny = 2.0**-53
    d = (rays[:, :, None, :2] - place[:, None]) * s.focal[:, None, None]
    dx, dy = d[..., 0].abs(), d[..., 1].abs()
    shift = (
        s.focal[:, None, :, None] * (place.abs() + (place.abs() + 1) * (moved / center[..., 2])[..., None]).mT[:, None]
    )
    return dx, dy, eps * (torch.stack([dx, dy], 2) + 1) + 8 * tiny * (shift + s.middle.abs()[:, None, :, None])


def _exponent(s: Scenes, center: Tensor, axes: Tensor, rays: Tensor) -> Tensor:
    """(B, R, M) d^T M^-1 d / 2."""
    (half_x, half_y), (_, _, _, det, place) = gaussian_ellipse(s, center, axes)
    d = (rays[:, :, None, :2] - place[:, None]) * s.focal[:, None, None]
    across = half_y[:, None] * d[..., :1] - half_x[:, None] * d[..., 1:]
    return 0.5 * _dot(across, across) / torch.where(det > 0, det, torch.ones_like(det))[:, None]


def _covariance_rounding(
    s: Scenes, center: Tensor, axes: Tensor, moved: Tensor
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """By how much xx, xy, yy and the determinant of a projected covariance may be off, (B, M) each, in double.

    A row of H is (axis_x - u axis_z) extent focal / z, each factor good to some 2^-53 and u to 2^-53 moved / z: 8 *
    2^-53 of the sizes of its terms. The others follow by the rule of products; the determinant from the cross product
    of the rows.
    """
    tiny = 2.0**-53
    (half_x, half_y), (_, _, _, _, place) = gaussian_ellipse(s, center, axes)
    held = torch.minimum(torch.maximum(place, view_limits(s)[0]), view_limits(s)[1])
    z = center[..., 2:]
    terms = (
        axes[..., :2, :].abs()
        + (held.abs() + (place.abs() + 1) * (moved[..., None] / z))[..., None] * axes[..., 2:, :].abs()
    )
    off = 8 * tiny * terms / z[..., None] * (s.extent[..., None, :] * s.focal[:, None, :, None])
    x, y, off_x, off_y = half_x.abs(), half_y.abs(), off[..., 0, :], off[..., 1, :]
    of_x, of_y = off_x + 4 * tiny * x, off_y + 4 * tiny * y
    across = torch.linalg.cross(half_x, half_y).abs()
    pairs = ((1, 2), (2, 0), (0, 1))
    of_across = torch.stack(
        [
            x[..., i] * of_y[..., j] + of_x[..., i] * y[..., j] + x[..., j] * of_y[..., i] + of_x[..., j] * y[..., i]
            for i, j in pairs
        ],
        -1,
    )
    entries = 2 * _dot(x, of_x), _dot(x, of_y) + _dot(y, of_x), 2 * _dot(y, of_y)
    return entries, _dot(2 * across + of_across, of_across)


def _exponent_rounding(
    s: Scenes, center: Tensor, axes: Tensor, rays: Tensor, moved: Tensor, eps: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Of a Gaussian's exponent: the sum of the sizes of its terms, by how much it may be off beside their rounding
    (B, R, M), and whether rounding decides if the ellipse is flat (B, M)."""
    _, (xx, xy, yy, det, place) = gaussian_ellipse(s, center, axes)
    dx, dy, shift = _distances(s, center, place, rays, moved, eps)
    entries, det_off = _covariance_rounding(s, center, axes, moved)
    threshold = GAUSSIAN_SINGULAR * (xx + yy) ** 2
    flat = (det - threshold).abs() <= det_off + 4 * GAUSSIAN_SINGULAR * (xx + yy) * (entries[0] + entries[2])
    det = torch.where(det > 0, det, torch.ones_like(det))
    det_off = (det_off / det)[:, None]
    off_xx, off_xy, off_yy = (e[:, None] / det[:, None] for e in entries)
    xx, xy, yy = (q[:, None] / det[:, None] for q in (xx, xy.abs(), yy))
    size = 0.5 * (yy * dx * dx + 2 * xy * dx * dy + xx * dy * dy)
    size_off = (yy * dx + xy * dy) * shift[:, :, 0] + (xx * dy + xy * dx) * shift[:, :, 1]
    size_off = size_off + 0.5 * (yy * shift[:, :, 0] ** 2 + 2 * xy * shift.prod(2) + xx * shift[:, :, 1] ** 2)
    # The entries of a needle's covariance cancel in the exponent, their errors do not.
    size_off = size_off + 0.5 * (off_yy * dx * dx + 2 * off_xy * dx * dy + off_xx * dy * dy) + size * det_off
    return size, size_off, flat


def gaussian_gradient_rounding(s: Scenes, found: Chords, off: Tensor, pull: Tensor, eps: float) -> list[Tensor]:
    """(B,) for each of PARAMETERS but the colours: by how much the gradient of a scene of Gaussians may be off.

    off: of `rounding`; pull (B, R, M): the size of the gradient to a ray's light times the colour. The kernel sums
    g d d^T and g d over the pixels, g the gradient to the exponent, and goes on to the covariance M by Q S Q / 2 with
    Q = M^-1, in absolute values

        |g|  <=  pull alpha / (1 - alpha), as the gradient to alpha is that to tau over 1 - alpha
        dg   <=  |g| (off / alpha + sum of the others' off / (1 - alpha) + (16 + 4 primitives) eps)
        dS   <=  sum (dg d d^T + |g| (d shift^T + shift d^T + shift shift^T)), shift as in `rounding`
        dM   <=  |Q| dS |Q| / 2 + dQ S |Q|, where dQ is that of M's entries and determinant, in double

    and from M and the projected centre to the parameters by the sizes of their derivatives. For an ellipse k times
    longer than wide |Q| |S| |Q| is k^2 times |Q S Q|: that is the gradient's condition.
    """
    tiny = 2.0**-53
    leaves = {name: getattr(s, name).detach().clone().requires_grad_() for name in PARAMETERS[:3]}
    with torch.enable_grad():
        some = replace(s, **leaves)
        center, axes = camera_space(some)
        there = drawn(s, center)
        center = torch.where(there[..., None], center, torch.ones_like(center))
        _, (xx, xy, yy, det, place) = gaussian_ellipse(some, center, axes)
        outputs = [xx, xy, yy, *(place * s.focal[:, None]).unbind(-1)]
        slopes = [
            torch.autograd.grad(o.sum(), list(leaves.values()), retain_graph=True, allow_unused=True) for o in outputs
        ]
    with torch.no_grad():
        center, axes, place = center.detach(), axes.detach(), place.detach()
        moved = s.center.abs().sum(-1) + s.pose[:, None, :3, 3].abs().sum(-1)
        dx, dy, shift = _distances(s, center, place, rays_of(s), moved, eps)
        (off_xx, off_xy, off_yy), det_off = _covariance_rounding(s, center, axes, moved)
        det = torch.where(det > 0, det, torch.ones_like(det)).detach()
        left = torch.exp(-found.tau)
        alpha = -torch.expm1(-found.tau)
        g = torch.where(found.hit, pull * alpha / left, torch.zeros_like(pull))
        others = (off / left).sum(-1, keepdim=True)
        part = torch.where(alpha > 0, off / alpha, torch.zeros_like(off)) + others + (16 + 4 * pull.shape[2]) * eps
        sx, sy = shift[:, :, 0], shift[:, :, 1]

        def moments(of_g: Tensor, more: bool) -> tuple[Tensor, ...]:
            return tuple(
                (of_g * a * b + (g * (a * sb + b * sa + sa * sb) if more else 0)).sum(1)
                for a, b, sa, sb in ((dx, dx, sx, sx), (dx, dy, sx, sy), (dy, dy, sy, sy))
            )

        def product(a: tuple, m: tuple, b: tuple) -> tuple[Tensor, Tensor, Tensor]:
            """The symmetric part of A M B for symmetric A, M, B, each (xx, xy, yy)."""
            first = a[0] * m[0] + a[1] * m[1], a[0] * m[1] + a[1] * m[2]
            second = a[1] * m[0] + a[2] * m[1], a[1] * m[1] + a[2] * m[2]
            return (
                first[0] * b[0] + first[1] * b[1],
                0.5 * (first[0] * b[1] + first[1] * b[2] + second[0] * b[0] + second[1] * b[1]),
                second[0] * b[1] + second[1] * b[2],
            )

        q = (yy.detach() / det, xy.detach().abs() / det, xx.detach() / det)
        relative = det_off / det + 8 * tiny
        q_off = tuple(e / det + a * relative for e, a in zip((off_yy, off_xy, off_xx), q, strict=True))
        whole = moments(g, False)
        of_s, of_q = product(q, moments(g * part, True), q), product(q_off, whole, q)
        m = [0.5 * a + b for a, b in zip(of_s, of_q, strict=True)]
        first_x, first_y = ((g * (part * d + shifted)).sum(1) for d, shifted in ((dx, sx), (dy, sy)))
        whole_x, whole_y = (g * dx).sum(1), (g * dy).sum(1)
        to_place = (
            q[0] * first_x + q[1] * first_y + q_off[0] * whole_x + q_off[1] * whole_y,
            q[1] * first_x + q[2] * first_y + q_off[1] * whole_x + q_off[2] * whole_y,
        )
        length = s.rotation.norm(dim=-1, keepdim=True)
        bounds = []
        for k in range(3):
            total = torch.zeros_like(list(leaves.values())[k])
            for size, slope in zip((m[0], 2 * m[1], m[2], *to_place), slopes, strict=True):
                if slope[k] is not None:
                    total = total + size[..., None] * slope[k].abs()
            if k == 1:
                total = total * torch.where(length > 0, length, torch.ones_like(length))
            bounds.append(total.flatten(1).norm(dim=1).nan_to_num(math.inf, math.inf))
        density = (g * part).sum(1) / s.density.clamp(1e-30, 1)
        return [*bounds, density.norm(dim=1)]


def _direction(s: Scenes, center: Tensor) -> Tensor:
    """(B, M, 3) the unit direction that affine rays are taken to have: of the centre, within `view_limits`."""
    at = center[..., :2] / center[..., 2:]
    held = torch.minimum(torch.maximum(at, view_limits(s)[0]), view_limits(s)[1])
    direction = torch.cat([held, torch.ones_like(held[..., :1])], -1)
    return direction / direction.norm(dim=-1, keepdim=True)


def _divisors(s: Scenes, normals: Tensor, center: Tensor, safe: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(B, M, F) the h by which a face's plane over the pixels is divided, 0 for a face seen edge-on; the size of its
    terms; and by how much it is off, in double. `safe`: the centres, in front of the camera."""
    tiny = 2.0**-53
    moved = s.center.abs().sum(-1) + s.pose[:, None, :3, 3].abs().sum(-1)
    if s.ray_model == "exact":
        m = (normals * center[..., None, :]).sum(-1)
        terms = (normals.abs() * (center.abs() + moved[..., None])[..., None, :]).sum(-1)
        return 1 + m, 1 + m.abs(), 16 * tiny * (1 + terms)
    size = normals.norm(dim=-1)
    h = (normals * _direction(s, safe)[..., None, :]).sum(-1)
    return h, size, 16 * tiny * size * (1 + moved / safe[..., 2])[..., None]


@torch.no_grad()
def gradient_condition(s: Scenes, found: Chords, eps: float) -> Tensor:
    """(B,) part of what entries and exits contribute to the gradient of a scene of polyhedra that is lost beside the
    roundings of the sums.

    A plane over the pixels and its derivatives are divided by h and h^2, which are off by `_divisors`. Moments of the
    gradient are summed about a corner of a tile and moved to the primitive: a tile's 16 px times eps, as a part of the
    primitive's width in pixels.
    """
    center, axes = camera_space(s)
    there = drawn(s, center)
    extent = torch.where((s.extent > 0).all(-1, keepdim=True), s.extent, torch.ones_like(s.extent))
    s = replace(s, extent=extent)
    in_front = there & (center[..., 2] > 0)
    safe = torch.where(in_front[..., None], center, torch.ones_like(center))
    h, size, off = _divisors(s, faces(s, axes), center, safe)
    of_divisor = 2 * (off / torch.maximum(h.abs(), EDGE_ON * size)).amax(-1)
    depth = found.t_out.amax(1).clamp(min=1e-30)
    width = extent.amin(-1) * s.focal.amin(-1, keepdim=True) / depth
    of_corner = torch.where(found.hit.any(1), TILE * eps / width, torch.zeros_like(width))
    return torch.where(there, of_divisor + of_corner, torch.zeros_like(width)).amax(-1).nan_to_num(math.inf, math.inf)


def rounding(s: Scenes, found: Chords, eps: float, depths: bool = False) -> Tensor:
    """(B, R, M) by how much the alpha of each ray and primitive may be off where planes are evaluated with unit
    roundoff `eps` / 2.

    A face is w = a + b dx + c dy over the pixels, dx and dy from the pixel nearest to the projected centre, with w the
    inverse depth less that of the centre (affine rays: the centre's distance less the distance). Rounded coefficients
    and two operations leave w off by 2 eps (|a| + |b dx| + |c dy|), and the set-up in double by 16 * 2^-53 of its
    terms; a face within EDGE_ON of edge-on is moved to it. Entry and exit, being a minimum and a maximum, are off by no
    more, and alpha is monotone in both: its range over them is the bound. With `depths` the chord is the difference of
    two depths, each good to 4 eps: what the order "overlap" does, whose segments end where several primitives' do. A
    Gaussian's exponent is off by 4 eps of the sum of the sizes of its terms, by the position of its centre and, in
    double, by its covariance; within that of the smallest alpha or of the flattest ellipse that is drawn, all of its
    alpha is in doubt.
    """
    center, axes = camera_space(s)
    there = drawn(s, center)
    rays = rays_of(s)
    tiny = 2.0**-53
    # By how many `tiny` the subtraction of the camera's position may move a centre.
    moved = s.center.abs().sum(-1) + s.pose[:, None, :3, 3].abs().sum(-1)
    alpha = -torch.expm1(-found.tau)
    if s.primitive == "gaussian":
        center = torch.where(there[..., None], center, torch.ones_like(center))
        size, size_off, flat = _exponent_rounding(s, center, axes, rays, moved, eps)
        # Alpha is monotone in the exponent, but for two jumps: nothing below the floor, nothing of a flat ellipse.
        off = torch.expm1((4 * eps + 64 * tiny) * size + size_off + 8 * eps).clamp(max=1e300)
        density = s.density.clamp(0, 1)[:, None]
        smooth = density * torch.exp(-_exponent(s, center, axes, rays))
        largest = (smooth * (1 + off)).clamp(max=GAUSSIAN_CAP).minimum(density)
        jumps = (smooth * (1 + off) >= GAUSSIAN_FLOOR) & (smooth / (1 + off) < GAUSSIAN_FLOOR) | flat[:, None]
        jump = torch.where(largest >= GAUSSIAN_FLOOR, largest, torch.zeros_like(largest))
        off = torch.where(jumps, jump, (alpha * off).clamp(max=1.0))
        return torch.where(there[:, None], off.nan_to_num(1.0, 1.0), alpha)
    exact = s.ray_model == "exact"
    extent = torch.where((s.extent > 0).all(-1, keepdim=True), s.extent, torch.ones_like(s.extent))
    s = replace(s, extent=extent)
    arms, _ = vertices(s)
    crosses = (center[..., 2] + arms[..., 2].amin(-1) < s.near[:, None]) if exact else torch.zeros_like(there)
    usable = there & (~crosses if exact else there)
    safe = torch.where(usable[..., None], center, torch.ones_like(center))
    at = safe[..., :2] / safe[..., 2:]
    reference = torch.round(at * s.focal[:, None] + s.middle[:, None] - 0.5)
    reference = torch.where(usable[..., None], reference, torch.floor(s.middle)[:, None].expand_as(reference)).clamp(
        -4e6, 4e6
    )
    base = (reference + 0.5 - s.middle[:, None]) / s.focal[:, None]
    base = torch.cat([base, torch.ones_like(base[..., :1])], -1)
    n = faces(s, axes)  # (B, M, F, 3)
    h, h_size, h_off = _divisors(s, n, center, safe)
    step = rays[:, :, None, :2] - base[:, None, :, :2]  # (B, R, M, 2)
    if exact:
        w0 = torch.where(usable, 1 / safe[..., 2], torch.zeros_like(safe[..., 2]))
        lead = (n * (base - w0[..., None] * center)[..., None, :]).sum(-1) - w0[..., None]
        terms = (n.abs() * (base.abs() + w0[..., None] * (center.abs() + moved[..., None]))[..., None, :]).sum(-1) + w0[
            ..., None
        ]
        gradient = n[..., :2]
        steep = gradient.abs()
    else:
        z, length = safe[..., 2], safe.norm(dim=-1)
        w0 = length
        direction = _direction(s, safe)
        gradient = z[..., None, None] * (n[..., :2] - direction[..., None, :2] * h[..., None])
        steep = z[..., None, None] * (n[..., :2].abs() + direction[..., None, :2].abs() * h_size[..., None])
        offset = base[..., :2] - at
        lead = (gradient * offset[..., None, :]).sum(-1) - 1
        terms = (steep * (base[..., :2].abs() + at.abs() * (1 + moved / z)[..., None])[..., None, :]).sum(-1) + 1
    kept = torch.where(h < 0, -1.0, 1.0) * torch.maximum(h.abs(), EDGE_ON * h_size)
    slide, run = ((g[:, None] * step[..., None, :]).abs().sum(-1) for g in (gradient, steep))  # (B, R, M, F)
    signed = lead[:, None] + (gradient[:, None] * step[..., None, :]).sum(-1)
    w, off = signed / h[:, None], (signed / kept[:, None] - signed / h[:, None]).abs()
    off = off + (2 * eps * (lead.abs()[:, None] + slide) + 16 * tiny * (terms[:, None] + run)) / kept.abs()[:, None]
    off = off + w.abs() * (h_off / kept.abs())[:, None]
    off, w = torch.nan_to_num(off, math.inf, math.inf), torch.nan_to_num(w, 0.0)
    inf = torch.full_like(w, math.inf)
    # Where rounding decides whether a face is of the front or the back, it may end the chord anywhere, or nowhere.
    unsure = (h.abs() <= h_off)[:, None].expand_as(w)
    off = torch.where(unsure, inf, off)
    front, back = (h < 0)[:, None].expand_as(w) | unsure, (h > 0)[:, None].expand_as(w) | unsure
    if exact:
        lowest, highest = (1 / FAR - w0)[:, None], (1 / s.near[:, None] - w0)[:, None]
    else:
        lowest, highest = -inf.amax(-1), inf.amax(-1)
    bounds, across = [], rays.norm(dim=-1)[:, :, None]
    for sign in (1, -1):  # the longest and the shortest chord
        w_in = torch.minimum(torch.where(front, w + sign * off, inf).amin(-1), highest)
        w_out = torch.maximum(torch.where(back, w - sign * off, -inf).amax(-1), lowest)
        if exact:
            i, o = (w_in + w0[:, None]), (w_out + w0[:, None])
            t_in, t_out = 1 / i.clamp(min=1 / FAR), 1 / o.clamp(min=1 / FAR)
            # (w_in - w_out) / (w_in w_out): the divisor has the inverse depth of the centre, rounded, in both factors.
            chord = across * (t_out - t_in) * (1 + sign * eps * w0[:, None] * (t_in + t_out))
        else:
            t_in, t_out = ((w0[:, None] - p).abs() / across for p in (w_in, w_out))
            chord = w_in - w_out
        if depths:
            # Of a chord that the reference does not see, too.
            reach = torch.where(found.hit, found.t_in.abs() + found.t_out.abs(), t_in + t_out)
            chord = chord + sign * 4 * eps * across * reach
        chord = torch.where(w_in > w_out, chord, torch.zeros_like(chord)).nan_to_num(0.0, 1e30)
        bounds.append(
            -torch.expm1(-s.density.clamp(0, LARGEST_DENSITY)[:, None] * chord.clamp(min=0) * (1 + sign * 8 * eps))
        )
    off_alpha = torch.maximum(bounds[0] - alpha, alpha - bounds[1]).clamp(min=0)
    return torch.where(there[:, None], off_alpha + 8 * eps * alpha, torch.zeros_like(alpha))
