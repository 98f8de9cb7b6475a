"""Comparison of gradients with central differences. All inputs form one vector and all outputs another one, so that no
output needs a backward pass and no input a difference of its own."""

from __future__ import annotations

import torch

STEP, RTOL = 1e-6, 1e-5


def flattened(run, inputs):
    """Returns `run` as a function from one vector of all inputs to one vector of all outputs, and the input vector."""
    shapes, sizes = [x.shape for x in inputs], [x.numel() for x in inputs]

    def of(vector):
        parts = [part.view(shape) for part, shape in zip(vector.split(sizes), shapes, strict=True)]
        return torch.cat([output.flatten() for output in run(*parts)])

    return of, torch.cat([x.detach().flatten() for x in inputs]).requires_grad_()


def assert_gradient_along_a_direction(run, inputs, atol: float) -> None:
    """Checks the derivative of a randomly weighted sum of all outputs along a random direction of all inputs."""
    of, vector = flattened(run, inputs)
    how = dict(eps=STEP, rtol=RTOL, atol=atol, check_undefined_grad=False, fast_mode=True)
    assert torch.autograd.gradcheck(of, (vector,), **how)


def assert_every_gradient(run, inputs, atol: float) -> None:
    """Checks the derivative of every output by every input."""
    of, vector = flattened(run, inputs)
    outputs = of(vector)
    (found,) = torch.autograd.grad(outputs, vector, torch.eye(len(outputs), dtype=outputs.dtype), is_grads_batched=True)
    with torch.no_grad():
        steps = STEP * torch.eye(len(vector), dtype=vector.dtype)
        wanted = torch.stack([(of(vector + step) - of(vector - step)) / (2 * STEP) for step in steps], 1)
    torch.testing.assert_close(found, wanted, rtol=RTOL, atol=atol)
