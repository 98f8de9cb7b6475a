"""Fusion in parts gives the same bits as fusion of the whole, and refuses invalid options."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.here import Here

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions
from linprim_geo.jobs import worker
from linprim_geo.runs.run import Run
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.surface.fusion.tsdf_field import canonical_in_world, vote_rules
from linprim_geo.surface.fusion.tsdf_fusion import fuse_lattice
from linprim_geo.surface.fusion.voxel_blocks import Lattice, find_blocks
from linprim_geo.surface.methods.method_tsdf import DepthFrames
from linprim_geo.surface.methods.tsdf_parts import (
    halo,
    load_lattice,
    load_part,
    merge_parts,
    owners,
    part_task,
    save_lattice,
)

LEVEL = 0.5


@pytest.fixture(scope="module", params=["of one size", "of two sizes"])
def lattice(tiny_run, request):
    frames = DepthFrames(Run.open(tiny_run), LEVEL)
    voxel, rules = 0.02, vote_rules(3.0, 0.75, 0.0)
    blocks, origin, _ = find_blocks(frames, voxel, 3.0, None, 8, np.inf)
    levels = np.zeros(len(blocks), np.int64)
    if request.param == "of two sizes":  # one quadrant in voxels twice as large
        large = (blocks[:, 0] < 0) & (blocks[:, 1] < 0)
        blocks = np.concatenate([blocks[~large], np.unique(blocks[large] >> 1, axis=0)])
        levels = (np.arange(len(blocks)) >= (~large).sum()).astype(np.int64)
    reach = np.random.default_rng(0).integers(levels, 2)  # as if beside larger ones
    made = Lattice(blocks, levels, reach, origin, voxel, 8, 3.0, rules)
    return made, fuse_lattice(made, frames)


def parts_of(run: Path, lattice: Lattice, owner: np.ndarray, folder: Path) -> list:
    save_lattice(folder / "lattice.npz", lattice, owner)
    found, limit = [], DepthFrames(Run.open(run), LEVEL).limit
    for part in range(int(owner.max()) + 1):
        (folder / str(part)).mkdir()
        part_task(folder / str(part), str(run), LEVEL, limit, part)
        found.append(load_part(folder / str(part) / "part.npz"))
    return found


@pytest.mark.parametrize("kind", ["boxes", "scattered"])
def test_merged_parts_equal_the_whole_bit_for_bit(kind, tiny_run, lattice, tmp_path):
    made, whole = lattice
    if kind == "boxes":
        owner = owners(made, 5)
    else:  # nearly every block is a seam
        owner = np.random.default_rng(0).integers(0, 3, len(made.blocks))
    parts = parts_of(tiny_run, made, owner, tmp_path)
    mesh = canonical_in_world(merge_parts(parts), made.origin)
    assert len(whole.faces) > 1000 and all(len(part.faces) for part in parts)
    assert np.array_equal(mesh.vertices, whole.vertices) and np.array_equal(mesh.faces, whole.faces)
    assert sum(len(part.faces) for part in parts) == len(whole.faces)  # nothing twice


def test_parts_without_a_halo_leave_seams(tiny_run, lattice, tmp_path):
    made, whole = lattice
    owner = owners(made, 2)
    faces = 0
    for part in range(2):
        own = owner == part
        alone = replace(made, blocks=made.blocks[own], levels=made.levels[own], reach=made.reach[own])
        faces += len(fuse_lattice(alone, DepthFrames(Run.open(tiny_run), LEVEL)).faces)
    assert faces < len(whole.faces)


def test_owners_are_balanced_and_halos_contain_adjacent_blocks(lattice):
    made = lattice[0]
    owner = owners(made, 4)
    counts = np.bincount(owner, minlength=4)
    assert counts.min() > 0.4 * len(owner) / 4 and counts.sum() == len(owner)
    size = 2 ** made.levels[:, None]
    low, high = made.blocks * size, (made.blocks + 1) * size
    for part in range(4):
        own = owner == part
        touch = ((low[:, None] <= high[own]) & (low[own] <= high[:, None])).all(2).any(1)
        near = halo(made, own)
        assert near[touch].all()
        assert (made.levels > 0).any() or np.array_equal(near, touch)


def test_a_lattice_survives_a_round_trip(lattice, tmp_path):
    made, owner = lattice[0], owners(lattice[0], 3)
    save_lattice(tmp_path / "lattice.npz", made, owner)
    found, other = load_lattice(tmp_path / "lattice.npz")
    assert (
        np.array_equal(found.blocks, made.blocks)
        and np.array_equal(other, owner)
        and np.array_equal(found.origin, made.origin)
    )
    assert (found.voxel, found.resolution, found.rules) == (made.voxel, made.resolution, made.rules)
    (tmp_path / "part.npz").write_bytes(b"PK")
    with pytest.raises(LinprimError, match="part.npz: cannot be read"):
        load_part(tmp_path / "part.npz")


def test_extraction_in_parts_writes_the_same_files(run_copy, tmp_path):
    options = ExtractOptions(level=LEVEL, refine=0)
    files = [tmp_path / name / "mesh.ply" for name in ("whole", "parts")]
    extract_mesh(run_copy, output=files[0], options=options, quiet=True)
    stats = extract_mesh(run_copy, output=files[1], options=options, quiet=True, blocks=3, workers=2)
    assert stats["blocks"] == 3
    for name in ("mesh.ply", "mesh_visible.ply"):
        assert (files[0].parent / name).read_bytes() == (files[1].parent / name).read_bytes()
    assert sorted(path.name for path in (run_copy / "mesh" / "tsdf").iterdir()) == ["stats.json"]


def test_finished_parts_are_reused_and_those_of_other_options_removed(run_copy, monkeypatch, tmp_path):
    options = ExtractOptions(level=LEVEL, refine=0)
    folder = run_copy / "mesh" / "tsdf" / "parts"
    monkeypatch.setattr("linprim_geo.surface.extract.open_executor", Here)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", lambda path: None)  # what a kill before the end leaves
        extract_mesh(run_copy, options=options, quiet=True, blocks=2)
        before = {path: path.stat().st_mtime_ns for path in folder.glob(f"*/*/{worker.DONE}")}
        assert len(before) == 4  # of coarse voxels and of all
        extract_mesh(run_copy, options=options, quiet=True, blocks=2)
        assert before == {path: path.stat().st_mtime_ns for path in folder.glob(f"*/*/{worker.DONE}")}
    extract_mesh(run_copy, options=replace(options, voxel_size=0.03), quiet=True, blocks=2)
    assert not folder.exists()


@pytest.mark.parametrize(
    ("how", "sentence"),
    [
        ({"blocks": 0}, "--blocks is 0"),
        (
            {"blocks": 2, "method": "polyhedra"},
            "--blocks is for --method tsdf, not for polyhedra",
        ),
        ({"blocks": 2, "options": ExtractOptions(level=LEVEL, voxel_size=1e-5)}, "voxel size 1e-05 is less than"),
    ],
)
def test_invalid_options_are_refused(how, sentence, run_copy):
    with pytest.raises(LinprimError, match=sentence):
        extract_mesh(run_copy, quiet=True, **how)
