"""Protocols of published tables, compared with closed forms and direct implementations."""

import dataclasses
import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.surfaces import CONTEXT, SCORES, camera_above, grid, join, sphere, wavy
from PIL import Image
from scipy.io import savemat

from linprim_geo.base.errors import LinprimError
from linprim_geo.cli import main as cli
from linprim_geo.eval import options
from linprim_geo.eval.culling import count_views
from linprim_geo.eval.mesh import eval_mesh_files
from linprim_geo.eval.protocols.files import CropVolume, ObservedVolume, read_observed_volume, read_plane
from linprim_geo.eval.protocols.point_sets import cell_means
from linprim_geo.eval.protocols.score import PROTOCOLS, TNT_TAU, Settings, score_by_protocol
from linprim_geo.eval.surface_samples import PointDistance, refine, sample_surface
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.mesh_files import load_mesh, save_mesh
from linprim_geo.geometry.raycast import RayCaster

MILLIMETRES = Settings(metre=1000.0)


def moved(mesh, *offset):
    return replace(mesh, vertices=mesh.vertices + offset)


def score(protocol, prediction, reference, **settings):
    return score_by_protocol(protocol, prediction, reference, Settings(**settings)).results


# --- linprim ------------------------------------------------------------------------------------------------


def test_linprim_distances_include_the_spacing_of_5000_points():
    result = score("linprim", grid(40, 20), grid(3, 3))
    assert result["chamfer"] == pytest.approx(0.5 * math.sqrt(2.0 / 5000), rel=0.04)
    assert result["samples"] == result["samples_reference"] == 5000 and result["normal_consistency"] == 1.0
    # The floor adds to an offset as the root of squares, point by point: E sqrt(h^2 + d^2) with d^2 of an
    # exponential distribution of mean A / (pi N).
    h, mean_square = 0.02, 2.0 / (math.pi * 5000)
    squares = -mean_square * np.log((np.arange(100_000) + 0.5) / 100_000)
    offset = score("linprim", moved(grid(40, 20), 0, 0, h), grid(3, 3))
    assert offset["chamfer"] == pytest.approx(np.sqrt(h * h + squares).mean(), rel=0.02)


@pytest.mark.parametrize("prediction", [wavy(), grid(40, 20)], ids=["apart", "coincident"])
def test_standard_errors_of_point_distances_agree_with_the_spread_over_seeds(prediction):
    results = [score("linprim", prediction, grid(), samples=400, seed=seed) for seed in range(40)]
    for key, error in (("chamfer", "standard_error"), ("f1", "f1_standard_error")):
        spread = np.std([result[key] for result in results], ddof=1)
        # 40 values give the spread to 11 %.
        assert 0.9 < np.mean([result[error] for result in results]) / spread < 2.2


def test_equal_seeds_give_equal_scores_in_every_protocol():
    cameras = [camera_above(z) for z in (3.0, 3.1, 3.2, 3.3)]
    own = {"dtu": {"metre": 50.0}, "tnt": {"tau": 0.05}, "scannetpp": {"cameras": cameras, "metre": 3.0}}
    for name in PROTOCOLS:
        pair = [score(name, wavy(), grid(), seed=seed, **own.get(name, {})) for seed in (1, 1, 2)]
        for result in pair:
            result.pop("seconds")
        assert pair[0] == pair[1] and pair[0]["chamfer"] != pair[2]["chamfer"]
        assert SCORES | CONTEXT - {"seconds"} <= set(pair[0]) and "chamfer_percent_diagonal" in pair[0]
        assert set(pair[0]["published"]) <= set(pair[0])
        assert pair[0]["sampling"] and pair[0]["culling"] and 0 < pair[0]["kept_prediction"] <= 1


# --- dtu ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def planes():
    """60 mm squares, meshed at 1.6 and 0.66 mm."""
    return grid(37, 37, (60.0, 60.0)), grid(91, 91, (60.0, 60.0))


