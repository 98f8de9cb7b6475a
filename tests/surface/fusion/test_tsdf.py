"""Fusion of depth maps and visibility, compared with surfaces of known depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, face_components
from linprim_geo.geometry.topology import manifold_status, topology
from linprim_geo.imaging.colors import error_colors
from linprim_geo.kernels import ops, surface_ops
from linprim_geo.surface import visibility
from linprim_geo.surface.fusion import tsdf_fusion as fuse
from linprim_geo.surface.fusion.tsdf_field import DepthFrame, Grid, vote_rules
from linprim_geo.surface.fusion.tsdf_fusion import fuse_tsdf
from linprim_geo.surface.mesh_views import MeshViews

SIZE = 128


def look_at(eye, target=(0.0, 0.0, 0.0), size=SIZE, focal=None) -> Camera:
    eye, target = np.asarray(eye, dtype=np.float64), np.asarray(target, dtype=np.float64)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ eye
    focal = focal or 1.2 * size
    return Camera(size, size, focal, focal, size / 2, size / 2, pose)


def around(count, radius=3.0, **options) -> list[Camera]:
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    angle = np.pi * (1.0 + 5.0**0.5) * index
    flat = np.sqrt(1.0 - z * z)
    eyes = radius * np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    return [look_at(eye, **options) for eye in eyes]


def sphere_depth(camera: Camera, radius=1.0, center=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Depth of a sphere by the nearer root of |c + d r - m| = radius, with rays r of z = 1; 0 for a miss."""
    rays = camera.world_rays()
    start = camera.center - np.asarray(center)
    a = (rays**2).sum(-1)
    b = rays @ start
    root = b**2 - a * (start @ start - radius**2)
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0.0)


def sphere_frames(cameras, radius=1.0, center=(0.0, 0.0, 0.0), **extra) -> list[DepthFrame]:
    depths = [sphere_depth(camera, radius, center) for camera in cameras]
    return [
        DepthFrame(camera, depth.astype(np.float32), background=depth == 0, **extra)
        for camera, depth in zip(cameras, depths, strict=True)
    ]


def box_frames(cameras, half=(0.8, 0.5, 0.3)) -> list[DepthFrame]:
    half, frames = np.asarray(half), []
    for camera in cameras:
        rays, eye = camera.world_rays(), camera.center
        near, far = np.sort(np.stack([(-half - eye) / rays, (half - eye) / rays]), axis=0)
        enter, leave = near.max(-1), far.min(-1)
        depth = np.where(enter < leave, enter, 0.0)
        frames.append(DepthFrame(camera, depth.astype(np.float32), background=depth == 0))
    return frames


@pytest.fixture(scope="module")
def ball() -> Mesh:
    return fuse_tsdf(sphere_frames(around(24)), voxel_size=0.05)


def radial_error(mesh: Mesh) -> np.ndarray:
    return np.linalg.norm(mesh.vertices, axis=1) - 1.0


# --- accuracy --------------------------------------------------------------------------------------------


def test_a_sphere_is_accurate_and_closed(ball):
    error = radial_error(ball) / 0.05
    # The chord between two voxels bends away from the sphere by h^2 / 8 = 0.006 voxel; pixels are 0.25 voxel.
    assert np.sqrt((error**2).mean()) < 0.02 and np.abs(error).max() < 0.1
    assert abs(error.mean()) < 0.02
    stats = topology(ball)
    assert stats["watertight"] and stats["genus"] == 0 and stats["components"] == 1
    assert stats["volume"] == pytest.approx(4 / 3 * np.pi, rel=0.005)
    assert manifold_status(ball) == "NoError"


def test_normals_point_outward(ball):
    along = np.einsum("ij,ij->i", ball.normals, ball.vertices / np.linalg.norm(ball.vertices, axis=1)[:, None])
    assert along.min() > 0.9 and along.mean() > 0.995


