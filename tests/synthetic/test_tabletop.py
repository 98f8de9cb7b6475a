"""Objects on a table in a room: exact geometry, unchanged colours, a far room, a hand-held path, noise and JPEG."""

import dataclasses
import json
import sys
import types

import numpy as np
import pytest
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import load_scene
from linprim_geo.cli import main as cli
from linprim_geo.geometry.camera import Camera
from linprim_geo.synthetic import camera_paths as campath
from linprim_geo.synthetic import shapes, tabletop_captures
from linprim_geo.synthetic.environment import synthetic_environment
from linprim_geo.synthetic.options import SynthOptions
from linprim_geo.synthetic.photos import sensor_noise
from linprim_geo.synthetic.synth import synthesize
from linprim_geo.synthetic.tabletop import on_table
from linprim_geo.synthetic.textured import TexturedMesh, load_textured

SMALL = {"views": 7, "test_views": 3, "size": (64, 48), "supersample": 1, "points": 150, "threads": 1}


@pytest.fixture(scope="module")
def part():
    return shapes.cad_part()


@pytest.fixture(scope="module")
def capture(tmp_path_factory, part):
    """A capture as PNG without noise, so that every pixel has a closed form."""
    out = tmp_path_factory.mktemp("tabletop") / "part"
    report = synthesize(out, mesh=part, table=2.5, environment=4, seed=5, distance=3.4, **SMALL)
    return out, report


def pixels(path):
    return np.array(Image.open(path))