@pytest.mark.parametrize(
    ("offset", "expected"),
    [(0.0, 0.106), (0.1, 0.149), (0.2, 0.230), (0.3, 0.321), (0.4, 0.416), (0.5, 0.513)],
)
def test_dtu_distances_include_the_spacing_of_points(planes, offset, expected):
    result = score("dtu", moved(planes[0], 0, 0, offset), planes[1], metre=1000.0)
    # Random thinning changes the third digit.
    assert result["chamfer"] == pytest.approx(expected, abs=0.0015)
    assert result["kept_prediction"] == result["kept_reference"] == 1.0 and result["normal_consistency"] is None
    assert result["points_before_thinning"] > result["samples"] > 40_000


def test_dtu_scores_scans_independently_of_unit_and_position(planes):
    scan = np.random.default_rng(0).random((200_000, 3)) * [60, 60, 0]
    result = score("dtu", planes[0], scan, metre=1000.0)
    assert result["samples_reference"] == 200_000
    # Accuracy is the floor of the scan's own density, which is random here.
    assert result["accuracy"] == pytest.approx(0.5 * math.sqrt(3600 / 200_000), rel=0.02)
    away = np.array([1e6, -2e6, 5e5])
    metres = replace(planes[0], vertices=1e-3 * planes[0].vertices + away)
    far = score("dtu", metres, 1e-3 * scan + away)
    # Coordinates of 2e6 are rounded to 2e-10, and lattice points at exactly 0.2 mm may go either way.
    assert far["chamfer"] == pytest.approx(1e-3 * result["chamfer"], rel=0.01)


def test_dtu_culls_the_prediction_by_mask_and_box_and_the_reference_by_the_plane(planes):
    low, high = np.array([100.0, 0, -10]), np.array([110.0, 60, 10])
    cells = np.zeros((11, 61, 21), bool)
    cells[:, :31] = True  # y up to 30.5
    plane = np.array([1.0, 0, 0, -10])  # x > 10
    # The box reaches from 100 - 60 to 110 + 120 in x: the part of the prediction from x = 40 on is in it.
    result = score("dtu", planes[0], planes[1], metre=1000.0, observed=ObservedVolume(low, high), plane=plane)
    assert result["kept_prediction"] == pytest.approx(1 / 3, abs=0.01)
    assert result["kept_reference"] == pytest.approx(5 / 6, abs=0.01)
    assert "box -60/+120" in result["culling"] and "plane" in result["culling"]
    # Reference points from 10 to 40 have nothing near; those 20 mm away or more are not counted: from 10 to
    # 20, the others have mean 10 (a fifth of all is dropped, 20 of 40 are far, 20 of 40 near zero).
    assert result["far_reference"] == pytest.approx(0.2, abs=0.01) and result["far_prediction"] == 0.0
    assert result["completeness"] == pytest.approx(5.05, abs=0.15) and result["accuracy"] < 0.12
    masked = replace(ObservedVolume(low, high, cells, 1.0), low=np.array([50.0, 0, -10]))
    result = score("dtu", planes[0], planes[1], metre=1000.0, observed=masked)
    # The cells cover x from 49.5 to 60.5 and y from -0.5 to 30.5.
    assert result["kept_prediction"] == pytest.approx(10.5 / 60 * 30.5 / 60, abs=0.004)
    assert result["completeness"] < 0.12  # the reference is compared with all that is in the box
    with pytest.raises(LinprimError, match="^prediction: nothing of it lies in the mask or box"):
        score("dtu", moved(planes[0], 900, 0, 0), planes[1], metre=1000.0, observed=masked)
    with pytest.raises(LinprimError, match="^reference: nothing of it lies above the plane"):
        score("dtu", planes[0], planes[1], metre=1000.0, plane=np.array([0, 0, 1.0, -1]))


# --- tnt ----------------------------------------------------------------------------------------------------


