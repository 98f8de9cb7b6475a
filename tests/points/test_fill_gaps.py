"""Points added where features give none: a room with untextured walls, masks, backdrops and degenerate clouds."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.captures import look_at, transforms
from PIL import Image

from linprim_geo.capture.load import load_scene
from linprim_geo.capture.types import PointCloud, Scene
from linprim_geo.points import fill_gaps as filling
from linprim_geo.points.fill_gaps import _differences, _Gaps, _not_in_free_space, _sources, fill_gaps
from linprim_geo.points.initial_points import evenly_spread_views, local_planes

# A room of 4 x 4 x 3: the far wall at y = 2, the floor at z = -1.5, a box in front of the wall.
BOX_LOW, BOX_HIGH = np.array([-0.5, 0.6, -1.5]), np.array([0.5, 1.4, -0.3])
COLORS = {"wall": (200, 200, 205), "floor": (120, 90, 60), "box": (60, 90, 40)}
SIZE, FOCAL = (128, 96), 100.0


def cameras():
    return [
        look_at((x, -2.0 + 0.1 * abs(x), 0.15 * (i % 3)), (0.3 * x, 2.0, -0.5), size=SIZE, focal=FOCAL)
        for i, x in enumerate(np.linspace(-1.5, 1.5, 9))
    ]


def cast(camera):
    """((H, W) z-depth, (H, W, 3) uint8 picture) of the room."""
    origin, rays = camera.center, camera.world_rays()
    wall, floor = (2.0 - origin[1]) / rays[..., 1], np.full(rays.shape[:2], np.inf)
    down = rays[..., 2] < 0
    floor[down] = (-1.5 - origin[2]) / rays[..., 2][down]
    depth = np.minimum(wall, floor)
    color = np.where((wall < floor)[..., None], COLORS["wall"], COLORS["floor"]).astype(float)
    near, far = (BOX_LOW - origin) / rays, (BOX_HIGH - origin) / rays
    enter, leave = np.minimum(near, far).max(-1), np.maximum(near, far).min(-1)
    box = (enter < leave) & (enter > 0) & (enter < depth)
    depth = np.where(box, enter, depth)
    color[box] = COLORS["box"]
    # Weak texture on the box alone, in place: what features would overlook and patches do not.
    place = origin + depth[..., None] * rays
    color[box] += 12 * np.sin(9 * place[box]).sum(-1, keepdims=True)
    return depth, np.clip(color + 0.5, 0, 255).astype(np.uint8)


def features():
    """Points on the edges of a chequerboard of bare plates, 0.5 wide, on the wall and on the floor; none on the box."""
    rng = np.random.default_rng(0)
    wall = np.stack([rng.uniform(-3, 3, 4000), np.full(4000, 2.0), rng.uniform(-1.5, 1.5, 4000)], axis=1)
    floor = np.stack([rng.uniform(-3, 3, 4000), rng.uniform(-2, 2, 4000), np.full(4000, -1.5)], axis=1)
    wall = wall[(np.abs(wall[:, [0, 2]] % 0.5 - 0.25) > 0.2).any(1)]
    floor = floor[(np.abs(floor[:, [0, 1]] % 0.5 - 0.25) > 0.2).any(1)]
    xyz = np.concatenate([wall[:700], floor[:700]])
    keep = np.zeros(len(xyz), dtype=bool)
    for camera in cameras():
        pixels, depth = camera.project(xyz)
        with np.errstate(invalid="ignore"):
            inside = np.flatnonzero((depth > 0) & (pixels >= 0).all(1) & (pixels < SIZE).all(1))
        column, row = pixels[inside].astype(int).T
        keep[inside] |= np.abs(cast(camera)[0][row, column] / depth[inside] - 1) < 0.02
    return xyz[keep]


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Scene:
    root = tmp_path_factory.mktemp("room")
    paths = []
    for i, camera in enumerate(cameras()):
        paths.append(f"{i}.png")
        Image.fromarray(cast(camera)[1]).save(root / paths[-1])
    (root / "transforms.json").write_text(json.dumps(transforms(cameras(), paths)))
    xyz = features()
    return with_cloud(load_scene(root), xyz)


def with_cloud(scene, xyz):
    cloud = PointCloud(xyz, np.full((len(xyz), 3), 128, np.uint8))
    return Scene(scene.root, scene.kind, scene.train, scene.test, cloud)


def surface_distance(xyz):
    """(P,) distance to the nearest of wall, floor and box."""
    outside = np.linalg.norm(np.maximum(np.maximum(BOX_LOW - xyz, xyz - BOX_HIGH), 0), axis=1)
    inside = np.minimum(xyz - BOX_LOW, BOX_HIGH - xyz).min(1)
    box = np.where(inside > 0, inside, outside)
    return np.minimum(np.minimum(np.abs(xyz[:, 1] - 2.0), np.abs(xyz[:, 2] + 1.5)), box)


def on_box(xyz):
    return ((xyz > BOX_LOW - 0.1) & (xyz < BOX_HIGH + 0.1)).all(1)


def test_new_points_lie_on_surfaces_and_fill_gaps(room):
    given = len(room.points.xyz)
    cloud = fill_gaps(room, seed=0)
    np.testing.assert_array_equal(cloud.xyz[:given], room.points.xyz)
    new = cloud.xyz[given:]
    assert len(new) > given / 2 and cloud.rgb.shape == cloud.xyz.shape and cloud.rgb.dtype == np.uint8
    behind = (new[:, 1] > 2.07) | (new[:, 2] < -1.57)  # points without evidence lie beyond the room, by 2 % and more
    distance = surface_distance(new[~behind]) / 3.5  # of the typical depth
    assert np.median(distance) < 0.003 and (distance < 0.02).mean() > 0.9 and behind.mean() < 0.15
    # The bare plates' middles get points: there is one within a quarter of a plate.
    x, z = np.meshgrid(np.arange(-1.25, 1.5, 0.5), np.arange(0.25, 1.0, 0.5))
    middles = np.stack([x.ravel(), np.full(x.size, 2.0), z.ravel()], axis=1)
    assert (np.linalg.norm(cloud.xyz[None] - middles[:, None], axis=2).min(1) < 0.2).mean() > 0.9


def test_object_without_features_gets_points(room):
    assert on_box(room.points.xyz).sum() <= 60  # floor points at its foot
    given = len(room.points.xyz)
    new = fill_gaps(room, seed=0)
    box = on_box(new.xyz[given:]) & (new.xyz[given:, 2] > -1.2)
    rgb = new.rgb[given:].astype(int)[box]
    green = rgb[:, 1] > rgb[:, 0]
    assert green.sum() >= 25 and (~green).sum() <= 4


def test_few_new_points_lie_in_free_space(room):
    """Points without evidence of their depth are placed behind the known surfaces, not between the cameras. At the
    depth of the nearest points, a share of 0.021 of the new points was in free space."""
    given = len(room.points.xyz)
    new = fill_gaps(room, seed=0).xyz[given:]
    free = surface_distance(new) > 0.02 * 3.5
    within = (new[:, 1] < 2.0) & (new[:, 2] > -1.5) & (new[:, 1] > -1.0)
    assert (free & within).mean() < 0.015


def test_points_repeat_for_one_seed_and_differ_for_another(room):
    first, again, other = (fill_gaps(room, seed=seed).xyz for seed in (3, 3, 4))
    assert first.tobytes() == again.tobytes()
    assert first.shape != other.shape or (first != other).any()


def full_cloud(room):
    """The room with a point for every 9th pixel of every view."""
    dense = []
    for camera in cameras():
        depth, _ = cast(camera)
        dense.append((camera.center + depth[..., None] * camera.world_rays())[::3, ::3].reshape(-1, 3))
    return with_cloud(room, np.concatenate(dense))


def test_dense_cloud_gets_hardly_any_points(room):
    full = full_cloud(room)
    assert len(fill_gaps(full, seed=0).xyz) <= 1.01 * len(full.points.xyz)


def test_masked_pixels_get_no_points(room, tmp_path):
    # The same photographs with everything but the wall masked out: wall points alone may be added.
    paths = []
    for i, camera in enumerate(cameras()):
        depth, picture = cast(camera)
        place = camera.center + depth[..., None] * camera.world_rays()
        alpha = np.where(np.abs(place[..., 1] - 2.0) < 1e-6, 255, 0).astype(np.uint8)
        Image.fromarray(np.concatenate([picture, alpha[..., None]], axis=2)).save(tmp_path / f"{i}.png")
        paths.append(f"{i}.png")
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(cameras(), paths)))
    scene = with_cloud(load_scene(tmp_path), room.points.xyz)
    assert scene.has_alpha
    cloud = fill_gaps(scene, seed=0)
    new = cloud.rgb[len(scene.points.xyz) :]
    assert len(new) > 100
    np.testing.assert_allclose(new, np.broadcast_to(COLORS["wall"], new.shape), atol=1)


def test_pixels_of_the_backdrop_colour_get_no_points(room):
    given = len(room.points.xyz)
    backdrop = np.array(COLORS["wall"]) / 255
    with_it = fill_gaps(room, seed=0).rgb[given:].astype(int)
    without = fill_gaps(room, seed=0, backdrop=backdrop).rgb[given:].astype(int)
    like = [np.abs(rgb - COLORS["wall"]).max(1) <= 20 for rgb in (with_it, without)]
    assert like[0].sum() > 100 and like[1].sum() == 0 and len(without) > 100


def test_points_in_front_of_surfaces_of_other_views_are_dropped(room):
    full = full_cloud(room)
    views = [_Gaps(look, full.points.xyz) for look in evenly_spread_views(room.train, 100)]
    wall = np.array([[0.2, 2.0, 0.4], [-0.7, 2.0, 0.2], [0.9, 2.0, 0.3]])
    floating = wall - [0, 0.5, 0]
    np.testing.assert_array_equal(_not_in_free_space(wall, views, 0), True)
    np.testing.assert_array_equal(_not_in_free_space(floating, views, 0), False)


def test_patch_difference_is_smallest_at_the_true_depth(room):
    views = [_Gaps(look, room.points.xyz) for look in evenly_spread_views(room.train, 100)]
    index = 4
    view, depth = views[index], cast(cameras()[index])[0]
    face = np.array([[64.0, 60.0], [58.0, 64.0], [70.0, 58.0]])  # the box's front
    column, row = face.astype(int).T
    np.testing.assert_allclose(view.points_at(face, 1 / depth[row, column])[:, 1], BOX_LOW[1], atol=0.02)
    tried = (1 / depth[row, column])[:, None] * np.linspace(0.6, 1.6, 41)
    difference = _differences(view, _sources(views, index), face, tried)
    assert difference.shape == (3, 41)
    best = np.linspace(0.6, 1.6, 41)[difference.argmin(1)]
    assert np.abs(best - 1).max() <= 0.05
    assert (difference.min(1) < filling._SAME_COLOR).all() and difference.max() > 3 * filling._SAME_COLOR


@pytest.mark.parametrize(
    "xyz",
    [
        np.zeros((5, 3)),
        np.linspace([-1.0, 2.0, 0.0], [1.0, 2.0, 0.0], 50),  # on a line
        np.full((40, 3), 2.0),  # in one place
        np.full((40, 3), [0.0, -50.0, 0.0]),  # behind all cameras
    ],
    ids=["few", "line", "one place", "behind"],
)
def test_degenerate_clouds_keep_their_points_and_stay_finite(room, xyz):
    cloud = fill_gaps(with_cloud(room, xyz), seed=0)
    np.testing.assert_array_equal(cloud.xyz[: len(xyz)], xyz)
    assert np.isfinite(cloud.xyz).all() and len(cloud.rgb) == len(cloud.xyz)


def test_local_planes_are_flat_for_a_plane_and_round_for_a_volume():
    rng = np.random.default_rng(1)
    normal = np.array([1.0, 2.0, -2.0]) / 3
    plane = rng.uniform(-1, 1, (400, 3))
    plane -= (plane @ normal)[:, None] * normal
    rotation, flat = local_planes(plane + 5, seed=0)
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, rtol=1e-12)
    w, x, y, z = rotation.T
    third = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    np.testing.assert_allclose(np.abs(third @ normal), 1, rtol=1e-9)
    np.testing.assert_array_equal(flat, 0.1)
    volume = local_planes(rng.uniform(-1, 1, (2000, 3)), seed=0)[1]
    assert 0.5 < np.median(volume) < 0.75
    few, one = local_planes(plane[:3], seed=0)
    assert few.shape == (3, 4) and (one == 1).all()
    again = local_planes(plane + 5, seed=0)[0]
    np.testing.assert_array_equal(again, rotation)
