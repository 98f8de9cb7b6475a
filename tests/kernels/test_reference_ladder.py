"""The reference on every variant: an independent program, gradients, precision, and arguments."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from helpers.finite_differences import assert_every_gradient, assert_gradient_along_a_direction
from helpers.reference_ladder import BASIS, ORDERS, POLYHEDRA, VARIANTS, scene
from helpers.reference_scenes import IMAGES, assert_same, axis_camera, octahedra, tensor
from scipy.optimize import brentq

from linprim_geo.kernels.reference import rasterize as reference
from linprim_geo.kernels.reference.rasterize import rasterize

pytestmark = pytest.mark.usefixtures("one_thread")


# --- an independent program: whether a point is inside, and nothing else about the shapes ---


class Body:
    """One primitive as a convex function of camera space that is below 0 inside it."""

    def __init__(self, primitive, center, rotation, extent):
        self.primitive, self.center, self.rotation, self.extent = primitive, center, rotation, extent
        if primitive == "octahedron":
            self.vertices = np.array([s * extent[k] * rotation[:, k] for k in range(3) for s in (1, -1)]) + center
        else:
            self.vertices = center + extent[:, None] * (BASIS @ rotation.T)
            self.barycentric = np.linalg.inv(np.concatenate([self.vertices, np.ones((4, 1))], 1))

    def __call__(self, p):
        if self.primitive == "octahedron":
            return np.abs((p - self.center) @ self.rotation / self.extent).sum(-1) - 1
        return -(np.concatenate([p, np.ones_like(p[..., :1])], -1) @ self.barycentric).min(-1)

    def outward(self, p):
        """Gradient of the linear piece that holds at p, normalised."""
        if self.primitive == "octahedron":
            slope = np.sign((p - self.center) @ self.rotation) / self.extent @ self.rotation.T
        else:
            value = np.concatenate([p, np.ones_like(p[..., :1])], -1) @ self.barycentric
            slope = -self.barycentric.T[value.argmin(-1), :3]
        return slope / np.linalg.norm(slope, axis=-1, keepdims=True)


def ray_space(p):
    return torch.stack([p[0] / p[2], p[1] / p[2], p.norm()])


def where(body, model, camera, pixels, k, near):
    """The function from z-depths (P,) to points (P, 3) of the rays of `pixels` (P, 2), and the density's factor."""
    focal = np.array([camera["fx"], camera["fy"]])
    principal = np.array([camera["cx"], camera["cy"]])
    length = np.linalg.norm(np.c_[(pixels - principal) / focal, np.ones(len(pixels))], axis=1)
    center = tensor(body.center)
    size = np.array([camera["width"], camera["height"]])
    limits = [(share * size - principal) / focal for share in (-0.15, 1.15)]
    held = np.r_[np.clip(body.center[:2] / body.center[2], *limits), 1] * body.center[2]
    jacobian = torch.autograd.functional.jacobian(ray_space, tensor(held)).numpy()
    middle, factor = focal * body.center[:2] / body.center[2] + principal, 1.0
    if k > 0 and (model == "affine" or (body.vertices[:, 2] > near).all()):
        corners = (body.vertices - body.center) @ jacobian[:2].T
        if model == "exact":
            corners = body.vertices[:, :2] / body.vertices[:, 2:]
        half = np.ptp(corners * focal, axis=0) / 2
        scale = half / (half + k / 2)
        pixels, factor = middle + scale * (pixels - middle), scale.prod()
    xy = (pixels - principal) / focal
    if model == "exact":
        return (lambda t: t[:, None] * np.c_[xy, np.ones(len(xy))]), factor
    start = ray_space(center).numpy()
    return (lambda t: body.center + np.linalg.solve(jacobian, (np.c_[xy, t * length] - start).T).T), factor


