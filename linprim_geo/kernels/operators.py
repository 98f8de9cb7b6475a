"""Define functions of the compiled core as torch operators (`torch.ops.linprim_geo.*`), and check their arguments.

Arrays are passed as `tensor.detach().numpy()`, without a copy if the tensor is contiguous.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from linprim_geo import _core
from linprim_geo.base.errors import LinprimError

# The operators exist as long as this object.
_LIBRARY = torch.library.Library("linprim_geo", "DEF")


def define(
    name: str,
    compute: Callable,
    fake: Callable,
    backward: Callable | None = None,
    setup: Callable | None = None,
) -> None:
    """Define `compute`, whose annotations give its argument and result types, as the CPU operator `name`.

    Does the same as `torch.library.custom_op`, except that calling an operator does not load torch's compiler, which
    would take every process a second.

    Args:
        fake: the same function without values, for tracing.
        backward, setup: its gradient, as for `torch.library.register_autograd`; without it, requesting a gradient
            raises RuntimeError.
    """
    whole = f"linprim_geo::{name}"
    _LIBRARY.define(name + torch.library.infer_schema(compute, mutates_args=()))
    _LIBRARY.impl(name, compute, "CPU")
    torch.library.register_fake(whole, fake, lib=_LIBRARY)

    def no_backward(ctx, *grads):
        raise RuntimeError(f"{whole} has no gradient")

    torch.library.register_autograd(whole, backward or no_backward, setup_context=setup, lib=_LIBRARY)


def as_array(tensor: Tensor):
    return tensor.detach().contiguous().resolve_neg().numpy()


def scalar_suffix(dtype: torch.dtype) -> str:
    if dtype == torch.float32:
        return "f32"
    if dtype == torch.float64:
        return "f64"
    raise LinprimError(f"rasterize takes float32 or float64 tensors, found {dtype}")


def check_dtypes(wanted: torch.dtype, **tensors: Tensor) -> None:
    for name, tensor in tensors.items():
        if tensor.dtype != wanted:
            raise ValueError(f"{name} is {tensor.dtype}, wanted {wanted}")


def check_finite(suffix: str, **tensors: Tensor) -> None:
    check = getattr(_core, f"first_non_finite_{suffix}")
    for name, tensor in tensors.items():
        at = check(as_array(tensor))
        if at >= 0:
            row = at // max(1, tensor[0].numel()) if tensor.dim() else 0
            raise LinprimError(f"{name}: row {row} holds {tensor.reshape(-1)[at].item()}, finite numbers were wanted")
