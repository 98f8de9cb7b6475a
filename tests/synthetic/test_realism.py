"""Path-traced scenes: their geometry is what is rendered, their light does not clip, and they are repeatable."""

import importlib.util
import sys

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import load_scene
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic.camera_paths import look_at
from linprim_geo.synthetic.options import SynthOptions
from linprim_geo.synthetic.realism import parts, render, scenes, textures
from linprim_geo.synthetic.realism.parts import Material, Part
from linprim_geo.synthetic.synth import synthesize

needs_mitsuba = pytest.mark.skipif(importlib.util.find_spec("mitsuba") is None, reason="the extra realism is missing")
SMALL = {"views": 3, "test_views": 1, "size": (48, 36), "samples": 4, "points": 60}


def camera(position, target, size=(40, 30), focal=40.0):
    return Camera(*size, focal, focal, 0.5 * size[0], 0.5 * size[1], look_at(np.array(position), np.array(target)))


# Shapes and textures


def volume(part: Part) -> float:
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    return float(np.einsum("nc,nc->n", a, np.cross(b, c)).sum() / 6.0)


def test_boxes_and_turned_profiles_have_their_volume_and_face_outwards():
    stone = Material()
    assert volume(parts.box("b", (1, 2, 3), (2, 4, 6), stone)) == pytest.approx(6.0)
    ball = parts.sphere("s", (1.0, 2.0, 3.0), 0.5, stone, segments=256)
    assert volume(ball) == pytest.approx(np.pi / 6.0, rel=1e-3)
    pipe = parts.tube("t", [(0, 0, z) for z in np.linspace(0, 2, 9)], 0.1, stone, segments=256)
    radius = np.hypot(*pipe.vertices[:, :2].T)
    np.testing.assert_allclose(radius, 0.1, rtol=1e-9)


def test_textures_repeat_by_seed_and_have_contrast():
    for make in (
        lambda seed: textures.wood((64, 128), 3, seed),
        lambda seed: textures.brick(128, seed),
        lambda seed: textures.paving(128, seed),
        lambda seed: textures.cover((96, 64), seed),
        lambda seed: textures.speckled((0.5, 0.5, 0.5), (64, 64), 0.1, seed),
    ):
        first = make(1)
        assert first.dtype == np.uint8 and first.std() > 5.0
        assert np.array_equal(first, make(1)) and not np.array_equal(first, make(2))


def test_colors_of_the_reference_are_those_of_the_texture():
    image = np.zeros((2, 2, 3), np.uint8)
    image[0], image[1] = (255, 0, 0), (0, 0, 255)  # the first row is the upper one
    wall = parts.quad("wall", (0, 0, 0), (1, 0, 0), (0, 0, 1), Material(color=image))
    surface = scenes.surface_of(render.Stage([wall]), "wall")
    points = np.array([[0.5, 0, 0.25], [0.5, 0, 0.75]])
    caster = RayCaster(surface.vertices, surface.faces)
    _, face, bary = caster.cast(points - [0, 1, 0], np.tile([0.0, 1.0, 0.0], (2, 1)))
    np.testing.assert_allclose(surface.colors(points, face, bary), [[0, 0, 1], [1, 0, 0]], atol=1e-6)


@pytest.mark.parametrize("name", scenes.SCENES)
def test_cameras_stand_in_free_space_and_see_the_scene(name):
    traced = scenes.TracedScene(name, None, SynthOptions(views=12, test_views=4, size=(48, 36), realism=name))
    assert len(traced.train) == 12 and len(traced.test) == 4
    caster = RayCaster(traced.surface.vertices, traced.surface.faces)
    for view in traced.train + traced.test:
        depth, face, _ = caster.render_depth(view)
        assert (face >= 0).mean() > 0.5
        assert np.quantile(depth[face >= 0], 0.01) > 0.2


@pytest.mark.parametrize(
    ("option", "value"), [("table", 2.0), ("environment", 1), ("path", "arc"), ("distortion", 0.1)]
)
def test_options_that_a_scene_decides_are_refused(option, value, tmp_path):
    with pytest.raises(LinprimError, match=f"--{option} is {value}, but the scene of --realism desk has its own"):
        synthesize(tmp_path / "out", realism="desk", **{option: value})


def test_without_mitsuba_one_sentence_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(LinprimError, match=r"pip install linprim-geo\[realism\]"):
        synthesize(tmp_path / "out", realism="statue", **SMALL)
    assert not (tmp_path / "out").exists()


# Rendering


