"""The compiled image loss and Adam step, compared with float64 torch and torch.optim.Adam."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.octahedra import KERNELS, kernels

from linprim_geo.base.errors import LinprimError
from linprim_geo.kernels import ops
from linprim_geo.kernels.adam import adam_step
from linprim_geo.kernels.reference import rasterize as reference

EPS = torch.finfo(torch.float32).eps


@pytest.fixture(autouse=True)
def few_threads():
    before = torch.get_num_threads(), ops.threads(), ops.instruction_set()
    torch.set_num_threads(1)
    ops.set_threads(1)
    yield
    torch.set_num_threads(before[0])
    ops.set_threads(before[1])
    ops.set_instruction_set(before[2])


def images(height, width, seed=0, noise=0.3):
    """A smooth image with noise, another, and a weight with zeros; float32."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / max(height, width)
    a = 0.5 + 0.3 * np.sin(7 * x + 3 * y + np.arange(3)[:, None, None]) + noise * rng.normal(size=(3, height, width))
    b = 0.5 + 0.3 * np.sin(7 * x + 3 * y + np.arange(3)[:, None, None]) + noise * rng.normal(size=(3, height, width))
    weight = rng.random((height, width)) * (rng.random((height, width)) < 0.8)
    weight[0, 0] = 1.0
    return [
        torch.from_numpy(v.clip(0, 1)).float() if v.ndim == 3 else torch.from_numpy(v).float() for v in (a, b, weight)
    ]


def compare(image, target, share=0.2, weight=None):
    """Error of the loss, and the largest and the root mean square error of the gradient, relative to those of the
    gradient."""
    inputs, exact = image.clone().requires_grad_(), image.double().requires_grad_()
    parts = ops.photometric_loss(inputs, target, share, weight)
    parts[0].backward()
    wanted = reference.photometric_loss(exact, target.double(), share, None if weight is None else weight.double())
    wanted.backward()
    off = inputs.grad.double() - exact.grad
    return (
        abs((parts[0] - wanted).item()),
        (off.abs().max() / exact.grad.abs().max()).item(),
        (off.norm() / exact.grad.norm()).item(),
    )


# float32 moments of values up to 1 are rounded to EPS, and a variance is a difference of two of them beside C2 = 9e-4:
# on noise of variance 0.05 the SSIM is off by some EPS / 0.05, and the gradient in that proportion; means over pixels
# hide most of it. The last is wider than the 1024 columns that the core takes at once.
SIZES = [(1, 1), (1, 50), (50, 1), (3, 4), (10, 10), (11, 11), (12, 37), (64, 48), (97, 33), (200, 17), (13, 1043)]


@pytest.mark.parametrize("isa", KERNELS)
@pytest.mark.parametrize("size", SIZES)
def test_loss_and_gradient_agree_with_the_reference(size, isa):
    a, b, weight = images(*size)
    with kernels(isa):
        for share in (0.0, 0.2, 1.0):
            for w in (None, weight):
                loss, largest, rms = compare(a, b, share, w)
                assert loss < 1e-6 and largest < 2e-5 and rms < 5e-6


@pytest.mark.parametrize("isa", KERNELS)
def test_parts_of_the_loss_agree_with_their_definitions(isa):
    a, b, weight = images(40, 31, 1)
    with kernels(isa):
        for w in (None, weight):
            loss, l1, ssim, mse = ops.photometric_loss(a, b, 0.3, w).tolist()
            scale = (torch.ones_like(weight) if w is None else w).double()
            scale = scale / (3 * scale.sum())
            d = (a - b).double()
            assert l1 == pytest.approx((scale * d.abs()).sum().item(), rel=1e-6)
            assert mse == pytest.approx((scale * d * d).sum().item(), rel=1e-6)
            assert ssim == pytest.approx((scale * reference.ssim_map(a.double(), b.double())).sum().item(), rel=1e-5)
            assert loss == pytest.approx(0.7 * l1 + 0.3 * (1 - ssim), rel=1e-6)


