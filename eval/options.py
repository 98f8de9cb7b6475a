"""The options of eval-mesh and of tradeoff."""

from __future__ import annotations

import os
from dataclasses import dataclass

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import check, flag_of, option

PROTOCOLS = ("headline", "linprim", "dtu", "tnt", "scannetpp")

# Protocols of eval-mesh that use an option, for options that only some of them use.
TAKEN_BY = {
    "samples": ("headline", "linprim"),
    "cameras": ("headline", "scannetpp"),
    "mask": ("dtu",),
    "box": ("headline", "dtu"),
    "plane": ("dtu",),
    "scene": ("tnt",),
    "crop": ("tnt",),
    "transform": ("tnt",),
    "meters_per_unit": ("dtu", "tnt", "scannetpp"),
}


@dataclass(frozen=True)
class ScoreOptions:
    """Settings for scoring a mesh against a reference."""

    protocol: str = option(
        "headline",
        "headline: exact distances from points to the other surface; others: as in the published tables of that name",
        choices=PROTOCOLS,
    )
    samples: int | None = option(None, "sample points per mesh (default 200000; linprim 5000)", low=2)
    tau: float | None = option(
        None,
        "distance threshold of precision, recall and F1, in the meshes' unit (default: the protocol's, else 1 % of the "
        "reference's diagonal)",
        positive=True,
        metavar="LENGTH",
    )
    seed: int = option(0, "random seed of the sample points", low=0)
    cameras: str | os.PathLike | None = option(
        None, "scene whose training cameras define the visible part, in place of those of --run", metavar="SCENE"
    )
    meters_per_unit: float | None = option(
        None, "unit of the meshes in metres, for dtu, tnt and scannetpp (default 1; dtu 0.001)", positive=True
    )
    align: str = option(
        "none",
        "register MESH to REFERENCE before scoring. icp: rotation and translation, starting from the present pose; "
        "similarity: also scale, from any frame",
        choices=("none", "similarity", "icp"),
    )
    mask: str | os.PathLike | None = option(
        None, "dtu: observation mask of the scan, .mat with ObsMask, BB and Res", metavar="FILE"
    )
    box: str | None = option(
        None,
        "score only inside these corners, written --box=...; auto (headline only): around what the cameras of --run or "
        "--cameras look at; dtu: in place of --mask",
        metavar="auto|X0,Y0,Z0,X1,Y1,Z1",
    )
    plane: str | os.PathLike | None = option(
        None, "dtu: Plane .mat, or --plane=A,B,C,D; the reference is scored above it only", metavar="PLANE"
    )
    scene: str | None = option(None, "tnt: scene such as Barn or Truck; sets the threshold", metavar="NAME")
    crop: str | os.PathLike | None = option(None, "tnt: crop volume (.json)", metavar="FILE")
    transform: str | os.PathLike | None = option(
        None, "tnt: text file with the 4x4 matrix from MESH to REFERENCE", metavar="FILE"
    )


def check_score_options(options: ScoreOptions) -> None:
    """Raise LinprimError as `check` does, or if an option is given that the protocol does not use."""
    check(options)
    for name, protocols in TAKEN_BY.items():
        if getattr(options, name) is not None and options.protocol not in protocols:
            raise LinprimError(
                f"{flag_of(name)} does not belong to --protocol {options.protocol}, only to {' and '.join(protocols)}"
            )


@dataclass(frozen=True)
class TradeoffOptions:
    """Settings of a sweep: the parameters that it varies and the sizes of its measurements."""

    parameters: tuple[str, ...] = option(
        (), "parameters to sweep; an unknown name prints the list (default all)", metavar="NAME"
    )
    run: str | os.PathLike | None = option(
        None,
        "run of this scene on which to measure rendering, extraction and scoring (default: train one of modest size)",
        metavar="RUN",
    )
    reference: str | os.PathLike | None = option(
        None,
        "reference mesh in the data set's frame (default: the scene's reference.ply, if it exists)",
        metavar="MESH",
    )
    quick: bool = option(False, "use tiny sizes, to check that everything runs")
    rounds: int | None = option(None, "number of timings of each setting, interleaved (default 3; --quick 2)", low=1)
    iterations: int | None = option(None, "steps of the base training (default 2000; --quick 200)", low=1)
    max_primitives: int | None = option(None, "primitives of the base training (default 2000; --quick 200)", low=1)
    threads: int = option(0, "number of threads; 0: one per core", low=0)