@needs_mitsuba
def test_edges_in_the_picture_are_where_the_camera_projects_them():
    # A dark square on a bright wall, lit evenly by the sky: its middle is that of the projection.
    bright, dark = Material(color=(0.9, 0.9, 0.9)), Material(color=(0.05, 0.05, 0.05))
    wall = parts.quad("wall", (-9, 0, -9), (18, 0, 0), (0, 0, 18), bright)
    patch = parts.quad("patch", (0.1, -0.01, 0.2), (0.5, 0, 0), (0, 0, 0.4), dark)
    sky = np.ones((8, 16, 3), np.float32)
    view = Camera(60, 44, 50.0, 50.0, 33.0, 19.0, look_at(np.array([0.4, -2.5, 0.1]), np.array([0.2, 0.0, 0.3])))
    light, _ = render.PathTracer(render.Stage([wall, patch], sky=sky)).render(view, 64, 0)
    covered = light.mean(-1) < 0.4
    y, x = np.mgrid[:44, :60] + 0.5
    middle = np.array([x[covered].mean(), y[covered].mean()])
    fine = np.stack(np.meshgrid(np.linspace(0.1, 0.6, 40), [-0.01], np.linspace(0.2, 0.6, 40)), -1).reshape(-1, 3)
    np.testing.assert_allclose(middle, view.project(fine)[0].mean(0), atol=0.25)


@needs_mitsuba
def test_a_grey_wall_under_an_even_sky_reflects_its_share():
    # Under a sky of radiance 1 on all sides a plane of albedo a has radiance a.
    wall = parts.quad("wall", (-9, 0, -9), (18, 0, 0), (0, 0, 18), Material(color=(0.5, 0.5, 0.5)))
    stage = render.Stage([wall], sky=np.ones((8, 16, 3), np.float32))
    light, error = render.PathTracer(stage).render(camera((0, -2, 0), (0, 0, 0)), 64, 0)
    albedo = float(render.to_linear(np.array(0.5)))
    assert light.mean() == pytest.approx(albedo, rel=0.02)
    assert 0.0 < np.median(error) < 0.2 * albedo


@needs_mitsuba
def test_the_sky_is_where_its_rows_and_columns_say():
    sky = np.zeros((32, 64, 3), np.float32)
    sky[:16] = 1.0  # the upper half
    sky[:, 12:20, 0] += 1.0  # azimuth 90 degrees from +y towards +x
    far = parts.quad("far", (500, 500, 500), (1, 0, 0), (0, 0, 1), Material())
    tracer = render.PathTracer(render.Stage([far], sky=sky))
    east = tracer.render(camera((0, 0, 0), (1, 0, 0.3), focal=200.0), 4, 0)[0].mean((0, 1))
    north = tracer.render(camera((0, 0, 0), (0, 1, 0.3), focal=200.0), 4, 0)[0].mean((0, 1))
    below = tracer.render(camera((0, 0, 0), (0, 1, -0.4), focal=200.0), 4, 0)[0].mean((0, 1))
    np.testing.assert_allclose([east, north, below], [[2, 1, 1], [1, 1, 1], [0, 0, 0]], atol=0.05)


@needs_mitsuba
def test_a_capture_can_be_trained_and_does_not_clip(tmp_path):
    report = synthesize(tmp_path / "a", realism="statue", **SMALL)
    assert report["unit"] == "m" and report["realism"] == "statue"
    scene = load_scene(tmp_path / "a")
    assert len(scene.train) == 3 and len(scene.test) == 1
    pixels = np.concatenate([view.load().rgb.reshape(-1, 3) for view in scene.train])
    assert (pixels == 255).mean() < 0.01 and pixels.mean() > 25
    reference = load_mesh(tmp_path / "a" / "reference.ply")
    assert 0 < len(reference.faces)


@needs_mitsuba
def test_the_same_seed_gives_the_same_picture_and_another_one_does_not():
    ball = parts.sphere("ball", (0.0, 0.0, 0.0), 0.5, Material("metal", roughness=0.2), segments=24)
    stage = render.Stage([ball], sky=np.random.default_rng(0).uniform(0, 1, (8, 16, 3)))
    view = camera((0, -2, 0), (0, 0, 0))
    first, second = (render.PathTracer(stage, threads=threads).render(view, 4, 7)[0] for threads in (1, 2))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, render.PathTracer(stage).render(view, 4, 8)[0])


def test_what_is_no_number_or_far_too_bright_touches_no_other_pixel():
    rng = np.random.default_rng(0)
    images = rng.uniform(0.4, 0.6, (2, 8, 8, 3)).astype(np.float32)
    usual = render.without_outliers(images)
    assert (usual == images).all()
    images[0, 2, 3], images[:, 5, 5, 1], images[1, 7, 0] = np.nan, np.inf, 1000.0
    mended = render.without_outliers(images)
    touched = np.zeros((8, 8, 3), bool)
    touched[2, 3], touched[5, 5, 1], touched[7, 0] = True, True, True
    assert (mended[:, ~touched] == usual[:, ~touched]).all() and mended.dtype == np.float32
    assert (mended[0, 2, 3] == images[1, 2, 3]).all() and (0.4 < mended[:, 5, 5, 1]).all() and mended.max() < 50
