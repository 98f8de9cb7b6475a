"""Gaussians of the reference, compared with the splatting formula."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from helpers.reference_ladder import MODELS, scene
from helpers.reference_scenes import IMAGES, assert_same, axis_camera, octahedra, tensor

from linprim_geo.kernels.reference import rasterize as reference
from linprim_geo.kernels.reference.rasterize import rasterize

pytestmark = pytest.mark.usefixtures("one_thread")


def literal_gaussians(parameters, camera, blur=0.0, near=0.01, stop=1e-3, level=0.5):
    """rgb, depths, normal and distortion of Gaussians by 3DGS's formula, in numpy scalars."""
    center, quaternion, extent, opacity, sh, background = (p.detach().numpy() for p in parameters)
    pose = camera["world_to_camera"].numpy()
    w, shift = pose[:3, :3], pose[:3, 3]
    fx, fy, cx, cy, width, height = (camera[k] for k in ("fx", "fy", "cx", "cy", "width", "height"))
    color = reference.primitive_color(parameters[0], parameters[4], tensor(-w.T @ shift)).numpy()
    out = {
        name: np.zeros((3, height, width) if name in ("rgb", "normal", "normal_median") else (height, width))
        for name in IMAGES
    }
    out |= {"max_weight": np.zeros(len(center)), "pixels": np.zeros(len(center), dtype=np.int64)}
    local = center @ w.T + shift
    for i, j in itertools.product(range(height), range(width)):
        left, terms = 1.0, []
        for n in sorted(range(len(center)), key=lambda n: (local[n, 2], n)):
            x, y, z = local[n]
            if z <= near or left < stop:
                continue
            r = reference.rotation_matrix(tensor(quaternion[n])).numpy()
            # Farther than 0.15 of the image's size from it, the Jacobian is the one there.
            u, v = (
                np.clip(x / z, *(np.array([-0.15, 1.15]) * width - cx) / fx),
                np.clip(y / z, *(np.array([-0.15, 1.15]) * height - cy) / fy),
            )
            jacobian = np.array([[fx / z, 0, -fx * u / z], [0, fy / z, -fy * v / z]])
            cov = jacobian @ w @ r @ np.diag(extent[n] ** 2) @ r.T @ w.T @ jacobian.T + blur * np.eye(2)
            d = np.array([j + 0.5, i + 0.5]) - [fx * x / z + cx, fy * y / z + cy]
            alpha = min(0.99, opacity[n] * math.exp(-0.5 * d @ np.linalg.inv(cov) @ d))
            if alpha < 1 / 255:
                continue
            axis = (w @ r)[:, np.argmin(extent[n])]
            axis = -axis if axis @ local[n] > 0 else axis
            weight, after = left * alpha, left * (1 - alpha)
            if not terms:
                out["depth_first"][i, j] = z
            if left > level >= after:
                out["depth_median"][i, j], out["normal_median"][:, i, j] = z, axis
            out["rgb"][:, i, j] += weight * color[n]
            out["normal"][:, i, j] += weight * axis
            out["depth_expected"][i, j] += weight * z
            out["max_weight"][n] = max(out["max_weight"][n], weight)
            out["pixels"][n] += 1
            terms.append((weight, z))
            left = after
        out["rgb"][:, i, j] += left * background
        out["opacity"][i, j] = 1 - left
        out["distortion"][i, j] = 0.5 * sum(a * b * (y - z) ** 2 for a, y in terms for b, z in terms)
    return {name: torch.from_numpy(value) for name, value in out.items()}


@pytest.mark.parametrize(
    "count,blur,more", [(1, 0.0, {}), (2, 0.3, {}), (12, 0.3, {"stop": 0.2}), (12, 0.0, {"depth": 1.0})]
)
def test_gaussians_agree_with_the_splatting_formula(count, blur, more):
    parameters, camera = scene("gaussian", 70 + count, count, 9, width=9, height=8, **more)
    definition = {name: camera[name] for name in ("stop",) if name in camera}
    expected = literal_gaussians(parameters, camera, blur, **definition)
    assert expected["opacity"].max() > 0.2 and (expected["pixels"] > 0).sum() > count / 2
    for model in MODELS:
        result = rasterize(*parameters, **camera, primitive="gaussian", ray_model=model, screen_filter=blur)
        assert_same(result, expected, rtol=1e-10, atol=1e-12)


