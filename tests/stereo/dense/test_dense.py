"""The command `stereo` on photographs of a textured room: files that COLMAP reads, calibrated confidence, and the same
bits after an interruption and with any number of threads."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import look_at, reconstruction
from helpers.textured_room import HALF, photograph
from PIL import Image

from linprim_geo.base.budget import Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions, StereoOptions
from linprim_geo.cli.main import main
from linprim_geo.geometry.load_pycolmap import pycolmap
from linprim_geo.kernels import ops
from linprim_geo.stereo.confidence import RIGHT
from linprim_geo.stereo.dense import dense
from linprim_geo.stereo.dense.time_plan import planned
from linprim_geo.stereo.depth_maps import depth_maps

SIZE = (96, 72)
CENTERS = [(x, y, 0.0) for y in (-0.35, 0.0) for x in (-0.7, -0.35, 0.0)]
# Calibration errors on captures that the confidence was not fitted to are up to 0.16 (docs/stereo.md).
CALIBRATION = 0.16


def cameras() -> list:
    """Cameras in the room that look at a corner of two walls."""
    return [look_at(center, target=(1.6, 2.0, 0.1), size=SIZE, focal=80.0) for center in CENTERS]


def true_depth(camera) -> np.ndarray:
    """(H, W) z-depth of the walls."""
    rays = camera.world_rays()
    with np.errstate(divide="ignore"):
        return ((np.sign(rays) * HALF - camera.center) / rays).min(axis=-1)


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    """A COLMAP capture of the room."""
    root = tmp_path_factory.mktemp("room")
    (root / "images").mkdir()
    (root / "sparse" / "0").mkdir(parents=True)
    taken, names = cameras(), [f"{number}.png" for number in range(len(CENTERS))]
    for camera, name in zip(taken, names, strict=True):
        Image.fromarray(photograph(camera)).save(root / "images" / name)
    points = taken[0].center + (taken[0].world_rays() * true_depth(taken[0])[..., None])[::6, ::6].reshape(-1, 3)
    reconstruction(taken, names, points).write_binary(str(root / "sparse" / "0"))
    return root


@pytest.fixture(scope="module")
def made(capture, tmp_path_factory) -> dense.Dense:
    """The result of the command for this capture."""
    return dense.run_stereo(capture, tmp_path_factory.mktemp("made") / "dense", None, None, None, quiet=True)


def contents(root: Path) -> dict[str, bytes]:
    """Files by their names, without stereo.json, which contains durations."""
    files = [path for path in root.rglob("*") if path.is_file() and path.name != dense.NOTES]
    return {str(path.relative_to(root)): path.read_bytes() for path in files}


def test_maps_on_disk_equal_those_in_memory(capture, made):
    views = made.workspace.views
    points = pycolmap.Reconstruction(str(capture / "sparse" / "0")).points3D.values()
    expected = depth_maps(views, np.array([point.xyz for point in points]))
    for k, each in enumerate(expected):
        assert np.array_equal(made.workspace.read_maps(k).depth, np.nan_to_num(each.depth))


def test_mean_confidence_agrees_with_the_share_of_right_depths(made):
    predicted, right = [], []
    for k, view in enumerate(made.workspace.views):
        maps = made.workspace.read_maps(k)
        known = maps.depth > 0
        assert known.mean() > 0.8 and not maps.confidence[~known].any()
        predicted.append(maps.confidence[known])
        right.append((np.abs(maps.depth / true_depth(view.camera) - 1) < RIGHT)[known])
    confidence, is_right = np.concatenate(predicted), np.concatenate(right)
    # Errors are correlated within windows of 11x11 pixels: count one independent sample per window.
    error = 3 * np.sqrt(0.25 * 11**2 / len(is_right))
    assert abs(confidence.mean() - is_right.mean()) < CALIBRATION + error
    sure = confidence > np.median(confidence)
    assert is_right[sure].mean() > is_right[~sure].mean()


def test_normals_are_in_camera_axes_and_face_the_camera(made):
    camera = made.workspace.views[0].camera
    maps = made.workspace.read_maps(0)
    sure = maps.confidence > 0.9
    assert ((maps.normal * camera.ray_grid()).sum(-1)[sure] < 0).all()
    # Walls are parallel to the axes of the world: the largest entry of a normal is 1.
    largest = np.abs(maps.normal[sure] @ camera.rotation).max(1)
    assert np.median(largest) > np.cos(np.radians(5))


def test_colmap_reads_and_fuses_the_folder(made, tmp_path):
    root = made.workspace.root
    model = pycolmap.Reconstruction(str(root / "sparse"))
    assert model.num_reg_images() == len(CENTERS) and model.num_points3D() > 100
    assert model.compute_mean_track_length() >= 3
    model.update_point_3d_errors()
    # Observations are at centres of pixels.
    assert np.median([point.error for point in model.points3D.values()]) < 1
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels, options.num_threads = 3, 1
    fused = pycolmap.stereo_fusion(str(tmp_path), str(root), options=options)
    xyz = np.array([point.xyz for point in fused.points3D.values()])
    assert len(xyz) > 1000
    off = np.abs(np.abs(xyz).max(1) - HALF)
    # COLMAP takes depths that differ by 1 %, of at most 4.
    assert np.quantile(off, 0.9) < 0.04
    assert (root / "stereo" / "fusion.cfg").read_text().split() == made.workspace.names
    listed = (root / "stereo" / "patch-match.cfg").read_text().splitlines()
    assert listed[::2] == made.workspace.names and all(
        set(line.split(", ")) <= set(listed[::2]) for line in listed[1::2]
    )


def test_points_lie_on_the_walls_without_duplicates(made):
    from linprim_geo.capture.readers.ply_points import read_points_ply

    path = made.workspace.root / dense.POINTS
    cloud = read_points_ply(path)
    assert cloud is not None and len(cloud.xyz) == made.notes["result"]["count"]
    off = np.abs(np.abs(cloud.xyz).max(1) - HALF)
    # Right depths are within 1 % of at most 4, and at least half are right by the threshold.
    assert (off < 0.04).mean() > 0.5
    pixels = len(CENTERS) * SIZE[0] * SIZE[1]
    # Six photographs show the same corner, each point is confirmed by two more of them.
    assert 0.1 * pixels < len(cloud.xyz) < 0.5 * pixels
    properties = [line.split()[-1] for line in path.read_bytes()[:600].split(b"\n") if line.startswith(b"property")]
    assert properties == b"x y z nx ny nz red green blue confidence".split()


def test_a_resumed_run_writes_the_same_files(capture, made, tmp_path, monkeypatch):
    calls = []

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return photometric(*arguments)

    from linprim_geo.stereo.dense import planes_on_disk

    photometric, target = planes_on_disk.photometric_planes, tmp_path / "dense"
    monkeypatch.setattr(planes_on_disk, "photometric_planes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        dense.run_stereo(capture, target, None, None, None, quiet=True)
    with pytest.raises(LinprimError, match="go on with --resume"):
        dense.run_stereo(capture, target, None, None, None, quiet=True)
    (target / "images" / ".0.abc.tmp.png").write_bytes(b"what a kill has left")
    dense.run_stereo(capture, target, None, None, None, resume=True, quiet=True)
    assert len(calls) == 4 + len(CENTERS) - 3  # three maps were complete
    assert contents(target) == contents(made.workspace.root)


def test_resuming_a_finished_run_only_fuses_again(made, tmp_path, capture, monkeypatch):
    target = tmp_path / "dense"
    shutil.copytree(made.workspace.root, target)
    monkeypatch.setattr(dense, "PlanesOnDisk", None)
    again = dense.run_stereo(capture, target, None, StereoOptions(least_confidence=0.9), None, resume=True, quiet=True)
    assert again.notes["result"]["count"] < made.notes["result"]["count"]


def test_files_do_not_depend_on_the_number_of_threads(capture, made, tmp_path, few_threads):
    target = tmp_path / "dense"
    dense.run_stereo(capture, target, None, StereoOptions(threads=3), None, quiet=True)
    assert ops.threads() == 3
    assert contents(target) == contents(made.workspace.root)


def test_downscale_applies_to_photographs_and_maps(capture, tmp_path):
    small = dense.run_stereo(capture, tmp_path / "dense", SceneOptions(downscale=2), None, None, quiet=True)
    assert small.workspace.colors(0).shape == (SIZE[1] // 2, SIZE[0] // 2, 3)
    assert small.workspace.read_maps(0).depth.shape == (SIZE[1] // 2, SIZE[0] // 2)


def test_a_budget_reduces_size_before_number_of_photographs(made):
    views = [view for view in made.workspace.views for _ in range(20)]
    large = [type(view)(**{**vars(view), "camera": view.camera.magnified(10)}) for view in views]
    pixels = sum(view.camera.width * view.camera.height for view in large)
    # 960 pixels along the longer side are averaged down to no less than 240.
    for seconds, wanted in ((2000, (1, 120)), (700, (2, 120)), (120, (3, 120)), (30, (4, 55))):
        plan = planned(large, 1000 / pixels, Budget(seconds))
        assert (plan.downscale, plan.views) == wanted
        assert plan.seconds <= 0.97 * seconds
    with pytest.raises(LinprimError, match="the least stereo that is of any use takes 2 s here"):
        planned(large, 1000 / pixels, Budget(1))


def test_the_command_prints_one_line_and_writes_a_page(capture, tmp_path, capsys):
    target = tmp_path / "dense"
    assert main(["stereo", str(capture), "-o", str(target), "--quiet", "--time-budget", "10m"]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith(f"{len(CENTERS)} photographs") and printed.out.count("\n") == 1
    page = (target / "report.html").read_text(encoding="utf-8")
    assert page.count("<figure>") == len(CENTERS) and "linprim-geo stereo" in page


def test_unusable_captures_are_refused(capture, made, tmp_path):
    def refused(match, scene=capture, output=None, **options):
        with pytest.raises(LinprimError, match=match):
            dense.run_stereo(scene, output or tmp_path / "dense", SceneOptions(**options), None, None, quiet=True)

    (tmp_path / "empty").mkdir()
    refused("no camera poses found", scene=tmp_path / "empty")
    refused("no such folder", scene=tmp_path / "none")
    refused("24 pixels a side", downscale=4)
    refused("no such folder, neither here", masks="nowhere")
    refused("exists already", output=capture)
    two = tmp_path / "two"
    shutil.copytree(capture / "images", two / "images")
    (two / "sparse" / "0").mkdir(parents=True)
    reconstruction(cameras()[:2], ["0.png", "1.png"], np.ones((4, 3))).write_binary(str(two / "sparse" / "0"))
    refused("2 photographs with poses, wanted at least 3", scene=two)


def test_photographs_are_undistorted_before_writing(tmp_path):
    from linprim_geo.synthetic.synth import synthesize

    settings = {"views": 8, "test_views": 0, "size": 64, "points": 500, "supersample": 1, "distortion": -0.1}
    synthesize(tmp_path / "bent", shape="room", **settings)
    found = dense.run_stereo(tmp_path / "bent", tmp_path / "dense", None, None, None, quiet=True)
    model = pycolmap.Reconstruction(str(found.workspace.root / "sparse"))
    for k, view in enumerate(found.workspace.views):
        assert view.lens is not None and found.workspace.image(k).suffix == ".png"
        assert np.array_equal(found.workspace.colors(k), view.load().rgb)
    # The centre of the first pixel is at 0.5, as in COLMAP.
    camera, taken = found.workspace.views[0].camera, model.camera(1)
    assert taken.model_name == "PINHOLE" and np.allclose(taken.params, [camera.fx, camera.fy, camera.cx, camera.cy])


def test_damaged_notes_are_refused(capture, made, tmp_path):
    for text in ("[", "[]", "{}", '{"names": [], "downscale": null, "scene": ""}'):
        target = tmp_path / "dense"
        target.mkdir(exist_ok=True)
        (target / dense.NOTES).write_text(text)
        with pytest.raises(LinprimError, match="stereo.json"):
            dense.run_stereo(capture, target, None, None, None, resume=True, quiet=True)


def test_photographs_that_exceed_memory_are_refused(capture, tmp_path, monkeypatch):
    monkeypatch.setattr("linprim_geo.stereo.dense.planes_on_disk.available_memory", lambda: 2**20)
    with pytest.raises(LinprimError, match="photographs of 96x72 takes 0.0 GiB of the 0.0 that are free"):
        dense.run_stereo(capture, tmp_path / "dense", None, None, None, quiet=True)


def test_depths_beside_a_mask_are_unknown(capture, tmp_path):
    masked = tmp_path / "masked"
    shutil.copytree(capture, masked)
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[:, : SIZE[0] // 2] = 255
    (masked / "masks").mkdir()
    for number in range(len(CENTERS)):
        Image.fromarray(mask).save(masked / "masks" / f"{number}.png")
    found = dense.run_stereo(masked, tmp_path / "dense", None, None, None, quiet=True)
    maps = found.workspace.read_maps(0)
    assert not maps.depth[mask == 0].any() and maps.depth[mask > 0].any()
