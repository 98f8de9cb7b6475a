"""Voxel sizes: small on curved surfaces, large on flat ones, limited by pixels and noise."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, select_faces
from linprim_geo.geometry.topology import topology
from linprim_geo.surface.fusion.tsdf_field import DepthFrame, vote_rules
from linprim_geo.surface.fusion.tsdf_fusion import fuse_lattice, fuse_tsdf
from linprim_geo.surface.fusion.voxel_blocks import (
    Lattice,
    NearBlocks,
    TooFine,
    block_keys,
    estimate_memory,
    find_blocks,
    touching,
    unpack_keys,
)
from linprim_geo.surface.fusion.voxel_levels import COARSE_RATIO, NOISE_VOXELS, VoxelLevels
from linprim_geo.synthetic.camera_paths import look_at

SIZE, FOCAL, RADIUS = 160, 200.0, 0.12
USUAL = 0.02
"""Of the scene's voxels, were all as large. Pixels cover 0.01."""


def camera(eye) -> Camera:
    eye = np.asarray(eye, float)
    return Camera(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, look_at(eye, np.zeros(3)))


def around(count=16, height=1.6) -> list[Camera]:
    angles = 2 * np.pi * (np.arange(count) + 0.5) / count
    return [camera((1.2 * np.cos(angle), 1.2 * np.sin(angle), height)) for angle in angles]


def ball_on_floor(cameras, noise=0.0, rod=0.0) -> list[DepthFrame]:
    """Depths of the floor z = 0, a ball on it, and a rod of radius `rod` along y above it, with noise."""
    rng, frames = np.random.default_rng(0), []
    for each in cameras:
        rays, eye = each.world_rays(), each.center
        depth = -eye[2] / rays[..., 2]
        depth = np.where((np.abs(eye + depth[..., None] * rays)[..., :2] < 1.3).all(-1), depth, 0)
        for middle, radius, axes in (((0, 0, RADIUS), RADIUS, (0, 1, 2)), ((0.5, 0, 0.3), rod, (0, 2))):
            d, start = rays[..., axes], (eye - middle)[list(axes)]
            a, b = (d**2).sum(-1), d @ start
            root = b**2 - a * (start @ start - radius**2)
            there = root > 0
            nearest = (-b - np.sqrt(np.maximum(root, 0))) / a
            there &= (np.abs(eye + nearest[..., None] * rays)[..., 1] < 0.8) & (radius > 0)
            depth = np.where(there & ((depth <= 0) | (nearest < depth)), nearest, depth)
        depth = np.where(depth > 0, depth * (1 + noise * rng.standard_normal(depth.shape)), 0)
        frames.append(DepthFrame(each, depth.astype(np.float32), background=depth == 0))
    return frames


def coarse_lattice(frames) -> Lattice:
    blocks, origin, _ = find_blocks(frames, COARSE_RATIO * USUAL, 3.0, None, 4, np.inf)
    rules = vote_rules(3.0, 0.75, 0.0)
    levels = np.zeros(len(blocks), np.int64)
    return Lattice(blocks, levels, levels, origin, COARSE_RATIO * USUAL, 4, 3.0, rules)


def split(frames, most_faces=1e6, limit=np.inf) -> Lattice:
    lattice = coarse_lattice(frames)
    return VoxelLevels(lattice, fuse_lattice(lattice, frames), frames, most_faces, limit).lattice


def fused(frames, **options) -> Mesh:
    return fuse_tsdf(frames, voxel_size=USUAL, relevant_part=lambda surface: surface, **options)


def edges_near(mesh: Mesh, near) -> float:
    """Median edge length of faces whose centres satisfy `near`."""
    corners = mesh.vertices[mesh.faces]
    corners = corners[near(corners.mean(1))]
    return float(np.median(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)))


def on_ball(points: np.ndarray) -> np.ndarray:
    return points[:, 2] > 0.05


def ball_error(mesh: Mesh) -> float:
    on = mesh.vertices[on_ball(mesh.vertices)]
    return float(np.abs(np.linalg.norm(on - [0, 0, RADIUS], axis=1) - RADIUS).mean())


@pytest.fixture(scope="module")
def frames():
    return ball_on_floor(around())


