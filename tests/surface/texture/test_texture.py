"""Textures of a scene with known colours, charts of various meshes, and files as trimesh reads them."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from helpers.surfaces import grid, join, sphere
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.types import Photo
from linprim_geo.geometry.mesh import Mesh, select_faces
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.runs.run import Run
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.surface.normals import vertex_normals
from linprim_geo.surface.texture import texture as texture_module
from linprim_geo.surface.texture import texture_charts, texture_files, texture_raster
from linprim_geo.surface.texture.texture import make_texture
from linprim_geo.surface.texture.texture_charts import unwrap
from linprim_geo.surface.texture.texture_files import save_textured
from linprim_geo.surface.visibility import color_vertices
from linprim_geo.synthetic.synth import synthesize
from linprim_geo.synthetic.textured import TexturedMesh, procedural_albedo

SIZE = 256


def lookup(texture, faces, weights):
    """(N, 3) bilinear colours at barycentric weights (N, 3) of faces (N,)."""
    size = len(texture.image)
    u, v = np.einsum("nk,nkd->dn", weights, texture.uv[faces])
    x, y = u * size - 0.5, (1 - v) * size - 0.5
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    image, total = texture.image.astype(float), 0.0
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = np.abs(1 - dy - (y - i)) * np.abs(1 - dx - (x - j))
        total = total + share[:, None] * image[np.clip(i + dy, 0, size - 1), np.clip(j + dx, 0, size - 1)]
    return total


def anywhere(mesh, count=20_000, seed=0):
    """Faces (N,) and barycentric weights (N, 3) of random points on the mesh."""
    rng = np.random.default_rng(seed)
    return rng.integers(len(mesh.faces), size=count), rng.dirichlet([1, 1, 1], count)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """(mesh, views, truth(faces, weights) -> colours 0 to 255) of 24 masked photographs of a painted ball."""
    mesh = sphere(rounds=3)
    albedo = procedural_albedo(np.zeros(len(mesh.faces), np.int32), detail=2.0)
    painted = TexturedMesh("ball", mesh.vertices, mesh.faces, np.zeros(len(mesh.faces), np.int32), albedo, "sphere")
    out = tmp_path_factory.mktemp("ball") / "scene"
    synthesize(out, mesh=painted, views=24, test_views=1, size=128, points=50, supersample=2)

    def truth(faces, weights):
        points = np.einsum("nk,nkd->nd", weights, mesh.vertices[mesh.faces[faces]])
        return 255.0 * painted.colors(points, faces, weights[:, 1:])

    return mesh, load_scene(out).train, truth


@pytest.fixture(scope="module")
def ball_texture(ball):
    return make_texture(ball[0], SIZE, ball[1])


def test_the_texture_agrees_with_the_paint_better_than_vertex_colours(ball, ball_texture):
    mesh, views, truth = ball
    faces, weights = anywhere(mesh)
    paint = truth(faces, weights)
    error = np.abs(lookup(ball_texture, faces, weights) - paint)
    colors = color_vertices(mesh, [view.camera for view in views], (view.load().rgb for view in views))
    coarse = np.abs(np.einsum("nk,nkc->nc", weights, colors[mesh.faces[faces]].astype(float)) - paint)
    assert error.mean() < 2.5 and np.quantile(error, 0.99) < 10.0
    assert error.mean() < 0.5 * coarse.mean()
    assert ball_texture.about["texels_seen"] == 1.0 and ball_texture.about["texels_seen_well"] > 0.99


def test_one_wrong_photograph_does_not_change_the_texture(ball, ball_texture):
    mesh, views, _ = ball
    spoiled = [SimpleNamespace(camera=view.camera, load=view.load) for view in views]
    photo = views[4].load()
    spoiled[4].load = lambda: Photo(255 - photo.rgb, photo.alpha)
    again = make_texture(mesh, SIZE, spoiled)
    assert np.abs(again.image.astype(int) - ball_texture.image).mean() < 2


def test_known_exposure_gains_are_compensated(ball, ball_texture):
    mesh, views, _ = ball
    gains = np.linspace(0.8, 1.0, len(views))

    def darker(view, gain):
        photo = view.load()
        return Photo(np.round(photo.rgb * gain).astype(np.uint8), photo.alpha)

    drifting = [
        SimpleNamespace(camera=view.camera, load=lambda view=view, gain=gain: darker(view, gain))
        for view, gain in zip(views, gains, strict=True)
    ]
    seams, level = (make_texture(mesh, SIZE, drifting, given).image.astype(int) for given in (None, gains))
    plain = ball_texture.image.astype(int)
    assert np.abs(level - plain).mean() < 0.5 and np.abs(seams - plain).mean() > 5


@pytest.mark.parametrize("with_alpha", [True, False])
def test_background_pixels_are_not_used_with_alpha(ball, with_alpha):
    mesh, views, _ = ball
    # The mesh is larger than the ball, so its silhouette lies in front of the background, which is red here.
    larger, red = replace(mesh, vertices=1.05 * mesh.vertices), []

    def posed(view, photo):
        return SimpleNamespace(camera=view.camera, load=lambda: photo)

    for view in views:
        photo = view.load()
        rgb = np.where(photo.alpha[..., None] > 0, photo.rgb, [255, 0, 0]).astype(np.uint8)
        red.append(posed(view, Photo(rgb, photo.alpha if with_alpha else None)))
    few = red[:3]
    texture = make_texture(larger, SIZE, few)
    faces, weights = anywhere(mesh)
    spoiled = (lookup(texture, faces, weights)[:, 1] < 20).mean()
    assert spoiled == 0 if with_alpha else spoiled > 0.01
    assert texture.about["texels_seen"] < 0.9


def test_unseen_texels_take_vertex_colours(ball):
    mesh, views, _ = ball
    both = join(mesh, replace(mesh, vertices=0.3 * mesh.vertices))
    inner = np.arange(len(both.faces)) >= len(mesh.faces)
    colors = np.tile(np.uint8([10, 200, 30]), (len(both.vertices), 1))
    texture = make_texture(replace(both, colors=colors), SIZE, views)
    faces, weights = anywhere(both)
    shown = lookup(texture, faces, weights)
    assert np.abs(shown[inner[faces]] - [10, 200, 30]).max() < 1e-9
    assert np.abs(shown[~inner[faces]] - [10, 200, 30]).max(1).min() > 10
    assert 0.5 < texture.about["texels_seen"] < 0.99
    uncolored = make_texture(both, 128, views)
    assert lookup(uncolored, faces, weights)[inner[faces]].min() > 5


def test_texels_between_charts_take_colours_of_charts(ball_texture):
    owner = texture_raster._rasterize(np.stack([ball_texture.uv[..., 0], 1 - ball_texture.uv[..., 1]], 2) * SIZE, SIZE)
    inside = (owner >= 0).reshape(SIZE, SIZE)
    assert 0.3 < inside.mean() < 0.95
    known = {tuple(color) for color in ball_texture.image[inside]}
    assert {tuple(color) for color in ball_texture.image[~inside]} <= known


def test_the_texture_does_not_depend_on_passes_or_caching(ball, ball_texture, monkeypatch):
    monkeypatch.setattr(texture_module, "TEXELS_PER_PASS", 10_000)
    monkeypatch.setattr(texture_raster, "CANDIDATES", 5_000)
    monkeypatch.setattr(texture_module, "KEPT_BYTES", 0)
    monkeypatch.setattr("linprim_geo.surface.visibility.POINTS_PER_TASK", 3_000)
    again = make_texture(ball[0], SIZE, ball[1])
    np.testing.assert_array_equal(again.image, ball_texture.image)
    np.testing.assert_array_equal(again.uv, ball_texture.uv)


# --- charts ----------------------------------------------------------------------------------------------


def ramp(turns=3, steps=24):
    """A spiral ramp: one connected piece that faces up everywhere and overlaps itself from above."""
    angle = np.linspace(0, 2 * np.pi * turns, turns * steps + 1)
    rings = [np.stack([r * np.cos(angle), r * np.sin(angle), 0.1 * angle], 1) for r in (0.5, 1.0)]
    a = np.arange(len(angle) - 1)
    b, c, d = a + len(angle), a + len(angle) + 1, a + 1
    return Mesh(np.concatenate(rings), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def soup(count=60):
    rng = np.random.default_rng(3)
    return Mesh(rng.normal(size=(count, 3)), rng.permuted(np.tile(np.arange(count), (80, 1)), axis=1)[:, :3])


CASES = {
    "triangle": Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]),
    "flat": grid(6, 4),
    "ball": sphere(rounds=3),
    "spiral": ramp(),
    "soup": soup(),
    "fan of three": Mesh([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, -1, 0]], [[0, 1, 2], [0, 1, 3], [0, 1, 4]]),
    "back to back": Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 1]]),
    "same face three times": Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]] * 3),
    "no area": Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]], [[0, 1, 2], [0, 3, 1], [1, 1, 1]]),
    "needle": Mesh([[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]),
    "far away": replace(sphere(rounds=2), vertices=sphere(rounds=2).vertices * 1e-2 + 1e5),
}


@pytest.mark.parametrize("name", CASES)
def test_charts_do_not_overlap(name):
    mesh, size = CASES[name], 96
    corners, charts = unwrap(mesh, size)
    assert corners.shape == (len(mesh.faces), 3, 2) and np.isfinite(corners).all() and 1 <= charts <= len(mesh.faces)
    assert corners.min() >= texture_charts.PADDING and corners.max() <= size - texture_charts.PADDING
    y, x = np.mgrid[0:size, 0:size] + 0.5
    inside = np.zeros((size, size), dtype=int)
    for a, b, c in corners:
        signs = np.stack([(q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in ((a, b), (b, c), (c, a))])
        inside += (signs > 1e-3).all(0) | (signs < -1e-3).all(0)
    assert inside.max() == 1


def test_unwrapping_limits_the_distortion_of_area():
    corners, charts = unwrap(CASES["flat"], 128)
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    world = CASES["flat"].vertices[CASES["flat"].faces]
    ratio = edges / np.linalg.norm(world - np.roll(world, 1, axis=1), axis=2)
    assert charts == 1 and np.ptp(ratio) < 1e-9 * ratio.max()
    mesh = CASES["ball"]
    corners, charts = unwrap(mesh, 128)
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    flat = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    solid = np.linalg.norm(
        np.cross(*(mesh.vertices[mesh.faces[:, k]] - mesh.vertices[mesh.faces[:, 0]] for k in (1, 2))), axis=1
    )
    share = flat / solid
    # Projection multiplies the area of a face by at least LEAST_COSINE.
    assert share.min() / share.max() > texture_charts.LEAST_COSINE * 0.99 and charts <= 12


def test_too_many_charts_and_invalid_meshes_are_refused(ball):
    views = ball[1]
    with pytest.raises(LinprimError, match="charts of 80 faces do not fit.*16x16.*--target-faces"):
        make_texture(CASES["soup"], 16, views)
    broken = ball[0].vertices.copy()
    broken[3] = np.inf
    for mesh in (replace(ball[0], vertices=broken), Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))):
        with pytest.raises(LinprimError, match="not finite|empty"):
            make_texture(mesh, 64, views)


def test_faces_with_few_texels_are_reported(ball):
    lines = []
    make_texture(ball[0], 48, ball[1][:2], note=lines.append)
    assert len(lines) == 2 and "512 faces" in lines[0] and "--target-faces" in lines[1]


# --- files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".obj", ".glb", ".OBJ"])
@pytest.mark.parametrize("far", [False, True])
def test_files_load_with_the_same_uv_and_image(suffix, far, ball, ball_texture, tmp_path):
    mesh = replace(ball[0], normals=vertex_normals(ball[0]))
    if far:
        mesh = replace(mesh, vertices=mesh.vertices + [5e5, -3e5, 10.0])
    path = tmp_path / f"a part{suffix}"
    save_textured(path, mesh, ball_texture)
    names = {f"a part{suffix}"} | ({"a part.mtl", "a part.png"} if suffix != ".glb" else set())
    assert {p.name for p in tmp_path.iterdir()} == names
    loaded = trimesh.load(path, process=False)
    pose = np.eye(4)
    if isinstance(loaded, trimesh.Scene):
        pose, name = loaded.graph[loaded.graph.nodes_geometry[0]]
        loaded = loaded.geometry[name]
    corners = loaded.vertices[loaded.faces] @ pose[:3, :3].T + pose[:3, 3]
    assert np.abs(corners - mesh.vertices[mesh.faces]).max() < 1e-6
    assert np.abs(loaded.visual.uv[loaded.faces] - ball_texture.uv).max() < 1e-6
    material = loaded.visual.material
    image = getattr(material, "baseColorTexture", None) or material.image
    np.testing.assert_array_equal(np.asarray(image.convert("RGB")), ball_texture.image)
    if suffix != ".glb":
        np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a part.png")), ball_texture.image)
        text = path.read_text()
        assert text.startswith("mtllib a part.mtl\n") and text.count("\nf ") == len(mesh.faces)
        assert text.count("\nv ") == len(mesh.vertices) == text.count("\nvn ")


def test_selected_faces_keep_their_texture(ball, ball_texture, tmp_path):
    half = ball[0].vertices[ball[0].faces].mean(1)[:, 2] > 0
    part = ball_texture.select(half)
    save_textured(tmp_path / "half.glb", select_faces(ball[0], half), part)
    assert len(part.uv) == half.sum() == len(load_mesh(tmp_path / "half.glb").faces)
    np.testing.assert_array_equal(part.uv, ball_texture.uv[half])


def test_textures_in_other_formats_than_obj_and_glb_are_refused(ball, ball_texture, tmp_path):
    for suffix in (".ply", ".stl"):
        with pytest.raises(LinprimError, match=f"{suffix} files hold no texture, wanted .obj or .glb"):
            save_textured(tmp_path / f"m{suffix}", ball[0], ball_texture)
    empty = select_faces(ball[0], np.zeros(len(ball[0].faces), bool))
    with pytest.raises(LinprimError, match="no faces"):
        save_textured(tmp_path / "m.obj", empty, ball_texture.select(np.zeros(len(ball[0].faces), bool)))
    assert not list(tmp_path.iterdir())


def test_an_obj_that_cannot_be_written_leaves_the_files_of_before(ball, ball_texture, tmp_path, monkeypatch):
    path = tmp_path / "m.obj"
    save_textured(path, ball[0], ball_texture)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(texture_files, "_write_obj", full)
    darker = replace(ball_texture, image=ball_texture.image // 2)
    with pytest.raises(LinprimError, match="no space left"):
        save_textured(path, ball[0], darker)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
    with pytest.raises(LinprimError, match="no space left"):
        save_textured(tmp_path / "other" / "m.obj", ball[0], darker)
    assert not list((tmp_path / "other").iterdir())


def test_extraction_writes_textures(solid, tmp_path):
    options = ExtractOptions(voxel_size=0.12, target_faces=300, texture=128)
    stats = extract_mesh(solid, output=tmp_path / "m.obj", options=options, quiet=True)
    written = {f"{stem}.{s}" for stem in ("m", "m_visible") for s in ("obj", "mtl", "png")} | {"m_shaded.png"}
    assert {p.name for p in tmp_path.iterdir()} == written
    assert stats["texture"]["size"] == 128 and stats["texture"]["texels_seen"] > 0.9 and "texture" in stats["seconds"]
    # One flat colour, 0.5 + 0.7 Y0 = 0.697 of 255 in every channel.
    image = np.asarray(Image.open(tmp_path / "m.png")).astype(int)
    assert (np.abs(image - 178).max(2) < 10).mean() > 0.97
    for name in ("m.obj", "m_visible.obj"):
        assert np.abs(np.median(load_mesh(tmp_path / name).colors, 0) - 178).max() <= 2


def test_invalid_textures_are_refused_before_rendering(solid, tmp_path, monkeypatch):
    monkeypatch.setattr(Run, "render_views", lambda *_, **__: pytest.fail("rendered"))
    for output, size, match in (
        (None, 128, r"mesh.ply: .ply files hold no texture, wanted .obj or .glb"),
        (tmp_path / "m.stl", 128, ".stl files hold no texture"),
        (tmp_path / "m.obj", 7, "--texture is 7, wanted 16 to 8192"),
        (tmp_path / "m.obj", 10_000, "--texture is 10000"),
    ):
        with pytest.raises(LinprimError, match=match):
            extract_mesh(solid, output=output, options=ExtractOptions(texture=size), quiet=True)
