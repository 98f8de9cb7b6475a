"""The rasterizer of the compiled core as a differentiable torch operator, and depth maps at a given transmittance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from linprim_geo import _core
from linprim_geo.base import kinds
from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels.operators import as_array, check_dtypes, check_finite, define, scalar_suffix

# Output images in the order that the core expects; the last one is internal state for the backward pass.
_PLANES = (
    "rgb",
    "opacity",
    "depth_expected",
    "depth_median",
    "depth_first",
    "distortion",
    "normal",
    "normal_median",
    "state",
)
_CHANNELS = (3, 0, 0, 0, 0, 0, 3, 3, 4)


def _planes(like: Tensor, width: int, height: int, geometry: bool) -> list[Tensor]:
    shapes = [((c,) if c else ()) + (height, width) for c in _CHANNELS]
    return [like.new_empty(shape if i < 2 or geometry else (0,)) for i, shape in enumerate(shapes)]


# Arguments of the two operators other than tensors. `numbers`: fx, fy, cx, cy, near, stop, level, screen_filter;
# `choices`: width, height, the indices of primitive, ray model and order in these lists, and whether geometry is
# wanted.
KINDS = tuple(kinds.KINDS)
RAY_MODELS = ("exact", "affine")
ORDERS = ("center", "entry", "overlap")


def _core_arguments(tensors: list[Tensor], pose: Tensor, numbers: list[float], choices: list[int]) -> list:
    fx, fy, cx, cy, near, stop, level, screen_filter = numbers
    width, height, kind, rays, order, geometry = choices
    return [
        kind,
        *[as_array(t) for t in tensors],
        as_array(pose[:3].double()),
        (fx, fy, cx, cy),
        width,
        height,
        near,
        stop,
        level,
        (rays, order, screen_filter),
        bool(geometry),
    ]


def _rasterize(
    center: Tensor,
    rotation: Tensor,
    extent: Tensor,
    density: Tensor,
    sh: Tensor,
    background: Tensor,
    screen: Tensor | None,
    world_to_camera: Tensor,
    numbers: list[float],
    choices: list[int],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    suffix = scalar_suffix(center.dtype)
    given = dict(center=center, rotation=rotation, extent=extent, density=density, background=background)
    check_dtypes(center.dtype, sh=sh, **given)
    check_finite(suffix, **given)
    planes, color, max_weight, pixels = _outputs(center, choices)
    getattr(_core, f"rasterize_{suffix}")(
        *_core_arguments([center, rotation, extent, density, sh, background], world_to_camera, numbers, choices),
        [p.numpy() if p.numel() else None for p in planes],
        color.numpy(),
        max_weight.numpy(),
        pixels.numpy(),
    )
    check_finite(suffix, sh=color)
    # torch takes the number of outputs from the annotation; the planes are a list of nine.
    return (*planes, color, max_weight, pixels)  # type: ignore[return-value]


def _outputs(center: Tensor, choices: list[int]) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
    width, height, *_, geometry = choices
    count = center.shape[0]
    statistics = count if geometry else 0
    return (
        _planes(center, width, height, bool(geometry)),
        center.new_empty((count, 3)),
        center.new_empty(statistics),
        center.new_empty(statistics, dtype=torch.int32),
    )


def _rasterize_fake(center, rotation, extent, density, sh, background, screen, world_to_camera, numbers, choices):
    planes, *others = _outputs(center, choices)
    return (*planes, *others)


def _rasterize_grad(
    center: Tensor,
    rotation: Tensor,
    extent: Tensor,
    density: Tensor,
    sh: Tensor,
    background: Tensor,
    world_to_camera: Tensor,
    numbers: list[float],
    choices: list[int],
    color: Tensor,
    planes: list[Tensor],
    grads: list[Tensor | None],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    inputs = [center, rotation, extent, density, sh, background]
    out = _gradients(inputs)
    getattr(_core, f"rasterize_grad_{scalar_suffix(center.dtype)}")(
        *_core_arguments(inputs, world_to_camera, numbers, choices),
        [as_array(p) if p.numel() else None for p in planes],
        as_array(color),
        [None if g is None or not g.numel() else as_array(g) for g in grads],
        *[t.numpy() for t in out],
    )
    return tuple(out)  # type: ignore[return-value]  # a list of seven, see above


def _gradients(inputs: list[Tensor]) -> list[Tensor]:
    out = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs]
    return [*out, inputs[0].new_empty((inputs[0].shape[0], 3))]


def _rasterize_grad_fake(
    center, rotation, extent, density, sh, background, world_to_camera, numbers, choices, color, planes, grads
):
    return tuple(_gradients([center, rotation, extent, density, sh, background]))


define("rasterize_grad", _rasterize_grad, _rasterize_grad_fake)


def _rasterize_setup(ctx, inputs, output):
    *tensors, screen, pose, numbers, choices = inputs
    ctx.numbers, ctx.choices = numbers, choices
    ctx.has_screen = screen is not None
    ctx.set_materialize_grads(False)
    *planes, color, max_weight, pixels = output
    ctx.mark_non_differentiable(planes[-1], color, max_weight, pixels)
    ctx.save_for_backward(*tensors, pose, color, *planes)


def _rasterize_backward(ctx, *grads):
    tensors, (pose, color, *planes) = ctx.saved_tensors[:6], ctx.saved_tensors[6:]
    *parameters, screen = torch.ops.linprim_geo.rasterize_grad(
        *tensors, pose, ctx.numbers, ctx.choices, color, planes, list(grads[:8])
    )
    return (*parameters, screen if ctx.has_screen else None, None, None, None)


define("rasterize", _rasterize, _rasterize_fake, _rasterize_backward, _rasterize_setup)


@dataclass(frozen=True)
class Rendering:
    """Result of `rasterize`. Images are (3, H, W) or (H, W); all depths are z-depths, 0 where a ray has none.

    The geometry fields are None unless geometry was requested.
    """

    rgb: Tensor  # (3, H, W) colour composited over the background
    opacity: Tensor  # (H, W) 1 - transmittance behind all primitives
    depth_expected: Tensor | None = (
        None  # sum of weight * mean depth inside the primitive; divide by opacity for a mean
    )
    depth_median: Tensor | None = None  # where the transmittance crosses `level`, solved inside the primitive
    depth_first: Tensor | None = None  # entry into the first primitive
    distortion: Tensor | None = None  # sum over pairs i < j of w_i w_j (z_i - z_j)^2
    normal: Tensor | None = None  # (3, H, W) sum of weight * unit normal of the entry face, camera frame
    normal_median: Tensor | None = None  # (3, H, W) unit normal of the primitive at the median depth
    max_weight: Tensor | None = None  # (N,) largest blending weight T alpha of a primitive in any pixel
    pixels: Tensor | None = None  # (N,) int32 number of pixels that hit a primitive


def rasterize(
    center: Tensor,
    rotation: Tensor,
    extent: Tensor,
    density: Tensor,
    sh: Tensor,
    background: Tensor,
    camera: Camera,
    *,
    primitive: str = "octahedron",
    ray_model: str = "exact",
    order: str = "center",
    screen_filter: float = 0.0,
    near: float = 0.01,
    stop: float = 1e-3,
    level: float = 0.5,
    geometry: bool = False,
    samples: int = 1,
    screen: Tensor | None = None,
) -> Rendering:
    """Render transparent primitives; by default octahedra with exact perspective, blended front to back in the order of
    their centres' depths.

    A ray with direction (u, v, 1) is inside a polyhedron for z-depths t_in < t < t_out. Its optical thickness there is
    tau = density |(u, v, 1)| (t_out - t_in), its blending weight T (1 - exp(-tau)), and the transmittance T is then
    multiplied by exp(-tau).

    Args:
        center: (N, 3) world positions. float32 or float64; the same for all tensors.
        rotation: (N, 4) quaternions w, x, y, z of any length; length 0 means no rotation.
        extent: (N, 3) half-axes of octahedra, (N, 4) distances of a tetrahedron's vertices along (1, 1, 1), (1, -1,
            -1), (-1, 1, -1) and (-1, -1, 1), or (N, 3) standard deviations of Gaussians; world units. A primitive with
            an extent that is not positive is not drawn; values are clamped to the range from 1e-15 to 1e12.
        density: (N,) optical thickness per world unit; negative values count as 0. For Gaussians the peak opacity, 0 to
            1.
        sh: (N, K, 3) spherical harmonics, K = 1, 4, 9 or 16; colour = max(0, 0.5 + their sum in the direction from the
            camera to the centre).
        background: (3,) colour behind all primitives.
        camera: pinhole camera in the frame of the centres.
        primitive: "octahedron", "tetrahedron", or "gaussian": the projected Gaussians of 3D Gaussian splatting, with
            alpha at most 0.99, nothing below 1/255, and one depth each.
        ray_model: "exact" perspective, or "affine": rays within a primitive are parallel in the ray space of its
            centre, nothing is cut at the near plane, and a primitive whose centre lies before the near plane is not
            drawn. For a centre farther than 0.15 of the image's size outside of the image, the ray space of the nearest
            position within that margin is used. Gaussians are always affine.
        order: "center": blended by the depth of the centres; "entry": by each ray's entry depth; "overlap": densities
            add up where primitives overlap, so the volume rendering integral is exact and depends on no order.
            Gaussians support "center" only.
        screen_filter: enlarges a polyhedron's bounding box on the screen by half this many pixels on every side, and
            reduces its density in proportion; for Gaussians it is added to the variance, in square pixels. 0 is off.
        near: z-depth at which rays begin, world units.
        stop: a ray ends when its transmittance falls below this; 0 = never.
        level: transmittance at which `depth_median` is taken.
        geometry: also compute depths, normals, distortion and per-primitive statistics (takes about twice the time).
        samples: render with this many by this many rays per pixel and average them. A photograph averages over each
            pixel, so edges need this. Geometry has no meaningful average, so it requires 1.
        screen: (N, 3) zeros that receive screen-space gradients. The first two columns are the loss gradient to the
            projected centres, per pixel. The third is the sum, over 16x16 tiles, of the norm of each tile's
            contribution, so that contributions do not cancel. For a primitive that crosses the near plane, the
            projected centre is taken at the middle of its depths beyond the plane.

    Raises:
        LinprimError: a non-finite input (the message names tensor and row; in sh, only of primitives in view) or a
            dtype other than float32 or float64.
        ValueError: shapes, dtypes, a camera or options that do not fit.

    Gradient: from every output image to center, rotation, extent, density, sh, background and screen; not
    differentiable twice.

    Accuracy: float64 agrees with `reference.rasterize` to 1e-9 relative; float32 to about 1e-5 of the image's range,
    except for a plate thinner than 1e-2 that is cut by the near plane (about 1e-7 * distance / thickness). Bitwise the
    same for any number of threads.

    Source: LinPrim (von Luetzow and Niessner, arXiv 2501.16312) for the primitive and its density.
    """
    for name, value, known in (
        ("primitive", primitive, KINDS),
        ("ray_model", ray_model, RAY_MODELS),
        ("order", order, ORDERS),
    ):
        if value not in known:
            raise ValueError(f"{name} is {value!r}, wanted {', '.join(known)}")
    if samples < 1 or (samples > 1 and geometry):
        raise ValueError("samples has to be 1 with geometry, and at least 1 without")
    if samples > 1:
        fine = rasterize(
            center,
            rotation,
            extent,
            density,
            sh,
            background,
            camera.magnified(samples),
            primitive=primitive,
            ray_model=ray_model,
            order=order,
            screen_filter=kinds.KINDS[primitive].screen_filter_at(samples, screen_filter),
            near=near,
            stop=stop,
            level=level,
            screen=None if screen is None else screen * samples,
        )
        return Rendering(
            torch.ops.linprim_geo.average_pixels(fine.rgb, samples),
            torch.ops.linprim_geo.average_pixels(fine.opacity, samples),
        )
    pose = torch.from_numpy(camera.world_to_camera.copy())
    out = torch.ops.linprim_geo.rasterize(
        center,
        rotation,
        extent,
        density,
        sh,
        background,
        screen,
        pose,
        [camera.fx, camera.fy, camera.cx, camera.cy, near, stop, level, screen_filter],
        [
            camera.width,
            camera.height,
            KINDS.index(primitive),
            RAY_MODELS.index(ray_model),
            ORDERS.index(order),
            int(geometry),
        ],
    )
    if not geometry:
        return Rendering(out[0], out[1])
    return Rendering(*out[:8], *out[10:])  # without the state for the backward pass


def has_kernels(primitive: str, ray_model: str, order: str) -> bool:
    """Return whether `rasterize` supports this combination. Gaussians have no entry point, so they support only the
    order "center"."""
    return _core.has_kernels_f32(KINDS.index(primitive), RAY_MODELS.index(ray_model), ORDERS.index(order))


def _average(image: Tensor, factor: int) -> Tensor:
    height, width = image.shape[-2] // factor, image.shape[-1] // factor
    coarse = image.new_empty((*image.shape[:-2], height, width))
    getattr(_core, f"average_pixels_{scalar_suffix(image.dtype)}")(
        as_array(image), height, width, factor, coarse.numpy()
    )
    return coarse


def _average_fake(image, factor):
    return image.new_empty((*image.shape[:-2], image.shape[-2] // factor, image.shape[-1] // factor))


def _average_grad(grad: Tensor, factor: int) -> Tensor:
    height, width = grad.shape[-2:]
    fine = grad.new_empty((*grad.shape[:-2], height * factor, width * factor))
    getattr(_core, f"average_pixels_grad_{scalar_suffix(grad.dtype)}")(
        as_array(grad), height, width, factor, fine.numpy()
    )
    return fine


def _average_grad_fake(grad, factor):
    return grad.new_empty((*grad.shape[:-2], grad.shape[-2] * factor, grad.shape[-1] * factor))


define("average_pixels_grad", _average_grad, _average_grad_fake)


def _average_setup(ctx, inputs, output):
    ctx.factor = inputs[1]


def _average_backward(ctx, grad):
    return torch.ops.linprim_geo.average_pixels_grad(grad, ctx.factor), None


define("average_pixels", _average, _average_fake, _average_backward, _average_setup)


def level_depth(
    center: Tensor,
    rotation: Tensor,
    extent: Tensor,
    density: Tensor,
    sh: Tensor,
    camera: Camera,
    *,
    level: float,
    primitive: str = "octahedron",
    ray_model: str = "exact",
    screen_filter: float = 0.0,
    near: float = 0.01,
) -> tuple[Tensor, Tensor]:
    """Return (H, W) z-depths at which the transmittance of each ray falls to `level` (0 if it never does), and the (H,
    W) opacity of the whole ray; no gradients.

    Unlike the depths of `rasterize`, the result does not depend on a blending order: densities add up where primitives
    overlap, so the depth solves sum_i density_i |v| clamp(t - t_in_i, 0, t_out_i - t_in_i) = ln(1 / level). Arguments
    as for `rasterize`, for polyhedra; 0 < level < 1.

    Raises: as `rasterize`.

    Accuracy: float64 to 1e-13, float32 to 1e-6, of the depth.
    """
    suffix = scalar_suffix(center.dtype)
    check_dtypes(center.dtype, rotation=rotation, extent=extent, density=density, sh=sh)
    check_finite(suffix, center=center, rotation=rotation, extent=extent, density=density)
    if not 0 < level < 1:
        raise ValueError(f"level is {level}, wanted a transmittance between 0 and 1")
    depth = center.new_empty((camera.height, camera.width), requires_grad=False)
    opacity = torch.empty_like(depth)
    if not kinds.KINDS[primitive].solid:
        raise ValueError("a Gaussian has no entry and no exit, so no depth at a level")
    getattr(_core, f"level_depth_{suffix}")(
        KINDS.index(primitive),
        as_array(center),
        as_array(rotation),
        as_array(extent),
        as_array(density),
        as_array(sh),
        camera.world_to_camera[:3].astype(float).copy(),
        (camera.fx, camera.fy, camera.cx, camera.cy),
        camera.width,
        camera.height,
        near,
        level,
        (RAY_MODELS.index(ray_model), 0, screen_filter),
        depth.numpy(),
        opacity.numpy(),
    )
    return depth, opacity