@pytest.fixture(scope="module")
def mesh(frames):
    return fused(frames)


def test_voxels_are_small_on_a_ball_and_large_on_the_floor(frames, mesh):
    uniform = fuse_tsdf(frames, voxel_size=USUAL)
    floor = lambda points: (np.linalg.norm(points[:, :2], axis=1) > 0.6) & (np.abs(points).max(1) < 0.9)  # noqa: E731
    assert edges_near(mesh, floor) == pytest.approx(COARSE_RATIO * edges_near(uniform, floor), rel=0.1)
    assert edges_near(mesh, on_ball) < edges_near(uniform, on_ball) / 1.8
    assert ball_error(mesh) < ball_error(uniform) / 1.4
    flat = mesh.vertices[floor(mesh.vertices)]
    assert np.abs(flat[:, 2]).max() < 0.0061 * COARSE_RATIO * USUAL  # see tsdf_field.ZERO_GAP


def test_no_cracks_where_voxel_sizes_change(mesh):
    assert topology(mesh)["non_manifold_edges"] == 0
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    ends = mesh.vertices[edges[count == 1]].mean(1)[:, :2]
    # Borders are at the end of the floor and below the ball, which no camera sees.
    assert ((np.linalg.norm(ends, axis=1) > 0.8) | (np.linalg.norm(ends, axis=1) < 1.2 * RADIUS)).all() and len(ends)


def test_blocks_do_not_overlap_and_adjacent_levels_differ_by_one(frames):
    lattice = split(frames)
    assert len(np.unique(lattice.levels)) >= 3
    parents = [np.unique(block_keys(lattice.blocks[lattice.levels == level])) for level in range(5)]
    for level in range(5):
        blocks = unpack_keys(parents[level])
        for larger in range(level + 1, 5):
            assert not np.isin(block_keys(blocks >> (larger - level)), parents[larger]).any()
        around = unpack_keys(np.unique(touching(blocks))) if len(blocks) else blocks
        for larger in range(level + 2, 5):
            assert not np.isin(block_keys(around >> (larger - level)), parents[larger]).any()


def test_the_number_of_faces_is_limited(frames):
    counts = [len(fuse_lattice(split(frames, most), frames).faces) for most in (1e6, 20_000, 100)]
    assert counts[0] > 30_000 and 15_000 < counts[1] < 20_000 and counts[1] >= counts[2]


def test_noise_limits_the_smallest_voxels(frames):
    """Noise of 0.5 % of depths of 2 at 45 degrees. Times NOISE_VOXELS, it is about as large as the usual voxel."""
    small = lambda lattice: (lattice.voxel_sizes() < 0.9 * USUAL).sum()  # noqa: E731
    assert NOISE_VOXELS * 0.005 * 2 * np.sqrt(0.5) > 0.9 * USUAL
    assert small(split(ball_on_floor(around(), noise=0.005))) < small(split(frames)) / 10


def test_surfaces_missing_in_coarse_voxels_get_usual_voxels():
    """A rod much thinner than a coarse voxel."""
    rod = ball_on_floor(around(24), rod=0.45 * USUAL)
    on_rod = lambda points: (points[:, 2] > 0.25).sum()  # noqa: E731
    coarse = fuse_tsdf(rod, voxel_size=COARSE_RATIO * USUAL, min_component=0)
    usual = fuse_tsdf(rod, voxel_size=USUAL, min_component=0)
    assert on_rod(coarse.vertices) < on_rod(usual.vertices) / 20
    found = fused(rod, min_component=0)
    assert on_rod(found.vertices) > 0.8 * on_rod(usual.vertices)


def test_curved_parts_are_refined_although_usual_voxels_exceed_the_faces(frames):
    """Outliers in depths of the floor would take more faces than are allowed."""
    rng, off = np.random.default_rng(0), []
    for frame in frames:
        floor = np.abs(frame.depth * frame.camera.world_rays()[..., 2] + frame.camera.center[2]) < 1e-3
        away = floor & (rng.random(floor.shape) < 0.15)
        off.append(replace(frame, depth=np.where(away, 0.97 * frame.depth, frame.depth).astype(np.float32)))
    lattice = coarse_lattice(frames)
    surface = fuse_lattice(lattice, frames)
    found = VoxelLevels(lattice, surface, off, 2.0 * len(surface.faces)).lattice
    assert found is not lattice and (found.levels == 0).any() and (found.levels >= 2).any()