def interval(body, points, count, low, high):
    """t_in and t_out (P,) in [low, high] by ternary search and bisection of a convex function; t_in > t_out: none."""

    def value(t):
        return body(points(t))

    a, b = np.full(count, low), np.full(count, high)
    for _ in range(110):
        p, q = a + (b - a) / 3, b - (b - a) / 3
        left = value(p) <= value(q)
        a, b = np.where(left, a, p), np.where(left, q, b)
    deepest = (a + b) / 2
    ends = []
    for end in (low, high):
        inside, outside = deepest.copy(), np.full(count, end)
        for _ in range(70):
            middle = (inside + outside) / 2
            within = value(middle) <= 0
            inside, outside = np.where(within, middle, inside), np.where(within, outside, middle)
        ends.append(np.where(value(np.full(count, end)) <= 0, end, (inside + outside) / 2))
    met = value(deepest) < 0
    return np.where(met, ends[0], np.inf), np.where(met, ends[1], -np.inf)


def segments(chords):
    """Segments between adjacent ends along one ray, and the primitives that contain their middle."""
    ends = sorted({t for t_in, t_out in chords.values() for t in (t_in, t_out)})
    for a, b in itertools.pairwise(ends):
        yield a, b, [n for n, (t_in, t_out) in chords.items() if t_in < (a + b) / 2 < t_out]


NODES, WEIGHTS = np.polynomial.legendre.leggauss(30)


def literal_render(parameters, camera, primitive, model, order, k=0.0, near=0.01, stop=1e-3, level=0.5, far=40.0):
    """Every output by its definition in numpy, with Gauss-Legendre quadrature of overlap in each segment."""
    center, quaternion, extent, density, sh, background = (p.detach().numpy() for p in parameters)
    pose = camera["world_to_camera"].numpy()
    turn, shift, height, width = pose[:3, :3], pose[:3, 3], camera["height"], camera["width"]
    color = reference.primitive_color(parameters[0], parameters[4], tensor(-turn.T @ shift)).numpy()
    center = center @ turn.T + shift
    rotation = turn @ reference.rotation_matrix(tensor(quaternion)).numpy()
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([columns, rows], -1).reshape(-1, 2) + 0.5
    count, total = len(pixels), len(center)
    rays = (pixels - [camera["cx"], camera["cy"]]) / [camera["fx"], camera["fy"]]
    length = np.sqrt((rays**2).sum(1) + 1)

    entry, leave, outward = {}, {}, np.zeros((total, count, 3))
    sigma = density.copy()
    for n in range(total):
        if model == "affine" and center[n, 2] <= near:
            continue
        body = Body(primitive, center[n], rotation[n], extent[n])
        points, factor = where(body, model, camera, pixels, k, near)
        sigma[n] *= factor
        low = near if model == "exact" else -far
        entry[n], leave[n] = interval(body, points, count, low, far)
        outward[n] = body.outward(points(np.where(np.isfinite(entry[n]), entry[n], 1.0)))
        outward[n][entry[n] == near] = 0

    out = {name: np.zeros((3, count) if name in ("rgb", "normal", "normal_median") else count) for name in IMAGES}
    out |= {"max_weight": np.zeros(total), "pixels": np.zeros(total, dtype=np.int64)}
    for p in range(count):
        chords = {n: (entry[n][p], leave[n][p]) for n in entry if entry[n][p] < leave[n][p]}
        left, terms, weight = 1.0, [], dict.fromkeys(chords, 0.0)
        first = min((c[0] for c in chords.values()), default=0.0)
        if order == "overlap":
            out["depth_first"][p] = first
            ended = math.inf
            for a, b, inside in segments(chords):
                if left < stop:
                    ended = min(ended, a)
                    continue
                rate = sum(sigma[n] for n in inside) * length[p]
                t = (a + b) / 2 + (b - a) / 2 * NODES
                absorbed = left * np.exp(-rate * (t - a)) * WEIGHTS * (b - a) / 2  # times a rate, integrated
                for n in inside:
                    weight[n] += sigma[n] * length[p] * absorbed.sum()
                terms += zip(rate * absorbed, t, strict=True)
                after = left * math.exp(-rate * (b - a))
                if left > level >= after:
                    median = brentq(lambda t, a=a, x=left, r=rate: x * math.exp(-r * (t - a)) - level, a, b, xtol=1e-15)
                    out["depth_median"][p] = median
                    out["normal_median"][:, p] = sum(sigma[n] * outward[n, p] for n in inside) / (rate / length[p])
                left = after
            hits = [n for n in chords if chords[n][0] < ended]
        else:
            hits = []
            keys = {n: chords[n][0] if order == "entry" else center[n, 2] for n in chords}
            for n in sorted(chords, key=lambda n: (keys[n], n)):
                if left < stop:
                    break
                a, b = chords[n]
                rate = sigma[n] * length[p]
                after = left * math.exp(-rate * (b - a))
                weight[n] = left - after
                terms.append((weight[n], a + 1 / rate - (b - a) * after / weight[n]))
                if not hits:
                    out["depth_first"][p] = a
                if left > level >= after:
                    out["depth_median"][p] = a + math.log(left / level) / rate
                    out["normal_median"][:, p] = outward[n, p]
                left = after
                hits.append(n)
        for n in hits:
            out["pixels"][n] += 1
            out["max_weight"][n] = max(out["max_weight"][n], weight[n])
        out["rgb"][:, p] = sum((weight[n] * color[n] for n in chords), left * background)
        out["normal"][:, p] = sum((weight[n] * outward[n, p] for n in chords), np.zeros(3))
        out["opacity"][p] = 1 - left
        w, z = np.array(terms).T if terms else np.zeros((2, 0))
        out["depth_expected"][p] = w @ z
        out["distortion"][p] = w.sum() * (w @ (z - first) ** 2) - (w @ (z - first)) ** 2
    for name in IMAGES:
        out[name] = out[name].reshape(*out[name].shape[:-1], height, width)
    return {name: torch.from_numpy(value) for name, value in out.items()}