def plane_of(equilateral, cells=30, edge=4.0, turn=0.3):
    """A plane of triangles with legs, or all edges, of `edge`, turned so that no averaging cell lines up."""
    mesh = grid(cells, cells, (cells * edge, cells * edge))
    x, y, z = mesh.vertices.T
    if equilateral:
        x, y = x - y / 2, y * math.sqrt(3) / 2
    c, s = math.cos(turn), math.sin(turn)
    return replace(mesh, vertices=np.stack([c * x - s * y, s * x + c * y, z], 1))


@pytest.mark.parametrize("equilateral", [True, False])
def test_tnt_recall_depends_on_the_triangulation_unless_points_are_uniform(equilateral):
    mesh = plane_of(equilateral)
    result = score("tnt", mesh, mesh, tau=1.0)
    # Discs of radius 1 around the vertices (one per two triangles) and the centroids (two); those of the
    # right-angled triangles are 4 sqrt(2) / 3 apart and share a lens of 0.04.
    triangle = 4 * math.sqrt(3) if equilateral else 8.0
    assert result["recall"] == pytest.approx(1.5 * math.pi / triangle - (0 if equilateral else 0.01), abs=0.01)
    by_vertices = PointDistance(mesh.vertices).query(
        cell_means(sample_surface(mesh, 60_000, 0, independent=True)[0], 0.5)
    )[0]
    assert (by_vertices < 1.0).mean() == pytest.approx(0.5 * math.pi / triangle, abs=0.01)
    assert result["precision"] > 0.999
    uniform = result["uniform_points"]
    assert uniform["recall"] > 0.9999 and uniform["f1"] > 0.999
    assert result["tau"] == 1.0 and result["normal_consistency"] is None and result["registration"] == "none"


def test_tnt_threshold_is_exclusive_and_depends_on_the_scene():
    points = np.array([[0.0, 0, 0], [5, 0, 0]])
    flat = Mesh(np.array([[0.0, 0, 0.25], [5, 0, 0.25], [2.5, 1e-3, 0.25]]), np.array([[0, 1, 2]]))
    assert score("tnt", flat, points, tau=0.25)["recall"] == 0.0
    assert score("tnt", flat, points, tau=0.2501)["recall"] == 1.0
    assert {name: score("tnt", flat, points, scene=name.upper())["tau"] for name in TNT_TAU} == TNT_TAU
    assert score("tnt", flat, points, scene="Truck", metre=100.0)["tau"] == 0.5
    for wrong in ({}, {"tau": 0.1, "scene": "Barn"}):
        with pytest.raises(LinprimError, match="wants one threshold"):
            score("tnt", flat, points, **wrong)
    with pytest.raises(LinprimError, match="--scene is Palace"):
        score("tnt", flat, points, scene="Palace")


def test_tnt_crops_both_to_the_polygon():
    crop = CropVolume(2, -1.0, 1.0, np.array([[0.0, 0], [60, 0], [60, 60]]))  # the lower right half of a square
    mesh = grid(60, 60, (60.0, 60.0))
    result = score("tnt", join(mesh, moved(mesh, 0, 0, 5.0)), mesh, tau=1.0, crop=crop)
    assert result["kept_reference"] == pytest.approx(0.5, abs=0.01)
    assert result["kept_prediction"] == pytest.approx(0.25, abs=0.01) and result["precision"] > 0.999
    concave = CropVolume(0, 0.0, 1.0, np.array([[0.0, 0], [4, 0], [4, 4], [2, 1], [0, 4]]))
    inside = concave.holds(np.array([[0.5, 2, 0.5], [0.5, 2, 2.0], [0.5, 0.1, 3], [0.5, 5, 1], [2, 2, 0.5]]))
    assert inside.tolist() == [True, False, True, False, False]
    with pytest.raises(LinprimError, match="^prediction: nothing of it lies in the crop volume"):
        score("tnt", moved(mesh, 0, 0, 9), mesh, tau=1.0, crop=crop)


# --- scannetpp ----------------------------------------------------------------------------------------------


