"""Samples of images: bilinear between pixel centres, clamped or wrapped outside."""

from __future__ import annotations

import numpy as np

from linprim_geo.geometry.sampling import sample_bilinear, sample_nearest


def linear(height=7, width=9):
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return (2 * x + 3 * y)[..., None].astype(np.float32)


def test_bilinear_samples_reproduce_a_linear_image():
    at = np.random.default_rng(0).uniform([0.5, 0.5], [8.5, 6.5], (4, 5, 2)).astype(np.float32)
    np.testing.assert_allclose(sample_bilinear(linear(), at)[..., 0], 2 * at[..., 0] + 3 * at[..., 1], rtol=1e-5)


def test_samples_outside_the_pixel_centres_are_clamped():
    image, at = linear(), np.array([[-5.0, 3.0], [0.2, 0.1], [9.0, 6.9], [40.0, -7.0]])
    inside = np.clip(at, 0.5, [8.5, 6.5])
    assert np.array_equal(sample_bilinear(image, at), sample_bilinear(image, inside))
    assert sample_bilinear(np.full((1, 1, 2), 4.0, np.float32), at).tolist() == [[4.0, 4.0]] * 4


def test_samples_of_a_repeating_image_wrap_around():
    image, at = linear(), np.random.default_rng(1).uniform([0.5, 0.5], [8.5, 6.5], (20, 2))
    once = sample_bilinear(image, at, repeat=True)
    assert np.array_equal(once, sample_bilinear(image, at))
    np.testing.assert_allclose(sample_bilinear(image, at + [-18, 14], repeat=True), once, rtol=1e-5)
    edge = sample_bilinear(image, np.array([9.0, 2.5]), repeat=True)  # half-way between the last column and the first
    assert edge == (image[2, 8] + image[2, 0]) / 2


def test_nearest_sample_is_the_pixel_that_contains_the_point():
    image = np.arange(12).reshape(3, 4)
    at = np.array([[[0.0, 0.0], [0.99, 0.99], [1.0, 0.0], [3.9, 2.9], [-3.0, 9.0]]])
    assert sample_nearest(image, at).tolist() == [[0, 0, 1, 11, 8]]
