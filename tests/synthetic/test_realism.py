"""Path-traced scenes: their geometry is what is rendered, their light does not clip, and they are repeatable."""

import importlib.util
import sys
from dataclasses import fields

import numpy as np
import pytest
from helpers.traced import nearest_surface, pixel_rays, unit_normals

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import load_scene
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic.camera_paths import WALK_EYES, WALK_STEP, WALK_TURN_DEG, fibonacci_directions, look_at, walk
from linprim_geo.synthetic.options import SynthOptions
from linprim_geo.synthetic.realism import garden, interiors, kitchen, outdoors, parts, render, scenes, terrace, textures
from linprim_geo.synthetic.realism.parts import Material, Part
from linprim_geo.synthetic.shapes import smooth_body
from linprim_geo.synthetic.synth import synthesize

needs_mitsuba = pytest.mark.skipif(importlib.util.find_spec("mitsuba") is None, reason="the extra realism is missing")
needs_denoiser = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("mitsuba", "pyoidn")), reason="the extra realism is missing"
)
SMALL = {"views": 3, "test_views": 1, "size": (48, 36), "samples": 4, "points": 60}


def camera(position, target, size=(40, 30), focal=40.0):
    return Camera(*size, focal, focal, 0.5 * size[0], 0.5 * size[1], look_at(np.array(position), np.array(target)))


# Shapes and textures


def volume(part: Part) -> float:
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    return float(np.einsum("nc,nc->n", a, np.cross(b, c)).sum() / 6.0)


def test_boxes_spheres_and_tubes_have_their_size_and_outward_faces():
    stone = Material()
    assert volume(parts.box("b", (1, 2, 3), (2, 4, 6), stone)) == pytest.approx(6.0)
    ball = parts.sphere("s", (1.0, 2.0, 3.0), 0.5, stone, segments=256)
    assert volume(ball) == pytest.approx(np.pi / 6.0, rel=1e-3)
    pipe = parts.tube("t", [(0, 0, z) for z in np.linspace(0, 2, 9)], 0.1, stone, segments=256)
    radius = np.hypot(*pipe.vertices[:, :2].T)
    np.testing.assert_allclose(radius, 0.1, rtol=1e-9)


def test_textures_depend_on_their_seed_and_have_contrast():
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


def test_reference_colors_agree_with_the_texture():
    image = np.zeros((2, 2, 3), np.uint8)
    image[0], image[1] = (255, 0, 0), (0, 0, 255)  # the first row is the upper one
    wall = parts.quad("wall", (0, 0, 0), (1, 0, 0), (0, 0, 1), Material(color=image))
    surface = scenes.surface_of(render.Stage([wall]), "wall")
    points = np.array([[0.5, 0, 0.25], [0.5, 0, 0.75]])
    caster = RayCaster(surface.vertices, surface.faces)
    _, face, bary = caster.cast(points - [0, 1, 0], np.tile([0.0, 1.0, 0.0], (2, 1)))
    np.testing.assert_allclose(surface.colors(points, face, bary), [[0, 0, 1], [1, 0, 0]], atol=1e-6)


def test_every_scene_is_a_choice_of_the_option():
    (option,) = (entry for entry in fields(SynthOptions) if entry.name == "realism")
    assert sorted(option.metadata["choices"]) == sorted(scenes.SCENES)


@pytest.mark.parametrize("name", scenes.SCENES)
def test_cameras_stand_in_free_space_and_see_the_scene(name):
    traced = scenes.TracedScene(name, None, SynthOptions(views=12, test_views=4, size=(48, 36), realism=name))
    assert len(traced.train) == 12 and len(traced.test) == 4
    caster = RayCaster(traced.surface.vertices, traced.surface.faces)
    for view in traced.train + traced.test:
        depth, face, _ = caster.render_depth(view)
        assert (face >= 0).mean() > 0.5
        assert np.quantile(depth[face >= 0], 0.01) > 0.2


# A whole room


@pytest.fixture(scope="module")
def walked():
    """The kitchen with 40 training views, and its ray caster."""
    traced = scenes.TracedScene("kitchen", None, SynthOptions(views=40, test_views=4, size=(64, 48), realism="kitchen"))
    return traced, RayCaster(traced.surface.vertices, traced.surface.faces)


