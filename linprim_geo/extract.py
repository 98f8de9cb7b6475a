"""From a trained run to triangle meshes: take a surface by one of several methods, finish it, write it with its statistics."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path

from .errors import LinprimError
from .files import write_json
from .mesh import SUFFIXES, save_mesh, select_faces, topology, topology_line
from .options import ExtractOptions
from .progress import Progress
from .run import Run
from .stages import Stages
from .visibility import visible_faces

# Each is a function (run, options, stages) -> (mesh, statistics of its own), found when it is wanted: their libraries are large.
METHODS = {"tsdf": "surface_tsdf.tsdf_surface"}

RANGES = {
    "level": (1e-6, 1 - 1e-6),
    "voxel_size": (0, 1e30),
    "truncation": (1, 100),
    "memory_limit": (0, 1e9),
    "smallest_part": (0, 1),
}


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

    Returns: what stats.json holds: topology of both meshes, options, seconds and peak memory per stage, and the paths.

    Raises:
        LinprimError: nothing was trained, no ray crosses the level, or the grid would not fit into memory.
    """
    options = options or ExtractOptions()
    if method not in METHODS:
        raise LinprimError(f"--method is {method!r}, wanted {' or '.join(METHODS)}")
    for name, (low, high) in RANGES.items():
        if not low <= getattr(options, name) <= high:
            raise LinprimError(
                f"--{name.replace('_', '-')} is {getattr(options, name)}, wanted {low:g} to {high:g}"
            )
    opened = Run.open(run)
    folder = opened.path / "mesh" / method
    target = Path(output) if output else folder / "mesh.ply"
    if target.suffix.lower() not in SUFFIXES:
        raise LinprimError(f"{target}: the suffix is {target.suffix!r}, wanted .ply, .obj, .glb or .stl")
    progress = Progress("extract", 1, quiet=quiet)
    stages = Stages(progress)

    module, function = METHODS[method].split(".")
    surface = getattr(import_module(f".{module}", __package__), function)
    mesh, about = surface(opened, options, stages)
    cameras = [view.camera for view in opened.scene().train]
    visible = select_faces(mesh, visible_faces(mesh, cameras))
    stages.lap("visibility")
    visible_target = target.with_name(f"{target.stem}_visible{target.suffix}")
    save_mesh(target, mesh)
    save_mesh(visible_target, visible)
    stages.lap("write")
    stats = {
        "mesh": str(target),
        "mesh_visible": str(visible_target),
        "method": method,
        **about,
        "unit": opened.unit,
        "views": len(cameras),
        "primitives": opened.state.get("primitives"),
        **topology(mesh),
        "visible": topology(visible),
        **stages.report(),
    }
    write_json(folder / "stats.json", stats)
    progress.note(f"{target}: {topology_line(stats)}")
    return stats
