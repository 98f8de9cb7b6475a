"""Camera paths see what they are to see, and a synthetic capture agrees with its own surface in every file."""

import itertools
import json
import types

import numpy as np
import pytest
from helpers.surfaces import areas

from linprim_geo.base import progress
from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import load_scene
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic import camera_paths as campath
from linprim_geo.synthetic import rendering, synth
from linprim_geo.synthetic.built_in import SHAPES
from linprim_geo.synthetic.points import MAX_TRACK, sees
from linprim_geo.synthetic.synth import synthesize
from linprim_geo.synthetic.textured import TexturedMesh, load_textured

SMALL = {"views": 8, "test_views": 3, "size": (72, 64), "supersample": 2, "points": 400}


@pytest.fixture(scope="module")
def built():
    return {name: make() for name, make in SHAPES.items()}


@pytest.fixture(scope="module")
def capture(tmp_path_factory, built):
    out = tmp_path_factory.mktemp("synth") / "cad"
    report = synthesize(out, mesh=built["cad"], principal_point_offset=(5.0, -3.5), point_noise=0.004, seed=3, **SMALL)
    return out, report


def png(path):
    from PIL import Image

    return np.array(Image.open(path))


def cameras_of(out, split):
    listing = json.loads((out / f"transforms_{split}.json").read_text())
    cameras = []
    for frame in listing["frames"]:
        pose = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1]))
        intrinsics = [listing[key] for key in ("fl_x", "fl_y", "cx", "cy")]
        cameras.append(Camera(listing["w"], listing["h"], *intrinsics, pose))
    return listing, cameras


# Camera paths


@pytest.mark.parametrize("path", ["orbit", "hemisphere", "sphere"])
def test_camera_paths_frame_the_object_with_test_views_in_between(built, path):
    surface = built["cad"]
    base = Camera(100, 80, 120.0, 120.0, 50.0, 40.0, np.eye(4))
    center = surface.center + 1.0
    distance = campath.fitting_distance(path, surface.vertices + 1.0, center, 24, base)
    poses = campath.around(path, 24, center, distance)
    held_out = campath.around(path, 7, center, distance, held_out=True)
    extremes = []
    for pose in poses:
        camera = Camera(100, 80, 120.0, 120.0, 50.0, 40.0, pose)
        pixel, depth = camera.project(surface.vertices + 1.0)
        assert (depth > 0).all()
        extremes.append([pixel.min(0), [100, 80] - pixel.max(0)])
        assert np.allclose(camera.project(center[None])[0], [[50, 40]])
        assert np.linalg.norm(camera.center - center) == pytest.approx(distance)
        assert camera.rotation[1] @ [0, 0, 1] < 1e-9  # upright: the image's y axis does not point up
        assert np.linalg.det(camera.rotation) == pytest.approx(1.0)
    extremes = np.array(extremes).min(axis=(0, 1))
    assert extremes.min() >= 0.0399 * 80
    assert extremes[0] == pytest.approx(4.0, abs=1e-6) or extremes[1] == pytest.approx(3.2, abs=1e-6)
    centers = np.array([-p[:3, :3].T @ p[:3, 3] for p in poses])
    others = np.array([-p[:3, :3].T @ p[:3, 3] for p in held_out])
    assert np.linalg.norm(others[:, None] - centers[None], axis=2).min() > 0.02 * distance
    up = (centers - center)[:, 2] / distance
    assert (up.min() > 0) == (path == "hemisphere") and up.max() > 0.6


