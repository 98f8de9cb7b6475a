"""extract-mesh with --box and with --held-out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import CENTER

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.region import focus_box, read_box
from linprim_geo.runs.run import Run
from linprim_geo.surface import postprocess
from linprim_geo.surface.extract import extract_mesh

OPTIONS = ExtractOptions(level=0.5, refine=0, denoise="off", voxel_size=0.05)
# Half of the octahedron of `solid`, from its middle on in x.
HALF = f"{CENTER[0]},-9,-9,9,9,9"


@pytest.mark.parametrize("method", ["tsdf", "polyhedra", "opacity-field"])
def test_the_surface_within_a_box_agrees_with_the_whole(method, solid, tmp_path):
    options = replace(OPTIONS, voxel_size=0.05 if method == "tsdf" else 0.0)
    whole, half = (
        extract_mesh(solid, method, tmp_path / f"{len(box)}.ply", replace(options, box=box), quiet=True)
        for box in ("", HALF)
    )
    mesh = load_mesh(half["mesh"])
    middles = mesh.vertices[mesh.faces].mean(1)
    assert middles[:, 0].min() >= CENTER[0] - 1e-6
    every = load_mesh(whole["mesh"])
    there = every.vertices[every.faces].mean(1)[:, 0] > CENTER[0]
    # Where a lattice begins depends on what is fused, so triangles differ, by a voxel at the border.
    assert half["area"] == pytest.approx(float(there.mean()) * whole["area"], rel=0.2)
    assert np.array_equal(read_box(half["options"]["box"]), read_box(HALF))


def test_a_box_reduces_the_number_of_fused_blocks(solid, tmp_path, capsys):
    for box in ("", HALF):
        extract_mesh(solid, output=tmp_path / "mesh.ply", options=replace(OPTIONS, box=box, voxel_size=0.025))
    # Half of them, and a layer on the border.
    blocks = [int(line.split()[1]) for line in capsys.readouterr().err.splitlines() if "fusing:" in line]
    assert len(blocks) == 2 and blocks[1] < 0.7 * blocks[0]


def test_box_auto_is_the_focus_box_of_the_cameras(solid, tmp_path):
    stats = extract_mesh(solid, output=tmp_path / "mesh.ply", options=replace(OPTIONS, box="auto"), quiet=True)
    wanted = focus_box([view.camera for view in Run.open(solid).scene().train])
    np.testing.assert_array_equal(read_box(stats["options"]["box"]), wanted)
    assert np.abs(wanted.mean(0) - CENTER).max() < 0.3


@pytest.mark.parametrize("method", ["tsdf", "polyhedra"])
def test_a_box_without_a_surface_is_refused(method, solid, tmp_path):
    options = replace(OPTIONS, box="50,50,50,51,51,51", voxel_size=0.0)
    with pytest.raises(LinprimError, match="50.*51|holds none of the surface"):
        extract_mesh(solid, method, tmp_path / "mesh.ply", options, quiet=True)


def test_held_out_photographs_are_used_on_request(solid, tmp_path, monkeypatch):
    finished = []

    def finish(mesh, run, *rest, original=postprocess.finish_surface, **how):
        finished.append(len(run.scene().train))
        return original(mesh, run, *rest, **how)

    monkeypatch.setattr("linprim_geo.surface.extract.finish_surface", finish)
    scene = Run.open(solid).scene()
    assert len(scene.test) == 2
    for held_out in (False, True):
        stats = extract_mesh(
            solid, output=tmp_path / f"{held_out}.ply", options=replace(OPTIONS, held_out=held_out), quiet=True
        )
        assert stats["views"] == len(scene.train) + 2 * held_out == finished.pop()
    meshes = [(tmp_path / f"{held_out}.ply").read_bytes() for held_out in (False, True)]
    assert meshes[0] != meshes[1]


def test_held_out_photographs_are_used_in_every_part(run_copy, tmp_path):
    options = ExtractOptions(level=0.5, refine=0, held_out=True)
    files = [tmp_path / f"{blocks}.ply" for blocks in (1, 2)]
    for blocks, file in enumerate(files, 1):
        extract_mesh(run_copy, output=file, options=options, quiet=True, blocks=blocks, workers=1)
    assert files[0].read_bytes() == files[1].read_bytes()
