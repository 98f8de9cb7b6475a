"""PatchMatch stereo, support and surface fits in the core: agreement with float64, accuracy, reproducibility."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at
from helpers.octahedra import KERNELS

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import ops
from linprim_geo.kernels.reference.stereo import CROSS_GREY, CROSS_REACH, match_cost
from linprim_geo.kernels.reference.stereo import fit_surfaces as reference_fit
from linprim_geo.kernels.reference.stereo import support as reference_support
from linprim_geo.kernels.stereo_ops import DepthPlanes, StereoImage, fit_surfaces, patch_match, support

# A wall through the origin, seen from points around (0, 0, -3).
NORMAL = np.array([0.35, -0.2, 1.0]) / np.linalg.norm([0.35, -0.2, 1.0])


def camera_at(position, width: int = 60, height: int = 44, focal: float = 70.0) -> Camera:
    shift = (0.01 * width, -0.02 * height)
    return look_at(position, size=(width, height), focal=focal, up=(0.0, 1.0, 0.0), shift=shift)


CAMERAS = [camera_at(p) for p in ((0, 0, -3), (0.5, 0, -2.9), (-0.5, 0.1, -3), (0.1, 0.5, -3), (0, -0.5, -2.9))]


def texture(points: np.ndarray) -> np.ndarray:
    """Grey values of world points: a sum of waves of 3 to 12 pixels."""
    rng = np.random.default_rng(1)
    value = np.zeros(points.shape[:-1])
    for _ in range(24):
        wave = rng.normal(size=3)
        wave *= 2 * np.pi / (np.linalg.norm(wave) * rng.uniform(0.13, 0.5))
        value += np.sin(points @ wave + rng.uniform(0, 2 * np.pi))
    return np.clip(127 + 16 * value, 0, 255)


def wall_depth(camera: Camera) -> np.ndarray:
    """(H, W) depth of the wall."""
    return -(camera.center @ NORMAL) / (camera.world_rays() @ NORMAL)


def picture(camera: Camera, noise: float = 0.0, seed: int = 0) -> StereoImage:
    points = camera.center + camera.world_rays() * wall_depth(camera)[..., None]
    grey = texture(points) + noise * np.random.default_rng(seed).normal(size=points.shape[:2])
    return StereoImage.of(camera, np.rint(np.clip(grey, 0, 255)).astype(np.uint8))


@pytest.fixture(scope="module")
def images() -> list[StereoImage]:
    return [picture(camera, 1.0, k) for k, camera in enumerate(CAMERAS)]


def some_planes(camera: Camera, seed: int = 0) -> DepthPlanes:
    """Random planes near the wall and far from it."""
    rng = np.random.default_rng(seed)
    planes = DepthPlanes.unknown(camera.height, camera.width)
    planes.plane[..., 0] = (1 / wall_depth(camera)) * rng.uniform(0.8, 1.2, (camera.height, camera.width))
    planes.plane[..., 1:] = rng.normal(0, 2e-3, (camera.height, camera.width, 2))
    return planes


def test_the_cost_agrees_with_float64(images):
    small = [camera_at(c.center, 23, 17, 27.0) for c in CAMERAS[:2]]
    a, b = (picture(camera) for camera in small)
    planes = some_planes(small[0])
    wanted = match_cost(small[0], a.grey, small[1], b.grey, planes.plane, 1.5)
    patch_match(a, [b], planes, (0.0, 1.0), 1.5, 0)
    assert (wanted < 1.9).mean() > 0.5 and (wanted == 2).any()
    # Windows of grey values up to 255 in float32: a relative rounding of 6e-8 of squares of up to 255^2, 36 of them,
    # against variances of 1.5 at least.
    assert np.abs(planes.cost - wanted).max() < 36 * 6e-8 * 255**2 / 1.5


def test_sources_that_do_not_show_a_point_do_not_change_its_cost(images):
    away = StereoImage.of(look_at((0, 0, -3), (0, 0, -6), size=(60, 44), focal=70.0, up=(0, 1, 0)), images[0].grey)
    costs = []
    for sources in (images[1:3], [images[1], away, images[2], away, away]):
        planes = some_planes(CAMERAS[0])
        patch_match(images[0], sources, planes, (0.0, 1.0), 1.0, 0)
        costs.append(planes.cost)
    both = costs[0] < 1.9
    assert both.mean() > 0.5 and np.array_equal(costs[0][both], costs[1][both])


def test_patch_match_finds_a_slanted_wall(images):
    planes = DepthPlanes.unknown(*images[0].grey.shape)
    patch_match(images[0], images[1:], planes, (0.0, 0.8), 1.0, 5)
    inside = np.s_[6:-6, 6:-6]  # where no window reaches beyond the photograph
    error = np.abs(1 / planes.plane[..., 0] / wall_depth(CAMERAS[0]) - 1)[inside]
    # A pixel of disparity is 3 / (70 * 0.5) = 9 % of the depth.
    assert np.median(error) < 0.003 and (error < 0.01).mean() > 0.97


def test_patch_match_finds_a_background_at_infinity():
    """Grey values depend on the direction only, so photographs agree only at infinity."""
    near, far = CAMERAS[0], []
    for camera in CAMERAS:
        rays = camera.world_rays()
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        far.append(StereoImage.of(camera, np.rint(texture(6 * rays)).astype(np.uint8)))
    planes = DepthPlanes.unknown(*far[0].grey.shape)
    patch_match(far[0], far[1:], planes, (0.0, 0.8), 1.0, 5)
    assert np.median(planes.plane[8:-8, 8:-8, 0]) < 0.01 / np.median(wall_depth(near))


def test_the_cost_without_texture_is_one():
    rng = np.random.default_rng(3)
    plain = [StereoImage.of(c, (100 + (rng.random((c.height, c.width)) < 0.5)).astype(np.uint8)) for c in CAMERAS]
    planes = some_planes(CAMERAS[0])
    planes.plane[..., 0] = 1 / wall_depth(CAMERAS[0])
    patch_match(plain[0], plain[1:], planes, (0.0, 0.8), 25.0, 0)
    # Variances of a quarter beside noise of 25: correlations below a hundredth.
    assert np.abs(planes.cost[10:-10, 10:-10] - 1).max() < 0.012


def test_contradicting_source_depths_increase_the_cost(images):
    planes = some_planes(CAMERAS[0])
    planes.plane[..., 0] = 1 / wall_depth(CAMERAS[0])
    alone, right, wrong = (DepthPlanes(planes.plane.copy(), planes.cost.copy(), planes.chosen.copy()) for _ in range(3))
    truth = [(1 / wall_depth(camera)).astype(np.float32) for camera in CAMERAS[1:]]
    patch_match(images[0], images[1:], alone, (0.0, 0.8), 1.0, 0)
    patch_match(images[0], images[1:], right, (0.0, 0.8), 1.0, 0, source_depths=truth)
    patch_match(images[0], images[1:], wrong, (0.0, 0.8), 1.0, 0, source_depths=[1.3 * w for w in truth])
    inside = np.s_[10:-10, 10:-10]
    # Neighbours' depths are those of the nearest pixel: it comes back to within a pixel.
    assert np.median((right.cost - alone.cost)[inside]) < 0.1 < np.median((wrong.cost - alone.cost)[inside])


@pytest.mark.parametrize("threads", [2, 3])
def test_patch_match_does_not_depend_on_threads(images, threads):
    before, found = ops.threads(), []
    try:
        for count in (1, threads):
            ops.set_threads(count)
            planes = DepthPlanes.unknown(*images[0].grey.shape)
            patch_match(images[0], images[1:], planes, (0.0, 0.8), 1.0, 2, seed=5)
            found.append(planes)
    finally:
        ops.set_threads(before)
    assert all(np.array_equal(getattr(found[0], k), getattr(found[1], k)) for k in ("plane", "cost", "chosen"))


def test_costs_agree_between_instruction_sets(images):
    before, costs = ops.instruction_set(), []
    try:
        for name in ("scalar", before):
            ops.set_instruction_set(name)
            planes = some_planes(CAMERAS[0])
            patch_match(images[0], images[1:], planes, (0.0, 0.8), 1.0, 0)
            costs.append(planes.cost)
    finally:
        ops.set_instruction_set(before)
    assert np.abs(costs[0] - costs[1]).max() < 36 * 6e-8 * 255**2  # as against float64, with variances of 1 at least


def test_invalid_input_of_patch_match_is_refused(images):
    planes = DepthPlanes.unknown(*images[0].grey.shape)
    with pytest.raises(ValueError, match="1 to 8 sources"):
        patch_match(images[0], [], planes, (0.0, 0.8), 1.0, 1)
    with pytest.raises(ValueError, match="not positive"):
        patch_match(images[0], images[1:], planes, (0.5, 0.5), 1.0, 1)
    with pytest.raises(ValueError, match="plane"):
        patch_match(images[0], images[1:], DepthPlanes.unknown(5, 5), (0.0, 0.8), 1.0, 1)


def slanted(height: int, width: int, inverse: float) -> np.ndarray:
    """(3, H, W) a plane of inverse depth, with `inverse` in the centre."""
    right, down = 2e-3 * inverse, -1e-3 * inverse
    rows, columns = np.indices((height, width))
    values = inverse + right * (columns - width // 2) + down * (rows - height // 2)
    return np.stack([values, np.full_like(values, right), np.full_like(values, down)]).astype(np.float32)


def test_support_agrees_with_float64():
    rng = np.random.default_rng(3)
    height, width = 30, 34
    grey = np.cumsum(rng.integers(-12, 13, (height, width)), axis=1) + 128
    plane = slanted(height, width, 0.5)
    plane[0] *= 1 + 0.02 * rng.normal(size=(height, width)).astype(np.float32)
    plane[0, rng.random((height, width)) < 0.2] = np.nan
    grey = np.clip(grey, 0, 255).astype(np.uint8)
    found, wanted = support(grey, plane, 0.01), reference_support(grey, plane, 0.01)
    # A comparison that rounding to float32 turns over would be off by one pixel of a cross: there is none.
    assert np.allclose(found, wanted, rtol=1e-6, atol=0) and len(np.unique(wanted)) > 100
    assert not found[np.isnan(plane[0])].any()


def test_pixels_of_a_plane_have_full_support():
    assert (support(np.full((24, 40), 90, np.uint8), slanted(24, 40, 0.3), 1e-4) == 1).all()


def test_support_ends_at_edges_of_the_photograph():
    height, width, edge, halo = 40, 60, 30, 5
    grey = np.full((height, width), 60, np.uint8)
    grey[:, edge:] = 60 + CROSS_GREY
    # What lies before the edge goes on beyond it by a window of stereo, and a wall is behind.
    plane = slanted(height, width, 0.5)
    plane[:, :, edge + halo :] = slanted(height, width, 0.3)[:, :, edge + halo :]
    found = support(grey, plane, 0.01)[height // 2]
    assert (found[:edge] == 1).all()
    # Of its own side, 10 columns and those to the edge, the halo has 5 columns.
    wanted = halo / np.minimum(2 * CROSS_REACH + 1, CROSS_REACH + 1 + np.arange(halo))
    assert np.allclose(found[edge : edge + halo], wanted) and (wanted < 0.5).all()
    assert (found[edge + halo : edge + 2 * halo] > 0.5).all() and (found[-CROSS_REACH:] == 1).all()


def test_support_does_not_depend_on_threads():
    rng = np.random.default_rng(4)
    grey = rng.integers(0, 60, (50, 70)).astype(np.uint8)
    plane = slanted(50, 70, 0.5) * (1 + 0.01 * rng.normal(size=(50, 70))).astype(np.float32)
    before, found = ops.threads(), []
    try:
        for count in (1, 3):
            ops.set_threads(count)
            found.append(support(grey, plane, 0.01))
    finally:
        ops.set_threads(before)
    assert np.array_equal(*found)


def test_invalid_arrays_of_support_are_refused():
    with pytest.raises(ValueError, match=r"plane has shape \(3, 8, 9\), wanted \(3, 8, 8\)"):
        support(np.zeros((8, 8), np.uint8), np.zeros((3, 8, 9), np.float32), 0.01)


def fitted(grey: np.ndarray, plane: np.ndarray, cost: np.ndarray | None = None, tolerance: float = 0.01) -> DepthPlanes:
    """The result of `fit_surfaces` for (3, H, W) planes."""
    cost = np.full(grey.shape, 0.1, np.float32) if cost is None else cost
    planes = DepthPlanes(np.moveaxis(plane, 0, 2).copy(), cost.copy(), np.zeros(grey.shape, np.uint8))
    fit_surfaces(grey, planes, plane[0] > 0, tolerance)
    return planes


def blotched(height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A grey image of areas, (3, H, W) planes of two walls with noise, mistakes and gaps, and costs."""
    rng = np.random.default_rng(5)
    grey = np.full((height, width), 60, np.uint8)
    grey[:, width // 2 :] = 120
    grey[height // 3 : height // 2] += 40
    plane = slanted(height, width, 0.5)
    plane[:, :, width // 2 + 3 :] = slanted(height, width, 0.3)[:, :, width // 2 + 3 :]
    plane[0] *= 1 + 1e-3 * rng.normal(size=grey.shape).astype(np.float32)
    wrong = rng.random(grey.shape)
    plane[0] *= np.where(wrong < 0.3, 1.1, 1).astype(np.float32)
    plane[:, wrong > 0.9] = 0
    return grey, plane, rng.random(grey.shape).astype(np.float32)


@pytest.mark.parametrize("kernels", KERNELS)
def test_fitted_surfaces_are_bitwise_equal_for_all_instruction_sets(kernels):
    """A comparison changed by rounding would select another plane and change the result visibly."""
    scene, before = blotched(61, 83), ops.instruction_set()
    try:
        ops.set_instruction_set("scalar")
        wanted = fitted(*scene)
        ops.set_instruction_set(kernels)
        found = fitted(*scene)
    finally:
        ops.set_instruction_set(before)
    assert np.array_equal(found.plane, wanted.plane) and np.array_equal(found.cost, wanted.cost)


def test_fitted_surfaces_agree_with_float64():
    grey, plane, cost = blotched(30, 34)
    found, (wanted, wanted_cost) = fitted(grey, plane, cost), reference_fit(grey, plane, cost, 0.01)
    relative = np.abs(found.plane[..., 0] - wanted[0]) / np.maximum(wanted[0], 0.1)
    # Rounding turns comparisons over for a few of a cross, and then for what is fitted to them.
    assert np.quantile(relative, 0.98) < 2e-6 and relative.max() < 2e-3
    assert np.quantile(np.abs(found.plane[..., 1:] - np.moveaxis(wanted[1:], 0, 2)), 0.98) < 2e-6
    assert np.quantile(np.abs(found.cost - wanted_cost), 0.98) < 1e-5
    # Most wrong and missing values are replaced.
    assert (np.abs(wanted[0] / plane[0].clip(1e-6) - 1) > 0.05).mean() > 0.25


def test_fitting_keeps_planes():
    plane = slanted(24, 40, 0.3)
    found = fitted(np.full((24, 40), 90, np.uint8), plane)
    assert np.allclose(np.moveaxis(found.plane, 2, 0), plane, rtol=0, atol=1e-6)


def test_fitting_reduces_noise_on_a_curved_surface():
    rng, (rows, columns) = np.random.default_rng(6), np.indices((60, 60))
    # A ball of 40 pixels: 0.3 % nearer in the middle of a cross than at its ends.
    true = 0.5 + 0.5 * (np.sqrt(40**2 - (rows - 30.0) ** 2 * 0.5 - (columns - 30.0) ** 2 * 0.5) - 40) / 400
    noisy = true * (1 + 2e-3 * rng.normal(size=true.shape))
    plane = np.stack([noisy, np.zeros_like(true), np.zeros_like(true)]).astype(np.float32)
    found = fitted(np.full(true.shape, 90, np.uint8), plane)
    inner = (slice(10, 50),) * 2
    error = (found.plane[..., 0] / true - 1)[inner]
    assert np.std(error) < 0.3 * 2e-3 and abs(error.mean()) < 1e-4
    slopes = np.gradient(true)
    # The noise of a slope from one difference of two pixels would be 7e-4.
    assert np.std(found.plane[..., 1] - slopes[1]) < 1e-4 and np.std(found.plane[..., 2] - slopes[0]) < 1e-4


def test_fitting_uses_the_surface_on_the_same_side_of_an_edge():
    height, width, edge, halo = 40, 60, 30, 5
    grey = np.full((height, width), 60, np.uint8)
    grey[:, edge:] = 60 + CROSS_GREY
    plane, wall = slanted(height, width, 0.5), slanted(height, width, 0.3)
    plane[:, :, edge + halo :] = wall[:, :, edge + halo :]
    cost = np.where(np.arange(width) < edge + halo, np.float32(0.2), np.float32(0.4)) * np.ones((height, 1), np.float32)
    found = fitted(grey, plane, cost)
    beyond, before = found.plane[:, edge:], found.plane[:, :edge]
    assert np.allclose(beyond, np.moveaxis(wall, 0, 2)[:, edge:], rtol=0, atol=1e-5)
    assert np.allclose(before, np.moveaxis(plane, 0, 2)[:, :edge], rtol=0, atol=1e-5)
    assert np.allclose(found.cost[:, edge : edge + halo], 0.4) and np.allclose(found.cost[:, :edge], 0.2)


def test_fitting_keeps_a_crease_of_uniform_brightness():
    rng, (height, width) = np.random.default_rng(8), (40, 60)
    columns = np.arange(width) - 29.5
    # Two walls at a right angle, seen from 3 m, and noise of 0.03 %: within 1 % one surface of second order fits both.
    true = np.broadcast_to(1 / (3 - 0.006 * np.abs(columns)), (height, width))
    slope = np.broadcast_to(np.gradient(true[0], edge_order=2), (height, width))
    slope = np.where(columns < -1, slope, slope[:, ::-1] * -1) * np.ones((height, 1))
    plane = np.stack([true * (1 + 3e-4 * rng.normal(size=true.shape)), slope, np.zeros_like(true)]).astype(np.float32)
    found = fitted(np.full(true.shape, 90, np.uint8), plane)
    error = np.abs(found.plane[..., 1] - slope)[8:-8, 10:-10]
    assert error.mean() < 0.1 * np.abs(slope).mean()


@pytest.mark.parametrize(("height", "width"), [(1, 30), (30, 1), (30, 2), (1, 1)])
def test_fitting_narrow_images_agrees_with_float64(height, width):
    rng = np.random.default_rng(9)
    plane = slanted(height, width, 0.5)
    plane[0] *= 1 + 1e-3 * rng.normal(size=(height, width)).astype(np.float32)
    grey, cost = np.full((height, width), 90, np.uint8), np.full((height, width), 0.1, np.float32)
    found, (wanted, _) = fitted(grey, plane, cost), reference_fit(grey, plane, cost, 0.01)
    assert np.allclose(np.moveaxis(found.plane, 2, 0), wanted, rtol=0, atol=2e-6)


def test_fitting_keeps_a_thin_object_with_edges():
    height, width = 40, 60
    grey = np.full((height, width), 60, np.uint8)
    grey[:, 30:33] = 60 + CROSS_GREY
    plane = slanted(height, width, 0.3)
    plane[:, :, 30:33] = slanted(height, width, 0.5)[:, :, 30:33]
    found = fitted(grey, plane)
    assert np.allclose(found.plane, np.moveaxis(plane, 0, 2), rtol=0, atol=1e-5)


def test_fitting_keeps_planes_without_a_majority():
    rng = np.random.default_rng(7)
    plane = slanted(30, 30, 0.5)
    plane[0] *= rng.choice(np.array([0.8, 1, 1.2], np.float32), (30, 30))
    plane[:, 10:20, 10:20] = 0
    found = fitted(np.full((30, 30), 90, np.uint8), plane)
    assert np.array_equal(found.plane, np.moveaxis(plane, 0, 2))


def test_fitted_surfaces_do_not_depend_on_threads():
    grey, plane, cost = blotched(50, 70)
    before, found = ops.threads(), []
    try:
        for count in (1, 3):
            ops.set_threads(count)
            found.append(fitted(grey, plane, cost))
    finally:
        ops.set_threads(before)
    assert np.array_equal(found[0].plane, found[1].plane) and np.array_equal(found[0].cost, found[1].cost)


def test_invalid_arrays_of_fit_surfaces_are_refused():
    planes = DepthPlanes.unknown(8, 9)
    with pytest.raises(ValueError, match=r"plane has shape \(3, 8, 9\), wanted \(3, 8, 8\)"):
        fit_surfaces(np.zeros((8, 8), np.uint8), planes, np.ones((8, 9), bool), 0.01)
    with pytest.raises(ValueError, match="tolerance has to be between 0 and 1"):
        fit_surfaces(np.zeros((8, 9), np.uint8), planes, np.ones((8, 9), bool), 1.0)
