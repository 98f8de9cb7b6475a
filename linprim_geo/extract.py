"""From a trained run to triangle meshes: render depth at a transmittance level, fuse it, clean and colour the surface."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .errors import LinprimError
from .files import write_json
from .options import ExtractOptions
from .progress import Progress, peak_memory_gib
from .run import Run

# A ray with less opacity than this has seen through the scene: it votes for free space.
SEEN_THROUGH = 0.5
# Depth, colour and background of a pixel; frames of more than this in all are not kept.
BYTES_PER_PIXEL, KEPT_BYTES = 8, 2**30


def extract_mesh(
    run: str | os.PathLike,
    method: str = "tsdf",
    output: str | os.PathLike | None = None,
    options: ExtractOptions | None = None,
    *,
    quiet: bool = False,
) -> dict:
    """Extracts the surface of a run and writes it, the part that cameras see, and statistics.

    RUN/mesh/METHOD holds mesh.ply, mesh_visible.ply and stats.json; with `output` the two meshes go to OUTPUT and its sibling
    *_visible, in the format of the suffix (.ply, .obj, .glb, .stl). Vertices have normals, colours and, as `quality`,
    the spread of the views' surfaces in the data set's unit; everything is in the data set's
    frame and unit.

    Returns: what stats.json holds: topology of both meshes, options, seconds per stage, peak memory, and the paths.

    Raises:
        LinprimError: nothing was trained, no ray crosses the level, or the grid would not fit into memory.
    """
    from .fuse import auto_voxel_size, fuse_tsdf
    from .mesh import save_mesh, select_faces, topology, topology_line
    from .visibility import visible_faces

    options = options or ExtractOptions()
    if method != "tsdf":
        raise LinprimError(f"--method is {method!r}, wanted tsdf")
    for name, low, high in (
        ("level", 1e-6, 1 - 1e-6),
        ("voxel_size", 0, 1e30),
        ("truncation", 1, 100),
        ("memory_limit", 0, 1e9),
        ("smallest_part", 0, 1),
    ):
        if not low <= getattr(options, name) <= high:
            raise LinprimError(
                f"--{name.replace('_', '-')} is {getattr(options, name)}, wanted {low:g} to {high:g}"
            )
    opened = Run.open(run)
    folder = opened.path / "mesh" / method
    target = Path(output) if output else folder / "mesh.ply"
    if target.suffix.lower() not in (".ply", ".obj", ".glb", ".stl"):
        raise LinprimError(f"{target}: the suffix is {target.suffix!r}, wanted .ply, .obj, .glb or .stl")
    progress = Progress("extract", 5, quiet=quiet)
    seconds: dict[str, float] = {}
    clock = time.perf_counter()

    def lap(name: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[name], clock = round(now - clock, 3), now

    frames = DepthFrames(opened, options.level)
    if not any((frame.depth > 0).any() for frame in frames):
        raise LinprimError(
            f"{opened.path}: no ray of any training view crosses transmittance {options.level}, so there is no surface"
        )
    lap("render")
    voxel = options.voxel_size if options.voxel_size > 0 else auto_voxel_size(frames)
    limit = int(options.memory_limit * 2**30) if options.memory_limit > 0 else None
    mesh = fuse_tsdf(
        frames,
        voxel_size=voxel,
        truncation_voxels=options.truncation,
        memory_limit=limit,
        min_component=options.smallest_part,
        log=lambda text: progress.note("  " + text),
    )
    lap("fuse")
    seen = visible_faces(mesh, [view.camera for view in frames.views])
    lap("visibility")
    visible = select_faces(mesh, seen)
    visible_target = target.with_name(f"{target.stem}_visible{target.suffix}")
    save_mesh(target, mesh)
    save_mesh(visible_target, visible)
    lap("write")
    stats = {
        "mesh": str(target),
        "mesh_visible": str(visible_target),
        "method": method,
        "level": options.level,
        "voxel_size": voxel,
        "truncation_voxels": options.truncation,
        "unit": opened.unit,
        "views": len(frames),
        "primitives": opened.state.get("primitives"),
        **topology(mesh),
        "visible": topology(visible),
        "seconds": {**seconds, "total": round(sum(seconds.values()), 3)},
        "peak_memory_gib": round(peak_memory_gib(), 3),
    }
    write_json(folder / "stats.json", stats)
    progress.note(f"{target}: {topology_line(stats)}")
    return stats


class DepthFrames(Sequence):
    """`fuse.DepthFrame`s of the training views: depth at transmittance `level`, the photographs' colours, free background.

    Kept in memory if they are at most KEPT_BYTES in all, else rendered whenever they are asked for.
    """

    def __init__(self, run: Run, level: float):
        self.run, self.level = run, level
        self.views = run.scene().train
        size = sum(view.camera.width * view.camera.height * BYTES_PER_PIXEL for view in self.views)
        self.kept = list(self._render(self.views)) if size <= KEPT_BYTES else None

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index):
        return self.kept[index] if self.kept is not None else next(self._render([self.views[index]]))

    def __iter__(self):
        return iter(self.kept) if self.kept is not None else self._render(self.views)

    def _render(self, views):
        from .fuse import DepthFrame

        for view, depth, opacity in self.run.surface_depths(views, self.level):
            free = opacity < SEEN_THROUGH
            yield DepthFrame(
                view.camera, np.where(free, np.float32(0), depth), color=view.load().rgb, background=free
            )