def test_inside_out_cameras_are_clear_of_surfaces_and_cover_the_room(built):
    import igl

    room = built["room"]
    caster = RayCaster(room.vertices, room.faces)
    train, test = campath.inside_out(caster, 40, 8, (np.deg2rad(37.5), np.deg2rad(37.5)), seed=0)
    assert len(train) == 40 and len(test) == 8
    centers = np.array([-p[:3, :3].T @ p[:3, 3] for p in train + test])
    squared = igl.point_mesh_squared_distance(centers, room.vertices, room.faces)[0]
    # Clearance is probed in 192 directions only, so a surface may be a little nearer than the nearest hit.
    assert np.sqrt(squared).min() > 0.5 * campath.CLEARANCE * room.diagonal
    assert (centers > [0, 0, 0]).all() and (centers < [6, 5, 2.7]).all()
    forward = np.array([p[2, :3] for p in train])
    octants = {tuple(row) for row in (forward[:, :2] > 0)}
    assert len(octants) == 4 and forward[:, 2].min() < -0.2 and forward[:, 2].max() > 0.1
    points, normals = campath.surface_samples(caster, 1500, np.random.default_rng(9))[:2]
    cameras = [Camera(100, 100, 65.16, 65.16, 50.0, 50.0, pose) for pose in train]
    seen = np.sum([sees(caster, camera, points, normals) for camera in cameras], axis=0)
    assert np.mean(seen >= 2) > 0.8
    again = campath.inside_out(caster, 40, 8, (np.deg2rad(37.5), np.deg2rad(37.5)), seed=0)
    assert np.array_equal(np.array(again[0]), np.array(train))


def test_inside_out_path_without_free_space_is_refused(built):
    caster = RayCaster(built["wires"].vertices, built["wires"].faces)
    with pytest.raises(LinprimError, match="no free space"):
        campath.inside_out(caster, 4, 1, (0.6, 0.6), seed=0)


# A capture


def test_capture_has_all_files_and_a_complete_report(capture):
    out, report = capture
    for split, count in (("train", 8), ("test", 3)):
        for folder in (split, f"depth/{split}", f"normal/{split}", f"masks/{split}"):
            assert len(list((out / folder).iterdir())) == count
    assert json.loads((out / "synth.json").read_text())["principal_point_offset"] == [5.0, -3.5]
    assert report["views"] == 8 and report["points"] == 400 and report["seconds"] > 0
    assert not [entry for entry in out.parent.iterdir() if entry.name.startswith(".")]


def test_progress_is_printed_unless_quiet(tmp_path, built, monkeypatch, capsys):
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(monotonic=itertools.count(0, 30).__next__))
    small = SMALL | {"views": 2, "test_views": 1}
    synthesize(tmp_path / "shown", mesh=built["cad"], **small)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[:3] for line in lines] == [["rendered", "views", f"{done}/3"] for done in (1, 2, 3)]
    synthesize(tmp_path / "quiet", mesh=built["cad"], quiet=True, **small)
    assert capsys.readouterr().err == ""


def test_depth_normals_and_masks_agree_with_ray_casts_at_pixel_centres(capture, built):
    out, _ = capture
    surface = built["cad"]
    caster = RayCaster(surface.vertices, surface.faces)
    for split in ("train", "test"):
        listing, cameras = cameras_of(out, split)
        assert (listing["cx"], listing["cy"]) == (36.0 + 5.0, 32.0 - 3.5)
        for frame, camera in zip(listing["frames"], cameras, strict=True):
            depth, face, normal = caster.render_depth(camera)
            stored = png(out / frame["depth_file_path"])
            assert stored.dtype == np.uint16
            unit = listing["depth_unit_scale_factor"]
            assert np.array_equal(stored > 0, face >= 0)
            hit = face >= 0
            assert np.abs(stored[hit] * unit - depth[hit]).max() <= 0.5001 * unit
            assert unit < depth[hit].max() / 13000
            decoded = png(out / frame["normal_file_path"])[hit] / 255.0 * 2 - 1
            assert np.abs(decoded - normal[hit]).max() < 1.01 / 255
            image, mask = png(out / frame["file_path"]), png(out / "masks" / frame["file_path"])
            assert image.shape == (64, 72, 4) and np.array_equal(image[..., 3], mask)
            inner = np.array([np.roll(hit, s, a) for s in (-1, 1) for a in (0, 1)] + [hit])
            assert (mask[inner.all(0)] > 120).all() and (mask[~inner.any(0)] < 140).all()