def test_walk_has_even_steps_with_held_out_views_in_between():
    corners = np.array([[1.0, 1, 0], [3, 1, 0], [3, 3, 0], [1, 3, 0]])
    middle = np.tile([2.0, 2.0, 1.4], (4, 1))
    train, test = walk(corners, middle, 40, 8, seed=3)
    eyes, held = (np.array([np.linalg.inv(pose)[:3, 3] for pose in poses]) for poses in (train, test))
    assert (WALK_EYES[0] <= eyes[:, 2]).all() and (eyes[:, 2] <= WALK_EYES[1]).all() and np.ptp(eyes[:, 2]) > 0.2
    # On the square's edges, all the way round.
    np.testing.assert_allclose(np.abs(eyes[:, :2] - 2.0).max(1), 1.0, atol=1e-9)
    step = np.linalg.norm(np.diff(np.concatenate([eyes, eyes[:1]])[:, :2], axis=0), axis=1)
    assert step.max() < WALK_STEP and step.min() > 0.5 * step.max()
    ahead = np.array([pose[2, :3] for pose in train])
    assert np.rad2deg(np.arccos((ahead[1:] * ahead[:-1]).sum(1))).max() < WALK_TURN_DEG
    assert (((middle[0] - eyes) * ahead).sum(1) > 0.99 * np.linalg.norm(middle[0] - eyes, axis=1)).all()
    nearest = np.linalg.norm(held[:, None, :2] - eyes[None, :, :2], axis=2).min(1)
    assert (nearest > 0.15 * step.min()).all() and (nearest < 0.55 * step.max()).all()
    assert np.array_equal(train, walk(corners, middle, 40, 8, seed=3)[0])
    assert not np.array_equal(train, walk(corners, middle, 40, 8, seed=4)[0])


