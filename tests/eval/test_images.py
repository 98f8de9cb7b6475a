"""PSNR and SSIM against closed forms and a direct evaluation, and the scoring of a run's held-out views."""

import csv
import json
import math
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.types import Photo
from linprim_geo.eval.images import eval_images_run, score_images
from linprim_geo.geometry.camera import Camera
from linprim_geo.imaging.metrics import composite, psnr, ssim, to_8bit

C1, C2 = 0.01**2, 0.03**2


def ssim_direct(a, b):
    """Evaluate the definition for every window, without separable filters or running moments."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    height, width, channels = a.shape
    total = 0.0
    for channel in range(channels):
        x, y = (np.pad(image[..., channel], 5) for image in (a, b))
        for i in range(height):
            for j in range(width):
                u, v = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
                mu_u, mu_v = (window * u).sum(), (window * v).sum()
                var_u, var_v = (window * (u - mu_u) ** 2).sum(), (window * (v - mu_v) ** 2).sum()
                cov = (window * (u - mu_u) * (v - mu_v)).sum()
                total += (2 * mu_u * mu_v + C1) * (2 * cov + C2) / ((mu_u**2 + mu_v**2 + C1) * (var_u + var_v + C2))
    return total / a.size


@pytest.mark.parametrize("shape", [(23, 17, 3), (11, 11, 1), (4, 30, 3), (1, 1, 3)])
def test_ssim_agrees_with_its_definition(shape):
    random = np.random.default_rng(1)
    a = random.random(shape)
    b = np.clip(a + 0.2 * random.standard_normal(shape), 0, 1)
    assert ssim(a, b) == pytest.approx(ssim_direct(a, b), abs=1e-12)


def test_ssim_of_equal_images_is_one_and_it_is_symmetric():
    random = np.random.default_rng(2)
    a, b = random.random((2, 20, 31, 3))
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-15)
    assert ssim(a, b) == ssim(b, a)
    assert ssim(a, 1 - a) < 0  # every window is anticorrelated


def test_ssim_of_constant_images_inside_is_the_luminance_term():
    a, b = np.full((200, 200), 0.3), np.full((200, 200), 0.6)
    luminance = (2 * 0.3 * 0.6 + C1) / (0.3**2 + 0.6**2 + C1)
    # Only the 5 px border sees the zeros outside; its share of the mean is 1 - (190/200)^2.
    border = 1 - (190 / 200) ** 2
    assert abs(ssim(a, b) - luminance) < border
    assert abs(ssim(a, b) - luminance) > 1e-4  # zeros outside do count, as in 3DGS


def test_ssim_of_uint8_and_of_the_same_values_as_float_agree():
    random = np.random.default_rng(3)
    a, b = random.integers(0, 256, (2, 16, 16, 3), dtype=np.uint8)
    assert ssim(a, b) == ssim(a / 255.0, b / 255.0)
    assert psnr(a, b) == psnr(a / 255.0, b / 255.0)


@pytest.mark.parametrize("step", [0.5, 0.1, 1e-3])
def test_psnr_of_a_constant_difference(step):
    a = np.full((9, 7, 3), 0.25)
    assert psnr(a, a + step) == pytest.approx(-20 * math.log10(step), abs=1e-9)


def test_psnr_of_equal_images_is_infinite():
    a = np.random.default_rng(4).random((5, 6, 3))
    assert psnr(a, a.copy()) == math.inf


def test_psnr_averages_squares_over_pixels_and_channels():
    a = np.zeros((4, 4, 3))
    b = a.copy()
    b[0, 0, 0] = 1.0
    assert psnr(a, b) == pytest.approx(10 * math.log10(48))


@pytest.mark.parametrize("score", [psnr, ssim])
def test_incompatible_images_are_refused(score):
    good = np.zeros((12, 12, 3))
    with pytest.raises(ValueError, match="shapes"):
        score(good, np.zeros((12, 13, 3)))
    with pytest.raises(ValueError, match="empty"):
        score(good[:0], good[:0])
    with pytest.raises(ValueError, match="NaN"):
        score(good, np.full_like(good, np.nan))


def test_rounding_to_8_bits_is_within_half_a_step_and_clamps():
    values = np.linspace(-0.2, 1.2, 100_001)
    rounded = to_8bit(values)
    inside = (values >= 0) & (values <= 1)
    assert np.abs(rounded[inside] / 255.0 - values[inside]).max() <= 0.5 / 255 + 1e-15
    assert (rounded[values < 0] == 0).all() and (rounded[values > 1] == 255).all()
    assert (to_8bit(np.arange(256) / 255.0) == np.arange(256)).all()


def test_score_images_averages_over_pairs():
    a = np.zeros((12, 12, 3))
    result = score_images([(a, a + 0.1), (a, a + 0.01)])
    assert result["psnr"] == pytest.approx((20 + 40) / 2)
    assert result["views"] == 2
    with pytest.raises(ValueError, match="no images"):
        score_images([])


def test_compositing_over_the_background():
    rgb = np.full((1, 3, 3), 200, np.uint8)
    alpha = np.array([[0, 128, 255]], np.uint8)
    over = composite(Photo(rgb, alpha), np.array([0.0, 0.5, 1.0]))
    assert over[0, 0].tolist() == [0, 128, 255]
    assert over[0, 2].tolist() == [200, 200, 200]
    share = 128 / 255
    expected = [200 * share + 255 * background * (1 - share) for background in (0.0, 0.5, 1.0)]
    assert np.abs(over[0, 1] - expected).max() <= 0.5
    assert composite(Photo(rgb), np.zeros(3)) is rgb


@dataclass(frozen=True)
class FakeView:
    name: str
    camera: Camera
    photo: Photo

    def load(self):
        return self.photo


@dataclass
class FakeRun:
    """A run that renders given images."""

    path: object
    test: tuple
    renders: dict
    background: np.ndarray = field(default_factory=lambda: np.array([1.0, 0.0, 0.5]))

    def scene(self):
        return SimpleNamespace(root="scene", train=(), test=self.test, unit="m")

    def render_views(self, views, geometry=True):
        assert not geometry  # nothing but colour is needed
        for view in views:
            yield view, {"rgb": self.renders[view.name]}


def make_run(path, renders, photos):
    camera = Camera(16, 12, 10.0, 10.0, 8.0, 6.0, np.eye(4))
    views = tuple(FakeView(name, camera, photo) for name, photo in photos.items())
    return FakeRun(path, views, renders)


def test_run_scores_and_files(tmp_path):
    truth = np.full((12, 16, 3), 100, np.uint8)
    half = np.zeros((12, 16), np.uint8)
    half[:, 8:] = 255
    background = np.array([1.0, 0.0, 0.5])
    masked = np.empty((3, 12, 16), np.float32)
    masked[:, :, :8] = background[:, None, None]
    masked[:, :, 8:] = 100 / 255
    off = np.full((3, 12, 16), 110 / 255, np.float32)
    run = make_run(tmp_path, {"a": off, "b": masked + 0.4 / 255}, {"a": Photo(truth), "b": Photo(truth, half)})
    results = eval_images_run(run)
    rows = list(csv.DictReader((tmp_path / "eval" / "images" / "per_view.csv").open()))
    assert [row["name"] for row in rows] == ["a", "b"]
    assert float(rows[0]["psnr"]) == pytest.approx(20 * math.log10(255 / 10))
    # b is its photograph over the run's background, up to less than half an 8-bit step: rounded away. Only
    # the channel with 0.5 * 255 = 127.5 rounds halves up on both sides.
    assert rows[1]["psnr"] == "inf" and float(rows[1]["ssim"]) == pytest.approx(1.0)
    assert results["views"] == 2 and math.isnan(results["psnr_standard_error"])  # one of them is infinite
    assert results["ssim_standard_error"] == pytest.approx((1 - float(rows[0]["ssim"])) / 2)
    assert results["ssim"] == pytest.approx((float(rows[0]["ssim"]) + 1) / 2)
    written = json.loads((tmp_path / "eval" / "images" / "results.json").read_text())
    assert written["psnr"] is None and written["ssim"] == results["ssim"]
    assert {"psnr", "ssim", "views", "protocol", "seconds"} <= set(written)


def test_run_with_unusable_renders_is_refused_and_writes_nothing(tmp_path):
    photo = Photo(np.zeros((12, 16, 3), np.uint8))
    wrong = np.zeros((3, 12, 15), np.float32)
    with pytest.raises(LinprimError, match="view a: the render is 15x12, expected 16x12"):
        eval_images_run(make_run(tmp_path, {"a": wrong}, {"a": photo}))
    bad = np.full((3, 12, 16), np.nan, np.float32)
    with pytest.raises(LinprimError, match="view a.*NaN"):
        eval_images_run(make_run(tmp_path, {"a": bad}, {"a": photo}))
    with pytest.raises(LinprimError, match="no views"):
        eval_images_run(make_run(tmp_path, {}, {}))
    with pytest.raises(LinprimError, match="split 'val'"):
        eval_images_run(make_run(tmp_path, {}, {"a": photo}), split="val")
    assert list(tmp_path.iterdir()) == []
