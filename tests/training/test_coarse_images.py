"""Photographs averaged down for the first part of a training."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from linprim_geo.base.options import TrainOptions
from linprim_geo.geometry.camera import Camera
from linprim_geo.runs.run import Run
from linprim_geo.training.start import start_trainer
from linprim_geo.training.step import coarse_images
from linprim_geo.training.step.coarse_images import CoarseImages, averaged_down, coarsest_factor
from linprim_geo.training.step.trainer import Trainer
from linprim_geo.training.step.training_images import TrainingImage, load_training_images
from linprim_geo.training.train import train


def image(width: int, height: int, alpha: float | None = None) -> TrainingImage:
    """A photograph of noise, of whose pixels the share `alpha` is foreground."""
    random = np.random.default_rng(0)
    rgb = torch.from_numpy(random.integers(0, 256, (3, height, width), dtype=np.uint8))
    shown = None
    if alpha is not None:
        shown = torch.zeros(height, width, dtype=torch.uint8)
        shown[: round(alpha * height)] = 255
    return TrainingImage("a", Camera(width, height, 500.0, 510.0, width / 2 + 3, height / 2 - 5, np.eye(4)), rgb, shown)


@pytest.mark.parametrize(
    ("size", "primitives", "alpha", "factor"),
    [
        ((480, 360), 20_000, None, 2),  # 2.2 pixels per primitive at half the size
        ((480, 360), 30_000, None, 1),
        ((1344, 1008), 20_000, None, 4),
        ((1600, 1200), 20_000, None, 4),
        ((1600, 1200), 10_000, None, 8),
        ((1600, 1200), 1000, None, 8),  # 200 pixels along the longer side
        ((398, 398), 100, None, 1),
        ((800, 800), 20_000, 0.2, 1),  # a fifth of the pixels shows the object
        ((800, 800), 20_000, 0.3, 2),
    ],
)
def test_photographs_are_averaged_while_primitives_have_pixels(size, primitives, alpha, factor):
    assert coarsest_factor([image(*size, alpha)] * 3, primitives) == factor


def test_phases_halve_the_factor_until_photographs_are_whole():
    images = [image(1600, 1200)]
    coarse = CoarseImages(images, TrainOptions(max_primitives=10_000))
    assert coarse.phases() == [(0.0, 8), (0.225, 4), (0.45, 2), (0.9, 1)]
    assert [coarse.factor(share) for share in (0.0, 0.22, 0.225, 0.89, 0.9, 1.0)] == [8, 8, 4, 2, 1, 1]
    assert CoarseImages(images, TrainOptions(coarse="off")).phases() == [(0.0, 1)]
    late = CoarseImages(images, TrainOptions(max_primitives=20_000, sensor_depth=1.0, geometry_from=0.6))
    assert late.phases() == [(0.0, 4), (0.3, 2), (0.6, 1)]
    assert CoarseImages(images, TrainOptions(sensor_depth=1.0, geometry_from=0.0)).factor(0.0) == 1


def test_averaged_image_shows_the_same_through_its_camera():
    whole = image(7, 5)
    half = averaged_down(whole, 2)
    assert (half.camera.width, half.camera.height) == (3, 2) and half.rgb.shape == (3, 2, 3)
    mean = whole.rgb[:, :2, 2:4].float().mean((1, 2))
    assert (half.rgb[:, 0, 1].float() - mean).abs().max() <= 0.5
    # The ray through the corner of four pixels is the ray through the centre of their mean.
    ray = half.camera.ray_grid()[0, 1]
    pixel, _ = whole.camera.project(3.0 * ray[None])
    assert pixel[0] == pytest.approx([3.0, 1.0])


def test_averaged_colours_are_weighted_by_alpha():
    alpha = torch.tensor([[255, 0], [255, 0]], dtype=torch.uint8)
    rgb = torch.tensor([[200, 10], [100, 20]], dtype=torch.uint8).expand(3, 2, 2).contiguous()
    half = averaged_down(TrainingImage("a", image(2, 2).camera, rgb, alpha, (8, 6)), 2)
    assert half.rgb.flatten().tolist() == [150] * 3 and half.alpha.flatten().tolist() == [128] and half.size == (4, 3)


def test_averaged_images_are_kept_up_to_the_limit(monkeypatch):
    images = [image(400, 300), image(400, 300)]
    coarse = CoarseImages(images, TrainOptions(max_primitives=100))
    monkeypatch.setattr(coarse_images, "photo_limit", lambda: 3 * 200 * 150 + 1)
    first, second = coarse.image(0, 2), coarse.image(1, 2)
    assert coarse.image(0, 2) is first and coarse.image(1, 2) is not second
    assert torch.equal(coarse.image(1, 2).rgb, second.rgb)
    assert coarse.image(0, 1) is images[0]


def test_a_coarse_run_resumes_bit_for_bit_and_ends_on_whole_photographs(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(coarse_images, "LEAST_SIDE", 10)
    options = TrainOptions(
        iterations=40, max_primitives=60, checkpoint_every=10, evaluate_every=0, sh_degree=0, threads=1
    )
    sizes = []
    used = CoarseImages.image
    monkeypatch.setattr(CoarseImages, "image", lambda self, i, factor: sizes.append(factor) or used(self, i, factor))
    train(tiny_scene, tmp_path / "whole", options=options, quiet=True)
    assert sizes[0] > 1 and sizes == sorted(sizes, reverse=True)
    assert sizes[35:] == [2] + [1] * 4
    advance = Trainer.advance

    def die(self):
        if self.step == 25:
            raise KeyboardInterrupt
        advance(self)

    monkeypatch.setattr(Trainer, "advance", die)
    with pytest.raises(KeyboardInterrupt):
        train(tiny_scene, tmp_path / "part", options=options, quiet=True)
    monkeypatch.setattr(Trainer, "advance", advance)
    train(tiny_scene, tmp_path / "part", resume=True, quiet=True)
    first, second = (Run.open(tmp_path / name).primitives() for name in ("whole", "part"))
    assert np.array_equal(first.center, second.center) and np.array_equal(first.sh, second.sh)


@pytest.mark.parametrize("environment", [False, True])
def test_a_coarse_step_is_that_of_averaged_photographs(environment, tiny_run):
    """Trainers whose images are averaged down by two beforehand, and in the step."""
    run = Run.open(tiny_run)
    images = load_training_images(run.scene().train, run.similarity)
    options = replace(run.train_options, coarse="off")
    started = start_trainer(run.scene(), run, images, options, None)

    def trainer(images: list[TrainingImage]) -> Trainer:
        parameters = {name: value.clone() for name, value in started.parameters.items()}
        texels = torch.full((6, 4, 4, 3), 0.5) if environment else None
        return Trainer(images, parameters, options, started.bounds, torch.zeros(3), False, False, environment=texels)

    small, coarse = trainer([averaged_down(each, 2) for each in images]), trainer(images)
    coarse.coarse.coarsest = 2
    for each in (small, coarse):
        each.advance()
    assert coarse.loss == small.loss
    assert all(torch.equal(coarse.parameters[name], small.parameters[name]) for name in small.parameters)
    assert ("environment" in small.parameters) == environment