def test_pierced_wall_has_an_open_hole_and_faces_the_room():
    hole = interiors.pierced_wall((4.0, 2.5), Material(), (1.0, 2.0), (0.8, 1.8), 0.3)
    surface = scenes.surface_of(render.Stage(interiors.on_wall("right", (5.0, 4.0, 2.5), hole)), "wall")
    caster = RayCaster(surface.vertices, surface.faces)
    # Straight through the hole, beside it, and to each of its sides.
    eye, middle = np.array([2.0, -1.5, 1.3]), np.array([5.15, -1.5, 1.3])
    ends = middle + [[0, 0, 0], [-0.15, 0.7, 0], [0, 0.5, 0], [0, -0.5, 0], [0, 0, 0.5], [0, 0, -0.5]]
    starts = np.array([eye, eye, *np.tile(middle, (4, 1))])
    distance, face, _ = caster.cast(starts, ends - starts)
    assert np.isinf(distance[0])
    np.testing.assert_allclose(distance[1:], 1.0, atol=1e-9)
    facing = unit_normals(surface.vertices, surface.faces)[face[1:]]
    np.testing.assert_allclose(facing, [[-1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], atol=1e-12)


def test_kitchen_has_few_degenerate_faces_and_lies_within_its_walls():
    stage = kitchen.kitchen_scene(smooth_body(), 0)
    low, high = np.array([0.0, -kitchen.DEPTH, 0.0]), np.array([kitchen.WIDTH, 0.0, kitchen.HEIGHT])
    for part in stage.parts:
        a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        # Only triangles at the axes of turned parts and at the poles of the figure are degenerate.
        flat = area < 1e-12
        assert not flat.any() or part.name == "face" or part.smooth, part.name
        assert flat.mean() <= 0.5, part.name
        # Only window, door and niche reach into the walls.
        assert (part.vertices > low - 0.25).all() and (part.vertices < high + 0.25).all(), part.name
        assert (part.vertices[:, 2] > -1e-9).all() and (part.vertices[:, 2] < high[2] + 1e-9).all(), part.name


def test_kitchen_surfaces_face_the_camera_and_no_ray_misses(walked):
    traced, caster = walked
    normals = unit_normals(caster.vertices, caster.faces)
    for view in traced.train[::4]:
        _, face, _ = caster.render_depth(view)
        assert (face >= 0).all()
        towards = (pixel_rays(view) * normals[face]).sum(-1)
        assert (towards < 0).mean() > 0.999


def test_kitchen_cameras_are_clear_of_surfaces_and_cover_the_room(walked):
    traced, caster = walked
    assert nearest_surface(traced, caster) > 0.25
    # Surface points hit by rays from the free floor, sampled in proportion to area.
    rng, probe = np.random.default_rng(0), fibonacci_directions(500)
    eyes = np.repeat(rng.uniform((1.4, -3.0, 1.0), (3.7, -0.9, 1.8), (60, 3)), len(probe), axis=0)
    rays = np.tile(probe, (60, 1))
    distance, face, _ = caster.cast(eyes, rays)
    slant = np.abs((unit_normals(caster.vertices, caster.faces)[face] * rays).sum(1))
    weight = distance**2 / np.maximum(slant, 0.05)
    points = (eyes + rays * distance[:, None])[rng.choice(len(rays), 2000, p=weight / weight.sum())]
    count = np.zeros(len(points), int)
    for view in traced.train:
        pixel, depth = view.project(points)
        inside = (depth > 0) & (pixel > 0).all(1) & (pixel < (view.width, view.height)).all(1)
        offset = points - view.center
        count += inside & ~caster.occluded(view.center, offset, 1.0 - 2e-3 / np.linalg.norm(offset, axis=1))
    assert (count >= 3).mean() > 0.92
    ceiling, floor = points[:, 2] > kitchen.HEIGHT - 1e-3, points[:, 2] < 0.02
    assert (count[ceiling] >= 3).mean() > 0.9 and (count[floor] >= 3).mean() > 0.85


def test_bedroom_cameras_are_clear_of_surfaces():
    traced = scenes.TracedScene("bedroom", None, SynthOptions(views=40, test_views=4, size=(64, 48), realism="bedroom"))
    caster = RayCaster(traced.surface.vertices, traced.surface.faces)
    assert nearest_surface(traced, caster) > 0.4


# A garden


@pytest.fixture(scope="module")
def terraced():
    """The terrace with 40 training views, and its ray caster."""
    traced = scenes.TracedScene("terrace", None, SynthOptions(views=40, test_views=4, size=(64, 48), realism="terrace"))
    return traced, RayCaster(traced.surface.vertices, traced.surface.faces)


def test_hedge_and_foliage_have_the_given_position_and_size():
    rng = np.random.default_rng(0)
    hedge = outdoors.hedge((1.0, 2.0, 0.0), (1.0, 8.0, 0.0), 1.7, rng)
    low, high = hedge.vertices.min(0), hedge.vertices.max(0)
    np.testing.assert_allclose([*low, *high], [0.6, 2.0, 0.0, 1.4, 8.0, 1.7], atol=0.35)
    assert np.median(hedge.vertices[:, 2]) > 1.0 and len(hedge.colors) == len(hedge.vertices)
    leaves = outdoors.foliage("leaves", outdoors.crown(500, (3, 4, 5), (1, 2, 1), rng), 0.1, outdoors.GREEN, rng)
    assert leaves.vertices.shape == (2000, 3) and leaves.faces.shape == (1000, 3) and leaves.faces.max() == 1999
    assert (np.abs(leaves.vertices - [3, 4, 5]) < np.array([1, 2, 1]) * 1.16 + 0.1).all()
    edge = leaves.vertices[leaves.faces[:, 0]] - leaves.vertices[leaves.faces[:, 1]]
    assert np.linalg.norm(edge, axis=1).max() < 0.1


def test_painted_parts_keep_shapes_and_colors():
    red = parts.box("red", (0, 0, 0), (1, 1, 1), Material(color=(0.8, 0.1, 0.1)))
    leaves = outdoors.foliage("leaves", np.zeros((3, 3)), 0.1, outdoors.GREEN, np.random.default_rng(0))
    both = outdoors.painted("both", [red, leaves])
    assert both.material == Material() and not both.smooth and both.uv is None
    assert (both.colors[: len(red.vertices)] == (0.8, 0.1, 0.1)).all()
    np.testing.assert_array_equal(both.colors[len(red.vertices) :], leaves.colors)
    corners = np.concatenate([red.vertices[red.faces], leaves.vertices[leaves.faces]])
    np.testing.assert_array_equal(both.vertices[both.faces], corners)


def test_terrace_has_few_degenerate_faces_and_stands_on_its_lawn(terraced):
    for part in terraced[0].stage.parts:
        a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
        flat = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1) < 1e-12
        assert not flat.any() or part.smooth, part.name
        assert flat.mean() <= 0.5, part.name
        # Leaves and the roughness of the hedge reach a little into the ground.
        assert (part.vertices[:, 2] > terrace.LAWN - 0.2).all(), part.name


