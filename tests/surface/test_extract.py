"""Meshes of runs: accuracy against an exact surface, file formats, and refused options."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import CENTER, octahedron_run

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import PROCESS_GIB
from linprim_geo.base.options import ExtractOptions
from linprim_geo.eval.mesh import score_mesh
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import validate_mesh
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.geometry.topology import topology
from linprim_geo.runs.run import Run
from linprim_geo.surface.extract import error_summary, extract_mesh
from linprim_geo.surface.fusion.tsdf_fusion import auto_voxel_size
from linprim_geo.surface.methods import method_tsdf
from linprim_geo.surface.methods.method_tsdf import (
    FAR_TRIES,
    SMALLEST_DISPARITY,
    DepthFrames,
    depth_limit,
    with_far_depths,
)

STATS = {
    "mesh",
    "mesh_visible",
    "mesh_shaded",
    "method",
    "level",
    "voxel_size",
    "truncation_voxels",
    "depth_limit",
    "unit",
    "views",
    "primitives",
    "vertices",
    "faces",
    "components",
    "boundary_edges",
    "non_manifold_edges",
    "genus",
    "watertight",
    "area",
    "volume",
    "visible",
    "seconds",
    "peak_gib",
}


@pytest.fixture(scope="module")
def extracted(solid):
    """(what extract_mesh returned for the opaque octahedron, its folder)"""
    return extract_mesh(solid, quiet=True), solid / "mesh" / "tsdf"


def outputs(folder):
    return sorted(path.name for path in folder.rglob("*") if path.is_file())


def test_output_files_and_stats(extracted, solid):
    stats, folder = extracted
    assert outputs(folder) == ["mesh.ply", "mesh_shaded.png", "mesh_visible.ply", "stats.json"]
    assert STATS <= stats.keys()
    assert json.loads((folder / "stats.json").read_text()) == json.loads(json.dumps(stats))
    assert stats["mesh"] == str(folder / "mesh.ply") and stats["mesh_visible"] == str(folder / "mesh_visible.ply")
    assert stats["views"] == 24 and stats["primitives"] == 1
    assert stats["seconds"].keys() == {
        "level",
        "render",
        "fuse",
        "compare",
        "refine",
        "denoise",
        "untangle",
        "creases",
        "outlines",
        "colours",
        "visibility",
        "picture",
        "write",
        "total",
    }
    assert (
        stats["peak_gib"].keys() == stats["seconds"].keys()
        and 0 < stats["peak_gib"]["fuse"] <= stats["peak_gib"]["total"]
    )
    predicted = load_mesh(folder / "mesh_visible.ply").quality
    assert stats["predicted_error"] == pytest.approx(
        {"median": np.median(predicted), "q90": np.quantile(predicted, 0.9)}
    )
    assert stats["visible"].keys() == topology(load_mesh(folder / "mesh.ply")).keys()


def test_error_summary_has_the_unconfirmed_share_if_known():
    quality = np.array([0.1, 0.2, 0.3, 0.3, np.nan], np.float32)
    assert error_summary(quality, 0.3) == pytest.approx({"median": 0.25, "q90": 0.3, "unconfirmed": 0.5})
    assert "unconfirmed" not in error_summary(quality) and error_summary(None, 0.3) is None


def test_the_mesh_agrees_with_the_reference(extracted, solid):
    stats, folder = extracted
    mesh, reference = load_mesh(folder / "mesh.ply"), load_mesh(solid.parent / "scene" / "reference.ply")
    scores = score_mesh(mesh, reference, samples=20_000)
    # Edges and corners are rounded within a voxel; the faces themselves are exact.
    assert scores["accuracy"] < 0.5 * stats["voxel_size"] and scores["completeness"] < 0.5 * stats["voxel_size"]
    assert scores["chamfer_percent_diagonal"] < 0.6 and scores["normal_consistency"] > 0.97
    truth = topology(reference)
    assert stats["components"] == 1 and stats["genus"] == 0
    assert stats["volume"] == pytest.approx(truth["volume"], rel=0.05)
    assert stats["area"] == pytest.approx(truth["area"], rel=0.05)
    assert np.abs(mesh.vertices.mean(0) - np.array(CENTER)).max() < 0.05


def test_normals_point_outward_and_colours_agree_with_photographs(extracted):
    mesh = load_mesh(extracted[1] / "mesh.ply")
    outward = mesh.vertices - np.array(CENTER)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < 1e-3
    assert (np.einsum("vc,vc->v", mesh.normals, outward) > 0).mean() > 0.98
    colors = mesh.colors.astype(float)
    # One flat colour, 0.5 + 0.7 Y0 = 0.697 of 255 in every channel.
    assert np.abs(np.median(colors, 0) - 178).max() <= 2
    assert (np.abs(colors - 178).max(1) < 20).mean() > 0.95


def test_the_visible_mesh_is_a_subset_of_the_mesh(extracted):
    stats, folder = extracted
    whole, visible = (load_mesh(folder / name) for name in ("mesh.ply", "mesh_visible.ply"))
    assert 0.9 * len(whole.faces) <= len(visible.faces) == stats["visible"]["faces"] <= len(whole.faces)
    triangles = {tuple(np.sort(row)) for row in np.round(whole.vertices[whole.faces].sum(2), 4)}
    seen = {tuple(np.sort(row)) for row in np.round(visible.vertices[visible.faces].sum(2), 4)}
    assert seen <= triangles


@pytest.mark.parametrize("suffix", [".obj", ".glb", ".stl", ".PLY"])
def test_all_formats_contain_the_same_surface(suffix, solid, extracted, tmp_path):
    options = ExtractOptions(voxel_size=0.08)
    stats = extract_mesh(solid, output=tmp_path / f"part{suffix}", options=options, quiet=True)
    assert outputs(tmp_path) == sorted([f"part{suffix}", "part_shaded.png", f"part_visible{suffix}"])
    mesh = load_mesh(tmp_path / f"part{suffix}")
    assert stats["voxel_size"] == pytest.approx(0.08) and len(mesh.faces) == stats["faces"]
    assert np.abs(mesh.vertices.mean(0) - np.array(CENTER)).max() < 0.1
    assert topology(validate_mesh(mesh, "part"))["area"] == pytest.approx(stats["area"], rel=1e-3)


def test_a_coarser_grid_gives_fewer_triangles(solid, extracted, tmp_path):
    fine, coarse = (
        extract_mesh(solid, output=tmp_path / f"{size}.ply", options=ExtractOptions(voxel_size=size), quiet=True)
        for size in (0.05, 0.1)
    )
    assert 2.5 < fine["faces"] / coarse["faces"] < 6


def test_the_level_moves_the_surface_of_a_soft_body(tmp_path):
    run = octahedron_run(tmp_path, density=6.0, views=16, size=48)
    volumes = [
        extract_mesh(run, options=ExtractOptions(level=level, voxel_size=0.06), quiet=True)["volume"]
        for level in (0.9, 0.5)
    ]
    # Half of the light is gone ln 2 / 6 = 0.12 behind the surface, of an octahedron some 0.7 in radius.
    assert volumes[1] < 0.85 * volumes[0]


def test_extraction_is_reproducible(tiny_run, tmp_path):
    for name in ("a", "b"):
        extract_mesh(tiny_run, output=tmp_path / f"{name}.ply", quiet=True)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_a_trained_part_is_accurate(tiny_run, tiny_scene, tmp_path):
    stats = extract_mesh(tiny_run, output=tmp_path / "m.ply", quiet=True)
    scores = score_mesh(load_mesh(stats["mesh"]), load_mesh(tiny_scene / "reference.ply"), samples=20_000)
    # 12 photographs of 48 pixels: a pixel is 2 % of the diagonal. Measured (see tests/README.md): 0.94 to 1.09 %, F1
    # 0.63 to 0.69.
    assert scores["chamfer_percent_diagonal"] < 1.36 and scores["f1"] > 0.58


def test_no_surface_at_the_level_writes_nothing(tmp_path):
    run = octahedron_run(tmp_path, density=0.1, views=4, size=32)
    with pytest.raises(LinprimError, match="no ray.*crosses transmittance"):
        extract_mesh(run, quiet=True)
    assert not (run / "mesh").exists()
    assert not [path for path in tmp_path.rglob("*.tmp*")]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"level": 0.0}, "--level"),
        ({"level": 1.0}, "--level"),
        ({"level": float("nan")}, "--level"),
        ({"memory_limit": 1e-4, "voxel_size": 0.01}, "GiB"),
        ({"voxel_size": -1.0}, "voxel"),
        ({"truncation": 0.0}, "truncation"),
        ({"smallest_part": 2.0}, "smallest"),
    ],
)
def test_invalid_options_are_refused(change, match, solid, tmp_path):
    with pytest.raises(LinprimError, match=match):
        extract_mesh(solid, output=tmp_path / "m.ply", options=replace(ExtractOptions(), **change), quiet=True)
    assert outputs(tmp_path) == []


def test_invalid_suffix_or_method_is_refused_before_rendering(solid, tmp_path, monkeypatch):
    monkeypatch.setattr(Run, "render_views", lambda *_, **__: pytest.fail("rendered"))
    with pytest.raises(LinprimError, match="suffix.*'.xyz'"):
        extract_mesh(solid, output=tmp_path / "m.xyz", quiet=True)
    with pytest.raises(LinprimError, match="--method"):
        extract_mesh(solid, method="magic", quiet=True)


@pytest.mark.parametrize(
    ("method", "change", "methods"),
    [
        ("polyhedra", {"voxel_size": 0.1}, "tsdf or opacity-field"),
        ("polyhedra", {"truncation": 2.0}, "tsdf"),
        ("opacity-field", {"depth_limit": 5.0}, "tsdf"),
    ],
)
def test_options_of_other_methods_are_refused(method, change, methods, solid, tmp_path):
    (name,) = change
    sentence = f"--{name.replace('_', '-')} is for --method {methods}, not for {method}"
    with pytest.raises(LinprimError, match=sentence):
        extract_mesh(solid, method, output=tmp_path / "m.ply", options=replace(ExtractOptions(), **change), quiet=True)
    assert outputs(tmp_path) == []


def test_a_run_without_results_is_refused(run_copy):
    (run_copy / "run.json").unlink()
    with pytest.raises(LinprimError, match="run.json is missing"):
        extract_mesh(run_copy, quiet=True)


def test_depth_frames_are_in_the_coordinates_of_the_data_set(solid):
    run = Run.open(solid)
    frames = DepthFrames(run, 0.5)
    shape = run.primitives().triangle_mesh()
    depth, face, _ = RayCaster(shape.vertices, shape.faces, threads=1).render_depth(frames[0].camera)
    assert len(frames) == 24 and frames[0].camera == run.scene().train[0].camera
    hit = frames[0].depth > 0
    inner = face >= 0
    for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        inner &= np.roll(face, shift, (0, 1)) == face
    assert hit[inner].all() and inner.sum() > 200
    assert np.abs(frames[0].depth[inner] - depth[inner]).max() < 2e-4
    assert not (frames[0].background & hit).any() and frames[0].background[~hit].all()


def test_depths_beyond_the_limit_are_clamped(solid):
    run = Run.open(solid)
    near = DepthFrames(run, 0.5)
    assert near.clamped_share == 0 and all(frame.clamped is None for frame in near)
    limit = float(np.median(np.concatenate([frame.depth[frame.depth > 0] for frame in near])))
    cut = DepthFrames(run, 0.5, limit)
    assert 0.4 < cut.clamped_share < 0.6 and cut.limit == limit
    for frame, whole in zip(cut, near, strict=True):
        assert frame.depth.max() <= np.float32(limit)
        np.testing.assert_array_equal(frame.clamped, whole.depth > limit)
        np.testing.assert_array_equal(frame.depth[~frame.clamped], whole.depth[~frame.clamped])


@pytest.mark.parametrize("within", [0.03, 0.08])
def test_depths_are_sharp_if_transmittance_falls_within_5_percent_of_depth(tmp_path, within):
    """The density lets the transmittance fall from 0.9 to 0.3 `within` a share of the depth along a ray."""
    clear = Run.open(octahedron_run(tmp_path / "any"))
    depth = float(np.median(np.concatenate([frame.depth[frame.depth > 0] for frame in DepthFrames(clear, 0.9)])))
    run = Run.open(octahedron_run(tmp_path / "fog", density=np.log(0.9 / 0.3) / (within * depth)))
    frames = DepthFrames(run, 0.35)  # where it falls so far
    sharp = [own[frame.depth > 0] for own, frame in zip(frames.sharp(), frames, strict=True)]
    assert len(sharp) == len(frames) and all(len(own) > 200 for own in sharp)
    share = np.concatenate(sharp).mean()
    assert share > 0.9 if within < 0.05 else share < 0.1


def test_the_depth_limit_is_where_a_quarter_pixel_equals_the_truncation():
    cameras = [
        replace(Camera(64, 48, 500.0, 500.0, 32.0, 24.0, np.eye(4)), world_to_camera=_shifted(x)) for x in (0.0, 6.0)
    ]
    limit = depth_limit(cameras, 2.0)
    # Disparity 500 * 6 / z: a quarter of a pixel less moves the point by three footprints of the median depth.
    moved = 500 * 6 / (500 * 6 / limit - 0.25) - limit
    assert moved == pytest.approx(3 * 2.0 / 500, rel=0.01)
    assert depth_limit(cameras[:1], 2.0) == 8.0


def test_far_depths_extend_to_the_truncation_of_the_largest_voxels(solid):
    run = Run.open(solid)
    frames = DepthFrames(run, 0.5)
    depth = float(np.median(frames[0].depth[frames[0].depth > 0]))
    near, voxel = frames.up_to(0.9 * depth), auto_voxel_size(frames)
    far = with_far_depths(near, ExtractOptions(), voxel)
    cameras = [view.camera for view in frames.views]
    baseline = np.linalg.norm(np.ptp([camera.center for camera in cameras], axis=0))
    # A quarter of a pixel between the outermost cameras moves a point by the truncation of voxels twice as large.
    assert SMALLEST_DISPARITY * far.limit**2 / (baseline * cameras[0].fx) == pytest.approx(3 * 2 * voxel, rel=1e-6)
    assert any(frame.clamped is not None for frame in near) and all(frame.clamped is None for frame in far)
    for options in (ExtractOptions(depth_limit=near.limit), ExtractOptions(voxel_size=voxel)):
        assert with_far_depths(near, options, voxel).limit == near.limit


@pytest.mark.parametrize("fits", [0.0, 0.5, 1.0])
def test_far_depths_keep_at_least_half_of_the_faces(solid, fits, monkeypatch):
    run = Run.open(solid)
    frames = DepthFrames(run, 0.5)
    near, voxel = frames.up_to(0.1 * frames.limit), auto_voxel_size(frames)
    farthest = with_far_depths(near, ExtractOptions(), voxel).limit
    most = near.limit + fits * (farthest - near.limit)
    monkeypatch.setattr(
        method_tsdf, "auto_voxel_size", lambda far: voxel * (1.5 if far.limit > most * (1 + 1e-9) else 1.4)
    )
    taken = with_far_depths(near, ExtractOptions(), voxel).limit
    assert near.limit <= taken <= most * (1 + 1e-9)
    assert taken > (farthest / near.limit) ** (-1 / FAR_TRIES) * most * (1 - 1e-9)


def test_voxels_grow_until_the_grid_fits_into_memory(solid, tmp_path, capsys):
    options = ExtractOptions(level=0.5, refine=0, denoise="off")
    whole = extract_mesh(solid, output=tmp_path / "whole.ply", options=options, quiet=True)
    # Half a MiB, or 240 blocks, beside what the process takes and a depth map of 64x64 at work.
    limit = PROCESS_GIB + (300 * 64**2 + 2**19) / 2**30
    small = extract_mesh(solid, output=tmp_path / "small.ply", options=replace(options, memory_limit=limit))
    assert small["voxel_size"] > 1.5 * whole["voxel_size"]
    assert "would not fit into memory" in capsys.readouterr().err
    given = replace(options, memory_limit=limit, voxel_size=whole["voxel_size"])
    with pytest.raises(LinprimError, match="a voxel size of .* fits"):
        extract_mesh(solid, output=tmp_path / "given.ply", options=given, quiet=True)
    least = replace(options, memory_limit=limit - 1.5 * 2**20 / 2**30)
    with pytest.raises(LinprimError, match="a depth map takes .* while it is fused"):
        extract_mesh(solid, output=tmp_path / "least.ply", options=least, quiet=True)


def _shifted(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = -x
    return pose


def test_frames_that_are_rendered_on_demand_give_the_same_mesh(tiny_run, tmp_path, monkeypatch):
    extract_mesh(tiny_run, output=tmp_path / "kept.ply", quiet=True)
    monkeypatch.setattr("linprim_geo.surface.methods.method_tsdf.KEPT_BYTES", 0)
    extract_mesh(tiny_run, output=tmp_path / "rendered.ply", quiet=True)
    assert (tmp_path / "kept.ply").read_bytes() == (tmp_path / "rendered.ply").read_bytes()