def test_scannetpp_keeps_faces_seen_by_more_than_three_cameras():
    floor, cellar = grid(3, 3, (1.0, 1.0)), moved(grid(3, 3, (1.0, 1.0)), 0, 0, -0.1)
    cameras = [camera_above(2.0 + 0.1 * k, target=(0.5, 0.5)) for k in range(4)]
    result = score("scannetpp", join(floor, cellar), floor, cameras=cameras)
    # The cellar is hidden by more than 2 cm; 10,000 points on a square metre have their floor.
    assert result["kept_prediction"] == pytest.approx(0.5, abs=0.01) and result["kept_reference"] == 1.0
    assert result["accuracy"] == pytest.approx(0.005, rel=0.04) and result["f1"] == 1.0 and result["tau"] == 0.05
    assert result["samples"] == pytest.approx(10_000, rel=0.02) and result["normal_consistency"] == 1.0
    close = score("scannetpp", join(floor, moved(cellar, 0, 0, 0.085)), floor, cameras=cameras)
    assert close["kept_prediction"] == pytest.approx(1.0)  # 1.5 cm below hides nothing
    with pytest.raises(LinprimError, match="^prediction: nothing of it is seen by more than 3 of the 3 cameras"):
        score("scannetpp", floor, floor, cameras=cameras[:3])
    with pytest.raises(LinprimError, match="--cameras"):
        score("scannetpp", floor, floor)
    with pytest.raises(LinprimError, match="--meters-per-unit"):
        score("scannetpp", replace(floor, vertices=1000 * floor.vertices), floor, cameras=cameras)
    # The same in millimetres.
    pose = cameras[0].world_to_camera
    millimetres = [
        replace(c, world_to_camera=np.vstack([np.c_[pose[:3, :3], 1000 * c.world_to_camera[:3, 3]], pose[3]]))
        for c in cameras
    ]
    large = [replace(m, vertices=1000 * m.vertices) for m in (join(floor, cellar), floor)]
    scaled = score("scannetpp", *large, cameras=millimetres, metre=1000.0)
    assert scaled["chamfer"] == pytest.approx(1000 * result["chamfer"], rel=1e-6) and scaled["tau"] == 50.0


def test_rays_that_slip_between_triangles_are_recast():
    mesh = refine(sphere(1.0, 0), 0.04)  # an octahedron, cut finely: faces towards the camera are those of z > 0
    caster = RayCaster(mesh.vertices, mesh.faces)
    views = count_views(caster, mesh.vertices, [camera_above(3.0)] * 5, 1e-3, enough=4)
    clear = np.abs(mesh.vertices[:, 2]) > 0.01
    assert (views[clear] == 4 * (mesh.vertices[clear, 2] > 0)).all()
    assert caster.recast > 0  # aimed exactly at vertices, some rays pass between the triangles in float32


# --- hard meshes --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PROTOCOLS)
def test_small_far_and_broken_meshes_are_scored_by_every_protocol(name):
    cameras = [camera_above(2.0 + 0.1 * k, target=(0.5, 0.5)) for k in range(4)]
    settings = {
        "linprim": {},
        # Not a multiple of 0.2 mm: lattices with exactly the radius of the thinning depend on rounding.
        "dtu": {"metre": 21.3},
        "tnt": {"tau": 0.05},
        "scannetpp": {"cameras": cameras},
    }
    triangle = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    # Three faces at one edge, and a face that crosses: non-manifold and self-intersecting.
    fan = Mesh(
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0.5, 0.2], [0.5, -0.2, 0]]),
        np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4], [2, 3, 4]]),
    )
    for mesh in (triangle, fan):
        near = score(name, mesh, mesh, **settings[name])
        assert math.isfinite(near["chamfer"]) and near["precision"] > 0.9
        if name == "scannetpp":
            continue
        away = np.array([1e6, -2e6, 3e6])
        far = score(name, moved(mesh, *away), moved(mesh, *away), **settings[name])
        assert far["chamfer"] == pytest.approx(near["chamfer"], rel=0.05)


