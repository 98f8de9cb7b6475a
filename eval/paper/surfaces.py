"""Tables 9 and 10 of the LinPrim paper: errors of the depth and of the surface fused from it."""

from __future__ import annotations

from linprim_geo.base.options import ExtractOptions
from linprim_geo.eval.depth import eval_depth_run
from linprim_geo.eval.mesh import eval_mesh_files
from linprim_geo.eval.paper.studies import Case
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.runs.run import Run
from linprim_geo.surface.extract import extract_mesh

VOXEL_M = 0.05
# Voxel size where lengths are not in metres: a share of the reference's diagonal, 5 cm in a room of 5 x 5 x 2.5 m.
VOXEL_SHARE = 1 / 150
METRES = ("m", "metre")
KINDS = ("gaussian", "octahedron")


def depths(case: Case) -> list[dict]:
    """Return table 9: L1 and L2 (root mean square) errors of the median depth, as mean and deviation over all
    photographs, and its coverage in %.

    Raises:
        LinprimError: the scene has neither a reference mesh nor depth images.
    """
    rows = []
    for kind in KINDS:
        folder = case.trained(case.kinds[kind])
        output = folder / "eval" / "depth_all"
        scores = eval_depth_run(folder, case.reference, split="all", depth="depth_median", output=output)
        figures = {
            "l1": scores["l1_mean"],
            "l1_std": scores["l1_std"],
            "l2": scores["l2_mean"],
            "l2_std": scores["l2_std"],
        }
        rows.append(case.row(case.kinds[kind].name, **figures, coverage=100 * scores["coverage"], unit=scores["unit"]))
    return rows


def chamfers(case: Case) -> list[dict]:
    """Return table 10: the Chamfer distance by the protocol `linprim` of a TSDF of the median depth with 5 cm voxels,
    without post-processing; needs `case.reference`.

    Raises:
        LinprimError: a fusion has no surface.
    """
    rows = []
    for kind in KINDS:
        folder = case.trained(case.kinds[kind])
        run = Run.open(folder)
        voxel = VOXEL_M if run.unit in METRES else VOXEL_SHARE * load_mesh(case.reference).diagonal
        options = ExtractOptions(level=0.5, voxel_size=voxel, refine=0, denoise="off", smallest_part=0.0)
        mesh = extract_mesh(folder, "tsdf", folder / "mesh" / "table_10.ply", options, quiet=True)["mesh"]
        scores = eval_mesh_files(mesh, case.reference, protocol="linprim", seed=case.options.seed)
        figures = {name: scores[name] for name in ("chamfer", "accuracy", "completeness")}
        rows.append(
            case.row(
                case.kinds[kind].name,
                voxel=voxel,
                **figures,
                standard_error=scores["standard_error"],
                unit=run.unit,
            )
        )
    return rows
