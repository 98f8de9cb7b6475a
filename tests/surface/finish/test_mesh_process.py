"""Processing of meshes: volume, topology and attributes are kept, and steps that cannot be done are reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.surfaces import grid, join, sphere

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions
from linprim_geo.eval.surface_samples import SurfaceDistance
from linprim_geo.geometry.mesh import Mesh, select_faces
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.topology import manifold_status, topology
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.surface.finish import mesh_process
from linprim_geo.surface.finish.mesh_process import (
    close_holes,
    process_mesh,
    remesh,
    simplify,
    smooth,
    within_tolerance,
)
from linprim_geo.surface.normals import vertex_normals

STEPS = (
    lambda mesh: simplify(mesh, 200),
    lambda mesh: smooth(mesh, 5),
    lambda mesh: remesh(mesh, 0.12),
    lambda mesh: close_holes(mesh, 20),
)
NAMES = ("simplify", "smooth", "remesh", "close_holes")
ALL_STEPS = (*STEPS, lambda mesh: within_tolerance(mesh, 0.01))


def painted(mesh):
    """The mesh with colours and quality that are linear in position."""
    low, high = mesh.bounds
    share = (mesh.vertices - low) / np.maximum(high - low, 1e-30)
    return replace(mesh, colors=np.round(255 * share), quality=share[:, 0], normals=vertex_normals(mesh))


def torus(around=40, across=20):
    u, v = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    a, b = 2 * np.pi * u.ravel() / around, 2 * np.pi * v.ravel() / across
    vertices = np.stack([(1 + 0.4 * np.cos(b)) * np.cos(a), (1 + 0.4 * np.cos(b)) * np.sin(a), 0.4 * np.sin(b)], 1)

    def at(i, j):
        return (i % around * across + j % across).ravel()

    p, q, r, s = at(u, v), at(u + 1, v), at(u + 1, v + 1), at(u, v + 1)
    return Mesh(vertices, np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)]))


def noisy_sphere(noise=0.01):
    mesh = sphere(rounds=4)
    outward = np.random.default_rng(0).normal(1.0, noise, (len(mesh.vertices), 1))
    return replace(mesh, vertices=mesh.vertices * outward)


def punctured(mesh, corner):
    """The mesh without the faces around one vertex."""
    return select_faces(mesh, ~(mesh.faces == corner).any(1))


def radii(mesh):
    return np.linalg.norm(mesh.vertices, axis=1)


def test_simplify_keeps_the_outline_of_a_flat_grid():
    flat = simplify(grid(20, 10), 64)
    assert (
        58 <= len(flat.faces) <= 64
        and topology(flat)["boundary_edges"] == 60
        and topology(flat)["non_manifold_edges"] == 0
    )
    assert topology(flat)["area"] == pytest.approx(2.0, abs=1e-9) and np.abs(flat.vertices[:, 2]).max() < 1e-9


@pytest.mark.parametrize("step", STEPS, ids=NAMES)
def test_a_torus_stays_a_closed_torus(step):
    before = torus()
    after = step(before)
    shape = topology(after)
    assert shape["watertight"] and shape["genus"] == 1 and shape["components"] == 1
    assert manifold_status(after) == "NoError"
    assert shape["volume"] == pytest.approx(topology(before)["volume"], rel=0.03)


@pytest.mark.parametrize("step", STEPS, ids=NAMES)
def test_results_are_reproducible_and_independent_of_position(step):
    mesh = painted(punctured(sphere(rounds=3), 7))
    once, again = step(mesh), step(mesh)
    for name in ("vertices", "faces", "normals", "colors", "quality"):
        np.testing.assert_array_equal(getattr(once, name), getattr(again, name))
    moved = step(replace(mesh, vertices=mesh.vertices + [1e6, -2e6, 5e5]))
    back = moved.vertices - [1e6, -2e6, 5e5]
    # Coordinates of 2e6 are rounded by 2e-10 (0.1 in float32), so collapses of equal cost may change order.
    assert abs(len(back) - len(once.vertices)) <= 0.02 * len(once.vertices)
    assert np.abs(radii(replace(moved, vertices=back)) - 1).max() <= np.abs(radii(once) - 1).max() + 0.02


@pytest.mark.parametrize("step", STEPS, ids=NAMES)
def test_attributes_are_interpolated(step):
    mesh = painted(sphere(rounds=4))
    after = step(mesh)
    expected = painted(after)
    assert np.abs(after.colors.astype(float) - 127.5 * (after.vertices + 1)).max() < 8
    assert np.abs(after.quality - 0.5 * (after.vertices[:, 0] + 1)).max() < 0.03
    np.testing.assert_array_equal(after.normals, expected.normals)
    bare = step(sphere(rounds=3))
    assert bare.colors is None and bare.quality is None and bare.normals is None


def test_simplifying_keeps_a_tenth_of_the_faces_on_the_surface():
    mesh = sphere(rounds=4)
    tenth = simplify(mesh, len(mesh.faces) // 10)
    assert len(tenth.faces) == len(mesh.faces) // 10
    distance, _ = SurfaceDistance(mesh).query(tenth.vertices)
    assert distance.max() < 0.03 and topology(tenth)["volume"] == pytest.approx(4 / 3 * np.pi, rel=0.04)


def test_smoothing_reduces_noise_and_keeps_the_volume():
    rough = noisy_sphere()
    done = smooth(rough, 20)
    assert radii(done).std() < 0.5 * radii(rough).std()
    assert topology(done)["volume"] == pytest.approx(topology(rough)["volume"], rel=5e-3)
    clean = sphere(rounds=4)
    assert topology(smooth(clean, 20))["volume"] == pytest.approx(topology(clean)["volume"], rel=5e-3)
    np.testing.assert_array_equal(done.faces, rough.faces)


def test_only_holes_up_to_the_given_size_are_closed():
    ball = sphere(rounds=3)
    six = punctured(ball, len(ball.vertices) - 1)
    big = select_faces(six, six.vertices[six.faces].mean(1)[:, 2] < 0.6)
    edges = topology(big)["boundary_edges"] - 6
    assert edges > 12
    small_closed = close_holes(big, 10)
    assert topology(small_closed)["boundary_edges"] == edges
    all_closed = close_holes(big, edges)
    assert topology(all_closed)["watertight"] and manifold_status(all_closed) == "NoError"
    np.testing.assert_array_equal(all_closed.vertices, big.vertices)
    np.testing.assert_array_equal(all_closed.faces[: len(big.faces)], big.faces)


def test_patches_with_non_manifold_edges_are_rejected():
    old = np.array([[0, 1, 2], [0, 2, 3]])
    added = np.array([[2, 1, 0], [0, 2, 4], [5, 6, 7]])
    assert mesh_process._sound_patches(old, added).tolist() == [False, False, True]


def test_remeshed_triangles_are_even():
    long = grid(40, 2)
    even = remesh(long, 0.1)
    ends = even.vertices[even.faces] - even.vertices[np.roll(even.faces, 1, axis=1)]
    lengths = np.linalg.norm(ends, axis=2)
    assert 0.07 < np.median(lengths) < 0.13 and lengths.max() < 0.25
    assert topology(even)["area"] == pytest.approx(2.0, rel=1e-6)


def test_steps_are_reported_in_order(capsys):
    mesh, lines = painted(punctured(sphere(rounds=4), 300)), []
    options = ExtractOptions(close_holes=10, smooth=3, remesh=0.1, tolerance=0.002, target_faces=300)
    done, steps = process_mesh(mesh, options, lines.append)
    names = ["close_holes", "smooth", "remesh", "simplify", "simplify"]
    assert [step["step"] for step in steps] == names and len(lines) == len(names) and steps[3]["tolerance"] == 0.002
    assert steps[0]["faces_before"] == len(mesh.faces) and steps[-1]["faces_after"] == len(done.faces) == 300
    for one, other in zip(steps, steps[1:], strict=False):
        assert one["faces_after"] == other["faces_before"]
    assert [step["topology_kept"] for step in steps] == [False, True, True, True, True]
    assert all(step["watertight"] for step in steps) and topology(done)["genus"] == 0
    assert process_mesh(mesh, ExtractOptions()) == (mesh, [])


def test_meshes_with_fewer_faces_than_the_target_are_unchanged():
    mesh = sphere(rounds=2)
    done, (step,) = process_mesh(mesh, ExtractOptions(target_faces=10_000))
    assert done is mesh and "left as it is" in step["note"] and step["topology_kept"]
    assert "no holes" in process_mesh(mesh, ExtractOptions(close_holes=9))[1][0]["note"]


def test_topology_takes_precedence_over_the_target_number_of_faces():
    several = join(*(sphere(center=(3.0 * k, 0, 0), rounds=1) for k in range(5)))
    done, (step,) = process_mesh(several, ExtractOptions(target_faces=8))
    assert len(done.faces) > 8 and "no fewer than" in step["note"] and topology(done)["components"] == 5


def test_libigl_simplifies_closed_meshes_that_pymeshlab_opens(monkeypatch):
    def opened(mesh, name, **parameters):
        return punctured(real(mesh, name, **parameters), 3)

    real = mesh_process._filtered
    monkeypatch.setattr(mesh_process, "_filtered", opened)
    done, (step,) = process_mesh(painted(torus()), ExtractOptions(target_faces=400))
    assert topology(done)["watertight"] and topology(done)["genus"] == 1 and len(done.faces) <= 400
    assert "libigl" in step["note"] and step["topology_kept"] and done.colors is not None
    mesh = torus()
    assert remesh(mesh, 0.2) is mesh  # there is no fallback for remeshing
    monkeypatch.setattr(mesh_process, "_decimated", lambda mesh, target: punctured(mesh, 3))
    assert simplify(mesh, 400) is mesh


@pytest.mark.parametrize("step", ALL_STEPS, ids=(*NAMES, "within_tolerance"))
def test_invalid_meshes_are_refused(step):
    good = sphere(rounds=2)
    broken = good.vertices.copy()
    broken[5, 1] = np.nan
    for mesh, match in (
        (Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)), "is empty"),
        (replace(good, faces=good.faces[:0]), "is empty"),
        (replace(good, vertices=broken), "vertex 5 of the mesh is not finite"),
        (replace(good, faces=good.faces + 60), "has 66 vertices"),
        (replace(good, vertices=np.zeros_like(good.vertices)), "in one point"),
    ):
        with pytest.raises(LinprimError, match=match):
            step(mesh)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda m: simplify(m, 3), "--target-faces is 3"),
        (lambda m: smooth(m, -1), "--smooth is -1"),
        (lambda m: close_holes(m, -2), "--close-holes is -2"),
        (lambda m: remesh(m, 9.0), "--remesh is 9"),
        (lambda m: remesh(m, 1e-5), "--remesh is 1e-05.*0.0012 or more"),
        (lambda m: remesh(m, float("nan")), "--remesh is nan"),
        (lambda m: within_tolerance(m, 0.0), "--tolerance is 0.0"),
        (lambda m: within_tolerance(m, float("nan")), "--tolerance is nan"),
        (lambda m: within_tolerance(m, "auto"), "--tolerance is auto, but the mesh has no predicted errors"),
    ],
)
def test_invalid_parameters_are_refused(call, match):
    with pytest.raises(LinprimError, match=match):
        call(sphere(rounds=2))


def test_non_manifold_edges_and_degenerate_faces_are_harmless():
    fan = Mesh(
        [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, -1, 0], [0, 0, 0.5]],
        [[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 5, 1]],
    )
    for step in ALL_STEPS:
        assert len(step(fan).faces) and np.isfinite(step(fan).vertices).all()


def test_extraction_finishes_the_mesh(solid, tmp_path):
    options = ExtractOptions(voxel_size=0.08, smooth=2, target_faces=400)
    stats = extract_mesh(solid, output=tmp_path / "m.ply", options=options, quiet=True)
    mesh = load_mesh(tmp_path / "m.ply")
    assert stats["faces"] == len(mesh.faces) == 400 and len(stats["processing"]) == 2
    assert stats["seconds"]["process"] > 0 and [step["step"] for step in stats["processing"]] == ["smooth", "simplify"]
    assert mesh.colors is not None and mesh.quality is not None and mesh.normals is not None
    assert stats["watertight"] and stats["manifold_status"] == "NoError"
