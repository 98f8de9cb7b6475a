"""Depth and normal scores against closed forms, and runs against a mesh and against depth images."""

import csv
import json
import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.eval.depth import aggregate, eval_depth_run, score_depth
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.mesh_files import save_mesh

WANTED_KEYS = {
    *("abs_rel", "sq_rel", "rmse", "rmse_log", "mae", "delta1", "delta2", "delta3", "coverage"),
    *("l1_mean", "l1_std", "l2_mean", "l2_std", "normal_mean_deg", "normal_median_deg"),
}
REFERENCE = np.linspace(1.0, 3.0, 60).reshape(6, 10)


@pytest.mark.parametrize("factor", [1.1, 0.9, 1.0])
def test_scores_of_a_scaled_depth(factor):
    scores = score_depth(factor * REFERENCE, REFERENCE)
    off = abs(factor - 1)
    assert scores["abs_rel"] == pytest.approx(off, abs=1e-15)
    assert scores["sq_rel"] == pytest.approx(off**2 * REFERENCE.mean(), abs=1e-15)
    assert scores["mae"] == pytest.approx(off * REFERENCE.mean(), abs=1e-15)
    assert scores["rmse"] == pytest.approx(off * math.sqrt((REFERENCE**2).mean()), abs=1e-15)
    assert scores["rmse_log"] == pytest.approx(abs(math.log(factor)), abs=1e-15)
    assert scores["coverage"] == 1.0 and scores["pixels"] == 60
    assert math.isnan(scores["phantom"])


def test_deltas_are_symmetric_in_the_ratio_and_strict():
    reference = np.full((1, 6), 2.0)
    ratio = np.array([[1.0, 1.2499, 1 / 1.2499, 1.4, 1 / 1.9, 2.0]])
    scores = score_depth(reference * ratio, reference)
    assert (scores["delta1"], scores["delta2"], scores["delta3"]) == pytest.approx((3 / 6, 4 / 6, 5 / 6))
    assert score_depth(reference * 1.25, reference)["delta1"] == 0.0


@pytest.mark.parametrize("nothing", [0.0, -1.0, np.nan, np.inf])
def test_pixels_without_depth_count_for_coverage_and_phantom_only(nothing):
    predicted, reference = REFERENCE + 0.5, REFERENCE.copy()
    predicted[0] = nothing  # 10 missed pixels
    reference[1:3] = nothing  # 20 pixels of background
    predicted[1] = nothing  # on 10 of which nothing is claimed
    scores = score_depth(predicted, reference)
    assert scores["pixels"] == 30
    assert scores["coverage"] == pytest.approx(30 / 40)
    assert scores["phantom"] == pytest.approx(10 / 20)
    assert scores["mae"] == pytest.approx(0.5) and scores["rmse"] == pytest.approx(0.5)


def test_depths_without_common_pixels_score_nan():
    scores = score_depth(np.zeros((4, 4)), np.ones((4, 4)))
    assert scores["coverage"] == 0.0 and scores["pixels"] == 0 and math.isnan(scores["mae"])
    assert math.isnan(score_depth(np.ones((4, 4)), np.zeros((4, 4)))["coverage"])
    with pytest.raises(ValueError, match="shapes"):
        score_depth(np.ones((4, 4)), np.ones((4, 5)))


def rotated(angle_deg, shape):
    """Normals along z, and the same rotated about x by `angle_deg` (an array of `shape`)."""
    angle = np.radians(np.broadcast_to(angle_deg, shape))
    return np.stack([0 * angle, np.sin(angle), np.cos(angle)], -1), np.broadcast_to([0.0, 0.0, 1.0], (*shape, 3))


@pytest.mark.parametrize("angle", [0.0, 1e-7, 12.0, 90.0, 180.0 - 1e-7, 180.0])
def test_angle_between_normals(angle):
    predicted, reference = rotated(angle, REFERENCE.shape)
    scores = score_depth(REFERENCE, REFERENCE, 7.0 * predicted, reference)  # length does not matter
    # atan2 of float64 sine and cosine: a few units in the last place of 180 degrees.
    assert scores["normal_mean_deg"] == pytest.approx(angle, abs=1e-13)
    assert scores["normal_median_deg"] == pytest.approx(angle, abs=1e-13)
    assert scores["normal_under_11_25"] == float(angle < 11.25)
    assert scores["normal_under_22_5"] == float(angle < 22.5)


