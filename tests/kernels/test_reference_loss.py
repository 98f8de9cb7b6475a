"""The photometric loss of the reference: windows one by one, weights, and gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from linprim_geo.kernels.reference.rasterize import photometric_loss

pytestmark = pytest.mark.usefixtures("one_thread")


def literal_ssim(a, b):
    """SSIM of two (H, W) images, one window at a time."""
    line = [math.exp(-((k - 5) ** 2) / (2 * 1.5**2)) for k in range(11)]
    height, width = a.shape
    out = np.zeros((height, width))
    for i in range(height):
        for j in range(width):
            sums = np.zeros(5)
            for di in range(11):
                for dj in range(11):
                    y, x = i + di - 5, j + dj - 5
                    if 0 <= y < height and 0 <= x < width:
                        p, q = a[y, x], b[y, x]
                        sums += line[di] * line[dj] / sum(line) ** 2 * np.array([p, q, p * p, q * q, p * q])
            mx, my, xx, yy, xy = sums
            out[i, j] = (
                (2 * mx * my + 1e-4)
                * (2 * (xy - mx * my) + 9e-4)
                / ((mx**2 + my**2 + 1e-4) * (xx - mx**2 + yy - my**2 + 9e-4))
            )
    return out


def random_images(seed, height=9, width=13):
    g = torch.Generator().manual_seed(seed)
    a = torch.rand(3, height, width, generator=g, dtype=torch.float64)
    b = (a + 0.3 * torch.randn(3, height, width, generator=g, dtype=torch.float64)).clamp(0, 1)
    return a, b, torch.rand(height, width, generator=g, dtype=torch.float64)


@pytest.mark.parametrize("weighted", [False, True])
def test_loss_agrees_with_windows_one_by_one(weighted):
    a, b, weight = random_images(0)
    ssim = np.stack([literal_ssim(a[c].numpy(), b[c].numpy()) for c in range(3)])
    w = np.broadcast_to(weight.numpy() if weighted else 1.0, ssim.shape)
    for share in (0.0, 0.2, 1.0):
        expected = ((1 - share) * (w * (a - b).abs().numpy()).sum() + share * (w * (1 - ssim)).sum()) / w.sum()
        loss = photometric_loss(a, b, share, weight if weighted else None)
        assert loss.item() == pytest.approx(expected, rel=1e-12)


def test_loss_of_equal_images_is_zero():
    a, b, weight = random_images(1)
    assert photometric_loss(a, a, 0.2).item() == pytest.approx(0, abs=1e-15)
    assert photometric_loss(a, b, 0.2).item() > 0.05
    assert photometric_loss(a, b, 0.2, torch.zeros_like(weight)).item() == 0


def test_uniform_weights_and_their_scale_do_not_change_the_loss():
    a, b, weight = random_images(2)
    ones = torch.ones_like(weight)
    assert photometric_loss(a, b, 0.2, ones).item() == pytest.approx(photometric_loss(a, b, 0.2).item(), rel=1e-13)
    scaled = photometric_loss(a, b, 0.2, 7 * weight).item()
    assert scaled == pytest.approx(photometric_loss(a, b, 0.2, weight).item(), rel=1e-13)


@pytest.mark.parametrize("weighted", [False, True])
def test_gradient_of_the_loss_agrees_with_finite_differences(weighted):
    a, b, weight = random_images(3, 5, 6)
    inputs = (a.requires_grad_(), b, 0.2, weight if weighted else None)
    assert torch.autograd.gradcheck(photometric_loss, inputs, eps=1e-6, atol=1e-8, rtol=1e-5)