def test_a_slanted_plane_is_exact_with_large_pixels():
    # 1/z is linear over a plane, so pixels of five voxels and a slant of 75 degrees cause no error.
    normal = np.array([np.cos(np.radians(15)), 0.0, -np.sin(np.radians(15))])
    camera = Camera(64, 64, 64.0, 64.0, 32.0, 32.0, np.eye(4))
    depth = (normal @ [0, 0, 3.0]) / (camera.ray_grid() @ normal)
    depth = np.where((depth > 1) & (depth < 6), depth, 0.0)
    mesh = fuse_tsdf([DepthFrame(camera, depth)], voxel_size=0.02)
    distance = (mesh.vertices - [0, 0, 3.0]) @ normal
    assert len(mesh.faces) > 1000
    assert np.abs(distance).max() < 0.02 * 0.02
    assert (mesh.normals @ normal > 0.99).mean() > 0.99  # towards the camera


def test_a_box_is_accurate_and_closed():
    mesh = fuse_tsdf(box_frames(around(40)), voxel_size=0.04)
    stats = topology(mesh)
    assert stats["watertight"] and stats["genus"] == 0
    half = np.array([0.8, 0.5, 0.3])
    outside = np.abs(mesh.vertices) - half
    distance = np.where((outside < 0).all(1), outside.max(1), np.linalg.norm(np.maximum(outside, 0), axis=1))
    assert np.median(np.abs(distance)) < 1e-3 * 0.04
    assert np.abs(distance).mean() < 0.1 * 0.04  # marching cubes cuts edges off
    assert stats["volume"] == pytest.approx(8 * half.prod(), rel=0.01)


def test_both_sides_of_a_thin_sheet_are_accurate():
    mesh = fuse_tsdf(box_frames(around(40), half=(0.8, 0.6, 0.03)), voxel_size=0.04)
    flat = np.abs(mesh.vertices[:, :2]).max(1) < 0.5
    height = mesh.vertices[flat, 2]
    assert np.abs(np.abs(height) - 0.03).mean() < 0.15 * 0.04
    assert topology(mesh)["watertight"]


def test_accuracy_does_not_depend_on_the_distance_from_the_origin(ball):
    offset = np.array([4e5, -2e5, 1e5])
    moved = []
    for frame in sphere_frames(around(24)):
        pose = frame.camera.world_to_camera.copy()
        pose[:3, 3] -= pose[:3, :3] @ offset
        moved.append(replace(frame, camera=replace(frame.camera, world_to_camera=pose)))
    far = fuse_tsdf(moved, voxel_size=0.05)
    # Rounding of the offset shifts the grid, so distances to the surface are compared, not vertices.
    error = np.linalg.norm(far.vertices - offset, axis=1) - 1.0
    assert np.sqrt((error**2).mean()) < 1.2 * np.sqrt((radial_error(ball) ** 2).mean())


# --- free space ------------------------------------------------------------------------------------------


def with_phantom(frames, value) -> list[DepthFrame]:
    """Add a patch of wrong depths in a corner of the first image, beside the sphere."""
    depth = frames[0].depth.copy()
    depth[8:24, 8:24] = value
    background = frames[0].background & (depth == 0)
    return [replace(frames[0], depth=depth, background=background), *frames[1:]]


def pieces(mesh: Mesh) -> int:
    return face_components(mesh)[0]


def test_background_removes_a_surface_of_one_view():
    frames = with_phantom(sphere_frames(around(10)), 3.0)
    mesh = fuse_tsdf(frames, voxel_size=0.05, min_component=0)
    np.testing.assert_array_equal(mesh.vertices, fuse_tsdf(frames, voxel_size=0.05).vertices)
    assert pieces(mesh) == 1 and np.abs(radial_error(mesh)).max() < 0.25 * 0.05


def test_unknown_pixels_remove_no_surface():
    frames = [replace(f, background=None) for f in with_phantom(sphere_frames(around(10)), 3.0)]
    assert pieces(fuse_tsdf(frames, voxel_size=0.05, min_component=0)) > 1
    assert pieces(fuse_tsdf(frames, voxel_size=0.05, min_component=0.5)) == 1


def test_depths_far_behind_remove_a_surface_of_one_view():
    # Instead of background there is a wall (a large sphere seen from inside) behind everything.
    frames = []
    for frame in with_phantom(sphere_frames(around(10)), 3.0):
        rays = frame.camera.world_rays()
        eye = frame.camera.center
        a, b = (rays**2).sum(-1), rays @ eye
        wall = (-b + np.sqrt(b**2 - a * (eye @ eye - 36.0))) / a
        frames.append(DepthFrame(frame.camera, np.where(frame.background, wall, frame.depth)))
    mesh = fuse_tsdf(frames, voxel_size=0.05, bounds=[[-2] * 3, [2] * 3], min_component=0)
    assert pieces(mesh) == 1 and np.abs(radial_error(mesh)).max() < 0.25 * 0.05