@pytest.mark.parametrize("protocol", ["linprim", "dtu", "tnt"])
def test_degenerate_repeated_and_nan_faces_change_nothing(protocol, tmp_path):
    clean = wavy()
    n = len(clean.vertices)
    vertices = np.concatenate([clean.vertices, [[np.nan, 0, 0], [np.inf, 0, 0], [9.0, 9, 9]]])
    junk = [[0, 0, 1], [2, 2, 2], [0, 1, n], [0, 1, n + 1], clean.faces[7], clean.faces[9][::-1]]
    save_mesh(tmp_path / "clean.ply", clean)
    save_mesh(tmp_path / "broken.obj", Mesh(vertices, np.concatenate([clean.faces, junk])))
    save_mesh(tmp_path / "reference.ply", grid())
    options = {"tnt": {"tau": 0.05}, "dtu": {"meters_per_unit": 0.02}}.get(protocol, {})
    a, b = (
        eval_mesh_files(tmp_path / name, tmp_path / "reference.ply", protocol=protocol, **options)
        for name in ("clean.ply", "broken.obj")
    )
    # The files round coordinates to seven and nine digits.
    assert b["chamfer"] == pytest.approx(a["chamfer"], rel=1e-3)
    assert b["dropped"]["prediction"] == {"not_finite": 2, "degenerate": 2, "duplicate": 2, "unreferenced": 3}


def test_every_protocol_is_an_option():
    assert options.PROTOCOLS == ("headline", *PROTOCOLS)
    assert options.TAKEN_BY.keys() < {field.name for field in dataclasses.fields(options.ScoreOptions)}


# --- files and the command ----------------------------------------------------------------------------------


@pytest.fixture
def meshes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_mesh(tmp_path / "a.ply", grid(30, 30, (60.0, 60.0), 0.2))
    save_mesh(tmp_path / "b.ply", grid(7, 7, (60.0, 60.0)))
    return tmp_path


def run_command(line, capsys):
    status = cli.main([*line.split(), "--json"])
    shown = capsys.readouterr()
    return (json.loads(shown.out), "") if status == 0 else (status, shown.err)


def test_dtu_command_with_files_of_the_benchmark(meshes, capsys):
    grid_of_cells = np.ones((80, 80, 3), np.uint8)
    grid_of_cells[40:] = 0
    savemat(
        meshes / "mask.mat",
        {"ObsMask": grid_of_cells, "BB": np.array([[0.0, 0, -1], [79, 79, 1]]), "Res": 1.0},
    )
    savemat(meshes / "plane.mat", {"P": np.array([[0.0], [1.0], [0.0], [-30.0]])})
    line = "eval-mesh a.ply b.ply --protocol dtu --mask mask.mat --plane plane.mat -o out"
    result, _ = run_command(line, capsys)
    assert result["protocol"] == "dtu" and result["kept_prediction"] == pytest.approx(39.5 / 60, abs=0.01)
    assert result["kept_reference"] == pytest.approx(0.5, abs=0.01)
    assert result["chamfer"] == pytest.approx(0.235, abs=0.01)
    assert json.loads((meshes / "out" / "results.json").read_text())["chamfer"] == result["chamfer"]
    by_text, _ = run_command("eval-mesh a.ply b.ply --protocol dtu --box=0,0,-1,1,9,1 --plane=0,1,0,-30", capsys)
    assert by_text["kept_reference"] == result["kept_reference"] and by_text["kept_prediction"] == 1.0