def test_terrace_cameras_are_clear_of_surfaces(terraced):
    traced, caster = terraced
    assert nearest_surface(traced, caster) > 0.25


def test_a_third_of_the_terrace_pixels_is_far_and_some_views_show_nothing_far(terraced):
    traced, caster = terraced
    far = []
    for view in traced.train:
        depth, face, _ = caster.render_depth(view)
        y, x = np.mgrid[: view.height, : view.width] + 0.5
        slant = np.sqrt(((x - view.cx) / view.fx) ** 2 + ((y - view.cy) / view.fy) ** 2 + 1.0)
        far.append(((face < 0) | (depth * slant > 10.0)).mean())
    assert 0.25 < np.mean(far) < 0.45
    assert np.quantile(far, 0.2) < 0.02 and np.quantile(far, 0.6) > 0.4


def test_terrace_backdrop_is_far_and_not_in_the_surface(terraced):
    traced, caster = terraced
    points = np.concatenate([part.vertices for part in traced.backdrop])
    for view in traced.train + traced.test:
        assert np.linalg.norm(points - view.center, axis=1).min() > 10.0
    assert np.linalg.norm(points[:, :2], axis=1).max() > 300.0
    assert len(caster.faces) == sum(len(part.faces) for part in traced.stage.parts)
    assert caster.diagonal < 30.0


@pytest.fixture(scope="module")
def round_table():
    """The garden with 40 training views, and its ray caster."""
    traced = scenes.TracedScene("garden", None, SynthOptions(views=40, test_views=4, size=(64, 48), realism="garden"))
    return traced, RayCaster(traced.surface.vertices, traced.surface.faces)


def test_garden_cameras_are_clear_of_surfaces(round_table):
    traced, caster = round_table
    assert nearest_surface(traced, caster) > 0.4


def test_garden_backdrop_is_far_and_not_in_the_surface(round_table):
    traced, caster = round_table
    points = np.concatenate([part.vertices for part in traced.backdrop])
    # It begins where the lawn ends.
    assert np.linalg.norm(points[:, :2], axis=1).min() > garden.LAWN_END - 1.0
    for view in traced.train + traced.test:
        assert np.linalg.norm(points - view.center, axis=1).min() > 4.0
    assert np.linalg.norm(points[:, :2], axis=1).max() > 300.0
    assert len(caster.faces) == sum(len(part.faces) for part in traced.stage.parts)
    assert caster.diagonal < 30.0


def test_sun_has_the_given_direction():
    sky = outdoors.day(0, (236.0, 50.0), 180)
    row, column = np.unravel_index(sky.sum(-1).argmax(), sky.shape[:2])
    assert abs(row + 0.5 - 40.0) <= 1.0 and abs(column - 236.0) <= 1.0
    assert np.isfinite(sky).all() and (sky >= 0.0).all()


@pytest.mark.parametrize(
    ("option", "value"), [("table", 2.0), ("environment", 1), ("path", "arc"), ("distortion", 0.1)]
)
def test_options_that_the_scene_determines_are_refused(option, value, tmp_path):
    with pytest.raises(LinprimError, match=f"--{option} is {value}, but the scene of --realism desk has its own"):
        synthesize(tmp_path / "out", realism="desk", **{option: value})


def test_missing_mitsuba_is_reported_with_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(LinprimError, match=r"pip install linprim-geo\[realism\]"):
        synthesize(tmp_path / "out", realism="statue", **SMALL)
    assert not (tmp_path / "out").exists()


# Rendering


