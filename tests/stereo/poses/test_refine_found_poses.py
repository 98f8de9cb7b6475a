"""Found poses and lenses are refined by surface patches, unless keypoints contradict them or data are too few."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.captures import look_at
from helpers.textured_room import photograph
from PIL import Image
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.found_poses import found_model
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.structure_from_motion import find_poses
from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.poses import refine_found_poses as module
from linprim_geo.stereo.poses.patch_tracks import patch_tracks
from linprim_geo.stereo.poses.refine_found_poses import prepare, refined_model

SIZE, FOCAL, COUNT = (240, 180), 200.0, 14
LOST = "05.png"


def true_cameras() -> list[Camera]:
    places = [(-0.9 + 0.12 * i, -1.0 + 0.1 * (i % 4), 0.3 * np.sin(2.0 * i)) for i in range(COUNT)]
    return [look_at(place, (1.5, 2.0, 0.2), SIZE, FOCAL) for place in places]


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> tuple[Path, Path]:
    """Photographs of a room, and their model by structure from motion with errors as on plain walls: one photograph
    keeps five observations and is turned by 6 pixels, and the lens is wrong."""
    root, cache = tmp_path_factory.mktemp("photographs"), tmp_path_factory.mktemp("cache")
    for i, camera in enumerate(true_cameras()):
        Image.fromarray(photograph(camera)).save(root / f"{i:02d}.png")
    find_poses(root, cache, threads=1)
    model = pycolmap.Reconstruction(str(found_model(root, cache)))
    lost = next(image for image in model.images.values() if image.name == LOST)
    points = [index for index, point in enumerate(lost.points2D) if point.has_point3D()]
    for index in points[: len(points) - 5]:
        model.delete_observation(lost.image_id, index)
    pose = lost.cam_from_world().matrix()
    turned = Rotation.from_rotvec([0, 6 / FOCAL, 0]).as_matrix() @ pose
    lost.frame.set_cam_from_world(lost.camera_id, pycolmap.Rigid3d(turned))
    for camera in model.cameras.values():
        camera.params = camera.params * [1.004, 1, 1, 1] + [0, 0, 0, 0.03]
    path = tmp_path_factory.mktemp("model")
    model.write_binary(str(path))
    return root, path


def off_px(root: Path, model: Path) -> dict[str, float]:
    """RMS distance in pixels between points of the walls as seen by each view and by its true camera, with lens, after
    the best similarity transform."""
    walls = np.random.default_rng(0).uniform(-1, 1, (300, 3)) * [0.6, 0.6, 0.4] + [1.4, 1.9, 0.2]
    views = load_scene(root, sparse=str(model)).views
    wanted = [true_cameras()[int(view.name)] for view in views]
    scale = np.ptp([view.camera.center for view in views], axis=0).max() / np.ptp([c.center for c in wanted], axis=0)[0]
    first = wanted[0].rotation.T @ views[0].camera.rotation  # rotation from the found world to the true one

    def seen(moves: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(moves[:3]).as_matrix() @ first
        xyz = (walls - wanted[0].center - moves[3:6]) @ turn * scale * np.exp(moves[6]) + views[0].camera.center
        return np.stack([normalized(view.camera, xyz) - normalized(camera, walls) for view, camera in pairs]) * FOCAL

    pairs = list(zip(views, wanted, strict=True))
    off = least_squares(lambda moves: seen(moves).ravel(), np.zeros(7), loss="cauchy", f_scale=0.05)
    errors = np.sqrt((seen(off.x) ** 2).sum(2).mean(1))
    return dict(zip((view.name for view in views), errors.tolist(), strict=True))


def normalized(camera: Camera, xyz: np.ndarray) -> np.ndarray:
    return (camera.project(xyz)[0] - [camera.cx, camera.cy]) / [FOCAL, FOCAL]


def test_refinement_recovers_poses_and_lens(found, tmp_path):
    """Measured: errors fall from 6.1 to 0.003 pixels, that of k1 from 0.027 to 0.0003. Mapping with all keypoints has
    0.005 to 0.016 pixels."""
    root, model = found
    assert off_px(root, model)[Path(LOST).stem] > 5
    lines: list[str] = []
    assert refined_model(root, model, tmp_path, lines.append)
    assert max(off_px(root, tmp_path).values()) < 0.01
    (camera,) = pycolmap.Reconstruction(str(tmp_path)).cameras.values()
    assert abs(camera.params[0] / FOCAL - 1) < 0.003 and abs(camera.params[3]) < 0.001
    assert lines[-1].startswith("poses: refined by")
    before, after = (load_scene(root, sparse=str(path)).points for path in (model, tmp_path))
    assert len(after.xyz) > 0.95 * len(before.xyz) and np.median(after.error_px) < 0.1


def test_a_large_pose_error_takes_several_rounds(found, tmp_path, monkeypatch):
    root, model = found
    rounds: list[int] = []

    def counted(*given):
        rounds.append(len(given))
        return patch_tracks(*given)

    monkeypatch.setattr(module, "patch_tracks", counted)
    assert refined_model(root, model, tmp_path, print) and 1 < len(rounds) < module.MOST_ROUNDS
    rounds.clear()
    again = tmp_path / "again"
    again.mkdir()
    assert refined_model(root, tmp_path, again, print) and len(rounds) == 1


def test_patches_that_contradict_keypoints_are_refused(found, tmp_path, monkeypatch):
    """Patches are shifted by one offset per photograph in every other photograph, as highlights would be."""
    root, model = found

    def shifted_tracks(*given):
        tracks = patch_tracks(*given)
        off = np.random.default_rng(1).normal(0, 3, (COUNT, 2))[tracks.image]
        return replace(tracks, pixel=tracks.pixel + off * (tracks.image % 2)[:, None])

    monkeypatch.setattr(module, "patch_tracks", shifted_tracks)
    monkeypatch.setattr(module, "MOST_ROUNDS", 1)
    lines: list[str] = []
    assert not refined_model(root, model, tmp_path, lines.append)
    assert "contradict patches" in lines[-1] and not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "value"), [("MOST_VIEWS", COUNT - 1), ("LEAST_POINTS", 10**6)])
def test_too_many_views_or_too_few_points_leave_poses_unchanged(found, tmp_path, monkeypatch, name, value):
    root, model = found
    monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(module, "MOST_ROUNDS", 1)
    assert not refined_model(root, model, tmp_path, print) and not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [LinprimError("no room for stereo"), np.linalg.LinAlgError("nothing is determined")])
def test_poses_are_unchanged_if_stereo_or_patches_fail(found, tmp_path, monkeypatch, error):
    def fails(*given):
        raise error

    monkeypatch.setattr(module, "small_depth_maps", fails)
    lines: list[str] = []
    assert not refined_model(*found, tmp_path, lines.append)
    assert lines == [f"poses: by keypoints alone: {error}"]


def test_training_and_stereo_refine_found_poses(tmp_path, monkeypatch):
    from linprim_geo.capture import structure_from_motion
    from linprim_geo.stereo.dense import dense
    from linprim_geo.training import start

    asked: list[dict] = []
    monkeypatch.setattr(structure_from_motion, "prepare", lambda *given, **how: asked.append(how))
    assert start.prepare is dense.prepare is prepare
    prepare(tmp_path, threads=1)
    assert asked == [{"threads": 1, "refine": refined_model}]
