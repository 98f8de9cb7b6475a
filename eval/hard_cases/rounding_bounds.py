"""Bounds of the rounding errors of a kernel variant on the scenes of `many_scenes`: images, depths and gradients."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from linprim_geo.eval.hard_cases.many_scenes import (
    EDGE_ON,
    FAR,
    GAUSSIAN_CAP,
    GAUSSIAN_FLOOR,
    GAUSSIAN_SINGULAR,
    LARGEST_DENSITY,
    PARAMETERS,
    TILE,
    Chords,
    Scenes,
    camera_space,
    dot,
    drawn,
    faces,
    gaussian_ellipse,
    rays_of,
    vertices,
    view_limits,
)


@torch.no_grad()
def _distances(
    s: Scenes, center: Tensor, place: Tensor, rays: Tensor, moved: Tensor, eps: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return |dx| and |dy| (B, R, M) of pixels from projected centres, px, and bounds of their errors (B, R, 2, M)."""
    tiny = 2.0**-53
    d = (rays[:, :, None, :2] - place[:, None]) * s.focal[:, None, None]
    dx, dy = d[..., 0].abs(), d[..., 1].abs()
    shift = (
        s.focal[:, None, :, None] * (place.abs() + (place.abs() + 1) * (moved / center[..., 2])[..., None]).mT[:, None]
    )
    return dx, dy, eps * (torch.stack([dx, dy], 2) + 1) + 8 * tiny * (shift + s.middle.abs()[:, None, :, None])


def _exponent(s: Scenes, center: Tensor, axes: Tensor, rays: Tensor) -> Tensor:
    """Return (B, R, M) d^T M^-1 d / 2, the negated exponent of a Gaussian at offset d with covariance M."""
    (half_x, half_y), (_, _, _, det, place) = gaussian_ellipse(s, center, axes)
    d = (rays[:, :, None, :2] - place[:, None]) * s.focal[:, None, None]
    across = half_y[:, None] * d[..., :1] - half_x[:, None] * d[..., 1:]
    return 0.5 * dot(across, across) / torch.where(det > 0, det, torch.ones_like(det))[:, None]