def test_pixels_have_the_albedo_of_the_surface(tmp_path, built):
    surface = built["smooth"]
    synthesize(tmp_path / "a", mesh=surface, **{**SMALL, "supersample": 1, "views": 2, "background": "white"})
    caster = RayCaster(surface.vertices, surface.faces)
    _, cameras = cameras_of(tmp_path / "a", "train")
    image = png(tmp_path / "a/train/001.png")
    rays = cameras[1].world_rays().reshape(-1, 3)
    t, face, bary = caster.cast(cameras[1].center, rays)
    hit = face >= 0
    color = surface.colors(cameras[1].center + t[hit, None] * rays[hit], face[hit], bary[hit])
    assert image.shape == (64, 72, 3)
    assert np.abs(image.reshape(-1, 3)[hit] / 255.0 - color).max() < 0.75 / 255
    assert (image.reshape(-1, 3)[~hit] == 255).all()
    assert (tmp_path / "a/truth_masks").is_dir() and not (tmp_path / "a/masks").exists()


def test_transparent_capture_over_black_agrees_with_the_black_capture(tmp_path, built):
    for background in ("transparent", "0,0,0"):
        synthesize(tmp_path / background, mesh=built["cad"], background=background, **SMALL)
    rgba, black = (
        png(tmp_path / "transparent/train/002.png").astype(float),
        png(tmp_path / "0,0,0/train/002.png"),
    )
    assert 0 < np.mean((rgba[..., 3] > 0) & (rgba[..., 3] < 255)) < 0.3
    assert np.abs(rgba[..., :3] * rgba[..., 3:] / 255.0 - black).max() <= 1.01


def test_points_have_consistent_tracks_colours_and_errors(capture, built):
    import pycolmap

    out, report = capture
    surface = built["cad"]
    _, cameras = cameras_of(out, "train")
    model = pycolmap.Reconstruction(str(out / "sparse/0"))
    assert model.num_points3D() == 400 and model.num_reg_images() == 8
    by_name = {image.name: image for image in model.images.values()}
    for number, camera in enumerate(cameras):
        image = by_name[f"train/{number:03d}.png"]
        assert np.abs(image.cam_from_world().matrix() - camera.world_to_camera[:3]).max() < 1e-12
        assert list(image.camera.params) == [camera.fx, camera.fy, camera.cx, camera.cy]
    caster = RayCaster(surface.vertices, surface.faces)
    off, errors = [], []
    for point in list(model.points3D.values())[:60]:
        assert 3 <= point.track.length() <= MAX_TRACK
        true, residual = [], []
        for element in point.track.elements:
            image = model.image(element.image_id)
            camera = cameras[int(image.name[-7:-4])]
            x, y = image.point2D(element.point2D_idx).xy
            ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0]) @ camera.rotation
            t, face, bary = caster.cast(camera.center, ray[None])
            true.append(camera.center + t[0] * ray)
            residual.append(np.linalg.norm(camera.project(point.xyz[None])[0] - [x, y]))
        # Rays of all observations meet the surface at the same point, the position without noise.
        assert np.ptp(np.array(true), axis=0).max() < 1e-5
        color = surface.colors(true[0][None], face, bary)[0]
        assert np.abs(point.color / 255.0 - color).max() < 0.02
        off.append(point.xyz - true[0])
        errors.append(residual)
        assert point.error == pytest.approx(np.mean(residual), abs=1e-3)
    assert 0.003 < np.std(off) < 0.005
    cloud = (out / "points3D.ply").read_bytes()
    assert b"element vertex 400" in cloud[:200] and len(cloud) == cloud.index(b"end_header\n") + 11 + 400 * 27
    assert report["mean_track_length"] > 3


def test_loaded_scene_agrees_with_the_written_capture(capture):
    out, _ = capture
    scene = load_scene(out)
    assert len(scene.train) == 8 and len(scene.test) == 3
    _, cameras = cameras_of(out, "test")
    for view, camera in zip(scene.test, cameras, strict=True):
        assert np.allclose(view.camera.world_to_camera, camera.world_to_camera, atol=1e-12)
        assert np.array_equal(view.camera.K, camera.K)
        photo = view.load()
        assert np.array_equal(photo.rgb, png(out / f"test/{int(view.image_path.stem):03d}.png")[..., :3])
        assert photo.alpha is not None
    assert len(scene.points.xyz) == 400


def test_reference_mesh_agrees_with_the_surface(capture, built):
    from linprim_geo.geometry.mesh_files import load_mesh

    out, _ = capture
    reference = load_mesh(out / "reference.ply")
    surface = built["cad"]
    assert areas(reference.vertices, reference.faces).sum() == pytest.approx(
        areas(surface.vertices, surface.faces).sum(), rel=1e-5
    )
    assert np.abs(reference.vertices.min(0) - surface.vertices.min(0)).max() < 1e-6
    assert reference.colors is not None and reference.colors.std() > 5


