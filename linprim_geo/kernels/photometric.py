"""The photometric loss of the compiled core, L1 and SSIM, as a torch operator."""

from __future__ import annotations

import torch
from torch import Tensor

from linprim_geo import _core
from linprim_geo.kernels.operators import as_array, check_dtypes, define


def _photometric(image: Tensor, target: Tensor, dssim: float, weight: Tensor | None) -> tuple[Tensor, Tensor]:
    check_dtypes(torch.float32, image=image, target=target, **({} if weight is None else {"weight": weight}))
    gradient = torch.empty_like(image, memory_format=torch.contiguous_format)
    parts = _core.photometric_loss(
        as_array(image), as_array(target), None if weight is None else as_array(weight), dssim, gradient.numpy()
    )
    return torch.tensor(parts, dtype=torch.float64), gradient


def _photometric_fake(image, target, dssim, weight):
    return image.new_empty(4, dtype=torch.float64), torch.empty_like(image, memory_format=torch.contiguous_format)


def _photometric_setup(ctx, inputs, output):
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(output[1])


def _photometric_backward(ctx, grad_parts, _):
    (gradient,) = ctx.saved_tensors
    return (None if grad_parts is None else gradient * grad_parts[0].to(gradient.dtype)), None, None, None


define("photometric_loss", _photometric, _photometric_fake, _photometric_backward, _photometric_setup)


def photometric_loss(image: Tensor, target: Tensor, dssim: float = 0.2, weight: Tensor | None = None) -> Tensor:
    """Return (1 - dssim) L1 + dssim (1 - SSIM) of two float32 images (3, H, W), with its analytic gradient to `image`.

    SSIM: 11x11 Gaussian window with sigma 1.5, zeros beyond the border, C1 = 0.01^2, C2 = 0.03^2. `weight` (H, W)
    multiplies both maps; their means are weighted means.

    Returns: (4,) float64: the loss, L1, SSIM and the mean squared error. Only the loss has a gradient, to `image`; not
    differentiable twice.

    Accuracy: loss within 1e-6 and gradient within 1e-4 relative of `reference.photometric_loss` in float64 on
    photographs; SSIM computes variances as differences of float32 moments, so 1e-5 and 5e-4 on bright images without
    contrast.
    """
    return torch.ops.linprim_geo.photometric_loss(image, target, dssim, weight)[0]
