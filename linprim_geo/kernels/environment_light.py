"""The light of an environment map behind transparent primitives, as a torch operator."""

from __future__ import annotations

import torch
from torch import Tensor

from linprim_geo import _core
from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels.operators import as_array, check_dtypes, define, scalar_suffix


def _environment(opacity: Tensor, texels: Tensor, rotation: list[float], lens: list[float], least: float) -> Tensor:
    check_dtypes(texels.dtype, opacity=opacity)
    light = opacity.new_empty(3, *opacity.shape)
    getattr(_core, f"environment_light_{scalar_suffix(texels.dtype)}")(
        rotation, lens, as_array(texels), least, as_array(opacity), light.numpy()
    )
    return light


def _environment_fake(opacity, texels, rotation, lens, least):
    return opacity.new_empty(3, *opacity.shape)


def _environment_grad(
    grad: Tensor, opacity: Tensor, size: int, rotation: list[float], lens: list[float], least: float
) -> Tensor:
    out = grad.new_empty(6, size, size, 3)
    getattr(_core, f"environment_light_grad_{scalar_suffix(grad.dtype)}")(
        rotation, lens, least, as_array(opacity), as_array(grad), out.numpy()
    )
    return out


def _environment_grad_fake(grad, opacity, size, rotation, lens, least):
    return grad.new_empty(6, size, size, 3)


define("environment_light_grad", _environment_grad, _environment_grad_fake)


def _environment_setup(ctx, inputs, output):
    opacity, texels, *ctx.how = inputs
    ctx.size = texels.shape[1]
    ctx.save_for_backward(opacity, output)


def _environment_backward(ctx, grad):
    opacity, light = ctx.saved_tensors
    # light = (1 - opacity) colour
    left = (1 - opacity).clamp_min(torch.finfo(opacity.dtype).tiny)
    to_opacity = (grad * light).sum(0).div_(left).neg_()
    return to_opacity, torch.ops.linprim_geo.environment_light_grad(grad, opacity, ctx.size, *ctx.how), None, None, None


define("environment_light", _environment, _environment_fake, _environment_backward, _environment_setup)


def environment_light(opacity: Tensor, texels: Tensor, camera: Camera, least: float = 0.0) -> Tensor:
    """Return the (3, H, W) light of a cube map at infinity that passes primitives of (H, W) `opacity`: (1 - opacity) *
    colour in the direction of the pixel.

    Added to an image that was rendered over black, it gives the image with the environment behind it.

    Face 2a of the cube map contains the directions d whose largest coordinate is d_a > 0, face 2a + 1 those with d_a <
    0. Columns correspond to d_b / |d_a| and rows to d_c / |d_a| from -1 to 1, with (a, b, c) cyclic. Colours between
    texel centres are interpolated bilinearly. Beyond a face's border, the nearest texel of the neighbouring face is
    used, so a seam is at most the difference of two neighbouring texels.

    Args:
        opacity: (H, W) as returned by `rasterize`; float32 or float64, the same for both tensors.
        texels: (6, S, S, 3) colours.
        camera: camera of the rendering; its position does not matter.
        least: where 1 - opacity is below this, the ray has ended and the light is 0.

    Raises:
        ValueError: shapes or dtypes that do not fit.

    Gradient: to opacity (0 where it is 1) and texels; not differentiable twice.

    Accuracy: positions are computed in double, colours in the tensors' type; float64 agrees with
    `reference.environment_light` to 1e-12.
    """
    return torch.ops.linprim_geo.environment_light(opacity, texels, *_directions(camera), least)


def environment_weights(values: Tensor, opacity: Tensor, size: int, camera: Camera) -> Tensor:
    """Return (6, size, size, 3) sums over pixels of (1 - opacity) times (3, H, W) `values` times the weight of each
    texel in the pixel: the adjoint of `environment_light`."""
    return torch.ops.linprim_geo.environment_light_grad(values, opacity, size, *_directions(camera), 0.0)


def _directions(camera: Camera) -> tuple[list[float], list[float]]:
    """Return a camera's rotation and intrinsics; its position does not matter at infinity."""
    return camera.rotation.reshape(-1).tolist(), [camera.fx, camera.fy, camera.cx, camera.cy]
