"""The float64 reference in torch, compared with closed forms, a program over triangles, and sampling."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from helpers.reference_scenes import (
    C0,
    EXACT,
    IDENTITY,
    IMAGES,
    LENGTHS,
    assert_same,
    axis_camera,
    octahedra,
    random_scene,
    tensor,
)

from linprim_geo.kernels.reference import rasterize as reference
from linprim_geo.kernels.reference.rasterize import quadrature_transmittance, rasterize

pytestmark = pytest.mark.usefixtures("one_thread")


# --- an independent program: one pixel, one primitive, one triangle at a time ---


def triangle_interval(center, rotation, extent, ray, near):
    """Depths where a ray from the origin meets the eight triangles (Moeller-Trumbore), clipped to t >= near,
    and the outward normal of the triangle it enters through (0 if the near plane)."""
    hits = []
    for sx in (1, -1):
        for sy in (1, -1):
            for sz in (1, -1):
                p, q, r = (center + sign * extent[k] * rotation[:, k] for k, sign in enumerate((sx, sy, sz)))
                e1, e2 = q - p, r - p
                h = np.cross(ray, e2)
                det = e1 @ h
                if det == 0:
                    continue
                u = (-p @ h) / det
                k = np.cross(-p, e1)
                v = (ray @ k) / det
                if u >= 0 and v >= 0 and u + v <= 1:
                    outward = np.cross(e1, e2)
                    outward *= np.sign(outward @ (p - center)) / np.linalg.norm(outward)
                    hits.append(((e2 @ k) / det, outward))
    if not hits:
        return math.inf, -math.inf, np.zeros(3)
    (t_in, outward), (t_out, _) = min(hits, key=lambda x: x[0]), max(hits, key=lambda x: x[0])
    return (t_in, t_out, outward) if t_in > near else (near, t_out, np.zeros(3))


def literal_render(parameters, camera, near=0.01, stop=1e-3, level=0.5):
    """Every output of `rasterize` by its definition, in numpy scalars."""
    center, quaternion, extent, density, sh, background = (p.detach().numpy() for p in parameters)
    pose = camera["world_to_camera"].numpy()
    turn, shift, height, width = pose[:3, :3], pose[:3, 3], camera["height"], camera["width"]
    color = reference.primitive_color(parameters[0], parameters[4], tensor(-turn.T @ shift)).numpy()
    center = center @ turn.T + shift
    rotation = turn @ reference.rotation_matrix(tensor(quaternion)).numpy()
    out = {
        name: np.zeros((3, height, width) if name in ("rgb", "normal", "normal_median") else (height, width))
        for name in IMAGES
    }
    out |= {"max_weight": np.zeros(len(center)), "pixels": np.zeros(len(center), dtype=np.int64)}
    for i in range(height):
        for j in range(width):
            ray = np.array([(j + 0.5 - camera["cx"]) / camera["fx"], (i + 0.5 - camera["cy"]) / camera["fy"], 1.0])
            transmittance, terms = 1.0, []
            for n in sorted(range(len(center)), key=lambda n: (center[n, 2], n)):
                t_in, t_out, outward = triangle_interval(center[n], rotation[n], extent[n], ray, near)
                if t_out <= t_in or transmittance < stop:
                    continue
                if not terms:
                    out["depth_first"][i, j] = t_in
                rate = density[n] * np.linalg.norm(ray)
                after = transmittance * math.exp(-rate * (t_out - t_in))
                weight = transmittance - after
                # Mean depth of the absorbed light: integral of t T rate dt, in closed form, over the weight.
                mean = (t_in + 1 / rate) - (t_out - t_in) * after / weight
                if transmittance > level >= after:
                    out["depth_median"][i, j] = t_in + math.log(transmittance / level) / rate
                    out["normal_median"][:, i, j] = outward
                out["rgb"][:, i, j] += weight * color[n]
                out["normal"][:, i, j] += weight * outward
                out["depth_expected"][i, j] += weight * mean
                out["max_weight"][n] = max(out["max_weight"][n], weight)
                out["pixels"][n] += 1
                terms.append((weight, mean))
                transmittance = after
            out["rgb"][:, i, j] += transmittance * background
            out["opacity"][i, j] = 1 - transmittance
            out["distortion"][i, j] = 0.5 * sum(a * b * (y - z) ** 2 for a, y in terms for b, z in terms)
    return {name: torch.from_numpy(value) for name, value in out.items()}


@pytest.mark.parametrize(
    "seed,more",
    [
        (0, {}),
        (1, {"depth": 0.8}),  # camera inside some, others cross the near plane or lie behind
        (2, {"near": 2.5, "level": 0.8}),
        (3, {"stop": 0.3, "level": 0.4}),
    ],
)
def test_reference_agrees_with_a_scalar_program_over_triangles(seed, more):
    parameters, camera = random_scene(seed, 12, 9, width=11, height=8, **more)
    definition = {name: camera[name] for name in ("near", "stop", "level") if name in camera}
    result = rasterize(*parameters, **camera)
    expected = literal_render(parameters, camera, **definition)
    assert (expected["pixels"] > 0).sum() >= 6 and (expected["depth_median"] > 0).sum() >= 10
    assert_same(result, expected, rtol=1e-9, atol=1e-11)  # the triangles' own rounding, near grazing rays


@pytest.mark.parametrize("depth", [3.0, 0.3])
def test_thickness_agrees_with_sampled_density(depth):
    parameters, camera = random_scene(4, 6, 1, depth=depth)
    near, far, samples = 0.05, 9.0, 20_000
    result = rasterize(*parameters, **camera, near=near, stop=0.0)
    assert result["opacity"].max() > 0.5
    intrinsics = [camera[k] for k in ("width", "height", "fx", "fy", "cx", "cy")]
    rays = reference.pixel_rays(*intrinsics, parameters[0])
    turn, shift = camera["world_to_camera"][:3, :3], camera["world_to_camera"][:3, 3]
    t = tensor([[near, far]]).expand(len(rays), 2)
    sampled = quadrature_transmittance(*parameters[:4], (-turn.T @ shift).expand(len(rays), 3), rays @ turn, t, samples)
    bound = parameters[3].sum() * rays.norm(dim=1) * (far - near) / samples
    error = (torch.log(sampled) - torch.log(1 - result["opacity"].reshape(-1))).abs()
    assert (error <= bound).all()


def test_depths_agree_with_sampled_transmittance_without_overlap():
    # Three in a row with gaps, so that blending by centre is blending by depth.
    parameters = octahedra(
        [[0.1, 0, 2], [0, -0.1, 4], [0.1, 0.1, 6]],
        [[0.9, 0.8, 0.7]] * 3,
        [0.5, 0.4, 0.6],
        rotation=[[1, 0.2, 0.1, 0.3], [0.3, 1, 0.2, 0], [0.1, 0.4, 1, 0.2]],
    )
    camera = axis_camera(3, 3, 20.0)
    result = rasterize(*parameters, **camera, stop=0.0)
    rays = reference.pixel_rays(3, 3, 20.0, 20.0, 1.5, 1.5, parameters[0])
    steps = 350
    edges = torch.linspace(0, 7, steps + 1, dtype=torch.float64)
    for p, ray in enumerate(rays):
        t = torch.stack([torch.zeros_like(edges), edges], -1)
        left = quadrature_transmittance(
            *parameters[:4], torch.zeros(steps + 1, 3, dtype=torch.float64), ray.expand(steps + 1, 3), t, 2000
        )
        expected = (torch.diff(-left) * (edges[1:] + edges[:-1]) / 2).sum()
        median = edges[int((left <= 0.5).nonzero()[0])]
        assert abs(result["depth_expected"].reshape(-1)[p] - expected) < 5e-3
        assert 0 <= median - result["depth_median"].reshape(-1)[p] < 0.025  # a step of 0.02, and the sampling


# --- closed forms ---


def test_octahedron_on_the_axis_agrees_with_the_closed_form():
    result = rasterize(*octahedra([[0, 0, 5]], [[1.0, 1.0, 0.7]], [0.9], background=(0.2, 0.2, 0.2)), **axis_camera())
    tau, t_in = 0.9 * 2 * 0.7, 5 - 0.7
    alpha = 1 - math.exp(-tau)
    assert result["opacity"][4, 4].item() == pytest.approx(alpha, rel=1e-14)
    assert result["rgb"][0, 4, 4].item() == pytest.approx(alpha + (1 - alpha) * 0.2, rel=1e-14)
    assert result["depth_first"][4, 4].item() == pytest.approx(t_in, rel=1e-14)
    assert result["depth_median"][4, 4].item() == pytest.approx(t_in + math.log(2) / 0.9, rel=1e-14)
    mean = t_in + 1 / 0.9 - 1.4 * math.exp(-tau) / alpha
    assert result["depth_expected"][4, 4].item() == pytest.approx(alpha * mean, rel=1e-13)
    assert result["max_weight"].item() == pytest.approx(alpha, rel=1e-14)
    assert result["distortion"].abs().max() < 1e-15  # one primitive is no spread
    assert result["opacity"][4, 0] == 0 and result["pixels"].item() == (result["opacity"] > 0).sum()
    for name in ("rgb", "opacity", "depth_expected", "depth_median", "depth_first"):
        image = result[name]
        for mirrored in (image.flip(-1), image.flip(-2), image.transpose(-1, -2)):
            torch.testing.assert_close(image, mirrored, **EXACT)


def test_entry_normals_are_those_of_faces():
    result = rasterize(*octahedra([[0, 0, 5]], [[1.0, 0.8, 0.7]], [20.0]), **axis_camera(8, 8))
    rows, columns = (result["depth_median"] > 0).nonzero(as_tuple=True)
    assert len(rows) >= 4
    # The quadrant that a ray passes is its entry face.
    sx, sy = torch.sign(columns + 0.5 - 4), torch.sign(rows + 0.5 - 4)
    normal = torch.stack([sx / 1.0, sy / 0.8, torch.full_like(sx, -1 / 0.7, dtype=torch.float64)])
    normal = normal / normal.norm(dim=0)
    torch.testing.assert_close(result["normal_median"][:, rows, columns], normal, **EXACT)
    torch.testing.assert_close(result["normal"], result["normal_median"] * result["opacity"], **EXACT)


def test_two_primitives_on_the_axis_agree_with_the_closed_form():
    parameters = octahedra([[0, 0, 8], [0, 0, 4]], [[1, 1, 1], [1, 1, 0.5]], [0.6, 0.5], color=[0.3, 0.9])
    pixel = {
        name: value[..., 4, 4] for name, value in rasterize(*parameters, **axis_camera()).items() if value.ndim > 1
    }
    front, back = 1 - math.exp(-0.5), math.exp(-0.5) * (1 - math.exp(-1.2))
    z = [3.5 + 2 - math.exp(-0.5) / front, 7 + 1 / 0.6 - 2 * math.exp(-1.2) / (1 - math.exp(-1.2))]
    assert pixel["rgb"][1].item() == pytest.approx(front * 0.9 + back * 0.3, rel=1e-13)
    assert pixel["depth_expected"].item() == pytest.approx(front * z[0] + back * z[1], rel=1e-13)
    assert pixel["depth_median"].item() == pytest.approx(7 + (math.log(2) - 0.5) / 0.6, rel=1e-13)
    assert pixel["distortion"].item() == pytest.approx(front * back * (z[0] - z[1]) ** 2, rel=1e-12)


def test_distortion_is_accurate_at_large_depths():
    # Two in touch at a depth of 1e5: M2 - M1^2 of plain depths would be rounded to multiples of 1e-6.
    near_by, far_off = (
        rasterize(*octahedra([[0, 0, z], [0, 0, z + 2]], [[1, 1, 1]] * 2, [0.6, 0.6]), **axis_camera(1, 1))
        for z in (4.0, 1e5)
    )
    assert far_off["distortion"].item() == pytest.approx(near_by["distortion"].item(), abs=1e-9)


def test_camera_inside_a_primitive():
    result = rasterize(*octahedra([[0, 0, 0.2]], [[1, 1, 1]], [0.8]), **axis_camera(near=0.1))
    assert (result["opacity"] > 0).all() and result["pixels"].item() == 81
    assert result["opacity"][4, 4].item() == pytest.approx(1 - math.exp(-0.8 * (1.2 - 0.1)), rel=1e-14)
    assert (result["depth_first"] == 0.1).all()
    assert (result["normal"] == 0).all() and (result["normal_median"] == 0).all()


def test_primitives_are_cut_by_the_near_plane():
    # The near plane cuts the body on the axis; rays further out still enter through a face and have a normal.
    result = rasterize(*octahedra([[0, 0, 2]], [[1, 1, 1]], [0.8]), **axis_camera(near=1.25))
    assert result["depth_first"][4, 4].item() == 1.25
    assert result["opacity"][4, 4].item() == pytest.approx(1 - math.exp(-0.8 * (3 - 1.25)), rel=1e-14)
    assert (result["normal"][:, 4, 4] == 0).all()
    entered = result["depth_first"] > 1.25
    assert entered.any() and (result["normal"][2][entered] < 0).all()


def test_primitives_behind_the_camera_have_no_effect():
    parameters, camera = random_scene(5, 5, 4)
    behind, _ = random_scene(6, 3, 4)
    turn, shift = camera["world_to_camera"][:3, :3], camera["world_to_camera"][:3, 3]
    behind[0] = (tensor([[0.1, 0.2, -2.0], [1.0, 0.0, -1.5], [0.0, 0.0, -1.2]]) - shift) @ turn
    both = [torch.cat([b, a]).requires_grad_() for a, b in zip(parameters[:5], behind[:5], strict=True)]
    result = rasterize(*both, parameters[5], **camera)
    alone = rasterize(*parameters, **camera)
    assert_same(result, alone, IMAGES, rtol=0, atol=0)
    assert (result["pixels"][:3] == 0).all() and (result["max_weight"][:3] == 0).all()
    total = sum(result[name].sum() for name in IMAGES)
    for grad in torch.autograd.grad(total, both):
        assert (grad[:3] == 0).all() and (grad[3:] != 0).any()


def test_primitives_with_centre_behind_the_camera_are_drawn():
    parameters = octahedra([[0, 0, -0.5], [0, 0, 1]], [[1, 1, 1], [1, 1, 0.5]], [0.8, 0.4], color=[0.2, 0.8])
    pixel = rasterize(*parameters, **axis_camera())["rgb"][0, 4, 4].item()
    first = 1 - math.exp(-0.8 * (0.5 - 0.01))
    assert pixel == pytest.approx(0.2 * first + 0.8 * (1 - first) * (1 - math.exp(-0.4)), rel=1e-13)


def test_rays_parallel_to_faces():
    # v = (1, 0, 1): both faces with s = (1, ., -1) are parallel to the ray, with a slope of exactly zero.
    camera = dict(world_to_camera=torch.eye(4), fx=1.0, fy=1.0, cx=-0.5, cy=0.5, width=1, height=1)

    def result(x):
        return rasterize(*octahedra([[2 + x, 0, 2]], [[1, 1, 1]], [1.0]), **camera)

    inside, outside = result(0.5), result(-1.25)
    # |t - 2 - x| + |t - 2| <= 1 is |2 t - 4 - x| <= 1 while |x| <= 1.
    assert inside["opacity"].item() == pytest.approx(1 - math.exp(-math.sqrt(2)), rel=1e-14)
    assert inside["depth_first"].item() == pytest.approx(2 + 0.25 - 0.5, rel=1e-14)
    assert outside["opacity"].item() == 0 and outside["pixels"].item() == 0


def test_ties_are_ordered_by_index():
    parameters = octahedra([[0, 0, 5], [0, 0, 5], [0, 0, 4.9]], [[1, 1, 1]] * 3, [0.5] * 3, color=[0.1, 0.5, 0.9])
    pixel = rasterize(*parameters, **axis_camera())["rgb"][0, 4, 4].item()
    left = math.exp(-1.0)
    assert pixel == pytest.approx((1 - left) * (0.9 + left * 0.1 + left**2 * 0.5), rel=1e-13)


def test_stop_ends_rays_by_transmittance():
    tau = math.log(100)  # each lets 1 % through, so T is 1, 0.01, 1e-4 before the first, second and third
    parameters = octahedra([[0, 0, z] for z in (4, 7, 10)], [[1, 1, 1]] * 3, [tau / 2] * 3)
    for stop, count in ((1.0, 1), (0.011, 1), (0.009, 2), (1.1e-4, 2), (0.9e-4, 3), (0.0, 3)):
        result = rasterize(*parameters, **axis_camera(1, 1), stop=stop)
        assert result["pixels"].tolist() == [1] * count + [0] * (3 - count)
        assert result["opacity"].item() == pytest.approx(1 - 0.01**count, rel=1e-14)
        assert (result["max_weight"][count:] == 0).all()


def test_median_depth_is_zero_if_the_level_is_not_reached():
    result = rasterize(*octahedra([[0, 0, 5]], [[1, 1, 1]], [0.1]), **axis_camera(), level=0.5)
    assert result["opacity"].max() > 0
    assert (result["depth_median"] == 0).all() and (result["normal_median"] == 0).all()
    crossed = rasterize(*octahedra([[0, 0, 5]], [[1, 1, 1]], [0.1]), **axis_camera(), level=0.9)
    assert crossed["depth_median"][4, 4].item() == pytest.approx(4 - math.log(0.9) / 0.1, rel=1e-13)


def test_no_primitives_give_the_background():
    parameters = [p[:0] for p in octahedra([[0, 0, 5]], [[1, 1, 1]], [1.0])[:5]] + [tensor([0.1, 0.2, 0.3])]
    result = rasterize(*parameters, **axis_camera())
    assert (result["rgb"] == parameters[5][:, None, None]).all()
    assert all((result[name] == 0).all() for name in IMAGES[1:]) and result["pixels"].shape == (0,)


def test_colour_does_not_depend_on_geometry_output():
    parameters, camera = random_scene(7, 6, 16)
    less = rasterize(*parameters, **camera, geometry=False)
    assert set(less) == {"rgb", "opacity", "max_weight", "pixels"}
    assert_same(rasterize(*parameters, **camera), less, set(less), rtol=0, atol=0)


def test_invalid_parameters_are_refused():
    parameters, camera = random_scene(7, 2, 4)
    with pytest.raises(ValueError, match="5 coefficients"):
        rasterize(*parameters[:4], torch.zeros(2, 5, 3, dtype=torch.float64), parameters[5], **camera)
    parameters[2][1, 2] = 0
    with pytest.raises(ValueError, match="not positive"):
        rasterize(*parameters, **camera)


# --- invariants ---


def quaternion_product(a, b):
    w, x, y, z = a.unbind(-1)
    left = torch.stack(
        [torch.stack(row, -1) for row in ((w, -x, -y, -z), (x, w, -z, y), (y, z, w, -x), (z, -y, x, w))], -2
    )
    return (left @ b[..., None])[..., 0]


@pytest.mark.parametrize("turned", [True, False])
def test_images_are_invariant_to_rigid_motion(turned):
    # Harmonics stay in the world's axes, so a rotation keeps only degree 0; a translation keeps them all.
    parameters, camera = random_scene(8, 10, 1 if turned else 16, width=9, height=8)
    before = rasterize(*parameters, **camera)
    q = tensor([0.3, -0.7, 0.5, 0.9] if turned else IDENTITY)
    turn, shift = reference.rotation_matrix(q), tensor([3.0, -1.0, 2.0])
    parameters[0] = parameters[0] @ turn.T + shift
    parameters[1] = quaternion_product(q.expand(10, 4), parameters[1])
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = turn, shift
    camera["world_to_camera"] = camera["world_to_camera"] @ torch.linalg.inv(motion)
    assert_same(before, rasterize(*parameters, **camera), rtol=1e-10, atol=1e-11)


def test_images_scale_with_the_world():
    parameters, camera = random_scene(9, 10, 16, width=9, height=8, near=1.5)
    before = rasterize(*parameters, **camera)
    k = 37.0
    parameters[0], parameters[2], parameters[3] = parameters[0] * k, parameters[2] * k, parameters[3] / k
    camera["near"] *= k
    camera["world_to_camera"][:3, 3] *= k
    after = rasterize(*parameters, **camera)
    for name, power in LENGTHS.items():
        before[name] = before[name] * k**power
    assert_same(before, after, rtol=1e-10, atol=1e-10)


def test_images_do_not_depend_on_length_and_sign_of_quaternions():
    parameters, camera = random_scene(10, 8)
    before = rasterize(*parameters, **camera)
    parameters[1] = parameters[1] * tensor([-1.0, 1e-3, 7.0, -0.2, 1e4, 1.0, 2.0, 3.0])[:, None]
    assert_same(before, rasterize(*parameters, **camera))


def test_images_do_not_depend_on_the_order_of_primitives():
    parameters, camera = random_scene(11, 8)
    before = rasterize(*parameters, **camera)
    shuffle = torch.tensor([3, 1, 7, 0, 5, 2, 6, 4])
    after = rasterize(*[p[shuffle] for p in parameters[:5]], parameters[5], **camera)
    assert_same(before, after, IMAGES)
    assert (after["pixels"] == before["pixels"][shuffle]).all()


def test_float32_agrees_with_float64():
    parameters, camera = random_scene(12, 30, 16, width=16, height=12)
    # stop = 0 and the median left out: both can jump where rounding decides a comparison.
    exact = rasterize(*parameters, **camera, stop=0.0)
    single = rasterize(*[p.float() for p in parameters], **camera, stop=0.0)
    assert all(value.dtype == torch.float32 for name, value in single.items() if name != "pixels")
    for name in ("rgb", "opacity", "depth_expected", "distortion"):
        assert (single[name] - exact[name]).abs().max() < 2e-5 * max(1.0, exact[name].abs().max().item())


def test_mean_depth_fraction_agrees_with_exact_values():
    for tau in (0.0, 1e-9, 0.01, 0.2499, 0.25, 0.3, 1.0, 5.0, 40.0, 1e3):
        if tau == 0:
            expected = 0.5
        elif tau < 0.3:  # the closed form as a quotient of two positive series, in exact fractions
            x = Fraction(tau)
            terms = [x**k / math.factorial(k + 2) for k in range(12)]
            expected = float(
                sum((k + 1) * t for k, t in enumerate(terms)) / sum(x**k / math.factorial(k + 1) for k in range(13))
            )
            expected = 1 - expected
        else:
            expected = 1 / tau - 1 / math.expm1(min(tau, 700.0))
        for dtype in (torch.float64, torch.float32):
            value = reference.mean_depth_fraction(tensor(tau, dtype)).item()
            assert value == pytest.approx(expected, rel=8 * torch.finfo(dtype).eps)
    tau = torch.logspace(-8, 2, 41, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(reference.mean_depth_fraction, tau, eps=1e-9, atol=1e-6)


# --- colour ---


def test_harmonics_are_orthonormal():
    # Gauss-Legendre in z and equal steps in the angle integrate products of degree 6 exactly.
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = 2 * np.pi * np.arange(16) / 16
    x, y = np.sqrt(1 - z**2)[:, None] * np.cos(angle), np.sqrt(1 - z**2)[:, None] * np.sin(angle)
    direction = tensor(np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], -1).reshape(-1, 3))
    basis = reference.sh_basis(direction, 16)
    weight = tensor(np.repeat(weight * 2 * np.pi / 16, 16))
    torch.testing.assert_close(basis.T @ (weight[:, None] * basis), torch.eye(16, dtype=torch.float64), **EXACT)


def test_harmonics_agree_with_scipy():
    from scipy.special import assoc_legendre_p  # includes (-1)^m

    g = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(20, 3, generator=g, dtype=torch.float64), dim=-1)
    x, y, z = direction.numpy().T
    expected = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            n = abs(m)
            scale = math.sqrt(
                (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - n) / math.factorial(degree + n)
            )
            wave = 1.0 if m == 0 else math.sqrt(2) * (np.cos if m > 0 else np.sin)(n * np.arctan2(y, x))
            expected.append(scale * wave * assoc_legendre_p(degree, n, z)[0])
    torch.testing.assert_close(reference.sh_basis(direction, 16), tensor(np.stack(expected, -1)), **EXACT)


def test_harmonics_of_axis_directions():
    basis = reference.sh_basis(tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]), 4)
    c1 = 0.4886025119029199
    torch.testing.assert_close(basis, tensor([[C0, 0, 0, -c1], [C0, -c1, 0, 0], [C0, 0, c1, 0]]), rtol=1e-15, atol=0)


def test_colour_uses_the_world_direction_from_camera_to_centre():
    sh = torch.zeros(2, 4, 3, dtype=torch.float64)
    sh[:, 3, 0] = -1.0  # + C1 x in red
    sh[:, 1, 1] = 9.0  # - 9 C1 y in green
    center = tensor([[5.0, 2.0, 3.0], [1.0, 6.0, 3.0]])
    color = reference.primitive_color(center, sh, tensor([1.0, 2.0, 3.0]))
    c1 = 0.4886025119029199
    torch.testing.assert_close(color, tensor([[0.5 + c1, 0.5, 0.5], [0.5, 0.0, 0.5]]), rtol=1e-15, atol=1e-16)
