"""Primitives: vertices, faces and volumes of each kind compared with closed forms, and the file format."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.kinds import KINDS
from linprim_geo.geometry.primitives import ARRAYS, Primitives, load_primitives, save_primitives


def some(kind: str, count: int = 20, seed: int = 0) -> Primitives:
    rng = np.random.default_rng(seed)
    rotation = rng.normal(size=(count, 4))
    return Primitives(
        rng.normal(size=(count, 3)),
        rotation / np.linalg.norm(rotation, axis=1, keepdims=True),
        np.exp(rng.normal(-1, 0.7, (count, KINDS[kind].extents))),
        rng.uniform(0, 1, count),
        rng.normal(size=(count, 4, 3)),
        kind,
    )


def corners_of(primitives: Primitives) -> np.ndarray:
    """(N, F, 3, 3) corners of the faces of the mesh."""
    mesh = primitives.triangle_mesh()
    return mesh.vertices[mesh.faces].reshape(len(primitives), -1, 3, 3)


def test_vertices_of_a_tetrahedron_follow_its_definition():
    primitives = some("tetrahedron")
    for row in range(len(primitives)):
        for j, b in enumerate([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]):
            expected = primitives.center[row] + primitives.extent[row, j] * primitives.axes[row] @ np.array(
                b
            ) / math.sqrt(3)
            np.testing.assert_allclose(primitives.vertices[row, j], expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", ["octahedron", "tetrahedron"])
def test_faces_point_outward_and_close_the_solid(kind):
    primitives = some(kind)
    corners = corners_of(primitives)
    normal = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    away = corners.mean(2) - primitives.center[:, None].astype(np.float64)
    assert (np.einsum("nfi,nfi->nf", normal, away) > 0).all()
    # The vector areas of a closed surface sum to zero.
    assert np.abs(normal.sum(1)).max() < 1e-12 * np.abs(normal).max() * len(primitives)
    for j, face in enumerate(KINDS["tetrahedron"].faces):
        assert j not in face


def test_size_of_a_kind_gives_the_volume_of_an_octahedron():
    def volume(kind):
        extent = np.full((1, KINDS[kind].extents), KINDS[kind].size)
        one = Primitives(np.zeros((1, 3)), [[1, 0, 0, 0]], extent, [1.0], np.zeros((1, 1, 3)), kind)
        corners = corners_of(one)[0]
        return np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6

    # Extents are float32.
    assert volume("octahedron") == pytest.approx(4 / 3, rel=1e-6)
    assert volume("tetrahedron") == pytest.approx(4 / 3, rel=1e-6)


@pytest.mark.parametrize("kind", ["octahedron", "tetrahedron"])
def test_alpha_is_the_absorption_along_the_reference_length(kind):
    primitives = some(kind)
    length = KINDS[kind].reference_length(primitives.extent.astype(np.float64))
    np.testing.assert_allclose(primitives.alpha, 1 - np.exp(-primitives.density * length), rtol=1e-6)
    assert (some("gaussian").alpha == some("gaussian").density).all()


def test_mesh_of_gaussians_needs_a_number_of_sigmas():
    gaussians = some("gaussian", 5)
    for make in (lambda: gaussians.vertices, gaussians.triangle_mesh):
        with pytest.raises(LinprimError, match="Gaussians have no vertices"):
            make()
    mesh = gaussians.triangle_mesh(sigmas=2.0)
    assert mesh.vertices.shape == (5 * 42, 3) and mesh.faces.shape == (5 * 80, 3)
    away = mesh.vertices.reshape(5, 42, 3) - gaussians.center[:, None]
    local = np.einsum("nij,nvi->nvj", gaussians.axes, away) / gaussians.extent[:, None]
    np.testing.assert_allclose(np.linalg.norm(local, axis=2), 2.0, rtol=1e-6)


def test_octahedra_become_gaussians_of_the_same_opacity():
    octahedra = some("octahedron")
    gaussians = octahedra.as_gaussians()
    assert gaussians.kind == "gaussian"
    np.testing.assert_allclose(gaussians.extent, octahedra.extent / 2.6, rtol=1e-6)
    np.testing.assert_allclose(gaussians.density, octahedra.alpha, rtol=1e-6)
    with pytest.raises(LinprimError, match="tetrahedra cannot be written as Gaussians"):
        some("tetrahedron").as_gaussians()


@pytest.mark.parametrize("kind", KINDS)
def test_npz_round_trip_keeps_every_bit_and_the_kind(kind, tmp_path):
    before = some(kind)
    save_primitives(tmp_path / "x.npz", before)
    after = load_primitives(tmp_path / "x.npz")
    assert after.kind == kind
    for name in ARRAYS:
        assert getattr(after, name).tobytes() == getattr(before, name).tobytes()


def test_a_file_without_a_kind_holds_octahedra(tmp_path):
    before = some("octahedron")
    arrays = {name: getattr(before, name) for name in ARRAYS}
    np.savez(tmp_path / "x.npz", format=np.array("linprim-geo octahedra 1"), **arrays)
    after = load_primitives(tmp_path / "x.npz")
    assert after.kind == "octahedron" and (after.extent == before.extent).all()
    np.savez(tmp_path / "y.npz", format=np.array("linprim-geo primitives 2"), **arrays)
    with pytest.raises(LinprimError, match="y.npz: the array kind is missing"):
        load_primitives(tmp_path / "y.npz")
    np.savez(tmp_path / "z.npz", format=np.array("linprim-geo primitives 2"), kind=np.array("cube"), **arrays)
    with pytest.raises(LinprimError, match="z.npz: primitives are of the kind 'cube'"):
        load_primitives(tmp_path / "z.npz")


@pytest.mark.parametrize(
    ("kind", "change", "sentence"),
    [
        ("tetrahedron", {"extent": np.ones((20, 3))}, r"tetrahedra: extent has the shape \(20, 3\), wanted \(20, 4\)"),
        ("tetrahedron", {"extent": np.zeros((20, 4))}, "wanted four positive lengths"),
        ("tetrahedron", {"density": np.full(20, -1.0)}, "not negative"),
        ("gaussian", {"extent": np.ones((20, 4))}, r"Gaussians: extent has the shape \(20, 4\), wanted \(20, 3\)"),
        ("gaussian", {"density": np.full(20, 1.1)}, "density of row 0 .*wanted an opacity from 0 to 1"),
        ("gaussian", {"density": np.full(20, -0.1)}, "wanted an opacity from 0 to 1"),
        ("octahedron", {"extent": np.ones((20, 4))}, "octahedra: extent has the shape"),
        ("octahedron", {"kind": "cube"}, "of the kind 'cube', wanted one of octahedron, tetrahedron, gaussian"),
    ],
)
def test_invalid_values_of_a_kind_are_refused(kind, change, sentence):
    with pytest.raises(LinprimError, match=sentence):
        dataclasses.replace(some(kind), **change)