@needs_mitsuba
def test_rendered_patch_lies_at_its_projection():
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
def test_radiance_of_a_wall_under_a_uniform_sky_is_its_albedo():
    # Under a sky of radiance 1 on all sides a plane of albedo a has radiance a.
    wall = parts.quad("wall", (-9, 0, -9), (18, 0, 0), (0, 0, 18), Material(color=(0.5, 0.5, 0.5)))
    stage = render.Stage([wall], sky=np.ones((8, 16, 3), np.float32))
    light, error = render.PathTracer(stage).render(camera((0, -2, 0), (0, 0, 0)), 64, 0)
    albedo = float(render.to_linear(np.array(0.5)))
    assert light.mean() == pytest.approx(albedo, rel=0.02)
    assert 0.0 < np.median(error) < 0.2 * albedo


@needs_denoiser
def test_denoising_removes_grain_and_keeps_textures():
    bright, dark = Material(color=(0.9, 0.9, 0.9)), Material(color=(0.3, 0.3, 0.3))
    stripes = np.where(np.arange(64) % 8 < 4, 230, 120).astype(np.uint8)
    stripes = Material(color=np.broadcast_to(stripes[None, :, None], (64, 64, 3)))
    walls = [
        parts.quad("wall", (-9, 0, -9), (18, 0, 0), (0, 0, 18), bright),
        parts.quad("stripes", (-0.5, -0.01, -0.5), (1, 0, 0), (0, 0, 1), stripes),
        parts.quad("square", (0.6, -0.01, -0.2), (0.4, 0, 0), (0, 0, 0.4), dark),
    ]
    # A small bright part of the sky, which few paths meet.
    sky = np.full((32, 64, 3), 0.05, np.float32)
    sky[12, 30:33] = 40
    stage, view = render.Stage(walls, sky=sky), camera((0, -3, 0), (0, 0, 0), focal=60.0)
    truth = render.PathTracer(stage).render(view, 1024, 0)[0]
    noisy, clean = (render.PathTracer(stage, denoise=denoise).render(view, 16, 1)[0] for denoise in (False, True))
    assert clean.shape == truth.shape and clean.dtype == np.float32
    off = np.abs([noisy, clean] - truth)
    plain, shown = np.s_[:, :8], np.s_[:, 10:30]
    assert off[1][plain].mean() < off[0][plain].mean() / 2
    grain = [np.abs(np.diff(picture[plain], axis=1)).mean() for picture in (noisy, clean)]
    assert grain[1] < grain[0] / 5
    assert off[1][shown].mean() < off[0][shown].mean(), "stripes are not smoothed away"
    again = render.PathTracer(stage, threads=1, denoise=True).render(view, 16, 1)[0]
    assert np.array_equal(again, clean)


@needs_mitsuba
def test_missing_denoiser_is_reported_with_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(LinprimError, match=r"--denoise on .* pip install linprim-geo\[realism\]"):
        synthesize(tmp_path / "out", realism="statue", denoise="on", **SMALL)
    assert not (tmp_path / "out").exists()


@needs_mitsuba
def test_rows_and_columns_of_the_sky_map_to_directions():
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
def test_capture_loads_and_is_hardly_clipped(tmp_path):
    report = synthesize(tmp_path / "a", realism="statue", **SMALL)
    assert report["unit"] == "m" and report["realism"] == "statue"
    scene = load_scene(tmp_path / "a")
    assert len(scene.train) == 3 and len(scene.test) == 1
    pixels = np.concatenate([view.load().rgb.reshape(-1, 3) for view in scene.train])
    assert (pixels == 255).mean() < 0.01 and pixels.mean() > 25
    reference = load_mesh(tmp_path / "a" / "reference.ply")
    assert 0 < len(reference.faces)


@needs_mitsuba
def test_rendering_depends_on_the_seed_and_not_on_threads():
    ball = parts.sphere("ball", (0.0, 0.0, 0.0), 0.5, Material("metal", roughness=0.2), segments=24)
    stage = render.Stage([ball], sky=np.random.default_rng(0).uniform(0, 1, (8, 16, 3)))
    view = camera((0, -2, 0), (0, 0, 0))
    first, second = (render.PathTracer(stage, threads=threads).render(view, 4, 7)[0] for threads in (1, 2))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, render.PathTracer(stage).render(view, 4, 8)[0])


def test_outliers_are_replaced_without_changing_other_pixels():
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