def test_files_do_not_depend_on_the_threads(tmp_path, built):
    for threads in (1, 3):
        synthesize(tmp_path / str(threads), mesh=built["wires"], threads=threads, shading="shaded", **SMALL)
    names = sorted(p.relative_to(tmp_path / "1") for p in (tmp_path / "1").rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(tmp_path / "3") for p in (tmp_path / "3").rglob("*") if p.is_file())
    for name in names:
        if name.name != "synth.json":
            assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "3" / name).read_bytes(), name


def test_shading_agrees_with_lambert_and_float_depth_is_exact(tmp_path):
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
    gray = TexturedMesh(
        "plate", vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, int), lambda p, f, b: p * 0 + 0.5
    )
    report = synthesize(
        tmp_path / "a",
        mesh=gray,
        path="hemisphere",
        shading="shaded",
        depth_format="npy",
        **{**SMALL, "points": 0},
    )
    strength = rendering.AMBIENT + sum(power * max(d[2], 0) / np.linalg.norm(d) for d, power in rendering.LIGHTS)
    image = png(tmp_path / "a/train/000.png")
    inside = image[..., 3] == 255
    assert np.abs(image[inside][:, :3] / 255.0 - 0.5 * strength).max() < 0.75 / 255
    _, cameras = cameras_of(tmp_path / "a", "train")
    depth = np.load(tmp_path / "a/depth/train/000.npy")
    expected = -cameras[0].center[2] / cameras[0].world_rays()[..., 2]
    assert np.abs(depth - expected)[depth > 0].max() < 1e-6
    assert report["points"] == 0 and report["depth_unit_scale_factor"] == 1.0


# Meshes from files


def textured_quad(tmp_path, suffix):
    """A unit square at z = 0 with a texture: upper left red, upper right green, lower left blue, rest
    white."""
    import trimesh
    from PIL import Image

    pixels = np.full((64, 64, 3), 255, np.uint8)
    pixels[:32, :32], pixels[:32, 32:], pixels[32:, :32] = (200, 10, 10), (10, 180, 10), (10, 10, 220)
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(pixels))
    if suffix == ".glb":
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(pixels))
    visual = trimesh.visual.TextureVisuals(uv=vertices[:, :2], material=material)
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    mesh.export(tmp_path / f"quad{suffix}")
    return tmp_path / f"quad{suffix}"


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_texture_of_a_file_has_the_right_orientation(tmp_path, suffix):
    surface = load_textured(textured_quad(tmp_path, suffix))
    points = np.array([[0.25, 0.75, 0], [0.75, 0.75, 0], [0.25, 0.25, 0], [0.75, 0.25, 0]])
    caster = RayCaster(surface.vertices, surface.faces)
    _, face, bary = caster.cast(points + [0, 0, 1.0], np.tile([0, 0, -1.0], (4, 1)))
    colors = np.round(surface.colors(points, face, bary) * 255)
    assert colors.tolist() == [[200, 10, 10], [10, 180, 10], [10, 10, 220], [255, 255, 255]]


def test_vertex_colours_are_interpolated_and_a_mesh_without_colours_gets_a_texture(tmp_path):
    import trimesh

    vertices = np.array([[0, 0, 5e5], [1, 0, 5e5], [0, 1, 5e5]])
    colors = np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255]], dtype=np.uint8)
    trimesh.Trimesh(vertices, [[0, 1, 2]], vertex_colors=colors, process=False).export(tmp_path / "v.ply")
    surface = load_textured(tmp_path / "v.ply")
    value = surface.colors(np.zeros((1, 3)), np.array([0]), np.array([[0.25, 0.5]]))
    assert np.abs(value - [[0.25, 0.25, 0.5]]).max() < 1e-6
    trimesh.Trimesh(vertices, [[0, 1, 2]], process=False).export(tmp_path / "bare.stl")
    bare = load_textured(tmp_path / "bare.stl")
    rng = np.random.default_rng(0)
    spread = bare.colors(rng.uniform(0, 1, (500, 3)) + [0, 0, 5e5], np.zeros(500, int), np.zeros((500, 2)))
    assert spread.std(0).max() > 0.05