def test_clamped_depths_only_mark_free_space(ball):
    frames = with_phantom(sphere_frames(around(10)), 3.0)
    clear = [replace(f, depth=np.where(f.background, 4.5, f.depth), clamped=f.background) for f in frames]
    mesh = fuse_tsdf(clear, voxel_size=0.05, min_component=0)
    assert pieces(mesh) == 1 and np.abs(radial_error(mesh)).max() < 0.25 * 0.05
    taken = fuse_tsdf([replace(f, clamped=None) for f in clear], voxel_size=0.05, min_component=0)
    assert np.abs(radial_error(taken)).max() > 1  # shells behind the sphere
    assert (
        fuse.auto_voxel_size(clear)
        == fuse.auto_voxel_size(frames)
        < fuse.auto_voxel_size([replace(f, clamped=None) for f in clear])
    )
    # Cameras with all depths clamped in front of the sphere do not contradict those that see it.
    views, everywhere = sphere_frames(around(24)), np.ones((SIZE, SIZE), bool)
    before = [replace(f, depth=np.ones((SIZE, SIZE)), clamped=everywhere, background=None) for f in views]
    np.testing.assert_array_equal(fuse_tsdf([*views, *before], voxel_size=0.05).vertices, ball.vertices)


def test_invalid_depths_are_ignored(ball):
    frames = sphere_frames(around(24))
    for k, value in enumerate((0.0, -1.0, np.nan, np.inf, -np.inf)):
        frames[k] = replace(frames[k], depth=np.where(frames[k].background, value, frames[k].depth))
    mesh = fuse_tsdf(frames, voxel_size=0.05)
    np.testing.assert_array_equal(mesh.vertices, ball.vertices)
    np.testing.assert_array_equal(mesh.faces, ball.faces)


def test_pixels_of_zero_confidence_are_ignored():
    frames = with_phantom(sphere_frames(around(10)), 3.0)
    confidence = np.ones((SIZE, SIZE))
    confidence[:32, :32] = 0.0
    frames = [replace(f, background=None) for f in frames]
    frames[0] = replace(frames[0], confidence=confidence)
    assert pieces(fuse_tsdf(frames, voxel_size=0.05, min_component=0)) == 1


