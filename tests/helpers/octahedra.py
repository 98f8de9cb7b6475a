"""Scenes of octahedra for the tests of the compiled rasterizer, and comparison with its float64 reference, the twin."""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np
import torch

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import ops
from linprim_geo.kernels.reference import rasterize as reference

NAMES = ("center", "rotation", "extent", "density", "sh", "background")
COLOR = ("rgb", "opacity")
IMAGES = (*COLOR, "depth_expected", "depth_median", "depth_first", "distortion", "normal", "normal_median")
IDENTITY = (1.0, 0.0, 0.0, 0.0)
C0 = 0.28209479177387814  # the spherical harmonic of degree 0


def available_kernels() -> list[str]:
    """Returns the names of the instruction sets that this processor can run."""
    before, found = ops.instruction_set(), []
    for name in ("scalar", "v2", "v3", "v4", "neon"):
        try:
            ops.set_instruction_set(name)
        except LinprimError:
            continue
        found.append(name)
    ops.set_instruction_set(before)
    return found


KERNELS = available_kernels()
# Every build of the kernels; in double precision there is only the scalar one.
BUILDS = [("float64", "scalar"), *(("float32", name) for name in KERNELS)]


@contextmanager
def kernels(name: str, threads: int | None = None):
    """Selects the kernels `name` and a number of threads, and restores the previous ones afterwards."""
    before = ops.instruction_set(), ops.threads()
    ops.set_instruction_set(name)
    if threads is not None:
        ops.set_threads(threads)
    yield
    ops.set_instruction_set(before[0])
    ops.set_threads(before[1])


def octahedra(center, extent, density, rotation=None, sh=None, background=(0.2, 0.5, 0.1)) -> list[torch.Tensor]:
    """Returns the six float64 tensors of `rasterize` from lists; primitives have different colours by default."""
    n = len(center)
    shades = [[[0.9 - 0.3 * (i % 3), 0.2 + 0.5 * (i % 2), -0.4 + 0.4 * (i % 4)]] for i in range(n)]
    values = (center, rotation or [IDENTITY] * n, extent, density, sh or shades, background)
    return [torch.tensor(x, dtype=torch.float64) for x in values]


def camera(width=17, height=13, focal=None, pose=None, cx=None, cy=None) -> Camera:
    """Returns a camera whose pixel centres avoid the symmetries of a scene on its axis."""
    focal = focal or 1.2 * max(width, height)
    cx, cy = width / 2 + 0.137 if cx is None else cx, height / 2 - 0.219 if cy is None else cy
    return Camera(width, height, focal, 1.07 * focal, cx, cy, np.eye(4) if pose is None else pose)


def random_pose(rng, shift=1.0) -> np.ndarray:
    """Returns a random rigid world-to-camera matrix."""
    pose = np.eye(4)
    pose[:3, :3] = reference.rotation_matrix(torch.from_numpy(rng.normal(size=4))).numpy()
    pose[:3, 3] = shift * rng.normal(size=3)
    return pose


