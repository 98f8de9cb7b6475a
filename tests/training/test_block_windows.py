"""Training images of a block: windows of photographs, and the frozen scene around it."""

from __future__ import annotations

import tempfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.block_runs import OPTIONS

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.boxes import Block, cropped
from linprim_geo.geometry.camera import Camera
from linprim_geo.runs.run import Run
from linprim_geo.training.blocks.plan import read_plan
from linprim_geo.training.blocks.tasks import outside, tensors
from linprim_geo.training.blocks.windows import Windows, block_images
from linprim_geo.training.step.parameters import initial_parameters
from linprim_geo.training.step.trainer import Trainer
from linprim_geo.training.step.training_images import RECENT, LazyTrainingImage, TrainingImage


def test_block_images_show_photographs_in_the_block_and_frozen_renders_outside(blocks_run):
    run = Run.open(blocks_run[0])
    scene, coarse = run.scene(), Run.open(blocks_run[0] / "blocks" / "coarse" / "run")
    everything = Block((-np.inf,) * 3, (np.inf,) * 3)
    factor = coarse.scene_options.downscale
    frozen = outside(coarse.training_primitives(), everything, 0.1)
    assert len(frozen["center"]) == 0
    images = block_images(
        coarse, scene.train[:2], everything, 0.1, 0.1, factor, run.similarity, OPTIONS, tensors(frozen)
    )
    photo = scene.train[0].load()
    camera = images[0].camera
    left, top = (
        round(a - b) for a, b in ((scene.train[0].camera.cx, camera.cx), (scene.train[0].camera.cy, camera.cy))
    )
    part = photo.rgb[top : top + camera.height, left : left + camera.width]
    alpha = images[0].alpha.numpy() > 0
    assert np.array_equal(images[0].rgb.numpy().transpose(1, 2, 0)[alpha], part[alpha])
    own = read_plan(run.path).blocks[0].block
    frozen = outside(coarse.training_primitives(), own, 0.05)
    assert len(frozen["center"]) > 0 and not own.holds(frozen["center"], 0.05).any()
    images = block_images(coarse, scene.train, own, 0.05, 0.05, factor, run.similarity, OPTIONS, tensors(frozen))
    assert all(image.weight == image.camera.width * image.camera.height / 48**2 for image in images)
    assert all(
        image.camera.width <= 48 and image.rgb.shape[1:] == (image.camera.height, image.camera.width)
        for image in images
    )
    assert sum(image.camera.width * image.camera.height for image in images) < 0.9 * len(scene.train) * 48 * 48
    assert all(image.size == (48, 48) for image in images)


def test_windows_are_read_on_demand_and_leave_no_file(blocks_run, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    run = Run.open(blocks_run[0])
    scene, coarse = run.scene(), Run.open(blocks_run[0] / "blocks" / "coarse" / "run")
    everything, factor = Block((-np.inf,) * 3, (np.inf,) * 3), coarse.scene_options.downscale
    nothing = tensors(outside(coarse.training_primitives(), everything, 0.1))
    images = block_images(coarse, scene.train, everything, 0.1, 0.1, factor, run.similarity, OPTIONS, nothing)
    assert not list(tmp_path.iterdir())
    assert all(type(image) is LazyTrainingImage for image in images) and len(images) > RECENT
    first = [(image.rgb.clone(), image.alpha.clone()) for image in images]
    assert all(
        torch.equal(image.rgb, rgb) and torch.equal(image.alpha, alpha)
        for image, (rgb, alpha) in zip(images, first, strict=True)
    )
    assert len({rgb.numpy().tobytes() for rgb, _ in first}) == len(images)
    monkeypatch.setattr(tempfile, "tempdir", "/dev/null/nowhere")
    with pytest.raises(LinprimError, match="/dev/null/nowhere"):
        Windows()
    with pytest.raises(LinprimError, match="no space left on the device"):
        windows = Windows.__new__(Windows)
        windows._what, windows._file, windows._recent = tmp_path / "windows", open("/dev/full", "wb"), {}
        windows.image("a", images[0].camera, np.zeros((999, 999, 3), np.uint8), np.zeros((999, 999), np.uint8))


@pytest.mark.parametrize("population", ["gradient", "3dgs"])
def test_gradients_of_a_window_equal_those_of_its_photograph(population):
    rng = np.random.default_rng(0)
    reach = np.array([0.3, 0.15, 0.3])
    start = initial_parameters(rng.uniform(-reach, reach, (40, 3)), rng.integers(0, 255, (40, 3)), 0, 0, (0.01, 0.1))
    pose = np.eye(4)
    pose[2, 3] = 3.0
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, pose)
    rgb = torch.zeros(3, 48, 64, dtype=torch.uint8)
    rgb[:, 16:32, 16:48] = torch.from_numpy(rng.integers(0, 255, (3, 16, 32), dtype=np.uint8))
    whole_photo = TrainingImage("whole", camera, rgb, None)
    window = TrainingImage("window", cropped(camera, 16, 16, 32, 16), rgb[:, 16:32, 16:48].contiguous(), None, (64, 48))
    assert window.weight == 1 / 6 and whole_photo.weight == 1 and window.size == whole_photo.size
    name = {"gradient": "screen_gradient", "3dgs": "gradient"}[population]
    gradients = []
    for image in (whole_photo, window):
        options, copy = replace(OPTIONS, dssim=0.0, population=population), {k: v.clone() for k, v in start.items()}
        trainer = Trainer([image], copy, options, (0.01, 0.1), torch.zeros(3), False, False)
        trainer.advance()
        gradients.append(trainer.control.accumulated[name])
    assert gradients[0].max() > 0 and torch.allclose(
        gradients[0], gradients[1], rtol=1e-3, atol=1e-6 * float(gradients[0].max())
    )


def test_frozen_primitives_are_rendered_and_not_trained(blocks_run):
    run = Run.open(blocks_run[0])
    scene, coarse = run.scene(), Run.open(blocks_run[0] / "blocks" / "coarse" / "run")
    own = read_plan(run.path).blocks[0].block
    frozen = tensors(outside(coarse.training_primitives(), own, 0.05))
    images = block_images(
        coarse, scene.train, own, 0.05, 0.05, coarse.scene_options.downscale, run.similarity, OPTIONS, frozen
    )
    rng = np.random.default_rng(0)
    start = initial_parameters(rng.normal(size=(40, 3)), rng.integers(0, 255, (40, 3)), 1, 0, (0.01, 1.0))
    trainer = Trainer(images, start, replace(OPTIONS, iterations=20), (0.01, 1.0), torch.ones(3), False, True)
    alone = trainer.render(images[0].camera, torch.ones(3))
    trainer.frozen = frozen
    before = [tensor.clone() for tensor in frozen]
    assert not torch.equal(alone, trainer.render(images[0].camera, torch.ones(3)))
    for _ in range(20):
        trainer.advance()
    assert all(torch.equal(a, b) for a, b in zip(before, frozen, strict=True))
    assert (
        len(trainer) == len(trainer.primitives()) == len(trainer.state()["parameters"]["center"]) < 40 + len(frozen[0])
    )
    empty = tuple(tensor[:0] for tensor in frozen)
    twins = [
        Trainer(images, {k: v.clone() for k, v in start.items()}, OPTIONS, (0.01, 1.0), torch.ones(3), False, True)
        for _ in range(2)
    ]
    twins[1].frozen = empty
    for twin in twins:
        twin.advance()
    assert all(torch.equal(twins[0].parameters[name], twins[1].parameters[name]) for name in start)