def test_occluded_votes_close_tunnels():
    # A few pixels of one view have depths behind the ball, which makes free space inside of it.
    frames = sphere_frames(around(24))
    depth = frames[0].depth.copy()
    depth[SIZE // 2 - 4 : SIZE // 2 + 4, SIZE // 2 - 4 : SIZE // 2 + 4] = 3.0
    frames[0] = replace(frames[0], depth=depth)

    def inside(mesh):
        return (np.linalg.norm(mesh.vertices, axis=1) < 0.7).sum()

    assert inside(fuse_tsdf(frames, voxel_size=0.05, min_component=0)) > 0
    assert inside(fuse_tsdf(frames, voxel_size=0.05, min_component=0, occluded_vote=0.05)) == 0


# --- votes -----------------------------------------------------------------------------------------------


def votes_in_float64(table, rules, position, pixel, inverse):
    """(value * weight, weight, free) of one surfel per voxel, by the rules in float64."""
    near, far_front, behind, behind_weight, grazed, grazed_reach, grazed_weight, occluded = rules
    rows = table[pixel].astype(np.float64)
    value = rows[:, 3] - (rows[:, :3] * position).sum(1)
    weight, cosine, nearest, free = rows[:, 4:].T
    along = value / cosine
    past, hidden = value > 1, along < -1
    plane = (value > -grazed) & (along > -grazed_reach)
    share = np.where(
        value > 0, np.maximum(1 / (1 + (value / near) ** 2), far_front), np.clip(2 + along / behind, behind_weight, 1)
    )
    late = np.maximum(np.where(plane, weight * grazed_weight, 0), free * occluded)
    if occluded:
        value = np.where(hidden & ~plane, -1, value)
    said = np.where(past, 0, np.where(hidden, late, weight * share))
    return said * np.clip(value, -1, 1), said, np.where(past & (inverse > nearest), free, 0)


@pytest.mark.parametrize("occluded", [0.0, 0.02])
def test_votes_agree_with_float64(occluded):
    rng, camera = np.random.default_rng(3), Camera(40, 30, 51.37, 46.71, 19.31, 15.83, np.eye(4))
    table = rng.normal(size=(camera.width * camera.height, 8)).astype(np.float32)
    table[:, 3] += table[:, 2] * 2  # planes near the blocks
    table[:, 4:] = np.abs(table[:, 4:])
    table[:, 5] = table[:, 5].clip(0.05, 1)
    blocks = np.array([[-1, -1, 2], [0, 0, 2], [0, -2, 3], [5, 5, -1]])
    rules = vote_rules(3.0, 0.75, occluded)
    grid = Grid(blocks, np.zeros(4, np.int64), np.zeros(4, np.int64), np.array([0.0137, 0.0211, 0.0071]), 0.1, 3.0, 8)
    project = np.concatenate([camera.K, (camera.K @ grid.origin)[:, None]], axis=1)
    sums = (grid.total, grid.weight, grid.free)
    rows = np.array([0, 1, 2, 3])
    for _ in range(2):
        surface_ops.add_votes(
            project, camera.width, camera.height, table, rules, rows, grid.corner, grid.voxel, 8, *sums
        )
    k, j, i = (axis.ravel() for axis in np.meshgrid(*[np.arange(8)] * 3, indexing="ij"))
    for b in range(len(blocks)):
        position = grid.corner[b] + 0.1 * np.stack([i, j, k], 1)
        image = position @ project[:, :3].T + project[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = image[:, 0] / image[:, 2], image[:, 1] / image[:, 2]
        inside = (image[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        pixel = np.where(inside, v.astype(int) * camera.width + u.astype(int), 0)
        wanted = votes_in_float64(table, rules, position, pixel, 1 / np.where(inside, image[:, 2], 1))
        for found, each in zip((grid.total[b], grid.weight[b], grid.free[b]), wanted, strict=True):
            # A voxel on the border of two pixels, or of two rules, may fall on either side in float32.
            assert np.isclose(found, 2 * each * inside, rtol=1e-4, atol=1e-5).mean() > 0.995
    assert not grid.weight[3].any() and (grid.weight[:3] > 0).any(1).all()


@pytest.mark.parametrize("voxel", [0.01, 10.0])
def test_in_view_contains_all_visible_blocks_at_any_scale(voxel):
    camera = Camera(40, 30, 50.0, 50.0, 20.0, 15.0, np.eye(4))
    blocks = np.stack([axis.ravel() for axis in np.meshgrid(*[np.arange(-8, 8)] * 3)], axis=1)
    levels = np.zeros(len(blocks), np.int64)
    grid = Grid(blocks, levels, levels, np.zeros(3), voxel, 3.0, 4)
    voxels = np.stack([axis.ravel() for axis in np.meshgrid(*[np.arange(4)] * 3)], axis=1)
    pixels, depth = camera.project((voxel * (4 * blocks[:, None] + voxels + 0.5)).reshape(-1, 3))
    shown = camera.shows(pixels, depth).reshape(len(blocks), -1).any(1)
    seen = np.isin(np.arange(len(blocks)), grid.in_view(camera))
    assert shown.sum() > 100 and seen[shown].all()
    assert seen.sum() < 3 * shown.sum()  # spheres around blocks reach into view before these do


# --- contract --------------------------------------------------------------------------------------------


def test_results_do_not_depend_on_threads():
    frames, meshes = sphere_frames(around(8)), []
    for count in (1, 2, 3):
        ops.set_threads(count)
        meshes.append(fuse_tsdf(frames, voxel_size=0.06))
    ops.set_threads(0)
    one, again, many = meshes
    for name in ("vertices", "faces", "normals"):
        assert getattr(one, name).tobytes() == getattr(many, name).tobytes()
        assert getattr(one, name).tobytes() == getattr(again, name).tobytes()


def test_too_small_voxels_are_refused_with_a_size_that_fits():
    frames = sphere_frames(around(6))
    with pytest.raises(LinprimError, match="a voxel size of (.*) fits") as caught:
        fuse_tsdf(frames, voxel_size=0.01, memory_limit=60 * 2**20)
    size = float(str(caught.value).split("voxel size of ")[1].split()[0])
    assert 0.01 < size < 0.1
    lines = []
    assert len(fuse_tsdf(frames, voxel_size=size, memory_limit=60 * 2**20, log=lines.append).faces) > 0
    assert "MiB of 60 MiB" in lines[0]


def test_invalid_input_is_refused():
    frames = sphere_frames(around(3))
    empty = [replace(f, depth=np.zeros_like(f.depth)) for f in frames]
    for wrong, message in (
        (lambda: fuse_tsdf(empty, voxel_size=0.1), "none of the 3 depth maps"),
        (lambda: fuse_tsdf([], voxel_size=0.1), "none of the 0 depth maps"),
        (lambda: fuse.auto_voxel_size(empty), "no depth map holds a surface"),
        (lambda: fuse_tsdf(frames, voxel_size=0.1, bounds=[[5] * 3, [6] * 3]), r"inside \[5.0, 5.0, 5.0\] to"),
        (lambda: fuse_tsdf(frames, voxel_size=0.1, bounds=[[1] * 3, [0] * 3]), "bounds are"),
        (lambda: fuse_tsdf(frames, voxel_size=float("nan")), "voxel size is nan"),
        (lambda: fuse_tsdf(frames, voxel_size=1e-8), "what a pixel covers"),
        (lambda: fuse_tsdf(frames, voxel_size=0.1, truncation_voxels=0.5), "truncation is 0.5"),
        (lambda: replace(frames[0], depth=np.zeros((3, 4))), r"depth is \(3, 4\)"),
    ):
        with pytest.raises(LinprimError, match=message):
            wrong()


def test_an_iterator_is_refused():
    with pytest.raises(TypeError, match="only once"):
        fuse_tsdf(iter(sphere_frames(around(3))), voxel_size=0.1)


def test_a_surface_contradicted_by_all_other_views_is_removed():
    frames = with_phantom(sphere_frames(around(24)), 3.0)
    blind = [replace(frames[0], depth=np.where(frames[0].depth == 3.0, 3.0, 0.0), background=None)]
    blind += [replace(f, depth=np.zeros_like(f.depth), background=np.ones_like(f.background)) for f in frames[1:]]
    with pytest.raises(LinprimError, match="gave no surface"):
        fuse_tsdf(blind, voxel_size=0.05)


def test_auto_voxel_size_follows_the_pixels(monkeypatch):
    # Footprint: depth of about 2.2 over a focal length of 154 pixels.
    coarse = fuse.auto_voxel_size(sphere_frames(around(12)))
    assert 0.012 < coarse < 0.018
    fine_frames = sphere_frames(around(12, size=256))
    # Rounded to two digits.
    assert fuse.auto_voxel_size(fine_frames) == pytest.approx(coarse / 2, rel=0.03)
    # Held back by the number of faces: those of a sphere of radius 1.
    monkeypatch.setattr(fuse, "MOST_FACES", 1e5)
    held = fuse.auto_voxel_size(fine_frames)
    assert held == pytest.approx(np.sqrt(3 * 4 * np.pi / 1e5), rel=0.1)
    faces = len(fuse.fuse_tsdf(sphere_frames(around(12)), voxel_size=held).faces)
    assert 0.8e5 < faces < 1.2e5


# --- what cameras see ------------------------------------------------------------------------------------


def paint(points: np.ndarray) -> np.ndarray:
    return np.clip(np.round(127.5 + 100 * np.sin(2 * points)), 0, 255).astype(np.uint8)


def test_vertex_colours_agree_with_photographs(ball):
    frames = sphere_frames(around(24))
    cameras = [frame.camera for frame in frames]
    pictures = []
    for frame in frames:
        points = frame.camera.world_rays() * frame.depth[..., None] + frame.camera.center
        pictures.append(np.where(frame.background[..., None], 0, paint(points)).astype(np.uint8))
    # The median is robust against one wrong photograph.
    pictures[5] = 255 - pictures[5]
    colors = visibility.color_vertices(ball, cameras, pictures)
    error = np.abs(colors.astype(int) - paint(ball.vertices))
    assert np.quantile(error, 0.99) <= 6 and error.mean() < 1.5
    floats = [picture / np.float32(255) for picture in pictures]
    again = visibility.color_vertices(ball, cameras, floats, MeshViews(ball.vertices, ball.faces))
    assert np.abs(again.astype(int) - colors).max() <= 1


def test_unseen_vertices_take_colours_of_neighbours_or_grey(ball):
    camera = look_at([3, 0, 0])
    red = np.zeros((SIZE, SIZE, 3), dtype=np.uint8)
    red[..., 0] = 200
    assert (visibility.color_vertices(ball, [camera], [red]) == [200, 0, 0]).all()
    away = look_at([3, 0, 0], target=(6, 0, 0))
    assert (visibility.color_vertices(ball, [away], [red]) == 128).all()
    with pytest.raises(LinprimError, match="64x64"):
        visibility.color_vertices(ball, [camera], [red[:64, :64]])


def test_occluders_do_not_colour_surfaces_behind_them(ball):
    both = Mesh(
        np.concatenate([ball.vertices, 0.5 * ball.vertices + [2.0, 0, 0]]),
        np.concatenate([ball.faces, ball.faces + len(ball.vertices)]),
    )
    # From +x the small green ball hides the middle of the large red one; from the side it does not.
    cameras, pictures = [look_at([6, 0, 0]), look_at([3, 4, 1])], []
    for camera in cameras:
        large, small = sphere_depth(camera), sphere_depth(camera, 0.5, (2.0, 0, 0))
        green = (small > 0) & ((large == 0) | (small < large))
        pictures.append(np.where(green[..., None], [0, 200, 0], [200, 0, 0]).astype(np.uint8))
    hidden = np.flatnonzero(ball.vertices[:, 0] > 0.9)
    assert len(hidden) > 100
    for count in (1, 2):  # with the first view alone, red comes from the neighbours
        colors = visibility.color_vertices(both, cameras[:count], pictures[:count])
        assert (colors[hidden] == [200, 0, 0]).all(1).mean() > 0.95


def test_visible_faces_are_in_view_and_unoccluded(ball):
    camera = look_at([3, 0, 0])
    centers = ball.vertices[ball.faces].mean(1)
    height = centers[:, 0]  # the horizon of a sphere seen from distance 3 is at 1/3
    seen = visibility.visible_faces(ball, [camera])
    assert seen[height > 1 / 3 + 0.05].all() and not seen[height < 1 / 3 - 0.05].any()
    core = Mesh(
        np.concatenate([ball.vertices, 0.5 * ball.vertices]),
        np.concatenate([ball.faces, ball.faces + len(ball.vertices)]),
    )
    every = visibility.visible_faces(core, around(12))
    assert every[: len(ball.faces)].all() and not every[len(ball.faces) :].any()
    assert not visibility.visible_faces(ball, [look_at([3, 0, 0], target=(6, 0, 0))]).any()


def test_faces_smaller_than_pixels_are_visible(ball):
    coarse = around(12, size=8)
    assert visibility.visible_faces(ball, coarse).all()


def test_a_preview_shows_the_mesh(ball):
    camera = look_at([3, 0, 0])
    picture = visibility.render_preview(ball, camera, supersample=1)
    inside = sphere_depth(camera, 1.0) > 0
    drawn = (picture != 255).any(2)
    assert (drawn == inside).mean() > 0.99
    assert picture[SIZE // 2, SIZE // 2].min() > 200  # lit from the front
    error = visibility.render_preview(ball, camera, colors=error_colors(np.ones(len(ball.vertices))))
    assert error[SIZE // 2, SIZE // 2, 0] > 2 * error[SIZE // 2, SIZE // 2, 2]  # yellow
    flipped = visibility.render_preview(replace(ball, faces=ball.faces[:, ::-1]), camera)
    assert flipped[SIZE // 2, SIZE // 2, 2] > flipped[SIZE // 2, SIZE // 2, 0] + 30  # bluish from behind
