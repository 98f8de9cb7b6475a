"""Effects of a camera: size and unit of each, and values that they must not change."""

import json
from dataclasses import replace

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.srgb import to_linear, to_srgb
from linprim_geo.geometry.camera import Camera
from linprim_geo.synthetic import camera_effects as effects
from linprim_geo.synthetic.camera_paths import look_at
from linprim_geo.synthetic.options import SynthOptions
from linprim_geo.synthetic.pose_errors import reported
from linprim_geo.synthetic.synth import synthesize

SMALL = {"views": 6, "test_views": 2, "size": (64, 48), "supersample": 1, "points": 50, "background": "0.3,0.3,0.3"}


def photographed(values, **options):
    """Apply the effects to `values` as the first held-out photograph."""
    return effects.CameraEffects(SynthOptions(**options)).apply(np.asarray(values, np.float32), "test", 0)


def test_linear_and_srgb_are_inverse():
    values = np.linspace(0.0, 1.0, 1001)
    np.testing.assert_allclose(to_srgb(to_linear(values)), values, atol=1e-9)


def test_image_is_returned_unchanged_without_effects():
    picture = np.full((4, 5, 3), 0.3, np.float32)
    assert effects.CameraEffects(SynthOptions(noise=2.0)).apply(picture, "train", 3) is picture


@pytest.mark.parametrize("light", [0.02, 0.2, 0.8])
def test_noise_variance_is_shot_noise_plus_read_noise(light):
    well, read = 5000.0, 20.0
    seen = effects.exposed(np.full((300, 300, 1), light), well, read, np.random.default_rng(0)) * well
    electrons = light * well
    # 90,000 values: their mean and variance are within 5 standard errors of the truth.
    assert abs(seen.mean() - electrons) < 5 * np.sqrt((electrons + read**2) / seen.size)
    assert seen.var() == pytest.approx(electrons + read**2, rel=5 * np.sqrt(2 / seen.size))


def test_vignetting_darkens_corners_by_the_given_share():
    seen = to_linear(photographed(np.full((101, 201, 3), 0.7), vignetting=0.4))
    middle = float(to_linear(0.7))
    # The middle of the corner pixel is half a pixel inside the corner.
    inside = ((100.5 - 0.5) ** 2 + (50.5 - 0.5) ** 2) / (100.5**2 + 50.5**2)
    assert seen[50, 100] == pytest.approx(middle, rel=1e-5)
    assert seen[0, 0] == pytest.approx(middle * (1 - 0.4 * inside), rel=1e-5)


def test_demosaicing_keeps_measured_values_and_interpolates_the_rest():
    rng = np.random.default_rng(0)
    light = rng.random((10, 12, 3))
    seen = effects.demosaiced(light)
    np.testing.assert_allclose(seen[::2, ::2, 0], light[::2, ::2, 0])
    np.testing.assert_allclose(seen[1::2, 1::2, 2], light[1::2, 1::2, 2])
    np.testing.assert_allclose(seen[::2, 1::2, 1], light[::2, 1::2, 1])
    np.testing.assert_allclose(seen[1::2, ::2, 1], light[1::2, ::2, 1])
    # Red is the mean of two neighbours at a green pixel in a row of red ones, and of four corners at a blue pixel.
    np.testing.assert_allclose(seen[2, 3, 0], (light[2, 2, 0] + light[2, 4, 0]) / 2)
    np.testing.assert_allclose(seen[3, 3, 0], light[2:5:2, 2:5:2, 0].mean())
    np.testing.assert_allclose(seen[4, 4, 1], (light[3, 4, 1] + light[5, 4, 1] + light[4, 3, 1] + light[4, 5, 1]) / 4)
    # Interpolation is exact for a linear image except at the border.
    ramp = np.indices((10, 12)).sum(0)[..., None] * np.ones(3) / 30
    np.testing.assert_allclose(effects.demosaiced(ramp)[1:-1, 1:-1], ramp[1:-1, 1:-1])
    np.testing.assert_allclose(photographed(np.full((8, 8, 3), 0.4), mosaic="bayer"), 0.4, atol=1e-6)


def test_motion_blur_is_a_line_of_the_given_length_and_keeps_the_sum():
    dot = np.zeros((81, 81, 1))
    dot[40, 40] = 1.0
    lengths = []
    for seed in range(200):
        blurred = effects.motion_blurred(dot, 6.0, np.random.default_rng(seed))[..., 0]
        assert blurred.sum() == pytest.approx(1.0)
        y, x = np.mgrid[:81, :81] - 40.0
        spread = np.array([[(blurred * a * b).sum() for a in (x, y)] for b in (x, y)])
        # Of a line of length L the variance along it is L^2 / 12; interpolation adds less than 1/4 px^2.
        along = np.linalg.eigvalsh(spread)
        assert along[0] < 0.3
        lengths.append(np.sqrt(12 * max(along[1] - 0.17, 0.0)))
    assert np.mean(lengths) == pytest.approx(6.0, rel=0.15)