@pytest.mark.parametrize(
    "more",
    [{}, {"depth": 1.2, "near": 0.3, "fx": 6.0, "fy": 7.0, "level": 0.8}, {"stop": 0.3, "level": 0.4}],
    ids=("far", "near", "stop"),
)
@pytest.mark.parametrize("k", [0.0, 0.7])
@pytest.mark.parametrize("primitive,model,order", VARIANTS)
def test_reference_agrees_with_a_program_of_inside_tests(primitive, model, order, k, more):
    seed = 40 + VARIANTS.index((primitive, model, order))
    parameters, camera = scene(primitive, seed, 9, width=7, height=6, **more)
    definition = {name: camera[name] for name in ("near", "stop", "level") if name in camera}
    result = rasterize(*parameters, **camera, primitive=primitive, ray_model=model, order=order, screen_filter=k)
    expected = literal_render(parameters, camera, primitive, model, order, k, **definition)
    assert (expected["pixels"] > 0).sum() >= 3 and (expected["depth_median"] != 0).any()
    # The search stops at 1e-15 of 40 times a slope of up to 1e2 where a ray grazes.
    assert_same(result, expected, rtol=1e-9, atol=1e-10)


# --- gradients, precision, arguments ---


@pytest.mark.parametrize("k", [0.0, 0.6])
@pytest.mark.parametrize("primitive,model,order", [*VARIANTS, ("gaussian", "affine", "center")])
def test_directional_gradients_agree_with_finite_differences(primitive, model, order, k):
    seed = 80 + len(model) + len(order)
    for more in ({}, {"stop": 0.35, "level": 0.6, "depth": 1.2}):
        parameters, camera = scene(primitive, seed, 6, **more)
        pose = camera.pop("world_to_camera")
        inputs = [p.requires_grad_() for p in (*parameters, pose)]
        options = dict(primitive=primitive, ray_model=model, order=order, screen_filter=k)

        def run(*inputs, camera=camera, options=options):
            result = rasterize(*inputs[:6], world_to_camera=inputs[6], **camera, **options)
            return tuple(result[name] for name in IMAGES)

        assert all((image != 0).any() for image in run(*inputs))
        assert_gradient_along_a_direction(run, inputs, atol=1e-7)


