"""The options of eval-mesh and of tradeoff."""

from __future__ import annotations

import os
from dataclasses import dataclass

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import check, flag_of, option

PROTOCOLS = ("headline", "linprim", "dtu", "tnt", "scannetpp")

# The protocols that take an option of eval-mesh, for options that not all of them take.
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
    """The settings of the scoring of a mesh against a reference."""

    protocol: str = option(
        "headline", "headline: exact point to surface; the others as in the tables of that name", choices=PROTOCOLS
    )
    samples: int | None = option(None, "points per mesh (headline 200000, linprim 5000)", low=2)
    tau: float | None = option(
        None,
        "threshold of the rates, in the meshes' unit (default the protocol's, else 1 % of the diagonal)",
        positive=True,
        metavar="LENGTH",
    )
    seed: int = option(0, "seed of the points", low=0)
    cameras: str | os.PathLike | None = option(
        None, "cull to what the training cameras of a scene's folder see", metavar="SCENE"
    )
    meters_per_unit: float | None = option(
        None, "metres in one unit of the meshes, for dtu, tnt and scannetpp (default 1, dtu 0.001)", positive=True
    )
    align: str = option(
        "none",
        "bring MESH to REFERENCE before: icp turns and moves it from where it lies, similarity scales it as well and "
        "needs no common frame",
        choices=("none", "similarity", "icp"),
    )
    mask: str | os.PathLike | None = option(None, "dtu: ObsMask .mat of the scan", metavar="FILE")
    box: str | None = option(
        None,
        "headline: what lies within these corners alone; auto: within what the cameras of --run or --cameras look at; "
        "dtu: the box alone, in place of a mask; written --box=...",
        metavar="auto|X0,Y0,Z0,X1,Y1,Z1",
    )
    plane: str | os.PathLike | None = option(
        None, "dtu: Plane .mat, or --plane=A,B,C,D; above it counts", metavar="PLANE"
    )
    scene: str | None = option(None, "tnt: Barn, Truck, ...: sets the threshold", metavar="NAME")
    crop: str | os.PathLike | None = option(None, "tnt: crop volume, .json", metavar="FILE")
    transform: str | os.PathLike | None = option(
        None, "tnt: 4x4 matrix as text, takes MESH to REFERENCE", metavar="FILE"
    )


def check_score_options(options: ScoreOptions) -> None:
    """Raise LinprimError as `check` does, and for an option that the protocol does not take."""
    check(options)
    for name, protocols in TAKEN_BY.items():
        if getattr(options, name) is not None and options.protocol not in protocols:
            raise LinprimError(
                f"{flag_of(name)} does not belong to --protocol {options.protocol}, only to {' and '.join(protocols)}"
            )


@dataclass(frozen=True)
class TradeoffOptions:
    """The parameters that a sweep varies, and the sizes of its measurements."""

    parameters: tuple[str, ...] = option((), "what to sweep; a wrong name lists all (default all)", metavar="NAME")
    run: str | os.PathLike | None = option(
        None,
        "run of this scene to measure rendering, extraction and evaluation on (default: trains one of modest size)",
        metavar="RUN",
    )
    reference: str | os.PathLike | None = option(
        None, "mesh in the data set's frame (default: reference.ply in the scene, if there)", metavar="MESH"
    )
    quick: bool = option(False, "a tiny size, to see that all of it runs")
    rounds: int | None = option(None, "how often everything is timed, in turn (default 3, quick 2)", low=1)
    iterations: int | None = option(None, "of the training that is swept around (default 2000, quick 200)", low=1)
    max_primitives: int | None = option(None, "of the training that is swept around (default 2000, quick 200)", low=1)
    threads: int = option(0, "0 uses every core", low=0)