def test_a_capture_of_a_mesh_file_far_from_the_origin(tmp_path):
    import trimesh

    ball = trimesh.creation.icosphere(3)
    offset = np.array([4.0e5, -2.0e5, 300.0])
    color = np.clip(ball.vertices * 127 + 128, 0, 255).astype(np.uint8)
    trimesh.Trimesh(ball.vertices * 50 + offset, ball.faces, vertex_colors=color, process=False).export(
        tmp_path / "b.obj"
    )
    report = synthesize(tmp_path / "out", mesh=tmp_path / "b.obj", path="sphere", **SMALL)
    assert report["coverage"] > 0.3 and report["shape"] == "b"
    _, cameras = cameras_of(tmp_path / "out", "train")
    surface = load_textured(tmp_path / "b.obj")
    image = png(tmp_path / "out/train/003.png")
    rays = cameras[3].world_rays()
    t, face, _ = RayCaster(surface.vertices, surface.faces).cast(cameras[3].center, rays.reshape(-1, 3))
    point = (cameras[3].center + t.reshape(64, 72, 1) * rays - offset) / 50.0
    inside = image[..., 3] == 255
    expected = np.clip(point * 127 + 128, 0, 255) / 255
    assert np.abs(image[..., :3] / 255.0 - expected)[inside].max() < 0.03


# What cannot be done


@pytest.mark.parametrize(
    "options, words",
    [
        ({"shape": "teapot"}, "cad, smooth, room, wires"),
        ({"shape": "cad", "mesh": "x.ply"}, "both given"),
        ({"mesh": "missing.ply"}, "no such mesh"),
        ({"views": 1}, "views"),
        ({"size": (320, 0)}, "--size"),
        ({"size": 320.5}, "--size"),
        ({"path": "spiral"}, "orbit"),
        ({"fov": 190}, "fov"),
        ({"distance": 0.2}, "reaches"),
        ({"shading": "glossy"}, "albedo"),
        ({"background": "pink"}, "transparent"),
        ({"background": (0, 0, 2)}, "transparent"),
        ({"point_noise": float("nan")}, "--point-noise"),
        ({"supersample": 0}, "supersample"),
        ({"depth_format": "exr"}, "npy"),
        ({"samples": 64}, "--samples is 64, but nothing is path-traced"),
        ({"denoise": "on"}, "--denoise is on, but nothing is path-traced"),
        ({"tracer": "llvm"}, "--tracer is llvm, but nothing is path-traced"),
    ],
)
def test_invalid_options_are_refused_and_leave_no_files(tmp_path, options, words):
    with pytest.raises(LinprimError, match=words):
        synthesize(tmp_path / "out", **{**SMALL, **options})
    assert list(tmp_path.iterdir()) == []


def test_existing_folder_is_replaced_only_if_it_is_a_capture_and_overwrite_is_set(tmp_path, built):
    out = tmp_path / "out"
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    settings = {**SMALL, "views": 2, "test_views": 0, "points": 20, "mesh": built["cad"]}
    for overwrite in (False, True):
        with pytest.raises(LinprimError, match="out"):
            synthesize(out, overwrite=overwrite, **settings)
        assert (out / "precious.txt").read_text() == "mine"
    (out / "precious.txt").unlink()
    synthesize(out, **settings)
    with pytest.raises(LinprimError, match="new or empty"):
        synthesize(out, **settings)
    (out / "stale.txt").write_text("old")
    synthesize(out, overwrite=True, **settings)
    scene = load_scene(out)
    assert len(scene.train) == 2 and not scene.test
    assert not (out / "stale.txt").exists() and (out / "synth.json").is_file()
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_interrupted_capture_leaves_no_files(tmp_path, built, monkeypatch, interruption):
    def stop(*_):
        raise interruption

    monkeypatch.setattr(synth, "_write_reference", stop)
    expected = LinprimError if isinstance(interruption, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        synthesize(tmp_path / "out", mesh=built["cad"], **{**SMALL, "views": 2})
    assert list(tmp_path.iterdir()) == []
