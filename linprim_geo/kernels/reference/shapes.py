"""Ray-primitive intersections of the reference rasterizer: chords of polyhedra, exact or affine, and Gaussian splats.

The compiled kernels use planes in camera space and closed forms. Here a ray is transformed into the primitive's frame,
by matrices that torch inverts, and clipped by one half-space after another.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from linprim_geo.base.kinds import KINDS, Kind

FACE_SIGNS = tuple(itertools.product((1.0, -1.0), repeat=3))
"""The eight faces of |y0| + |y1| + |y2| <= 1, as the s of s . y <= 1."""

GAUSSIAN_CAP, GAUSSIAN_FLOOR = 0.99, 1 / 255
"""Largest alpha of a Gaussian, and the alpha under which it is skipped: those of 3D Gaussian splatting."""

GAUSSIAN_SINGULAR = 1e-12
"""A 2D covariance with det <= this * trace^2 has standard deviations in a ratio of 1e6 or more: a line."""


@dataclass(frozen=True)
class Chords:
    """The M intersections of pixel rays with primitives, by ascending primitive."""

    pixel: Tensor  # (M,) int64, index into the rays
    primitive: Tensor  # (M,) int64
    t_in: Tensor  # (M,) z-depth
    t_out: Tensor  # (M,) z-depth, > t_in; equal for a Gaussian, which absorbs at a single depth
    rate: Tensor  # (M,) optical thickness per unit of z-depth; infinite for a Gaussian
    tau: Tensor  # (M,) optical thickness
    normal: Tensor  # (3, M) camera frame, unit and outward; 0 where the ray enters through the near plane


@dataclass(frozen=True)
class _Solid:
    """A convex polyhedron about its centre: the y with faces . y <= room, where y = matrix^T x / scale and x is in
    camera axes."""

    matrix: Tensor  # (3, 3)
    scale: Tensor  # (3,)
    faces: Tensor  # (F, 3)
    room: Tensor  # (F,) > 0
    normals: Tensor  # (F, 3) unit and outward, matrix^T times those in camera axes
    vertices: Tensor  # (V, 3) relative to the centre, camera axes

    def local(self, vector: Tensor) -> Tensor:
        return torch.stack([_dot(vector, self.matrix[:, k]) for k in range(3)], -1) / self.scale


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the dot product over the last axis, rounded independently of the batch, so that a subset of rays gives the
    same bits."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _octahedron(rotation: Tensor, extent: Tensor) -> _Solid:
    """Return an octahedron in the frame where it is regular, which keeps precision for long and thin ones."""
    signs = rotation.new_tensor(FACE_SIGNS)
    outward = signs / extent
    outward = outward / outward.norm(dim=-1, keepdim=True)
    half = (rotation * extent).T
    return _Solid(rotation, extent, signs, torch.ones_like(signs[:, 0]), outward, torch.cat([half, -half]))


def _polyhedron(rotation: Tensor, extent: Tensor, kind: Kind) -> _Solid:
    """Return the convex hull of a kind's vertices; its faces are triangles."""
    directions = torch.from_numpy(kind.directions).to(rotation)
    vertices = extent[torch.from_numpy(kind.columns), None] * (directions @ rotation.T)
    size = extent.detach().max()  # keeps the squares of tiny edges from underflow
    normals, room = [], []
    for corners in kind.faces:
        a, b, c = (vertices[k] for k in corners)
        normal = torch.linalg.cross((b - a) / size, (c - a) / size)
        normal = normal / normal.norm()
        normals.append(normal)
        room.append(_dot(normal, a))
    faces = torch.stack(normals)
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    return _Solid(eye, torch.ones_like(vertices[0]), faces, torch.stack(room), faces, vertices)


