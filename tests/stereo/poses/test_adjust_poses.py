"""Given poses: wrong ones are adjusted, exact ones are kept, and runs keep a copy."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import look_at, transforms
from helpers.textured_room import photograph
from PIL import Image
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.capture.adjusted_poses import AdjustedPoses
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.types import PHOTOGRAPHS
from linprim_geo.geometry.camera import Camera
from linprim_geo.points.view_pairs import visible_places
from linprim_geo.runs.run import ADJUSTED_POSES, Run
from linprim_geo.stereo.poses import adjust_poses as module
from linprim_geo.stereo.poses.adjust_poses import adjusted_scene
from linprim_geo.stereo.poses.patch_tracks import patch_tracks
from linprim_geo.training.train import train

SIZE, FOCAL, COUNT, ERROR_PX = (240, 180), 200.0, 14, 1.0


def true_cameras(turned: int = COUNT) -> list[Camera]:
    """From number `turned` on each camera looks farther to the left than the one before it."""
    places = [(-0.9 + 0.12 * i, -1.0 + 0.1 * (i % 4), 0.3 * np.sin(2.0 * i)) for i in range(COUNT)]
    aims = [(1.5 - 0.3 * max(0, i + 1 - turned), 2.0, 0.2) for i in range(COUNT)]
    return [look_at(place, aim, SIZE, FOCAL) for place, aim in zip(places, aims, strict=True)]


def shaken(camera: Camera, rng: np.random.Generator) -> Camera:
    """Perturb a pose so that half of the variance ERROR_PX^2 is due to rotation, half to translation, at depth 3.5."""
    deviation = ERROR_PX / 2 / FOCAL
    pose = camera.world_to_camera.copy()
    pose[:3] = Rotation.from_rotvec(rng.normal(0, deviation, 3)).as_matrix() @ pose[:3]
    pose[:3, 3] += rng.normal(0, 3.5 * deviation, 3)
    return replace(camera, world_to_camera=pose)


def capture(root: Path, cameras: list[Camera], pictures: list[np.ndarray]) -> Path:
    names = [f"{i:02d}.png" for i in range(COUNT)]
    for name, picture in zip(names, pictures, strict=True):
        Image.fromarray(picture).save(root / name)
    (root / "transforms.json").write_text(json.dumps(transforms(cameras, names)))
    return root


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """Two captures of one room, with exact poses and with wrong ones."""
    rng, true = np.random.default_rng(2), true_cameras()
    pictures = list(map(photograph, true))
    wrong = [shaken(camera, rng) for camera in true]
    return {
        kind: capture(tmp_path_factory.mktemp(kind), cameras, pictures)
        for kind, cameras in (("exact", true), ("wrong", wrong))
    }


def off_px(scene) -> float:
    """RMS distance in pixels between points of the walls as seen by the views and by the true cameras."""
    walls = np.random.default_rng(0).uniform(-1, 1, (300, 3)) * [0.6, 0.6, 0.4] + [1.4, 1.9, 0.2]
    true, off = true_cameras(), []
    for view in scene.views:
        off.append(view.camera.project(walls)[0] - true[int(view.name)].project(walls)[0])
    return float(np.sqrt(2 * np.mean(np.square(off))))


def bent_px(scene) -> float:
    """The same after the best similarity transform, which photographs do not determine."""
    return float(np.sqrt(np.mean(bent_of_each(scene.views, true_cameras()) ** 2)))


def bent_of_each(views, true: list[Camera]) -> np.ndarray:
    """(V,) the same for each view."""
    walls = np.random.default_rng(0).uniform(-1, 1, (300, 3)) * [0.6, 0.6, 0.4] + [1.4, 1.9, 0.2]
    wanted = np.concatenate([true[int(view.name)].project(walls)[0] for view in views])

    def off(moves: np.ndarray) -> np.ndarray:
        moved = (1 + moves[6]) * walls @ Rotation.from_rotvec(moves[:3]).as_matrix().T + moves[3:6]
        return (np.concatenate([view.camera.project(moved)[0] for view in views]) - wanted).ravel()

    return np.sqrt(2 * np.square(least_squares(off, np.zeros(7)).fun).reshape(len(views), -1).mean(1))


def test_patches_give_more_accurate_poses_than_keypoints(rooms, tmp_path, monkeypatch):
    """Measured: 0.78 pixels before, 0.0035 with patches, 0.0092 with keypoints alone."""
    given, lines, counts = load_scene(rooms["wrong"]), [], []
    adjust = module.bundle_adjusted

    def counted(*given, common=0, **how):
        counts.append(common)
        return adjust(*given, common=common, **how)

    monkeypatch.setattr(module, "bundle_adjusted", counted)
    assert bent_px(adjusted_scene(given, cache=tmp_path / "patches", threads=1, log=lines.append)) < 0.006
    assert counts == [0, 0, module.COMMON_ERROR]  # half of the keypoints, all, patches
    monkeypatch.setattr(module, "LEAST_PATCHES", 10**6)
    keypoints = adjusted_scene(given, cache=tmp_path / "keypoints", threads=1, log=lines.append)
    assert 0.006 < bent_px(keypoints) < 0.02

    def fails(*given, **how):
        raise LinprimError("no room for stereo")

    monkeypatch.setattr(module, "small_depth_maps", fails)
    without = adjusted_scene(given, cache=tmp_path / "without", threads=1, log=lines.append)
    assert any("by keypoints alone: no room for stereo" in line for line in lines)
    for one, other in zip(keypoints.views, without.views, strict=True):
        assert (one.camera.world_to_camera == other.camera.world_to_camera).all()


def test_patches_that_contradict_keypoints_are_refused(rooms, tmp_path, monkeypatch):
    """Patches are shifted by one offset per photograph in every other photograph, as highlights would be."""

    def shifted_tracks(*given):
        tracks = patch_tracks(*given)
        off = np.random.default_rng(1).normal(0, 3, (COUNT, 2))[tracks.image]
        return replace(tracks, pixel=tracks.pixel + off * (tracks.image % 2)[:, None])

    given, lines = load_scene(rooms["wrong"]), []
    monkeypatch.setattr(module, "patch_tracks", shifted_tracks)
    found = adjusted_scene(given, cache=tmp_path, threads=1, log=lines.append)
    assert any("contradict patches" in line for line in lines)
    assert bent_px(found) < 0.02


@pytest.mark.parametrize("plain", [(), (COUNT - 1,)])
def test_photographs_without_keypoints_are_adjusted_by_patches(plain, tmp_path, monkeypatch):
    """Four photographs show nothing that has keypoints. Errors of up to 1.3 pixels fall to 0.008 at most. A uniformly
    grey photograph never joins, and does not keep the others from joining."""
    true, turned, rng = true_cameras(COUNT - 4), np.arange(COUNT - 4, COUNT), np.random.default_rng(2)
    pictures = [
        np.full((SIZE[1], SIZE[0], 3), 90, np.uint8) if k in plain else photograph(c) for k, c in enumerate(true)
    ]
    given = load_scene(capture(tmp_path, [shaken(camera, rng) for camera in true], pictures))
    find, rounds, number = module._observed, [], np.array([int(view.name) for view in given.views])

    def without_keypoints(*asked):
        points = find(*asked)
        return points.chosen(~np.any([visible_places(true[k], points.xyz)[0] for k in turned], axis=0))

    def counted(*asked):
        tracks = patch_tracks(*asked)
        rounds.append(np.bincount(number[tracks.image], minlength=COUNT) >= module.LEAST_PATCHES)
        return tracks

    monkeypatch.setattr(module, "_observed", without_keypoints)
    monkeypatch.setattr(module, "patch_tracks", counted)
    monkeypatch.setattr(module, "LEAST_POINTS", 50)
    found = adjusted_scene(given, cache=tmp_path / "cache", threads=1, log=lambda line: None)
    joining = ~np.isin(np.arange(COUNT), plain)
    assert not rounds[0][turned].all() and (rounds[-1] == joining).all() and len(rounds) == 2 + len(plain)
    before, after = ([view for view in scene.views if joining[int(view.name)]] for scene in (given, found))
    assert bent_of_each(after, true).max() < 0.03 < 0.1 < bent_of_each(before, true).min()


def test_wrong_poses_are_adjusted_and_cached(rooms, tmp_path, monkeypatch):
    given, lines = load_scene(rooms["wrong"]), []
    found = adjusted_scene(given, cache=tmp_path, threads=1, log=lines.append)
    assert found.adjusted is not None and found.adjusted.error_px == pytest.approx(ERROR_PX, rel=0.4)
    assert off_px(found) < 0.5 * off_px(given)
    assert len(lines) == 2 and "keypoints contradict" in lines[0] and "--poses given" in lines[1]
    monkeypatch.setattr(module, "triangulate_features", None)  # cached poses are not computed again
    again = adjusted_scene(given, cache=tmp_path, log=lines.append)
    assert len(lines) == 3
    for one, other in zip(found.views, again.views, strict=True):
        assert (one.camera.world_to_camera == other.camera.world_to_camera).all()
        assert one.camera.fx == other.camera.fx == found.adjusted.focal_factor * FOCAL


def test_exact_poses_are_not_changed(rooms, tmp_path, monkeypatch):
    given, lines = load_scene(rooms["exact"]), []
    assert adjusted_scene(given, cache=tmp_path, threads=1, log=lines.append) is given
    assert len(lines) == 1 and "do not contradict" in lines[0]
    monkeypatch.setattr(module, "triangulate_features", None)
    assert adjusted_scene(given, cache=tmp_path, log=lines.append) is given


def test_found_poses_and_small_photographs_are_not_adjusted(rooms, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "triangulate_features", None)
    given = replace(load_scene(rooms["wrong"]), kind=PHOTOGRAPHS)
    assert adjusted_scene(given, cache=tmp_path, log=print) is given
    small = load_scene(rooms["wrong"], downscale=3)
    assert adjusted_scene(small, cache=tmp_path, log=print) is small


def test_a_sample_of_photographs_decides_about_adjustment(rooms, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "ASKED_VIEWS", 7)
    monkeypatch.setattr(module, "LEAST_POINTS", 60)
    found = adjusted_scene(load_scene(rooms["wrong"]), cache=tmp_path, threads=1, log=lambda line: None)
    assert found.adjusted is not None and len(found.adjusted.poses) == COUNT
    monkeypatch.setattr(module, "MOST_VIEWS", COUNT - 1)
    lines: list[str] = []
    assert adjusted_scene(load_scene(rooms["wrong"]), 1, cache=tmp_path, log=lines.append).adjusted is None
    assert str(COUNT - 1) in lines[0]


def test_a_run_keeps_its_adjusted_poses(rooms, tmp_path, monkeypatch):
    monkeypatch.setenv("LINPRIM_GEO_CACHE", str(tmp_path / "cache"))
    options = TrainOptions(iterations=2, max_primitives=200, evaluate_every=0, start="points")
    train(rooms["wrong"], tmp_path / "run", options=options, quiet=True)
    monkeypatch.setenv("LINPRIM_GEO_CACHE", str(tmp_path / "empty"))
    scene = Run.open(tmp_path / "run").scene()
    assert off_px(scene) < 0.5 * off_px(load_scene(rooms["wrong"]))
    train(rooms["wrong"], tmp_path / "as_given", SceneOptions(poses="given"), options, quiet=True)
    assert not (tmp_path / "as_given" / ADJUSTED_POSES).exists()
    assert off_px(Run.open(tmp_path / "as_given").scene()) == off_px(load_scene(rooms["wrong"]))


def test_adjusted_focal_lengths_apply_to_the_lens_too(rooms, tmp_path):
    """If only the pinhole camera were scaled by 2 %, undistortion would enlarge the photographs by the same factor."""
    saved = json.loads((rooms["exact"] / "transforms.json").read_text())
    root = Path(shutil.copytree(rooms["exact"], tmp_path / "lens"))
    (root / "transforms.json").write_text(json.dumps(saved | {"k1": 0.05}))
    scene = load_scene(root, cache=tmp_path / "cache")
    adjusted = AdjustedPoses({}, 1.02, 0.5).applied(scene)

    def picture(view) -> np.ndarray:
        return replace(view, decoded=None, cache=None).load().rgb.astype(int)

    for before, after in zip(scene.views, adjusted.views, strict=True):
        assert before.lens is not None and after.lens is not None
        assert after.camera.fx == pytest.approx(1.02 * before.camera.fx)
        assert after.lens.params[:2] == pytest.approx(1.02 * np.array(before.lens.params[:2]))
        assert after.lens.params[2:] == before.lens.params[2:]
        enlarged = picture(replace(after, lens=before.lens))
        assert np.abs(picture(before) - picture(after)).mean() < 0.1 * np.abs(picture(before) - enlarged).mean()


@pytest.mark.parametrize(
    "damage",
    [
        {"error_px": None},
        {"focal_factor": 1e9},
        {"focal_factor": "nan"},
        {"poses": [1]},
        {"poses": {"00": [[1, 0], [0, 1]]}},
        {"poses": {"00": "x"}},
        {"poses": {"00": (2 * np.eye(4)).tolist()}},
    ],
)
def test_damaged_pose_files_are_refused(tmp_path, damage):
    path = tmp_path / ADJUSTED_POSES
    whole = AdjustedPoses({"00": np.eye(4)}, 1.001, 0.5)
    whole.write(path)
    assert (AdjustedPoses.read(path).poses["00"] == np.eye(4)).all()
    path.write_text(json.dumps(json.loads(path.read_text()) | damage))
    with pytest.raises(LinprimError, match=ADJUSTED_POSES):
        AdjustedPoses.read(path)