@pytest.mark.parametrize("isa", KERNELS)
def test_smooth_bright_images_are_within_a_few_hundred_roundings(isa):
    # White against nearly white: the variances are 1e-6 and less and cancel to EPS, so that SSIM is off by up to EPS /
    # C2 = 1.3e-4 in a pixel, and its gradient by as much of 2 / C2.
    white = torch.ones(3, 64, 64)
    noise = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0))
    with kernels(isa):
        for step in (1e-3, 1e-2, 1e-1):
            loss, largest, rms = compare(white - step * noise, white)
            assert loss < 0.2 * EPS / 9e-4 and largest < 4 * EPS / 9e-4 and rms < EPS / 9e-4


def test_equal_images_have_no_loss_and_no_gradient():
    a, _, weight = images(30, 20, 2)
    for w in (None, weight):
        inputs = a.clone().requires_grad_()
        parts = ops.photometric_loss(inputs, a, 0.2, w)
        parts[0].backward()
        assert abs(parts[0].item()) < 1e-6 and parts[1] == 0 and parts[3] == 0
        # The terms of the gradient are 1 / C2 each before they cancel, over the number of pixels.
        assert inputs.grad.abs().max() < 20 * EPS / 9e-4 / (3 * 30 * 20)


def test_backward_can_be_repeated_and_scaled():
    a, b, _ = images(20, 13, 3)
    inputs = a.clone().requires_grad_()
    loss = ops.photometric_loss(inputs, b)[0]
    (first,) = torch.autograd.grad(loss, inputs, retain_graph=True)
    first = first.clone()
    for k in (1, 2, 3):  # accumulated in place
        loss.backward(retain_graph=True)
        torch.testing.assert_close(inputs.grad, k * first, rtol=1e-6, atol=0)
    (half,) = torch.autograd.grad(0.5 * loss, inputs, retain_graph=True)
    assert torch.equal(half, 0.5 * first)
    (plus,) = torch.autograd.grad(loss + (inputs * b).sum(), inputs)
    torch.testing.assert_close(plus, first + b, rtol=1e-6, atol=1e-7)


def test_gradient_agrees_with_finite_differences():
    # In float32 a difference over a step h is good to EPS / h of the loss; the loss is smooth but for the L1 kinks,
    # which lie far off.
    a, b, weight = images(9, 8, 4)
    inputs = a.clone().requires_grad_()
    ops.photometric_loss(inputs, b, 0.8, weight)[0].backward()
    direction = torch.randn(a.shape, generator=torch.Generator().manual_seed(5)) * ((a - b).abs() > 0.02)
    step = 1e-3

    def loss(t):
        return ops.photometric_loss(a + t * direction, b, 0.8, weight)[0].item()

    assert (inputs.grad * direction).sum().item() == pytest.approx(
        (loss(step) - loss(-step)) / (2 * step), rel=2e-3, abs=2e-4
    )


def test_non_contiguous_inputs_give_the_same_result_and_stay_unchanged():
    a, b, weight = images(21, 16, 6)
    wanted = ops.photometric_loss(a, b, 0.2, weight)
    twisted = [t.transpose(-1, -2).contiguous().transpose(-1, -2) for t in (a, b, weight)]
    before = [t.clone() for t in twisted]
    assert not twisted[0].is_contiguous()
    inputs = twisted[0].detach().requires_grad_()
    got = ops.photometric_loss(inputs, twisted[1], 0.2, twisted[2])
    got[0].backward()
    other = a.clone().requires_grad_()
    ops.photometric_loss(other, b, 0.2, weight)[0].backward()
    assert torch.equal(got.detach(), wanted) and torch.equal(inputs.grad, other.grad)
    assert all(torch.equal(x, y) for x, y in zip(twisted, before, strict=True))


@pytest.mark.parametrize("weighted", [False, True])
def test_the_operator_is_registered_correctly(weighted):
    a, b, weight = images(7, 9, 7)
    args = (a.requires_grad_(), b, 0.2, weight if weighted else None)
    torch.library.opcheck(torch.ops.linprim_geo.photometric_loss.default, args)


def test_wrong_shapes_are_refused_by_name():
    a, b, weight = images(9, 8, 8)
    cases = {
        "target": (a, b[:, :-1]),
        "image has": (a[0], b),
        "weight": (a, b, 0.2, weight[:-1]),
        "empty": (a[:, :0], b[:, :0]),
    }
    for name, args in cases.items():
        with pytest.raises(ValueError, match=name):
            ops.photometric_loss(*args)