@pytest.mark.parametrize("primitive", POLYHEDRA)
def test_gradients_of_overlap_with_a_filter_agree_with_finite_differences(primitive):
    parameters, camera = scene(primitive, 90, 3, 1, width=4, height=4)
    inputs = [p.requires_grad_() for p in parameters]

    def run(*inputs):
        result = rasterize(*inputs, **camera, primitive=primitive, order="overlap", screen_filter=0.5)
        return tuple(result[name] for name in IMAGES)

    assert_every_gradient(run, inputs, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("center,near", [((0, 0, 2), 0.01), ((1, 0, 2), 0.01), ((0, 0, 2), 1), ((0.5, 0, 0.5), 0.01)])
def test_gradients_are_finite_in_degenerate_cases(center, near, dtype):
    # Through vertices and edges, parallel faces, coincident copies, no density, and an opaque one.
    for (primitive, model, order), k in itertools.product([*VARIANTS, ("gaussian", "exact", "center")], (0.0, 0.5)):
        parameters = octahedra([center, center, (0, 0, 4), (0, 0, 5)], [[1, 1, 1]] * 4, [1.0, 1.0, 0.0, 1e6])
        if primitive == "tetrahedron":
            parameters[2] = torch.full((4, 4), math.sqrt(3), dtype=torch.float64)
        if primitive == "gaussian":
            parameters[3] = tensor([0.5, 0.5, 0.1, 1.0])
        leaves = [p.to(dtype).requires_grad_() for p in parameters]
        options = dict(primitive=primitive, ray_model=model, order=order, screen_filter=k, stop=0.0)
        result = rasterize(*leaves, **axis_camera(5, 5, 1.0), near=near, **options)
        assert (result["pixels"] > 0).any() and result["opacity"].max() > 0.5
        for name in IMAGES:
            assert result[name].isfinite().all(), (name, options)
        grads = torch.autograd.grad(sum(result[name].sum() for name in IMAGES), leaves)
        assert all(g.isfinite().all() for g in grads), options


@pytest.mark.parametrize("primitive,model,order", [*VARIANTS, ("gaussian", "affine", "center")])
def test_float32_agrees_with_float64(primitive, model, order):
    parameters, camera = scene(primitive, 95, 30, width=16, height=12)
    options = dict(primitive=primitive, ray_model=model, order=order, screen_filter=0.3, stop=0.0)
    exact = rasterize(*parameters, **camera, **options)
    single = rasterize(*[p.float() for p in parameters], **camera, **options)
    assert all(value.dtype == torch.float32 for name, value in single.items() if name != "pixels")
    for name in ("rgb", "opacity", "depth_expected", "distortion"):
        assert (single[name] - exact[name]).abs().max() < 5e-5 * max(1.0, exact[name].abs().max().item())


@pytest.mark.parametrize("order", ORDERS)
def test_no_primitives_or_hits_give_the_background(order):
    parameters, camera = scene("tetrahedron", 96, 2)
    background = parameters[5]
    parameters[0] = parameters[0] + 100
    for some in (parameters[:5], [p[:0] for p in parameters[:5]]):
        result = rasterize(*some, background, **camera, primitive="tetrahedron", order=order)
        assert (result["rgb"] == background[:, None, None]).all()
        assert all((result[name] == 0).all() for name in (*IMAGES[1:], "max_weight", "pixels"))


@pytest.mark.parametrize("order", ORDERS)
def test_colour_does_not_depend_on_geometry_output(order):
    parameters, camera = scene("tetrahedron", 97, 6)
    options = dict(primitive="tetrahedron", order=order)
    less = rasterize(*parameters, **camera, **options, geometry=False)
    assert set(less) == {"rgb", "opacity", "max_weight", "pixels"}
    assert_same(rasterize(*parameters, **camera, **options), less, set(less), rtol=0, atol=0)


def test_invalid_options_are_refused():
    parameters, camera = scene("octahedron", 98, 2)
    for options, message in (
        ({"primitive": "gaussian", "order": "entry"}, "no entry"),
        ({"primitive": "gaussian", "order": "overlap"}, "no entry"),
        ({"primitive": "cube"}, "primitive is 'cube'"),
        ({"ray_model": "straight"}, "ray_model is 'straight'"),
        ({"order": "random"}, "order is 'random'"),
        ({"primitive": "tetrahedron"}, "3 columns"),
        ({"screen_filter": -1.0}, "screen_filter"),
        ({"screen_filter": math.nan}, "screen_filter"),
    ):
        with pytest.raises(ValueError, match=message):
            rasterize(*parameters, **camera, **options)