@torch.no_grad()
def clip_to_faces(direction: Tensor, origin: Tensor, faces: Tensor, room: Tensor, start: float) -> tuple[Tensor, ...]:
    """Clip the half-lines y(t) = origin + t direction, t >= start, to the y with faces . y <= room.

    Each half-space t (n . direction) <= room - n . origin bounds t from above or below. Where n . direction is exactly
    zero, it either imposes no bound or excludes the whole line.

    Args:
        direction: (P, 3).
        origin: (3,) or (P, 3).
        faces: (F, 3).
        room: (F,).
        start: -inf for whole lines.

    Returns:
        t_in, t_out (P,): empty where t_out <= t_in; and the indices of their faces, (P,) each, -1 where t_in is
            `start`. If several faces are met at the same t, the first one is returned.
    """
    t_in = torch.full_like(direction[:, 0], start)
    t_out = torch.full_like(t_in, math.inf)
    entry = torch.full_like(t_in, -1, dtype=torch.long)
    leave = entry
    for face, normal in enumerate(faces):
        slope, left = _dot(direction, normal), room[face] - _dot(origin, normal)
        t = left / slope
        later, sooner = (slope < 0) & (t > t_in), (slope > 0) & (t < t_out)
        t_in, entry = torch.where(later, t, t_in), torch.where(later, face, entry)
        t_out, leave = torch.where(sooner, t, t_out), torch.where(sooner, face, leave)
        t_out = torch.where((slope == 0) & (left < 0), -math.inf, t_out)
    return t_in, t_out, entry, leave


def clip_to_octahedron(direction: Tensor, origin: Tensor, near: float) -> tuple[Tensor, ...]:
    """Clip half-lines to |y0| + |y1| + |y2| <= 1: `clip_to_faces` with faces FACE_SIGNS and room 1."""
    signs = direction.new_tensor(FACE_SIGNS)
    return clip_to_faces(direction, origin, signs, torch.ones_like(signs[:, 0]), near)


def ray_space_jacobian(center: Tensor) -> Tensor:
    """Return d(x/z, y/z, |(x, y, z)|) / d(x, y, z) at `center` (3,), a (3, 3) matrix of determinant |c| / z^3.

    Source: Zwicker et al., EWA Splatting (2002), the local affine approximation.
    """
    x, y, z = center.unbind()
    zero, length = torch.zeros_like(z), center.norm()
    rows = ((1 / z, zero, -x / z**2), (zero, 1 / z, -y / z**2), (x / length, y / length, z / length))
    return torch.stack([torch.stack(row) for row in rows])


def view_limits(size: tuple[int, int], focal: tuple[float, float], principal: tuple[float, float]) -> Tensor:
    """Return (2, 2) the smallest and largest x/z and y/z of the image extended by 0.15 of its size on each side,
    float64, clamped to 1e4. `size`, `focal` and `principal` are in px."""
    width, scale, middle = (torch.tensor(x, dtype=torch.float64) for x in (size, focal, principal))
    return torch.stack([(-0.15 * width - middle) / scale, (1.15 * width - middle) / scale]).clamp(-1e4, 1e4)


def held_in_view(center: Tensor, limits: Tensor) -> Tensor:
    """Return the position at which J is evaluated for `center` (3,): the centre with x/z and y/z clamped to `limits` of
    `view_limits`.

    Farther out, J grows without bound. Source: Kerbl et al., 3D Gaussian Splatting (2023), 1.3 times half the field of
    view.
    """
    low, high = limits.to(center)
    held = torch.minimum(torch.maximum(center[:2] / center[2], low), high) * center[2]
    return torch.cat([held, center[2:]])


def _screen_scale(corners: Tensor, focal: Tensor, screen_filter: float) -> Tensor:
    """Return (2,) h / (h + screen_filter / 2), with h the half width and height in px of `corners` (V, 2), x/z and
    y/z."""
    half = focal * (corners.amax(0) - corners.amin(0)) / 2
    return half / (half + screen_filter / 2)