def test_tnt_command_with_scan_crop_and_transform(meshes, capsys):
    scan = np.random.default_rng(0).random((30_000, 3)) * [60, 60, 0]
    rows = "\n".join(f"{x} {y} {z}" for x, y, z in scan)
    head = "ply\nformat ascii 1.0\nelement vertex 30000\nproperty float x\nproperty float y\nproperty float z\n"
    (meshes / "scan.ply").write_text(f"{head}end_header\n{rows}\n")
    crop = {"orthogonal_axis": "Z", "axis_min": -1, "axis_max": 1, "class_name": "SelectionPolygonVolume"}
    crop["bounding_polygon"] = [[0, 0, 7], [30, 0, 7], [30, 60, 7], [0, 60, 7]]
    (meshes / "crop.json").write_text(json.dumps(crop))
    np.savetxt(meshes / "move.txt", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -0.2], [0, 0, 0, 1]])
    line = "eval-mesh a.ply scan.ply --protocol tnt --tau 0.5 --crop crop.json --transform move.txt -o out"
    result, _ = run_command(line, capsys)
    assert result["kept_reference"] == pytest.approx(0.5, abs=0.01) and result["precision"] > 0.95
    assert result["sampling"].startswith("vertices and centroids against points of the scan")
    assert result["uniform_points"]["recall"] > 0.99 > 0.6 > result["recall"]
    assert result["hausdorff"] < 2  # 0.2 less than without the transform, by the spacing of the points
    colored = load_mesh(meshes / "out" / "error_pred.ply")
    assert colored.quality.max() < 2 and np.ptp(colored.vertices[:, 2]) == 0
    header = (meshes / "out" / "error_ref.ply").read_bytes()[:300].decode("latin1")
    assert "element vertex 30000" in header and "property float quality" in header and "face" not in header


def test_scannetpp_and_headline_commands_with_cameras_of_a_scene(tiny_scene, tmp_path, capsys):
    mesh = sphere(0.8, 3)
    save_mesh(tmp_path / "ball.ply", mesh)
    save_mesh(tmp_path / "more.ply", join(mesh, sphere(0.2, 2)))
    pair = f"{tmp_path / 'more.ply'} {tmp_path / 'ball.ply'} --cameras {tiny_scene}"
    headline, _ = run_command(f"eval-mesh {pair} --samples 2000", capsys)
    # The inner ball, a sixteenth of the outer one's area, is seen by no camera.
    assert headline["accuracy"] > 0.03 and headline["visible"]["accuracy"] < 1e-6
    assert headline["visible"]["kept_prediction"] < 16.1 / 17 < headline["visible"]["kept_reference"]
    assert headline["visible"]["cameras"] == 12 and headline["visible"]["recast_rays"] >= 0
    assert headline["rays"]["rays"] == pytest.approx(2000, abs=12) and headline["rays"]["miss"] == 0.0
    assert headline["rays"]["distance_mean"] == 0.0 and headline["rays"]["phantom"] == 0.0
    result, _ = run_command(f"eval-mesh {pair} --protocol scannetpp --meters-per-unit 0.3", capsys)
    assert result["kept_prediction"] < 16.1 / 17 and result["f1"] == 1.0
    assert result["culling"].startswith("faces seen by more than 3 of 12 cameras")


