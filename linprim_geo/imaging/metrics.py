"""PSNR and SSIM of two images, and conversion to the 8-bit images that are compared."""

from __future__ import annotations

import numpy as np

WINDOW_SIGMA_PX = 1.5
WINDOW_RADIUS_PX = 5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2


def to_8bit(image: np.ndarray) -> np.ndarray:
    """Clamp a float image to [0, 1] and round it to uint8, halves upwards."""
    return np.floor(np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio in dB, -10 log10 of the mean squared difference over all pixels and
    channels.

    It is infinite for identical images. Nothing is clamped or rounded here.

    Args:
        a, b: images of one shape, uint8 or float in [0, 1].

    Raises:
        ValueError: the shapes differ, an image is empty, or a value is not finite.
    """
    a, b = _pair(a, b)
    error = float(np.mean((a - b) ** 2))
    return float("inf") if error == 0.0 else float(-10.0 * np.log10(error))


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Return the structural similarity with an 11x11 Gaussian window of sigma 1.5 px, averaged over all pixels and
    channels.

    With mu, var and cov the window-weighted mean, variance and covariance around a pixel of one channel, it
    is (2 mu_a mu_b + C1)(2 cov + C2) / ((mu_a^2 + mu_b^2 + C1)(var_a + var_b + C2)), C1 = 0.01^2, C2 =
    0.03^2. The image is padded with zeros, as in 3DGS, so pixels near the border have less than a full window.

    Args:
        a, b: images (H, W) or (H, W, C) of one shape, uint8 or float in [0, 1]; any size, also below 11 px.

    Raises:
        ValueError: the shapes differ, an image is empty, or a value is not finite.

    Accuracy: float64 throughout; within 1e-12 of the sum over the full 2D window.

    Source: Wang et al., "Image quality assessment", IEEE TIP 2004, eq. 13; window and border as in 3DGS.
    """
    from scipy.ndimage import correlate1d

    a, b = _pair(a, b)
    taps = np.exp(-0.5 * (np.arange(-WINDOW_RADIUS_PX, WINDOW_RADIUS_PX + 1) / WINDOW_SIGMA_PX) ** 2)
    taps /= taps.sum()

    def window_mean(image):
        rows = correlate1d(image, taps, axis=0, mode="constant")
        return correlate1d(rows, taps, axis=1, mode="constant")

    mean_a, mean_b = window_mean(a), window_mean(b)
    variances = window_mean(a * a + b * b) - mean_a**2 - mean_b**2
    covariance = window_mean(a * b) - mean_a * mean_b
    similarity = (2 * mean_a * mean_b + SSIM_C1) * (2 * covariance + SSIM_C2)
    similarity /= (mean_a**2 + mean_b**2 + SSIM_C1) * (variances + SSIM_C2)
    return float(similarity.mean())


def composite(photo, background: np.ndarray) -> np.ndarray:
    """Return the photograph over `background` (3,) in [0, 1], as (H, W, 3) uint8; without alpha, unchanged."""
    if photo.alpha is None:
        return photo.rgb
    alpha = photo.alpha[..., None] / 255.0
    return to_8bit(photo.rgb / 255.0 * alpha + np.asarray(background, np.float64) * (1.0 - alpha))


def _pair(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if a.shape != b.shape:
        raise ValueError(f"images of shapes {a.shape} and {b.shape} cannot be compared")
    if a.size == 0:
        raise ValueError("an empty image cannot be compared")
    first, second = (x / 255.0 if x.dtype == np.uint8 else np.asarray(x, np.float64) for x in (a, b))
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise ValueError("an image holds NaN or infinity")
    return first, second