def _local_lines(
    rays: Tensor, solid: _Solid, center: Tensor, scale: Tensor | None, inverse: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the origin and direction of each ray in the polyhedron's frame, after scaling rays towards the centre by
    `scale`.

    inverse: of `ray_space_jacobian` for affine rays, whose parameter is a distance; None for exact ones, whose
    parameter is a z-depth.
    """
    if scale is not None:
        middle = center[:2] / center[2]
        rays = torch.cat([middle + scale * (rays[:, :2] - middle), rays[:, 2:]], -1)
    if inverse is None:
        return -solid.local(center), solid.local(rays)
    offset = torch.cat([rays[:, :2] - center[:2] / center[2], -center.norm().expand(len(rays), 1)], -1)
    origin = torch.stack([_dot(offset, row) for row in inverse], -1)
    return solid.local(origin), solid.local(inverse[:, 2].expand(len(rays), 3))


def polyhedron_chords(
    center: Tensor,
    rotation: Tensor,
    extent: Tensor,
    density: Tensor,
    rays: Tensor,
    *,
    primitive: str,
    ray_model: str,
    screen_filter: float,
    focal: tuple[float, float],
    limits: Tensor,
    near: float,
) -> Chords:
    """Return the chords of all rays in all octahedra or tetrahedra.

    exact: x = t v, t >= near, is intersected directly. affine: ray-space points are (x/z, y/z, |c|) + J (p - c), so the
    ray of a pixel is the line p(s) = c + J^-1 ((X, Y, s) - (x/z, y/z, |c|)) and t = s / |v|, with J at `held_in_view`;
    there is no near plane, but a primitive with z <= near is left out. screen_filter: the ray is first scaled towards
    the centre, by s_x and s_y, and the density multiplied by s_x s_y; |v| is unchanged.

    Args:
        center: (N, 3), camera frame.
        rotation: (N, 3, 3), primitive to camera.
        extent: (N, 3) half-axes > 0, or (N, 4) vertex distances; a tetrahedron with one <= 0 is left out.
        density: (N,).
        rays: (P, 3), v = (X, Y, 1).
        screen_filter: px, 0 for none. Not applied to an exact primitive with a vertex at z <= near.
        focal: fx, fy in px.
        limits: of `view_limits`.

    Gradient:
        Finite: a face parallel to a ray bounds nothing, so there is no division by zero.
    """
    ray_length = rays.norm(dim=-1)
    pixel_scale = rays.new_tensor(focal)
    parts = []
    for i in range(len(center)):
        affine = ray_model == "affine"
        if affine and not center[i, 2] > near or not bool((extent[i] > 0).all()):
            continue
        if primitive == "octahedron":
            solid = _octahedron(rotation[i], extent[i])
        else:
            solid = _polyhedron(rotation[i], extent[i], KINDS[primitive])
        jacobian = ray_space_jacobian(held_in_view(center[i], limits)) if affine else None
        inverse = torch.linalg.inv(jacobian) if affine else None
        sigma, scale = density[i], None
        corners = solid.vertices + center[i]
        if screen_filter > 0 and (affine or bool((corners[:, 2] > near).all())):
            corners = solid.vertices @ jacobian[:2].T if jacobian is not None else corners[:, :2] / corners[:, 2:]
            scale = _screen_scale(corners, pixel_scale, screen_filter)
            sigma = sigma * scale[0] * scale[1]

        # The pixels hit and the faces of entry and exit are constant under small changes, so they need no gradient.
        with torch.no_grad():
            origin, direction = _local_lines(rays, solid, center[i], scale, inverse)
            start = -math.inf if affine else near
            t_in, t_out, entry, leave = clip_to_faces(direction, origin, solid.faces, solid.room, start)
            hit = (t_out > t_in).nonzero()[:, 0]
            entry, leave = entry[hit], leave[hit]

        # Both ends again as functions of the parameters, only for the rays that hit.
        origin, direction = _local_lines(rays[hit], solid, center[i], scale, inverse)
        length = ray_length[hit]
        at_near = entry < 0
        face = solid.faces[entry.clamp(min=0)]
        slope = torch.where(at_near, torch.ones_like(length), _dot(direction, face))
        t_in = torch.where(at_near, start, (solid.room[entry.clamp(min=0)] - _dot(origin, face)) / slope)
        face = solid.faces[leave]
        t_out = (solid.room[leave] - _dot(origin, face)) / _dot(direction, face)
        if affine:
            t_in, t_out = t_in / length, t_out / length
        rate = sigma * length
        outward = solid.normals[entry.clamp(min=0)] @ solid.matrix.T
        outward = torch.where(at_near[:, None], torch.zeros_like(outward), outward).T
        parts.append((hit, torch.full_like(hit, i), t_in, t_out, rate, rate * (t_out - t_in), outward))
    return _joined(parts, center)


def gaussian_chords(
    center: Tensor,
    rotation: Tensor,
    extent: Tensor,
    opacity: Tensor,
    rays: Tensor,
    *,
    screen_filter: float,
    focal: tuple[float, float],
    limits: Tensor,
    near: float,
) -> Chords:
    """Return the splats of all rays in all Gaussians, as chords of zero length at the depth of the centre.

    M = J2 S J2^T + screen_filter I, S = A A^T the covariance in camera axes, J2 the first two rows of
    `ray_space_jacobian` in px, evaluated at `held_in_view`; alpha = min(0.99, opacity exp(-1/2 d^T M^-1 d)), d from the
    projected centre to the pixel, skipped below 1/255; tau = -ln(1 - alpha). The normal is the axis of the smallest
    extent (the first of equal ones), turned towards the camera. Left out: z <= near, and det M <= 1e-12 trace(M)^2.

    Args:
        extent: (N, 3) standard deviations >= 0; the rest as for `polyhedron_chords`.
        opacity: (N,), peak opacity.
        screen_filter: px^2, added to the variances; 0.3 in the source.

    Accuracy:
        M and alpha are double for every dtype, so that the test of det gives the same result everywhere.

    Source: Kerbl et al., 3D Gaussian Splatting (2023).
    """
    pixel_scale = rays.new_tensor(focal).double()
    parts = []
    for i in range(len(center)):
        c = center[i].double()
        if not c[2] > near:
            continue
        half = (
            pixel_scale[:, None] * ray_space_jacobian(held_in_view(c, limits))[:2] @ (rotation[i] * extent[i]).double()
        )
        # det of half half^T by Cauchy-Binet: the squared area between its rows, without cancellation.
        area = torch.linalg.cross(half[0], half[1])
        xx, xy, yy = (half[0] ** 2).sum(), (half[0] * half[1]).sum(), (half[1] ** 2).sum()
        det = (area**2).sum() + screen_filter * (xx + yy + screen_filter)
        xx, yy = xx + screen_filter, yy + screen_filter
        if not det > GAUSSIAN_SINGULAR * (xx + yy) ** 2:
            continue

        def alpha_of(rays: Tensor, c=c, xx=xx, xy=xy, yy=yy, det=det, peak=opacity[i]) -> Tensor:
            dx, dy = ((rays[:, :2].double() - c[:2] / c[2]) * pixel_scale).unbind(-1)
            power = -0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det
            return (peak * torch.exp(power)).clamp(max=GAUSSIAN_CAP)

        hit = (alpha_of(rays).detach() >= GAUSSIAN_FLOOR).nonzero()[:, 0]
        tau = -torch.log1p(-alpha_of(rays[hit])).to(center.dtype)
        axis = rotation[i][:, int(torch.argmin(extent[i]))]
        axis = torch.where((axis * center[i]).sum() > 0, -axis, axis)
        depth = center[i, 2].expand_as(tau)
        point = torch.full_like(tau, math.inf)
        normal = axis[:, None].expand(3, len(hit))
        parts.append((hit, torch.full_like(hit, i), depth, depth, point, tau, normal))
    return _joined(parts, center)


def _joined(parts: Sequence[tuple[Tensor, ...]], like: Tensor) -> Chords:
    if not parts:
        none = like.new_zeros(0)
        index = none.long()
        return Chords(index, index, none, none, none, none, like.new_zeros(3, 0))
    return Chords(*[torch.cat(columns, -1) for columns in zip(*parts, strict=True)])