def _covariance_rounding(
    s: Scenes, center: Tensor, axes: Tensor, moved: Tensor
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Return error bounds of the entries xx, xy, yy and of the determinant of a projected covariance, (B, M) each, in
    double precision.

    A row of H is (axis_x - u axis_z) extent focal / z. Each factor is accurate to a few 2^-53, and u to 2^-53 moved /
    z, which gives 8 * 2^-53 of the sizes of its terms. The other bounds follow by the product rule, that of the
    determinant from the cross product of the rows.
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
    entries = 2 * dot(x, of_x), dot(x, of_y) + dot(y, of_x), 2 * dot(y, of_y)
    return entries, dot(2 * across + of_across, of_across)


def _exponent_rounding(
    s: Scenes, center: Tensor, axes: Tensor, rays: Tensor, moved: Tensor, eps: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return for a Gaussian's exponent: the sum of the absolute values of its terms, and a bound of its error beyond
    their rounding, (B, R, M) each; and whether rounding decides if the ellipse is flat, (B, M) bool."""
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
    # The entries of a needle's covariance cancel in the exponent; their errors do not.
    size_off = size_off + 0.5 * (off_yy * dx * dx + 2 * off_xy * dx * dy + off_xx * dy * dy) + size * det_off
    return size, size_off, flat


def gaussian_gradient_rounding(s: Scenes, found: Chords, off: Tensor, pull: Tensor, eps: float) -> list[Tensor]:
    """Return a bound (B,) of the gradient's error, for each of PARAMETERS but the colours, of scenes of Gaussians.

    off: error bound of alpha, from `rounding`; pull (B, R, M): absolute gradient to a ray's light, times the colour.
    The kernel sums g d d^T and g d over the pixels, where g is the gradient to the exponent, and gets the gradient to
    the covariance M as Q S Q / 2 with Q = M^-1 and S the first sum. In absolute values

        |g|  <=  pull alpha / (1 - alpha), as the gradient to alpha is that to tau over 1 - alpha
        dg   <=  |g| (off / alpha + sum of the others' off / (1 - alpha) + (16 + 4 primitives) eps)
        dS   <=  sum (dg d d^T + |g| (d shift^T + shift d^T + shift shift^T)), shift as in `rounding`
        dM   <=  |Q| dS |Q| / 2 + dQ S |Q|, where dQ follows from M's entries and determinant, in double precision

    From M and the projected centre, errors propagate to the parameters by the absolute values of their derivatives. For
    an ellipse k times longer than wide |Q| |S| |Q| is k^2 times |Q S Q|: this is the condition of the gradient.
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
            """Return the symmetric part of A M B for symmetric A, M, B, each (xx, xy, yy)."""
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
    """Return (B, M, 3) the unit direction assumed for affine rays: that of the centre, within `view_limits`."""
    at = center[..., :2] / center[..., 2:]
    held = torch.minimum(torch.maximum(at, view_limits(s)[0]), view_limits(s)[1])
    direction = torch.cat([held, torch.ones_like(held[..., :1])], -1)
    return direction / direction.norm(dim=-1, keepdim=True)


def _divisors(s: Scenes, normals: Tensor, center: Tensor, safe: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return (B, M, F) the divisor h of a face's plane over the pixels, 0 for a face seen edge-on; the sum of the
    absolute values of its terms; and its error bound, in double precision. `safe`: the centres, with those not in front
    of the camera replaced."""
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
    """Return (B,) the relative error of what entries and exits contribute to the gradient of a scene of polyhedra,
    beyond the rounding of sums.

    A plane over the pixels and its derivatives are divided by h and h^2, whose errors `_divisors` bounds. Moments of
    the gradient are summed about a corner of a tile and then moved to the primitive, which costs 16 px, the width of a
    tile, times eps, relative to the primitive's width in pixels.
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


def _gaussian_rounding(
    s: Scenes, there: Tensor, center: Tensor, axes: Tensor, moved: Tensor, alpha: Tensor, eps: float
) -> Tensor:
    """Compute `rounding` of Gaussians. `there` (B, M): which are drawn; `moved` (B, M): by how many units of double
    precision the camera's position may shift a centre."""
    rays, center = rays_of(s), torch.where(there[..., None], center, torch.ones_like(center))
    size, size_off, flat = _exponent_rounding(s, center, axes, rays, moved, eps)
    # Alpha is monotone in the exponent except for two jumps: to 0 below the floor, and to 0 for a flat ellipse.
    off = torch.expm1((4 * eps + 64 * 2.0**-53) * size + size_off + 8 * eps).clamp(max=1e300)
    density = s.density.clamp(0, 1)[:, None]
    smooth = density * torch.exp(-_exponent(s, center, axes, rays))
    largest = (smooth * (1 + off)).clamp(max=GAUSSIAN_CAP).minimum(density)
    jumps = (smooth * (1 + off) >= GAUSSIAN_FLOOR) & (smooth / (1 + off) < GAUSSIAN_FLOOR) | flat[:, None]
    jump = torch.where(largest >= GAUSSIAN_FLOOR, largest, torch.zeros_like(largest))
    off = torch.where(jumps, jump, (alpha * off).clamp(max=1.0))
    return torch.where(there[:, None], off.nan_to_num(1.0, 1.0), alpha)


def _pixel_at(s: Scenes, at: Tensor, usable: Tensor) -> Tensor:
    """Return (B, M, 3) the direction, of depth 1, through the centre of the pixel nearest to `at`, the origin of the
    planes' offsets; the pixel at the principal point for primitives that are not `usable`."""
    reference = torch.round(at * s.focal[:, None] + s.middle[:, None] - 0.5)
    middle = torch.floor(s.middle)[:, None].expand_as(reference)
    reference = torch.where(usable[..., None], reference, middle).clamp(-4e6, 4e6)
    base = (reference + 0.5 - s.middle[:, None]) / s.focal[:, None]
    return torch.cat([base, torch.ones_like(base[..., :1])], -1)


def rounding(s: Scenes, found: Chords, eps: float, depths: bool = False) -> Tensor:
    """Return a bound (B, R, M) of the error of each alpha, for planes evaluated with unit roundoff `eps` / 2.

    A face is w = a + b dx + c dy over the pixels, where dx and dy are offsets from the pixel nearest to the projected
    centre, and w is the inverse depth minus that of the centre (affine rays: the centre's distance minus the distance).
    Rounded coefficients and two operations give w an error of 2 eps (|a| + |b dx| + |c dy|), and the set-up in double
    precision one of 16 * 2^-53 of its terms. A face within EDGE_ON of edge-on is moved to it. Entry and exit, being a
    minimum and a maximum, have no larger errors, and alpha is monotone in both: the bound is its range over them. With
    `depths` the chord is the difference of two depths, each accurate to 4 eps, as in the order "overlap", where the
    segments end at entries and exits of several primitives. A Gaussian's exponent has an error of 4 eps of the sum of
    its absolute terms, plus that of the position of its centre and, in double precision, of its covariance. Where this
    reaches the smallest alpha or the flattest ellipse that is drawn, the error may be all of alpha.
    """
    center, axes = camera_space(s)
    there = drawn(s, center)
    rays = rays_of(s)
    tiny = 2.0**-53
    # By how many `tiny` the subtraction of the camera's position may shift a centre.
    moved = s.center.abs().sum(-1) + s.pose[:, None, :3, 3].abs().sum(-1)
    alpha = -torch.expm1(-found.tau)
    if s.primitive == "gaussian":
        return _gaussian_rounding(s, there, center, axes, moved, alpha, eps)
    exact = s.ray_model == "exact"
    extent = torch.where((s.extent > 0).all(-1, keepdim=True), s.extent, torch.ones_like(s.extent))
    s = replace(s, extent=extent)
    arms, _ = vertices(s)
    crosses = (center[..., 2] + arms[..., 2].amin(-1) < s.near[:, None]) if exact else torch.zeros_like(there)
    usable = there & (~crosses if exact else there)
    safe = torch.where(usable[..., None], center, torch.ones_like(center))
    at = safe[..., :2] / safe[..., 2:]
    base = _pixel_at(s, at, usable)
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
    # Where rounding decides whether a face is on the front or the back, it may end the chord anywhere, or nowhere.
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
            # (w_in - w_out) / (w_in w_out): both factors of the divisor hold the rounded inverse depth of the centre.
            chord = across * (t_out - t_in) * (1 + sign * eps * w0[:, None] * (t_in + t_out))
        else:
            t_in, t_out = ((w0[:, None] - p).abs() / across for p in (w_in, w_out))
            chord = w_in - w_out
        if depths:
            # Also for chords that the reference does not have.
            reach = torch.where(found.hit, found.t_in.abs() + found.t_out.abs(), t_in + t_out)
            chord = chord + sign * 4 * eps * across * reach
        chord = torch.where(w_in > w_out, chord, torch.zeros_like(chord)).nan_to_num(0.0, 1e30)
        bounds.append(
            -torch.expm1(-s.density.clamp(0, LARGEST_DENSITY)[:, None] * chord.clamp(min=0) * (1 + sign * 8 * eps))
        )
    off_alpha = torch.maximum(bounds[0] - alpha, alpha - bounds[1]).clamp(min=0)
    return torch.where(there[:, None], off_alpha + 8 * eps * alpha, torch.zeros_like(alpha))
