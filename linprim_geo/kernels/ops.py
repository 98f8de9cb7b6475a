"""All operators of the compiled core on tensors under one name, its thread pool, and the choice of its instruction set.

`rasterize`, `environment_light` and `photometric_loss` are differentiable operators (`torch.ops.linprim_geo.*`) with
fake implementations for tracing.
"""

from __future__ import annotations

import os

import torch
from torch import Tensor

from linprim_geo import _core
from linprim_geo.base.cores import usable_cores
from linprim_geo.base.errors import LinprimError
from linprim_geo.kernels.environment_light import environment_light as environment_light
from linprim_geo.kernels.environment_light import environment_weights as environment_weights
from linprim_geo.kernels.photometric import photometric_loss as photometric_loss
from linprim_geo.kernels.rasterize import KINDS as KINDS
from linprim_geo.kernels.rasterize import ORDERS as ORDERS
from linprim_geo.kernels.rasterize import RAY_MODELS as RAY_MODELS
from linprim_geo.kernels.rasterize import Rendering as Rendering
from linprim_geo.kernels.rasterize import has_kernels as has_kernels
from linprim_geo.kernels.rasterize import level_depth as level_depth
from linprim_geo.kernels.rasterize import rasterize as rasterize

# The core applies LINPRIM_GEO_ISA itself if it can; raise an error here if it could not.
if os.environ.get("LINPRIM_GEO_ISA", "auto") not in ("auto", _core.instruction_set()):
    raise LinprimError(
        f"LINPRIM_GEO_ISA is {os.environ['LINPRIM_GEO_ISA']!r}, which this processor or build does not have;"
        f" unset, {_core.instruction_set()} is used"
    )

LOG2_E = 1.4426950408889634


def set_threads(count: int) -> None:
    """Set the number of threads of the core; 0 means one per core that this process may use. No result depends on it.
    Do not call it while another thread renders."""
    _core.set_threads(count or usable_cores())


def threads() -> int:
    """Return the number of threads that the core uses."""
    return _core.threads()


set_threads(0)  # by default the core uses every core of the machine, even beyond the quota of its container


class _Exponential(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        y = torch.exp2(x.double() * LOG2_E).to(x.dtype)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return gradient * y


def exponential(x: Tensor) -> Tensor:
    """Return e^x of float32, bitwise equal on processors of all makers.

    `torch.exp` and `torch.sqrt` call MKL's vector library, which uses different code on Intel's processors than on
    others; `exp2` is torch's own. It is computed in float64 and rounded once.
    """
    return _Exponential.apply(x)


def instruction_set() -> str:
    """Return the name of the vector kernels in use: scalar, v2, v3, v4 (x86-64 levels) or neon."""
    return _core.instruction_set()


def set_instruction_set(name: str) -> None:
    """Select the vector kernels by name, or the best ones with "auto"."""
    if not _core.set_instruction_set(name):
        raise LinprimError(f"instruction set {name!r} is not available on this processor; scalar always is")


def machine_limits() -> dict[str, float]:
    """Measure the current speed of one core with the instruction set in use.

    Returns: `fma_gflops`; `exp_ns` per value; `pair_forward_ns` and `pair_backward_ns` per (pixel, primitive) pair, for
    octahedra with exact rays, all data in the first-level cache and every pixel hit.

    Takes some milliseconds on the calling thread; each value is the shortest of fifteen measurements.
    """
    return _core.limits()


def statistics() -> dict[str, float]:
    """Return counts, and milliseconds per stage, of the last `rasterize` and its backward pass."""
    return _core.statistics()