def to_world(center: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Transforms camera-space points (N, 3) to the world."""
    return (center - pose[:3, 3]) @ pose[:3, :3]


def random_scene(seed, count, coefficients=4, width=17, height=13, depth=3.0, spread=0.7, focal=None):
    """Returns overlapping random octahedra (half-axes 0.1 to 1.5, density 0.1 to 20) and a camera of random pose."""
    rng = np.random.default_rng(seed)
    pose = random_pose(rng)
    center = to_world(spread * rng.normal(size=(count, 3)) * [1, 1, 1.5] + [0, 0, depth], pose)
    extent, density = np.exp(rng.uniform(-2.3, 0.4, (count, 3))), np.exp(rng.uniform(-2.3, 3, count))
    sh, rotation = 0.4 * rng.normal(size=(count, coefficients, 3)), rng.normal(size=(count, 4))
    values = (center, rotation, extent, density, sh, rng.random(3))
    return [torch.from_numpy(x) for x in values], camera(width, height, focal, pose)


def hard_scene(seed):
    """Returns 1 to 8 octahedra with half-axes 1e-6 to 1e3, alignments and coincidences, a camera that may be extreme,
    and options of `rasterize`."""
    rng = np.random.default_rng(seed)

    def now_and_then(share):
        return rng.random() < share

    n = int(rng.integers(1, 9))
    width, height = [(16, 16), (17, 5), (1, 1), (1, 50), (50, 1), (9, 21), (33, 3)][int(rng.integers(7))]
    center = rng.normal(size=(n, 3)) * 10 ** rng.uniform(-3, 1)
    center[:, 2] += 10 ** rng.uniform(-2, 2) * rng.choice([1, 1, 1, -1, 0])
    extent, rotation = 10 ** rng.uniform(-6, 3, (n, 3)), rng.normal(size=(n, 4))
    density = 10 ** rng.uniform(-12, 4, n)
    if now_and_then(0.3):
        rotation[:] = IDENTITY
    if now_and_then(0.2):
        rotation *= 10 ** rng.uniform(-8, 8)
    if now_and_then(0.1):
        rotation[0] = 0
    if now_and_then(0.3):
        center = np.round(center)
    if now_and_then(0.3):
        extent = 2.0 ** np.round(np.log2(extent))
    if now_and_then(0.2):
        extent[:] = extent[:, :1]
    if now_and_then(0.1):
        center[:] = center[0]
    if now_and_then(0.1):
        center[0] = 0
    if now_and_then(0.3):
        density = 10 ** rng.uniform(-6, 6, n) / extent.min(1)  # optical thickness from almost 0 to a million
    if now_and_then(0.1):
        density[:] = 0
    if now_and_then(0.1):
        extent[0, rng.integers(3)] = rng.choice([0.0, -1.0])
    cx, cy = width / 2, height / 2
    if now_and_then(0.3):
        cx, cy = cx + rng.normal() * 10 ** rng.uniform(0, 4), cy + rng.normal()
    pose = np.eye(4)
    if now_and_then(0.5):
        pose = random_pose(rng, rng.choice([0.0, 0.1, 1.0]))
        center = to_world(center, pose)
    options = {
        "near": 10 ** rng.uniform(-4, 0),
        "stop": float(rng.choice([0, 1e-3, 0.3])),
        "level": float(rng.choice([0.5, 0.01, 0.99])),
    }
    sh = rng.normal(size=(n, int(rng.choice([1, 4, 9, 16])), 3))
    values = (center, rotation, extent, density, sh, rng.random(3))
    view = Camera(width, height, max(width, height) * 10 ** rng.uniform(-1, 2), max(width, height), cx, cy, pose)
    return [torch.from_numpy(x) for x in values], view, options


def leaves(parameters, dtype=None) -> list[torch.Tensor]:
    """Returns copies of the tensors that require a gradient."""
    return [p.detach().to(dtype or p.dtype).clone().requires_grad_() for p in parameters]


def twin(parameters, view: Camera, **options) -> dict[str, torch.Tensor]:
    """Renders the same scene with `reference.rasterize` in float64."""
    return reference.rasterize(
        *[p.double() for p in parameters],
        world_to_camera=torch.from_numpy(view.world_to_camera),
        fx=view.fx,
        fy=view.fy,
        cx=view.cx,
        cy=view.cy,
        width=view.width,
        height=view.height,
        **options,
    )


def fields(rendering: ops.Rendering, names=IMAGES) -> dict[str, torch.Tensor]:
    """Returns the named images of a rendering."""
    return {name: getattr(rendering, name) for name in names}


def cotangents(images: dict[str, torch.Tensor], seed=0) -> dict[str, torch.Tensor]:
    """Returns fixed random weights, one for each value of each image."""
    generator = torch.Generator().manual_seed(seed)
    return {k: torch.randn(v.shape, generator=generator, dtype=torch.float64) for k, v in images.items()}


def gradients(images, inputs, weights) -> list[torch.Tensor]:
    """Returns the gradients of the weighted sum of the images by the inputs; zeros where there is none."""
    total = sum((image * weights[name].to(image.dtype)).sum() for name, image in images.items())
    if not total.requires_grad:
        return [torch.zeros_like(x) for x in inputs]
    grads = torch.autograd.grad(total, inputs, allow_unused=True, retain_graph=True)
    return [torch.zeros_like(x) if g is None else g for g, x in zip(grads, inputs, strict=True)]


def everything(parameters, view: Camera, geometry=True, **options) -> list[torch.Tensor]:
    """Returns all outputs and all gradients of one rendering, for comparisons bit by bit."""
    inputs = leaves(parameters)
    screen = torch.zeros(len(inputs[0]), 3, dtype=inputs[0].dtype, requires_grad=True)
    out = ops.rasterize(*inputs, view, geometry=geometry, screen=screen, **options)
    images = fields(out, IMAGES if geometry else COLOR)
    grads = gradients(images, [*inputs, screen], cotangents(images))
    extra = [out.max_weight, out.pixels] if geometry else []
    return [x.detach() for x in (*images.values(), *extra, *grads)]


def assert_identical(a, b):
    """Checks that tensors have equal shapes and values, with NaN equal to itself."""
    assert len(a) == len(b)
    for i, (x, y) in enumerate(zip(a, b, strict=True)):
        same = (x == y) | (x.isnan() & y.isnan()) if x.is_floating_point() else x == y
        assert x.shape == y.shape and bool(same.all()), (
            f"tensor {i}: {int((~same).sum())} of {same.numel()} values differ"
        )