def one_gaussian(extent, opacity=0.8, z=4.0, **more):
    parameters = octahedra([[0, 0, z]], [extent], [opacity])
    return rasterize(*parameters, **axis_camera(**more), primitive="gaussian", screen_filter=more.pop("k", 0.0))


def test_limits_of_alpha_of_a_gaussian_on_the_axis():
    result = one_gaussian([0.5, 0.25, 0.1])  # 1 px and 0.5 px
    assert result["opacity"][4, 4].item() == pytest.approx(0.8, rel=1e-14)
    assert result["opacity"][4, 5].item() == pytest.approx(0.8 * math.exp(-0.5), rel=1e-13)
    assert result["opacity"][5, 4].item() == pytest.approx(0.8 * math.exp(-2), rel=1e-13)
    assert result["opacity"][4, 7].item() == pytest.approx(0.8 * math.exp(-4.5), rel=1e-13)  # 0.0089
    assert result["opacity"][4, 8].item() == 0  # 0.00027 < 1 / 255
    assert result["normal"][:, 4, 4].tolist() == pytest.approx([0, 0, -0.8], abs=1e-15)
    assert result["depth_median"][4, 4] == 4 and result["depth_first"][4, 7] == 4
    assert one_gaussian([0.5, 0.25, 0.1], 1.0)["opacity"][4, 4].item() == pytest.approx(0.99, rel=1e-14)
    for opacity, drawn in ((1.001 / 255, 1), (0.999 / 255, 0)):
        assert one_gaussian([0.5, 0.5, 0.5], opacity)["pixels"].item() == drawn
    for z, drawn in ((0.011, True), (0.01, False)):
        assert (one_gaussian([0.5, 0.5, 0.5], 0.8, z)["pixels"].item() > 0) == drawn


def test_degenerate_gaussians_are_drawn_face_on_or_with_a_filter():
    assert one_gaussian([0.5, 0.5, 0.0])["opacity"][4, 4].item() == pytest.approx(0.8, rel=1e-14)  # face on
    for extent in ([0.5, 0.0, 0.5], [0.0, 0.0, 0.0]):  # edge on, and a point: nothing without a filter
        parameters = [p.requires_grad_() for p in octahedra([[0, 0, 4]], [extent], [0.8])]
        for blur, drawn in ((0.0, False), (0.3, True)):
            result = rasterize(*parameters, **axis_camera(), primitive="gaussian", screen_filter=blur)
            assert (result["pixels"].item() > 0) == drawn
            for name in IMAGES:
                if result[name].requires_grad:
                    grads = torch.autograd.grad(result[name].sum(), parameters, retain_graph=True, allow_unused=True)
                    assert all(g is None or g.isfinite().all() for g in grads)
    # Ratios of standard deviations on either side of 1e-6, in float32 too.
    for dtype in (torch.float64, torch.float32):
        for ratio, drawn in ((1.01e-6, True), (0.99e-6, False)):
            parameters = [p.to(dtype) for p in octahedra([[0, 0, 4]], [[0.5, 0.5 * ratio, 0.5]], [0.8])]
            result = rasterize(*parameters, **axis_camera(), primitive="gaussian")
            assert (result["pixels"].item() > 0) == drawn


def test_normal_of_equal_extents_is_the_first_axis_towards_the_camera():
    result = one_gaussian([0.2, 0.2, 0.3])
    assert result["normal"][:, 4, 4].tolist() == pytest.approx([0.8, 0, 0], abs=1e-15)
    parameters = octahedra([[1.0, 0, 4]], [[0.2, 0.2, 0.2]], [0.8])
    result = rasterize(*parameters, **axis_camera(), primitive="gaussian")
    assert result["normal_median"][:, 4, 6].tolist() == pytest.approx([-1, 0, 0], abs=1e-15)