def test_missing_normals_are_left_out():
    predicted, reference = (x.copy() for x in rotated(np.linspace(0, 90, 10), (6, 10)))
    predicted[:, 5:] = 0.0
    reference[0] = np.nan
    depth = REFERENCE.copy()
    depth[1] = 0.0
    scores = score_depth(depth, REFERENCE, predicted, reference)
    assert scores["normal_mean_deg"] == pytest.approx(20.0) and scores["normal_median_deg"] == pytest.approx(20.0)
    assert scores["coverage"] == pytest.approx(50 / 60)
    assert math.isnan(score_depth(depth, REFERENCE, 0 * predicted, reference)["normal_mean_deg"])
    assert math.isnan(score_depth(depth, REFERENCE)["normal_mean_deg"])


def test_aggregate_is_the_mean_over_views_that_have_a_score():
    reference = np.full((2, 2), 2.0)
    partly = np.array([[2.3, 0.0], [0.0, 0.0]])
    views = [score_depth(reference + 0.1, reference), score_depth(partly, reference)]
    views.append(score_depth(np.zeros((2, 2)), reference))
    result = aggregate(views)
    assert result["mae"] == pytest.approx((0.1 + 0.3) / 2) == result["l1_mean"]
    assert result["l1_std"] == pytest.approx(0.1)
    assert result["l2_mean"] == pytest.approx(0.2) and result["l2_std"] == pytest.approx(0.1)
    assert result["coverage"] == pytest.approx((1 + 0.25 + 0) / 3)
    assert (result["views"], result["scored_views"], result["pixels"]) == (3, 2, 5)
    assert result["abs_rel_standard_error"] == pytest.approx((0.15 - 0.05) / 2)
    assert math.isnan(aggregate(views[1:])["abs_rel_standard_error"])
    assert WANTED_KEYS <= set(result)
    assert math.isnan(aggregate(views[2:])["mae"]) and aggregate(views[2:])["coverage"] == 0.0


# --- runs ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FakeView:
    name: str
    camera: Camera
    depth_path: str | None = None
    depth: np.ndarray | None = None

    def load_depth(self):
        return self.depth


@dataclass
class FakeRun:
    """A run that renders the plane z = `height` exactly."""

    path: object
    test: tuple
    height: float

    def scene(self):
        return SimpleNamespace(root="scene", train=(), test=self.test, unit="m")

    def depth_of(self, camera):
        return (self.height - camera.center[2]) / camera.world_rays()[..., 2]

    def surface_depths(self, views, level):
        assert level == 0.5
        for view in views:
            depth = self.depth_of(view.camera)
            yield view, depth.astype(np.float32), np.ones_like(depth)

    def render_views(self, views, geometry=True):
        assert geometry
        for view in views:
            depth = self.depth_of(view.camera)
            normal = np.broadcast_to(np.float32([0, 0, 1]), (*depth.shape, 3))
            yield (
                view,
                {"depth_median": 1.2 * depth, "depth_expected": 1.1 * depth, "normal": normal},
            )


def look_down(height, tilt_deg=0.0, target=(0.0, 0.0)):
    """A camera at `height` above `target` that looks down, tilted by `tilt_deg`."""
    angle = np.radians(tilt_deg)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = -pose[:3, :3] @ np.array([*target, height])
    return Camera(24, 18, 30.0, 29.0, 12.3, 8.8, pose)


def square(height=0.0, half=20.0):
    corners = [(-half, -half, height), (half, -half, height), (half, half, height), (-half, half, height)]
    return Mesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]))


def two_views(**fields):
    return (FakeView("a", look_down(3.0), **fields), FakeView("b", look_down(4.0, 20.0), **fields))


def test_a_run_has_no_error_against_its_own_surface(tmp_path):
    save_mesh(tmp_path / "reference.ply", square())
    run = FakeRun(tmp_path, two_views(), height=0.0)
    result = eval_depth_run(run, tmp_path / "reference.ply")
    # Renders are float32: half an ulp of depths below 8.
    assert result["mae"] < 5e-7 and result["rmse"] < 5e-7 and result["abs_rel"] < 1e-7
    assert result["delta1"] == 1.0 and result["coverage"] == 1.0
    assert result["normal_mean_deg"] < 1e-5
    assert WANTED_KEYS <= set(result) and result["unit"] == "m" and result["recast_rays"] >= 0
    folder = tmp_path / "eval" / "depth"
    assert json.loads((folder / "results.json").read_text())["mae"] == result["mae"]
    rows = list(csv.DictReader((folder / "per_view.csv").open()))
    assert [row["name"] for row in rows] == ["a", "b"] and rows[0]["coverage"] == "1.0"


def test_other_depths_are_scored_on_request(tmp_path):
    run = FakeRun(tmp_path, two_views(), height=0.0)
    for depth, wanted in (("depth_overlap", 0.0), ("depth_median", 0.2), ("depth_expected", 0.1)):
        result = eval_depth_run(run, square(), depth=depth)
        assert result["depth"] == depth and result["abs_rel"] == pytest.approx(wanted, abs=1e-6)