def test_a_plane_alone_stays_coarse():
    plane = [
        DepthFrame(each, (-each.center[2] / each.world_rays()[..., 2]).astype(np.float32))
        for each in around(6, height=3.0)
    ]
    lattice = coarse_lattice(plane)
    assert VoxelLevels(lattice, fuse_lattice(lattice, plane), plane, 1e6).lattice is lattice


def test_depths_without_surface_get_usual_voxels_only(frames):
    lattice = coarse_lattice(frames)
    surface = fuse_lattice(lattice, frames)
    floor = np.linalg.norm(surface.vertices[:, :2], axis=1) > 0.4
    inner = np.abs(surface.vertices).max(1) < 0.7
    floor = Mesh(surface.vertices[floor & inner], np.zeros((0, 3), np.int64))
    # Blocks with depths but without surface get the usual voxels.
    assert VoxelLevels(lattice, floor, frames, 1e6).lattice.voxel == pytest.approx(USUAL)


def test_torn_blocks_are_coarsened(frames):
    """The fine surface has a hole at the top of the ball, which the coarse one has not."""
    lattice = coarse_lattice(frames)
    coarse = fuse_lattice(lattice, frames)
    levels = VoxelLevels(lattice, coarse, frames, 1e6)
    fine = fuse_lattice(levels.lattice, frames)
    assert not levels.coarsen_torn_blocks(coarse, fine)  # borders of both surfaces are no tears
    hole = np.linalg.norm(fine.vertices[fine.faces].mean(1) - [0, 0, 2 * RADIUS], axis=1) > 0.04
    at_top = lambda points: np.linalg.norm(points - [0, 0, 2 * RADIUS], axis=1) < 0.03  # noqa: E731
    assert edges_near(fine, at_top) < 0.6 * USUAL
    assert hole.any() and levels.coarsen_torn_blocks(coarse, select_faces(fine, hole))
    mended = fuse_lattice(levels.lattice, frames)
    assert edges_near(mended, at_top) > 0.6 * USUAL and levels.lattice.voxel < USUAL  # no other block was torn
    assert mended.vertices[:, 2].max() > 1.9 * RADIUS and topology(mended)["non_manifold_edges"] == 0


def test_memory_limits_the_refinement(frames):
    whole, coarse = split(frames), coarse_lattice(frames)
    need = [estimate_memory(len(each.blocks), 4, SIZE**2) for each in (coarse, whole)]
    limit = (need[0] + need[1]) // 2
    limited = split(frames, limit=limit)
    assert need[0] < estimate_memory(len(limited.blocks), 4, SIZE**2) <= limit
    assert len(split(frames, limit=need[0]).blocks) == len(coarse.blocks)


def test_a_coarse_field_that_exceeds_memory_is_refused_with_a_size_that_fits(frames):
    with pytest.raises(TooFine) as caught:
        fused(frames, memory_limit=9_000_000)
    found = fuse_tsdf(
        frames, voxel_size=caught.value.fits, relevant_part=lambda surface: surface, memory_limit=9_000_000
    )
    assert caught.value.fits > USUAL and len(found.faces) > 1000
    sizes = f"voxel size {USUAL:.4g} needs .* allowed: a voxel size of {caught.value.fits:.2g} fits"
    assert re.fullmatch(sizes, str(caught.value))


def test_distant_points_are_in_separate_blocks():
    """Keys of pairs of voxels hold two million voxels on either side."""
    place = np.array([[1.0, -1.0, 1.0], [-1.0, 1.0, 1.0], [0.25, 0.5, -1.0]]) * 2_000_000
    near = NearBlocks(1.0, 3.0, 4)
    near.add(place)
    blocks = unpack_keys(near.keys())
    gap = np.abs(blocks[:, None] * 4 + 2 - place).max(2).min(1)
    assert gap.max() <= 3 + 2 + 2 and (np.abs(blocks[:, None] * 4 + 2 - place).max(2).min(0) <= 2).all()
    with pytest.raises(LinprimError, match="a few million voxels"):
        near.add(1.1 * place)