def test_exposure_and_white_balance_vary_smoothly_within_their_limits():
    drawn = effects.CameraEffects(SynthOptions(views=60, exposure_walk=0.5, white_balance=0.1))
    assert np.abs(drawn.stops).max() == pytest.approx(0.5) and abs(drawn.stops.mean()) < 1e-12
    assert np.abs(drawn.balance).max() == pytest.approx(0.1)
    assert np.abs(np.diff(drawn.stops)).max() < 0.25
    grey = np.full((3, 3, 3), 0.5, np.float32)
    brightest = int(np.argmax(np.abs(drawn.stops)))
    seen = to_linear(drawn.apply(grey, "train", brightest)[0, 0])
    light = to_linear(0.5) * 2.0 ** drawn.stops[brightest]
    balance = drawn.balance[brightest]
    np.testing.assert_allclose(seen, np.minimum(light * np.array([1 + balance, 1, 1 - balance]), 1.0), rtol=1e-5)
    # Held-out photographs have neither.
    np.testing.assert_allclose(drawn.apply(grey, "test", 0), grey, atol=1e-6)


def test_tone_curve_is_increasing_and_fixes_black_middle_and_white():
    values = np.linspace(0.0, 1.0, 101)
    seen = effects.toned(values, 1.0)
    np.testing.assert_allclose(seen[[0, 50, 100]], [0.0, 0.5, 1.0], atol=1e-12)
    assert (np.diff(seen) > 0).all() and seen[25] < 0.25 and seen[75] > 0.75


def test_pose_errors_move_projections_by_the_given_pixels():
    camera = Camera(640, 480, 600.0, 600.0, 320.0, 240.0, look_at(np.array([4.0, 0.0, 1.0]), np.zeros(3)))
    distance = float(np.linalg.norm(camera.center))
    moved = reported([camera] * 4000, 0.8, 0.0, distance, (3,))
    offsets = np.array([told.project(np.zeros((1, 3)))[0][0] for told in moved]) - (320.0, 240.0)
    # Of 4,000 squared distances the mean is known to 1.6 %.
    assert np.sqrt((offsets**2).sum(1).mean()) == pytest.approx(0.8, rel=0.05)
    for told in moved[:3]:
        np.testing.assert_allclose(told.rotation @ told.rotation.T, np.eye(3), atol=1e-12)
    assert reported([camera], 0.0, 0.005, distance, (3,))[0].fx == pytest.approx(603.0)


def test_phone_enables_all_effects_and_explicit_options_win():
    phone = effects.with_camera(SynthOptions(camera="phone", jpeg=75))
    assert phone.jpeg == 75
    assert all(getattr(phone, name) == value for name, value in effects.PHONE.items() if name != "jpeg")
    assert effects.with_camera(SynthOptions()) == SynthOptions()
    default = SynthOptions()
    assert all(getattr(default, name) != value for name, value in effects.PHONE.items())


def test_true_cameras_are_written_beside_cameras_with_errors(tmp_path):
    synthesize(tmp_path / "true", **SMALL)
    synthesize(tmp_path / "told", pose_error=1.0, focal_error=0.01, **SMALL)
    true, told = (json.loads((tmp_path / name / "transforms_train.json").read_text()) for name in ("true", "told"))
    assert told["fl_x"] == pytest.approx(1.01 * true["fl_x"])
    kept = json.loads((tmp_path / "told" / "truth_cameras.json").read_text())
    assert not (tmp_path / "true" / "truth_cameras.json").exists()
    for frame, wrong, pose in zip(true["frames"], told["frames"], kept["world_to_camera"]["train"], strict=True):
        matrix = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(np.linalg.inv(matrix), pose, atol=1e-9)
        assert not np.allclose(frame["transform_matrix"], wrong["transform_matrix"])
    for name in ("train/000.png", "depth/train/000.png"):
        assert (tmp_path / "true" / name).read_bytes() == (tmp_path / "told" / name).read_bytes()


def test_photographs_depend_on_the_seed_and_not_on_threads(tmp_path):
    many = {"full_well": 4000.0, "motion_blur": 1.0, "vignetting": 0.2, "jpeg": 90, **SMALL}
    for name, seed, threads in (("a", 1, 1), ("b", 1, 2), ("c", 2, 1)):
        synthesize(tmp_path / name, seed=seed, threads=threads, path="orbit", **many)
    photos = [(tmp_path / name / "train" / "003.jpg").read_bytes() for name in "abc"]
    assert photos[0] == photos[1] != photos[2]


def test_points_are_triangulated_from_the_photographs(tmp_path):
    options = {**SMALL, "size": (160, 120), "views": 10}
    report = synthesize(tmp_path / "out", points_from="photographs", **options)
    model = tmp_path / "out" / "sparse" / "0"
    assert (model / "points3D.bin").exists()
    assert report["points"] != 50


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"read_noise": 4.0}, "--full-well is 0"),
        ({"motion_blur": 1.0}, "the background is transparent"),
        ({"points_from": "photographs", "distortion": -0.1}, "without distortion only"),
        ({"camera": "phone"}, "the background is transparent"),
        ({"camera": "camera"}, "--camera is 'camera'"),
    ],
)
def test_contradictory_effects_are_refused(tmp_path, options, said):
    with pytest.raises(LinprimError, match=said):
        synthesize(tmp_path / "out", views=4, test_views=1, size=(32, 32), **options)
    assert not (tmp_path / "out").exists()


def test_phone_keeps_other_options():
    options = replace(SynthOptions(), camera="phone", views=12)
    assert effects.with_camera(options).views == 12
