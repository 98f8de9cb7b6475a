"""A training within a box: where its primitives begin, and where they are added."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.capture.types import PointCloud
from linprim_geo.geometry.region import read_box, within
from linprim_geo.points.start_points import AROUND_BOX, initial_cloud
from linprim_geo.runs.run import Run
from linprim_geo.training.step.population import GradientControl
from linprim_geo.training.train import train

UPPER = "-9,-9,0,9,9,9"


def cloud(inside: int, outside: int) -> PointCloud:
    """Points at random of which so many have z above 0."""
    xyz = np.random.default_rng(0).uniform(0.1, 1, (inside + outside, 3))
    xyz[inside:, 2] *= -1
    return PointCloud(xyz, np.zeros_like(xyz))


@pytest.mark.parametrize(
    "inside, outside, begin",
    [(500, 500, (75, 25)), (500, 10, (90, 10)), (50, 500, (50, 25)), (5, 3, (5, 3))],
)
def test_most_primitives_begin_in_the_box(inside, outside, begin):
    options = TrainOptions(max_primitives=200, initial_primitives=100, box=UPPER)
    found = initial_cloud(cloud(inside, outside), options, read_box(UPPER))
    above = within(found.xyz, read_box(UPPER))
    assert (np.count_nonzero(above), np.count_nonzero(~above)) == begin and AROUND_BOX == 0.25
    assert len(np.unique(found.xyz, axis=0)) == len(found.xyz)


def test_primitives_are_added_in_the_box_alone():
    options = TrainOptions(iterations=1000, max_primitives=4000, box=UPPER)
    control = GradientControl(options, 40, [], (1e-4, 1.0))
    parameters = {
        "center": torch.from_numpy(cloud(20, 20).xyz).float(),
        "rotation": torch.tensor([[1.0, 0, 0, 0]]).repeat(40, 1),
        "log_extent": torch.full((40, 3), -3.0),
        "raw_opacity": torch.zeros(40),
    }
    control.accumulated["screen_gradient"] += 1
    step = control.growth.first
    everywhere = control.grow(parameters, step).source
    control.grow_within(lambda center: within(center, read_box(UPPER)))
    boxed = control.grow(parameters, step).source
    assert len(boxed) > 40 and (everywhere[40:] >= 20).any() and (boxed[40:] < 20).all()


def test_a_trained_box_has_more_primitives_than_its_share(tiny_scene, tmp_path, tiny_options):
    options = replace(tiny_options, iterations=60)
    above = {}
    for box in ("", UPPER):
        train(tiny_scene, tmp_path / f"run{len(box)}", SceneOptions(), replace(options, box=box), quiet=True)
        center = Run.open(tmp_path / f"run{len(box)}").primitives().center
        above[box] = within(center, read_box(UPPER)).mean()
    assert above[UPPER] > above[""] + 0.1


def test_auto_is_what_the_cameras_look_at(tiny_scene, tmp_path, tiny_options):
    options = replace(tiny_options, iterations=1, box="auto")
    train(tiny_scene, tmp_path / "run", SceneOptions(), options, quiet=True)
    run = Run.open(tmp_path / "run")
    found = read_box("auto", [view.camera for view in run.scene().train])
    np.testing.assert_array_equal(read_box(run.train_options.box), found)


@pytest.mark.parametrize(
    "changes, blocks, words",
    [
        ({"box": "1,2"}, 1, "wanted six numbers"),
        ({"box": "50,50,50,60,60,60"}, 1, "none of .* points is in it"),
        ({"box": UPPER, "population": "mcmc"}, 1, "wanted --population gradient"),
        ({"box": UPPER}, 2, "wanted without --blocks"),
    ],
)
def test_what_a_box_cannot_be_is_one_sentence(changes, blocks, words, tiny_scene, tmp_path, tiny_options):
    with pytest.raises(LinprimError, match=words):
        train(tiny_scene, tmp_path / "run", SceneOptions(), replace(tiny_options, **changes), blocks=blocks, quiet=True)
    assert not (tmp_path / "run" / "config.json").exists()
