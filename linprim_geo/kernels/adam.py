"""Adam in the compiled core, on whole tensors or only on the rows that a view touched."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from linprim_geo import _core
from linprim_geo.kernels.operators import as_array, check_dtypes


def adam_step(
    value: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    rate: float,
    step: int,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
) -> None:
    """Make one Adam step with bias correction on float32 tensors, in place. `step` counts from 1.

    Source: Kingma and Ba, ICLR 2015, algorithm 1.
    """
    check_dtypes(torch.float32, value=value, gradient=gradient, first=first, second=second)
    if not (value.is_contiguous() and first.is_contiguous() and second.is_contiguous()):
        raise ValueError("value, first and second are changed in place and have to be contiguous")
    _core.adam_step(
        value.detach().numpy(),
        as_array(gradient),
        first.numpy(),
        second.numpy(),
        rate,
        beta1,
        beta2,
        epsilon,
        step,
    )


def adam_rows(
    values: Sequence[Tensor],
    gradients: Sequence[Tensor],
    firsts: Sequence[Tensor],
    seconds: Sequence[Tensor],
    rates: Sequence[float],
    steps: Tensor,
    touched: Tensor | None = None,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
) -> None:
    """Make one sparse Adam step on the touched rows of several float32 tensors, in place and in one pass.

    For a touched row, its step count t increases by one and its moments are corrected by 1 - beta^t: every row gets
    exactly the Adam updates of the steps that touched it, however rare they are. Untouched rows keep value, moments and
    count, whereas `adam_step` would keep moving them by their first moment and decay both moments. If every step
    touches all rows, the two are the same.

    Args:
        values, gradients, firsts, seconds: the same number of tensors each, with N rows of any shape. Gradients of
            untouched rows are ignored.
        rates: learning rate of each tensor.
        steps: (N,) int32, 0 for a row without a history. To reset a row's history, set it and both moments to 0.
        touched: (N,) bool; None: the rows where any of the tensors has a non-zero gradient, which requires reading the
            gradients of all rows.

    Raises:
        ValueError: shapes, dtypes or layouts that do not fit.

    Source: Kingma and Ba, ICLR 2015, algorithm 1, per row. (The sparse Adam of 3DGS's later code also freezes unseen
    rows, but corrects by the global step: it treats a rarely seen row like one with zero gradients in between, so its
    first steps are too small or too large.)
    """
    for name, tensors in (("value", values), ("gradient", gradients), ("first", firsts), ("second", seconds)):
        for tensor in tensors:
            check_dtypes(torch.float32, **{name: tensor})
            if tensor.shape[:1] != steps.shape:
                raise ValueError(f"{name} has {tuple(tensor.shape[:1])} rows, steps has shape {tuple(steps.shape)}")
            if name != "gradient" and not tensor.is_contiguous():
                raise ValueError(f"{name} is changed in place and has to be contiguous")
    check_dtypes(torch.int32, steps=steps)
    if not steps.is_contiguous():
        raise ValueError("steps is changed in place and has to be contiguous")
    if touched is not None:
        check_dtypes(torch.bool, touched=touched)
        touched = touched.contiguous().view(torch.uint8)
    _core.adam_rows(
        [t.detach().numpy() for t in values],
        [as_array(t) for t in gradients],
        [t.numpy() for t in firsts],
        [t.numpy() for t in seconds],
        list(rates),
        steps.numpy(),
        None if touched is None else touched.numpy(),
        beta1,
        beta2,
        epsilon,
    )
