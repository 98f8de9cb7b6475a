"""Three captures, made by code, of an object on a table in front of a distant room."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.synthetic.textured import load_textured

TABLETOPS: dict[str, dict] = {
    "large_table": {
        "mesh": "egyptian_cat",
        "up": "y",
        "table": 5.0,
        "path": "arc",
        "arc": 300.0,
        "distance": 4.0,
        "views": 56,
        "point_noise": 0.0032,
        "environment": 1,
        "seed": 1,
    },
    "small_table": {
        "mesh": "spot",
        "table": 1.8,
        "path": "arc",
        "arc": 360.0,
        "distance": 3.2,
        "views": 60,
        "point_noise": 0.0024,
        "environment": 2,
        "seed": 2,
    },
    "middle_table": {
        "mesh": "bob",
        "table": 3.0,
        "path": "arc",
        "arc": 120.0,
        "distance": 4.8,
        "views": 49,
        "point_noise": 0.0034,
        "environment": 3,
        "seed": 3,
    },
}
"""Arguments of `synth.synthesize` by name; `mesh` is the stem of a file, `up` the axis of its coordinates that becomes
the vertical one (default z). The noise of the points gives a mean reprojection error of half a pixel."""

ALL_TABLETOPS = {
    "test_views": 8,
    "size": (480, 360),
    "noise": 2.0,
    "jpeg": 92,
    "points": 1500,
    "shading": "shaded",
}
"""Arguments shared by these captures."""


def tabletop(name: str, out: str | os.PathLike, meshes: str | os.PathLike, **changes) -> dict:
    """Make the capture `name` of `TABLETOPS` in the folder `out`; return the report of `synth.synthesize`.

    Args:
        meshes: folder with the mesh as .glb, .obj or .ply.
        changes: arguments of `synthesize` that override the named ones.

    Raises:
        LinprimError: the name or the mesh does not exist, or `synthesize` rejects an argument.
    """
    from linprim_geo.synthetic.synth import synthesize

    if name not in TABLETOPS:
        raise LinprimError(f"tabletop {name!r} is not known, one of {', '.join(TABLETOPS)} is wanted")
    settings = {**ALL_TABLETOPS, **TABLETOPS[name], **changes}
    stem, up = settings.pop("mesh"), settings.pop("up", "z")
    files = [Path(meshes) / f"{stem}{suffix}" for suffix in (".glb", ".obj", ".ply")]
    found = [file for file in files if file.is_file()]
    if not found:
        raise LinprimError(f"{meshes}: holds no {stem}.glb, .obj or .ply")
    surface = load_textured(found[0])
    if up == "y":
        # A quarter turn about x maps (x, y, z) to (x, -z, y).
        surface = replace(surface, vertices=surface.vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0))
    return synthesize(out, mesh=surface, **settings)