def test_errors_against_a_shifted_mesh_agree_with_the_closed_form(tmp_path):
    offset, reference = 0.25, square(-0.25)
    result = eval_depth_run(FakeRun(tmp_path, two_views(), height=0.0), reference, output=tmp_path / "out")
    # Depth errors of a plane moved along z by h: h over the z component of the ray with camera z = 1.
    errors = [offset / -view.camera.world_rays()[..., 2] for view in two_views()]
    l1 = [error.mean() for error in errors]
    l2 = [math.sqrt((error**2).mean()) for error in errors]
    assert result["l1_mean"] == pytest.approx(np.mean(l1), rel=1e-6) == result["mae"]
    assert result["l1_std"] == pytest.approx(np.std(l1), rel=1e-4)
    assert result["l2_mean"] == pytest.approx(np.mean(l2), rel=1e-6) == result["rmse"]
    assert result["reference_diagonal"] == pytest.approx(40 * math.sqrt(2))
    assert result["mae_percent_diagonal"] == pytest.approx(100 * np.mean(l1) / (40 * math.sqrt(2)), rel=1e-6)
    assert (tmp_path / "out" / "results.json").is_file() and not (tmp_path / "eval").exists()


def test_expected_depth_is_scored_on_request(tmp_path):
    run = FakeRun(tmp_path, two_views(), height=0.0)
    assert eval_depth_run(run, square(), depth="depth_expected")["abs_rel"] == pytest.approx(0.1, abs=1e-9)


def test_reference_visible_in_a_part_of_the_image(tmp_path):
    view = FakeView("a", look_down(3.0, target=(0.0, 0.0)))
    right = square().vertices * [0.5, 1, 1] + [10.0, 0, 0]  # x > 0 only: the pixels right of cx = 12.3
    result = eval_depth_run(FakeRun(tmp_path, (view,), height=0.0), replace(square(), vertices=right))
    assert result["pixels"] == 18 * 12 and result["coverage"] == 1.0 and result["phantom"] == 1.0


def test_run_against_depth_images(tmp_path):
    views = []
    for view in two_views():
        depth = 2.0 * -view.camera.center[2] / view.camera.world_rays()[..., 2]
        views.append(replace(view, depth_path="there", depth=depth.astype(np.float32)))
    views.append(FakeView("c", look_down(3.0)))  # no depth image: not scored
    result = eval_depth_run(FakeRun(tmp_path, tuple(views), height=0.0))
    assert result["abs_rel"] == pytest.approx(0.5, abs=1e-6) and result["views"] == 2
    assert math.isnan(result["normal_mean_deg"])
    points = [v.camera.center + (v.camera.world_rays() * v.depth[..., None]).reshape(-1, 3) for v in views[:2]]
    points = np.concatenate(points)
    assert result["reference_diagonal"] == pytest.approx(np.linalg.norm(np.ptp(points, axis=0)), rel=1e-6)


def test_unusable_references_are_refused(tmp_path):
    run = FakeRun(tmp_path, two_views(), height=0.0)
    with pytest.raises(LinprimError, match="no test view has a depth image"):
        eval_depth_run(run)
    with pytest.raises(LinprimError, match="reference mesh: no pixel of the 2 test views"):
        eval_depth_run(run, square(height=50.0))
    with pytest.raises(LinprimError, match="no such mesh file"):
        eval_depth_run(run, tmp_path / "missing.ply")
    with pytest.raises(LinprimError, match="the train split has no views"):
        eval_depth_run(run, square(), split="train")
    with pytest.raises(LinprimError, match="empty"):
        eval_depth_run(run, Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)))
    small = FakeRun(tmp_path, two_views(depth_path="there", depth=np.ones((9, 12))), height=0.0)
    with pytest.raises(LinprimError, match="view a: the reference depth is 12x9, expected 24x18"):
        eval_depth_run(small)
    assert not (tmp_path / "eval").exists()


def test_reference_with_degenerate_and_nan_faces_scores_the_same(tmp_path):
    clean = square(-0.25)
    vertices = np.concatenate([clean.vertices, [[np.nan, 0, 0], [0.0, 0.0, 1.0]]])
    broken = Mesh(vertices, np.concatenate([clean.faces, [[0, 1, 4], [5, 5, 0], [0, 1, 2]]]))
    results = [eval_depth_run(FakeRun(tmp_path, two_views(), height=0.0), mesh) for mesh in (clean, broken)]
    assert results[0]["mae"] == results[1]["mae"] and results[1]["coverage"] == 1.0
