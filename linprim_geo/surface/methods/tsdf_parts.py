"""Fuses a TSDF in parts by several workers, each with a part of one voxel grid. Merged, the parts are identical to the
surface of the whole grid, to the last bit.

A worker holds the field of the blocks that its part owns and of their neighbours. It integrates the views in their
order, as the whole does, and returns the triangles of the cubes that belong to the owned blocks
(`surface_ops.marching_cubes`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from linprim_geo.base.arrays import read_named
from linprim_geo.base.files import atomic_write
from linprim_geo.base.memory import PROCESS_GIB
from linprim_geo.base.options import ExtractOptions
from linprim_geo.base.progress import Progress
from linprim_geo.base.sorting import distinct
from linprim_geo.geometry.boxes import split_space
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.jobs import worker
from linprim_geo.jobs.executor import Executor, Task
from linprim_geo.kernels import ops
from linprim_geo.runs.run import Run
from linprim_geo.surface.fusion.tsdf_field import canonical_in_world
from linprim_geo.surface.fusion.voxel_blocks import Lattice, block_keys, estimate_memory, touching, unpack_keys
from linprim_geo.surface.methods.method_tsdf import DepthFrames

# Arrays that `save_lattice` writes, with their shapes and kinds.
_LATTICE: dict[str, tuple[tuple[int | None, ...], str]] = {
    "blocks": ((None, 3), "i"),
    "levels": ((None,), "i"),
    "reach": ((None,), "i"),
    "owner": ((None,), "i"),
    "origin": ((3,), "f"),
    "voxel": ((), "f"),
    "resolution": ((), "i"),
    "truncation": ((), "f"),
    "rules": ((None,), "f"),
}
REMEDY = "more --blocks, a larger --voxel-size, fewer --workers, or more memory"


class PartFusion:
    """Fuses grids in `count` parts each; the `fuse` of `tsdf_fusion.fuse_tsdf`. Finished parts stay in `folder`, which
    the caller removes in the end."""

    def __init__(
        self, run: Run, options: ExtractOptions, count: int, executor: Executor, folder: Path, quiet: bool = False
    ):
        self.run, self.level, self.count, self.held_out = run, float(options.level), count, options.held_out
        self.executor, self.folder, self.quiet = executor, folder, quiet

    def __call__(self, lattice: Lattice, frames: DepthFrames) -> Mesh:
        count = min(self.count, len(lattice.blocks))
        digest = hashlib.sha256((self.run.path / "training_frame.npz").read_bytes())
        options = (
            self.level,
            self.held_out,
            frames.limit,
            count,
            lattice.voxel,
            lattice.resolution,
            lattice.truncation,
            lattice.rules,
        )
        digest.update(repr(options).encode())
        for array in (lattice.blocks, lattice.levels, lattice.reach, lattice.origin):
            digest.update(array.tobytes())
        place = self.folder / digest.hexdigest()[:16]
        owner = owners(lattice, count)
        save_lattice(place / "lattice.npz", lattice, owner)
        largest = max(view.camera.width * view.camera.height for view in self.run.scene().train)
        tasks = []
        for part in range(count):
            size = int(halo(lattice, owner == part).sum())
            need = PROCESS_GIB + estimate_memory(size, lattice.resolution, largest) / 2**30
            where = {"run": str(self.run.path.resolve()), "level": self.level, "limit": frames.limit, "part": part}
            where |= {"held_out": self.held_out}
            tasks.append(
                Task(
                    f"part {part}",
                    "linprim_geo.surface.methods.tsdf_parts:part_task",
                    where,
                    place / f"{part:03d}",
                    need,
                    1,
                    REMEDY,
                )
            )
        self.executor.run(tasks, Progress("parts", 1, quiet=self.quiet))
        parts = [load_part(place / f"{part:03d}" / "part.npz") for part in range(count)]
        return canonical_in_world(merge_parts(parts), lattice.origin)


def owners(lattice: Lattice, count: int) -> np.ndarray:
    """Return (B,) the part, of `count`, that each block belongs to: equally many blocks per part, close to
    each other."""
    middle = (lattice.blocks + 0.5) * 2.0 ** lattice.levels[:, None]
    owner = np.zeros(len(middle), dtype=np.int64)
    for part, box in enumerate(split_space(middle, np.ones(len(middle)), count)):
        owner[box.holds(middle)] = part
    return owner


def halo(lattice: Lattice, own: np.ndarray) -> np.ndarray:
    """Return (B,) bool: the blocks that are `own` (B,), or touch one that is."""
    inside = own.copy()
    for level in np.unique(lattice.levels[own]):
        # Blocks of this level that its own ones touch. Larger blocks touch if they contain one of these, smaller ones
        # if they lie in one.
        near = distinct(touching(lattice.blocks[own & (lattice.levels == level)]))
        for other in np.unique(lattice.levels):
            these = lattice.levels == other
            if other <= level:
                inside[these] |= np.isin(block_keys(lattice.blocks[these] >> (level - other)), near)
            else:
                larger = block_keys(unpack_keys(near) >> (other - level))
                inside[these] |= np.isin(block_keys(lattice.blocks[these]), larger)
    return inside


def part_task(folder: Path, run: str, level: float, limit: float, part: int, held_out: bool = False) -> dict:
    """Fuse the blocks that a part owns, and write its surface to part.npz."""
    import torch

    torch.set_num_threads(1)
    ops.set_threads(worker.cores)
    lattice, owner = load_lattice(folder.parent / "lattice.npz")
    own = owner == part
    inside = halo(lattice, own)
    blocks, levels, reach = (array[inside] for array in (lattice.blocks, lattice.levels, lattice.reach))
    grid = replace(lattice, blocks=blocks, levels=levels, reach=reach).grid()
    opened = Run.open(run)
    frames = DepthFrames(opened.with_held_out_views() if held_out else opened, level, limit, keep=False)
    used = 0
    for number, view in enumerate(frames.views):
        if len(grid.in_view(view.camera)):
            grid.integrate(frames[number], lattice.rules)
            used += 1
    surface = grid.surface(own[inside])
    with atomic_write(folder / "part.npz") as temporary, open(temporary, "wb") as file:
        np.savez(file, vertices=surface.vertices, faces=surface.faces)
    return {"faces": len(surface.faces), "views": used, "blocks": int(own.sum())}


def merge_parts(parts: Iterable[Mesh]) -> Mesh:
    """Return all parts as one mesh, in which vertices on seams occur more than once."""
    vertices, faces, first = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for part in parts:
        vertices.append(part.vertices)
        faces.append(part.faces + first)
        first += len(part.vertices)
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


def save_lattice(path: Path, lattice: Lattice, owner: np.ndarray) -> None:
    """Write a grid and the owners of its blocks."""
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            blocks=lattice.blocks,
            levels=lattice.levels,
            reach=lattice.reach,
            owner=owner,
            origin=lattice.origin,
            voxel=lattice.voxel,
            resolution=lattice.resolution,
            truncation=lattice.truncation,
            rules=lattice.rules,
        )


def load_lattice(path: Path) -> tuple[Lattice, np.ndarray]:
    """Read what `save_lattice` wrote.

    Raises:
        LinprimError: it is damaged.
    """
    blocks, levels, reach, owner, origin, voxel, resolution, truncation, rules = read_named(path, _LATTICE)
    numbers = float(voxel), int(resolution), float(truncation), tuple(float(x) for x in rules)
    return Lattice(blocks, levels, reach, origin, *numbers), owner


def load_part(path: Path) -> Mesh:
    """Read what `part_task` wrote.

    Raises:
        LinprimError: it is damaged.
    """
    return Mesh(*read_named(path, {"vertices": ((None, 3), "f"), "faces": ((None, 3), "i")}))