def test_each_protocol_has_its_own_output_folder_in_a_run(meshes):
    view = SimpleNamespace(camera=camera_above(90.0, target=(30.0, 30.0)))
    scene = SimpleNamespace(train=(view,) * 4, unit="mm")
    run = SimpleNamespace(path=meshes / "run", scene=lambda: scene)
    for protocol in ("linprim", "dtu", "scannetpp"):
        scale = {} if protocol == "linprim" else {"meters_per_unit": 0.001 if protocol == "dtu" else 0.02}
        result = eval_mesh_files("a.ply", "b.ply", run=run, protocol=protocol, **scale)
        names = {path.name for path in (meshes / "run" / "eval" / "mesh" / protocol).iterdir()}
        assert names == {
            "results.json",
            "error_pred.ply",
            "error_ref.ply",
            "precision_recall.png",
            "error_histogram.png",
        }
        assert result["unit"] == "mm" and result["color_max"] > 0.2
        for name in ("precision_recall.png", "error_histogram.png"):
            picture = np.asarray(Image.open(meshes / "run" / "eval" / "mesh" / protocol / name).convert("RGB"))
            assert picture.shape == (590, 900, 3)
            blue, orange = (
                np.abs(picture.astype(int) - color).max(axis=2) < 30 for color in ((31, 99, 178), (214, 112, 18))
            )
            assert blue.sum() > 100 and orange.sum() > 100 and (picture > 245).all(axis=2).mean() > 0.3


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            "--protocol dtu --samples 9",
            "--samples does not belong to --protocol dtu, only to headline and linprim",
        ),
        ("--mask m.mat", "--mask does not belong to --protocol headline, only to dtu"),
        ("--protocol linprim --cameras x", "--cameras does not belong to --protocol linprim"),
        ("--protocol dtu --mask gone.mat", "gone.mat: cannot be read"),
        ("--protocol dtu --mask a.ply", "a.ply: is not a MATLAB file"),
        ("--protocol dtu --mask p.mat", "p.mat: has no ObsMask and no BB and no Res"),
        ("--protocol dtu --mask flat.mat", "flat.mat: ObsMask is"),
        ("--protocol dtu --mask p.mat --box=0,0,0,1,1,1", "give one of them"),
        ("--protocol dtu --box=0,0,0,1,1", "--box is 0,0,0,1,1, expected 6 numbers"),
        ("--protocol dtu --box=0,0,0,1,1,-1", "expected the smaller corner first"),
        ("--protocol dtu --plane=0,0,0,1", "the plane is"),
        ("--protocol dtu --plane=0,0,nan,1", "--plane is"),
        ("--protocol dtu --plane gone.mat", "gone.mat: cannot be read"),
        ("--protocol dtu --meters-per-unit 1e6", "expected lengths in the protocol's unit"),
        ("--protocol tnt", "protocol tnt wants one threshold"),
        ("--protocol tnt --scene Palace", "--scene is Palace, expected one of Barn"),
        ("--protocol tnt --tau 1 --crop gone.json", "gone.json: cannot be read as a crop volume"),
        ("--protocol tnt --tau 1 --crop a.ply", "a.ply: is not a crop volume in JSON"),
        ("--protocol tnt --tau 1 --crop empty.json", "empty.json: has no orthogonal_axis"),
        ("--protocol tnt --tau 1 --transform empty.json", "empty.json: is not a table of numbers"),
        ("--protocol tnt --tau 1 --transform three.txt", "three.txt: is (3, 3), expected an invertible 4x4"),
        ("--protocol scannetpp", "give a scene's folder with --cameras, or --run"),
        ("--protocol scannetpp --cameras .", "no camera poses found"),
    ],
)
def test_what_does_not_fit_is_one_sentence(options, sentence, meshes, capsys):
    savemat(meshes / "p.mat", {"P": np.zeros(4)})
    savemat(meshes / "flat.mat", {"ObsMask": np.zeros((3, 3)), "BB": np.zeros((2, 3)), "Res": 1.0})
    (meshes / "empty.json").write_text("{}")
    np.savetxt(meshes / "three.txt", np.eye(3))
    status, error = run_command(f"eval-mesh a.ply b.ply {options} -o out", capsys)
    assert status == 1 and error.count("\n") == 1 and sentence in error
    assert not (meshes / "out").exists()


def test_point_references_are_accepted_only_by_protocols_with_scans(meshes, capsys):
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (meshes / "scan.ply").write_text(head + "0 0 0\n1 1 0\n")
    (meshes / "nan.ply").write_text(head + "nan 0 0\nnan 1 0\n")
    for protocol in ("headline", "linprim"):
        assert "holds no triangles" in run_command(f"eval-mesh a.ply scan.ply --protocol {protocol}", capsys)[1]
    assert "no finite points" in run_command("eval-mesh a.ply nan.ply --protocol dtu", capsys)[1]
    assert run_command("eval-mesh a.ply scan.ply --protocol dtu", capsys)[0]["samples_reference"] == 2


def test_masks_and_planes_without_files():
    box = read_observed_volume(None, "0,0,0,1,2,3")
    assert box.cells is None and box.holds(np.full((1, 3), 9.0)).all() and box.high.tolist() == [1, 2, 3]
    assert read_observed_volume(None, None) is None
    assert read_plane("1,2,3,-4").tolist() == [1, 2, 3, -4]