def cameras_of(out, split):
    listing = json.loads((out / f"transforms_{split}.json").read_text())
    poses = [np.linalg.inv(np.array(f["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])) for f in listing["frames"]]
    inner = [listing[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")]
    return listing, [Camera(*inner, pose) for pose in poses]


# Table


def test_table_is_a_slab_below_the_lowest_point_of_the_object(part):
    moved = TexturedMesh("moved", part.vertices + [10.0, -7.0, 3.3], part.faces, part.part, part.albedo)
    for surface in (part, moved):
        both = on_table(surface, 3.0)
        count = len(surface.vertices)
        assert np.array_equal(both.vertices[:count], surface.vertices)
        assert np.array_equal(both.faces[: len(surface.faces)], surface.faces)
        slab, lower, upper = both.vertices[count:], surface.vertices.min(0), surface.vertices.max(0)
        side = 3.0 * max((upper - lower)[:2])
        assert slab[:, 2].max() == surface.vertices[:, 2].min()
        assert np.ptp(slab, axis=0) == pytest.approx([side, side, 0.04 * side])
        assert 0.5 * (slab.min(0) + slab.max(0))[:2] == pytest.approx(0.5 * (lower + upper)[:2])
        corners = both.vertices[both.faces[len(surface.faces) :]] - slab.mean(0)
        volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
        assert volume == pytest.approx(0.04 * side**3)  # closed, and its faces look outwards
        assert set(both.part[len(surface.faces) :]) == {surface.part.max() + 1}


def test_unreferenced_vertices_do_not_change_the_table(part):
    stray = np.concatenate([part.vertices, [[50.0, 0.0, -50.0]]])
    loose = TexturedMesh("loose", stray, part.faces, part.part, part.albedo)
    assert np.array_equal(on_table(loose, 2.0).vertices[-8:], on_table(part, 2.0).vertices[-8:])


@pytest.mark.parametrize("kind", ["procedural", "file"])
def test_colours_of_the_object_do_not_change_on_a_table(tmp_path, part, kind):
    surface = part
    if kind == "file":
        import trimesh

        ball = trimesh.creation.icosphere(2)
        color = np.clip(ball.vertices * 127 + 128, 0, 255).astype(np.uint8)
        trimesh.Trimesh(ball.vertices + 5.0, ball.faces, vertex_colors=color, process=False).export(tmp_path / "b.ply")
        surface = load_textured(tmp_path / "b.ply")
    both = on_table(surface, 4.0)
    rng = np.random.default_rng(0)
    face = rng.integers(0, len(surface.faces), 1500)
    bary = rng.dirichlet([1.0, 1.0, 1.0], 1500)[:, 1:]
    weight = np.column_stack([1.0 - bary.sum(1), bary])
    points = np.einsum("nc,ncd->nd", weight, surface.vertices[surface.faces[face]])
    alone = surface.colors(points, face, bary)
    assert np.array_equal(both.colors(points, face, bary), alone)
    # The same points mixed with points of the table, which changes the blocks.
    table = rng.integers(len(surface.faces), len(both.faces), 1500)
    mixed = rng.permutation(3000)
    together = both.colors(np.tile(points, (2, 1))[mixed], np.append(face, table)[mixed], np.tile(bary, (2, 1))[mixed])
    assert np.abs(together[np.argsort(mixed)][:1500] - alone).max() < 1e-6


def test_wood_texture_is_continuous_has_contrast_and_is_band_limited(part):
    both = on_table(part, 4.0)
    wood, first = both.albedo.table, len(part.faces)
    side, unit = wood.side, wood.unit

    def colors(points):
        relative = (points + wood.middle).astype(np.float32)
        return wood(relative, np.full(len(points), first), np.zeros((len(points), 2)))

    # Across all planks: no step at the seams. Seams rise by 1.5 / SEAM of a contrast of 0.3, the grain by at most
    # 2 pi / 0.07 of one of 0.08: less than 20 per unit together.
    y = np.linspace(-0.49 * side, 0.49 * side, 40_000)
    line = np.column_stack([np.full_like(y, 0.2), y, np.zeros_like(y)])
    value = colors(line)
    assert np.abs(np.diff(value, axis=0)).max() < 20.0 / unit * (y[1] - y[0])
    assert 0.0 <= value.min() and value.max() <= 1.0 and value.std() > 0.03
    rng = np.random.default_rng(1)
    patches = []
    for _ in range(200):
        middle = np.append(rng.uniform(-0.45, 0.45, 2) * side, 0.0)
        square = np.column_stack([rng.uniform(-0.1, 0.1, (100, 2)) * unit, np.zeros(100)])
        patches.append(colors(middle + square).std(0).max())
    assert min(patches) > 0.008
    spectrum = np.abs(np.fft.rfft((value.mean(1) - value.mean()) * np.hanning(len(y)))) ** 2
    cycles = np.arange(len(spectrum)) / np.ptp(y) * unit
    # Beyond twice the finest grain, 0.07 units, only the third harmonics of its soft threshold are left.
    assert spectrum[cycles > 2.0 / 0.07].sum() < 5e-3 * spectrum.sum()


def test_depth_normals_masks_points_and_reference_contain_the_table(capture, part):
    from linprim_geo.geometry.mesh_files import load_mesh

    out, report = capture
    top = part.vertices[:, 2].min()
    listing, cameras = cameras_of(out, "train")
    for frame, camera in zip(listing["frames"], cameras, strict=True):
        depth = pixels(out / frame["depth_file_path"]) * listing["depth_unit_scale_factor"]
        z = (camera.center + depth[..., None] * camera.world_rays())[..., 2]
        normal = pixels(out / frame["normal_file_path"])
        on_top = (depth > 0) & (np.abs(z - top) < 1e-3) & (normal[..., 2] == 255)
        assert on_top.mean() > 0.15
        assert (pixels(out / "truth_masks" / frame["file_path"])[on_top] == 255).all()
    scene = load_scene(out)
    heights = scene.points.xyz[:, 2]
    assert 0.2 < np.mean(np.abs(heights - top) < 1e-9) < 0.9
    reference = load_mesh(out / "reference.ply")
    table = on_table(part, 2.5).vertices
    assert np.ptp(reference.vertices, axis=0) == pytest.approx(np.ptp(table, axis=0), abs=1e-5)
    assert report["faces"] == len(part.faces) + 12


# Environment


def test_environment_depends_on_direction_and_seed_only():
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(20_000, 3))
    room = synthetic_environment(4)
    color = room(directions)
    assert color.dtype == np.float32 and color.min() >= 0.0 and color.max() <= 1.0
    # Of the same directions with other rounding: an edge rises by at most 1.5 per BLUR, rounding is 1e-6 rad.
    assert np.abs(room(directions * rng.uniform(0.01, 100.0, (20_000, 1))) - color).max() < 1e-3
    assert np.array_equal(synthetic_environment(4)(directions), color)
    assert np.abs(synthetic_environment(5)(directions) - color).mean() > 0.03
    lowest = directions[:, 2] < -0.9 * np.linalg.norm(directions, axis=1)
    assert color[lowest].mean() < color[~lowest].mean() - 0.1


@pytest.mark.parametrize("seed", range(4))
def test_edges_of_the_environment_are_smooth(seed):
    room, rng = synthetic_environment(seed), np.random.default_rng(seed)
    step = np.deg2rad(0.02)
    angle = np.arange(0.0, 2.0 * np.pi, step)
    for _ in range(25):
        a, b = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
        color = room(np.cos(angle)[:, None] * a + np.sin(angle)[:, None] * b)
        # A smoothstep over one degree rises by 1.5 of its contrast per degree; two may rise at once.
        assert np.abs(np.diff(color, axis=0)).max() < 2.0 * 1.5 * 0.02
        assert color.std() > 0.02


def test_pixels_without_a_hit_show_the_environment(capture):
    out, report = capture
    room = synthetic_environment(4)
    seen = 0
    for split in ("train", "test"):
        listing, cameras = cameras_of(out, split)
        for frame, camera in zip(listing["frames"], cameras, strict=True):
            photo = pixels(out / frame["file_path"])
            assert photo.shape == (48, 64, 3)
            missed = pixels(out / "truth_masks" / frame["file_path"]) == 0
            expected = room(camera.world_rays()[missed]) * 255.0
            # Half a step of rounding, and single precision of the rays.
            assert np.abs(photo[missed] - expected).max(initial=0.0) < 0.51
            seen += missed.sum()
    assert seen > 3000
    assert report["environment"] == 4 and report["background"] == "environment"
    assert not (out / "masks").exists()


# Arc


@pytest.mark.parametrize("degrees, views, held_out", [(300.0, 40, 8), (120.0, 9, 20), (360.0, 24, 1), (90.0, 5, 0)])
def test_arc_stays_within_its_limits_with_held_out_views_in_between(degrees, views, held_out):
    center, distance = np.array([3.0, -2.0, 0.7]), 4.0
    train, test = campath.arc(views, held_out, center, distance, degrees, seed=6)
    again = campath.arc(views, held_out, center, distance, degrees, seed=6)
    assert np.array_equal(train, again[0]) and np.array_equal(test, again[1])
    assert not np.array_equal(train, campath.arc(views, held_out, center, distance, degrees, seed=7)[0])
    poses = np.array(train + test)
    assert np.linalg.det(poses[:, :3, :3]) == pytest.approx(1.0) and len(poses) == views + held_out
    offset = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses]) - center
    radius = np.linalg.norm(offset, axis=1)
    elevation = np.rad2deg(np.arcsin(offset[:, 2] / radius))
    assert elevation.min() >= 12.0 and elevation.max() <= 45.0 and np.ptp(elevation) > 8.0
    assert np.abs(radius / distance - 1.0).max() <= 0.1 and np.ptp(radius) > 0.2
    forward = poses[:, 2, :3]
    beside = np.linalg.norm(offset - (offset * forward).sum(1, keepdims=True) * forward, axis=1)
    assert 0.01 * distance < beside.max() <= 0.06 * distance
    assert np.abs(np.rad2deg(np.arcsin(poses[:, 0, 2]))).max() <= 2.0
    azimuth = np.rad2deg(np.arctan2(offset[:, 1], offset[:, 0]))
    spacing = degrees / views
    assert azimuth[:views] == pytest.approx(spacing * (np.arange(views) + 0.5) - 0.5 * degrees)
    gap = np.abs(azimuth[views:, None] - azimuth[:views])
    assert gap.min(initial=spacing) > 0.2499 * spacing
    assert np.abs(azimuth[views:]).max(initial=0.0) < 0.5 * degrees


def test_capture_with_a_table_uses_an_arc_above_the_table(capture, part):
    out, report = capture
    assert (report["path"], report["arc"], report["distance"], report["table"]) == ("arc", 300.0, 3.4, 2.5)
    middle = 0.5 * (part.vertices.min(0) + part.vertices.max(0))
    for split in ("train", "test"):
        for camera in cameras_of(out, split)[1]:
            assert camera.center[2] > part.vertices[:, 2].min()
            assert 0.9 * 3.4 <= np.linalg.norm(camera.center - middle) <= 1.1 * 3.4


def test_default_distance_of_an_arc_is_that_of_a_hemisphere(tmp_path, part):
    few = {**SMALL, "views": 3, "test_views": 0, "size": 16, "points": 0}
    arc = synthesize(tmp_path / "arc", mesh=part, table=6.0, arc=90, **few)
    dome = synthesize(tmp_path / "dome", mesh=part, path="hemisphere", **few)
    assert arc["distance"] == dome["distance"] and (arc["arc"], dome["arc"]) == (90.0, None)


# Noise and JPEG


def test_noise_variance_grows_with_the_signal_as_stated():
    for value in (0.1, 0.5, 0.9):
        clean = np.full((300, 300, 3), value, dtype=np.float32)
        noise = sensor_noise(clean, 2.0, (0, 1)) - clean
        # The variance of 270,000 numbers is known to 0.27 %, their mean to 0.002 deviations; five times that.
        expected = (2.0 / 255.0) ** 2 * (0.5 + value)
        assert noise.var() == pytest.approx(expected, rel=0.014)
        assert abs(noise.mean()) < 0.01 * np.sqrt(expected)
        neighbours = (noise[:, 1:] * noise[:, :-1]).mean() / expected
        channels = (noise[..., 0] * noise[..., 1]).mean() / expected
        assert abs(neighbours) < 0.015 and abs(channels) < 0.02
    assert sensor_noise(clean, 0.0, (0, 1)) is clean


def test_noise_of_a_capture_has_the_given_strength_and_is_independent_between_views(tmp_path, part):
    gray = {
        **SMALL,
        "views": 2,
        "test_views": 1,
        "points": 0,
        "background": (0.5, 0.5, 0.5),
        "fov": 90.0,
        "distance": 9.0,
    }
    synthesize(tmp_path / "a", mesh=part, noise=4.0, seed=1, **gray)
    synthesize(tmp_path / "b", mesh=part, noise=4.0, seed=2, **gray)
    views = []
    for name in ("a/train/000", "a/train/001", "a/test/000", "b/train/000"):
        folder, split, number = name.split("/")
        missed = pixels(tmp_path / folder / "truth_masks" / split / f"{number}.png") == 0
        noise = pixels(tmp_path / f"{name}.png")[missed] - 127.5
        # Rounding adds 1/12. Of some 8,000 numbers the variance is known to 1.6 %.
        assert noise.var() == pytest.approx(16.0 + 1.0 / 12.0, rel=0.08)
        views.append(pixels(tmp_path / f"{name}.png")[:6])
    for i in range(4):
        for j in range(i):
            assert np.abs(np.corrcoef(views[i].ravel() - 127.5, views[j].ravel() - 127.5)[0, 1]) < 0.15


def test_jpeg_capture_has_no_alpha_and_is_close_to_png(tmp_path, part):
    for jpeg in (0, 92):
        synthesize(tmp_path / str(jpeg), mesh=part, table=2.0, environment=1, jpeg=jpeg, **SMALL)
    out = tmp_path / "92"
    assert sorted(path.name for path in (out / "train").iterdir()) == [f"{i:03d}.jpg" for i in range(7)]
    assert json.loads((out / "synth.json").read_text())["jpeg"] == 92
    scene, plain = load_scene(out), load_scene(tmp_path / "0")
    assert len(scene.train) == 7 and len(scene.test) == 3 and len(scene.points.xyz) == 150
    for view, other in zip(scene.train + scene.test, plain.train + plain.test, strict=True):
        photo = view.load()
        assert photo.alpha is None and view.image_path.suffix == ".jpg"
        # Colour at half resolution blurs this small a picture; brightness is near.
        error = photo.rgb.astype(float).mean(2) - other.load().rgb.astype(float).mean(2)
        assert 0.0 < np.sqrt((error**2).mean()) < 6.0
    import pycolmap

    model = pycolmap.Reconstruction(str(out / "sparse/0"))
    assert {image.name for image in model.images.values()} == {f"train/{i:03d}.jpg" for i in range(7)}
    (out / "transforms_train.json").unlink()
    (out / "transforms_test.json").unlink()
    assert len(load_scene(out).train + load_scene(out).test) == 7  # by the COLMAP model alone


def test_files_do_not_depend_on_the_threads(tmp_path, part):
    everything = {"table": 2.0, "environment": 3, "noise": 3.0, "jpeg": 85, "arc": 200.0, "shading": "shaded"}
    for threads in (1, 2):
        synthesize(tmp_path / str(threads), mesh=part, **{**SMALL, **everything, "threads": threads})
    names = sorted(p.relative_to(tmp_path / "1") for p in (tmp_path / "1").rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(tmp_path / "2") for p in (tmp_path / "2").rglob("*") if p.is_file())
    for name in names:
        if name.name != "synth.json":
            assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes(), name


# What cannot be done


@pytest.mark.parametrize(
    "options, words",
    [
        ({"table": -1}, "table"),
        ({"table": 0.5}, "wanted 0, or 1 to 100"),
        ({"table": "wide"}, "table"),
        ({"table": 2, "path": "sphere"}, "arc or hemisphere"),
        ({"table": 2, "path": "inside-out"}, "arc or hemisphere"),
        ({"table": 2, "distance": 1.05}, "nearest view"),
        ({"environment": -1}, "environment"),
        ({"environment": 1.5}, "environment"),
        ({"environment": 1, "background": "black"}, "both given"),
        ({"arc": 0, "path": "arc"}, "arc is 0"),
        ({"arc": 361, "path": "arc"}, "arc is 361"),
        ({"arc": 90}, "path is orbit"),
        ({"noise": -1}, "noise"),
        ({"noise": float("nan")}, "noise"),
        ({"jpeg": 101, "background": "black"}, "jpeg"),
        ({"jpeg": 90}, "transparent"),
    ],
)
def test_invalid_options_are_refused_and_leave_no_files(tmp_path, part, options, words):
    with pytest.raises(LinprimError, match=words):
        synthesize(tmp_path / "out", mesh=part, **{**SMALL, **options})
    assert list(tmp_path.iterdir()) == []


# Named captures and the command


def test_named_capture_turns_its_mesh_upright(tmp_path):
    import trimesh

    # Longest along y, blue at its upper end.
    rod = trimesh.creation.box((0.4, 1.6, 0.6)).subdivide()
    color = np.where(rod.vertices[:, 1:2] > 0, (20, 20, 230), (200, 40, 30)).astype(np.uint8)
    trimesh.Trimesh(rod.vertices, rod.faces, vertex_colors=color, process=False).export(tmp_path / "egyptian_cat.ply")
    few = {**SMALL, "size": 24, "points": 30}
    report = tabletop_captures.tabletop("large_table", tmp_path / "out", tmp_path, **few)
    assert (report["table"], report["arc"], report["jpeg"], report["noise"]) == (5.0, 300.0, 92, 2.0)
    assert (report["shape"], report["shading"], report["points"]) == ("egyptian_cat", "shaded", 30)
    from linprim_geo.geometry.mesh_files import load_mesh

    reference = load_mesh(tmp_path / "out/reference.ply")
    upper = reference.vertices[:, 2] > 0.75
    assert reference.vertices[:, 2].max() == pytest.approx(0.8)
    assert (reference.colors[upper][:, 2] > 200).all()
    with pytest.raises(LinprimError, match="spot.glb"):
        tabletop_captures.tabletop("small_table", tmp_path / "other", tmp_path)
    with pytest.raises(LinprimError, match="large_table"):
        tabletop_captures.tabletop("round_table", tmp_path / "other", tmp_path)


def test_named_captures_have_valid_options_and_different_tables():
    known = {"mesh"} | {field.name for field in dataclasses.fields(SynthOptions)}
    tables = [settings["table"] for settings in tabletop_captures.TABLETOPS.values()]
    assert len(set(tables)) == len(tables) == 3
    for settings in tabletop_captures.TABLETOPS.values():
        assert set(settings) - {"up"} <= known
        assert 49 <= settings["views"] <= 60 and settings["path"] == "arc"
    assert set(tabletop_captures.ALL_TABLETOPS) <= known


def test_synth_command_passes_options_on(monkeypatch):
    calls = []
    stand_in = types.SimpleNamespace(synthesize=lambda out, options, **_: calls.append(options) or {})
    monkeypatch.setitem(sys.modules, "linprim_geo.synthetic.synth", stand_in)
    line = "synth out --table 2.5 --environment 3 --path arc --arc 120 --noise 1.5 --jpeg 90"
    assert cli.main(line.split()) == 0 and cli.main(["synth", "out"]) == 0
    full, plain = calls
    wanted = {"table": 2.5, "environment": 3, "path": "arc", "arc": 120.0, "noise": 1.5, "jpeg": 90}
    assert full == SynthOptions(**wanted) and plain == SynthOptions()