def test_a_weight_of_zero_has_no_gradient():
    a, b, weight = images(9, 8, 9)
    inputs = a.clone().requires_grad_()
    ops.photometric_loss(inputs, b, 0.2, torch.zeros_like(weight))[0].backward()
    assert not inputs.grad.any()


def test_a_weight_of_zero_has_no_loss():
    a, b, weight = images(9, 8, 9)
    assert ops.photometric_loss(a, b, 0.2, torch.zeros_like(weight))[0].item() == 0


def test_a_double_image_is_refused_or_has_its_gradient():
    a, b, _ = images(9, 8, 10)
    single, double = a.clone().requires_grad_(), a.double().requires_grad_()
    ops.photometric_loss(single, b)[0].backward()
    try:
        ops.photometric_loss(double, b)[0].backward()
    except (LinprimError, ValueError, TypeError):
        return
    torch.testing.assert_close(double.grad.float(), single.grad)


# --- Adam ---


@pytest.mark.parametrize("isa", KERNELS)
@pytest.mark.parametrize("n", [1, 7, 70_001])
def test_adam_equals_torch(n, isa):
    rng = torch.Generator().manual_seed(n)
    value = torch.randn(n, generator=rng)
    mine, theirs = value.clone(), torch.nn.Parameter(value.double())
    first, second = torch.zeros(n), torch.zeros(n)
    optimiser = torch.optim.Adam([theirs], lr=0.02, betas=(0.9, 0.99), eps=1e-8)
    with kernels(isa):
        for step in range(1, 31):
            gradient = torch.randn(n, generator=rng) * 10 ** (4 * torch.rand(n, generator=rng) - 3)
            if step == 5:
                gradient.zero_()
            before = gradient.clone()
            adam_step(mine, gradient, first, second, 0.02, step, beta1=0.9, beta2=0.99, epsilon=1e-8)
            theirs.grad = before.double()
            optimiser.step()
            assert torch.equal(gradient, before)
    # A step is at most 0.02 * (1 - 0.9) / sqrt(1 - 0.99) = 0.02 and is good to some 20 EPS; 1 - 0.9f and 1 - 0.99f are
    # rounded to 2^-25 / 0.1 and 2^-25 / 0.01 of themselves. The value, about 4 at most, is rounded once per step.
    state = optimiser.state[theirs]
    torch.testing.assert_close(first.double(), state["exp_avg"], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(second.double(), state["exp_avg_sq"], rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(mine.double(), theirs.detach(), rtol=0, atol=30 * (4 * EPS / 2 + 0.02 * 40 * EPS))


def test_adam_first_step_is_the_rate():
    value, gradient = torch.zeros(6), torch.tensor([1e-9, -1e-6, 0.5, -3.0, 1e9, 0.0])  # far above epsilon = 1e-15
    adam_step(value, gradient, torch.zeros(6), torch.zeros(6), 0.1, 1)
    torch.testing.assert_close(value, -0.1 * gradient.sign(), rtol=1e-5, atol=0)


def test_adam_refuses_other_sizes_and_step_zero():
    t = torch.zeros(4)
    for args in ((t, torch.zeros(3), t.clone(), t.clone()), (t, t.clone(), torch.zeros(5), t.clone())):
        with pytest.raises(ValueError, match="differ in size"):
            adam_step(*args, 0.1, 1)
    with pytest.raises(ValueError, match="step counts from 1"):
        adam_step(t, t.clone(), t.clone(), t.clone(), 0.1, 0)


@pytest.mark.parametrize("which", ["value", "first", "second"])
@pytest.mark.parametrize("kind", ["transposed", "double"])
def test_adam_refuses_or_steps_tensors_of_another_layout(which, kind):
    tensors = {name: torch.zeros(4, 3) for name in ("value", "first", "second")}
    odd = torch.zeros(3, 4).t() if kind == "transposed" else torch.zeros(4, 3, dtype=torch.float64)
    tensors[which] = odd
    try:
        adam_step(tensors["value"], torch.ones(4, 3), tensors["first"], tensors["second"], 0.1, 1)
    except (LinprimError, ValueError, TypeError):
        return
    assert (odd != 0).all()
