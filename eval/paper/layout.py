"""The layout of the paper's tables: columns, titles, and the formatting of rows as text."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from linprim_geo.eval.paper import studies as paper_studies
from linprim_geo.eval.paper.classes import classes
from linprim_geo.eval.paper.studies import Case
from linprim_geo.eval.paper.surfaces import chamfers, depths
from linprim_geo.eval.paper.text_tables import number, plain

OF_KINDS = ("1", "6", "8")
# Column titles, number of decimals, and whether a plus sign is shown.
COLUMNS = {
    "psnr_3": ("degree 3, dB", 2, False),
    "change_2": ("degree 2", 2, True),
    "change_1": ("1", 2, True),
    "change_0": ("0", 2, True),
    "share": ("% of pixels", 1, False),
    "gaussians": ("Gaussians, dB", 2, False),
    "octahedra": ("octahedra, dB", 2, False),
    "change": ("change", 2, True),
    "scale_1": ("1, dB", 2, False),
    "scale_2": ("1/2", 2, False),
    "scale_4": ("1/4", 2, False),
    "scale_8": ("1/8", 2, False),
    "mean": ("mean", 2, False),
    "ssim": ("SSIM", 3, False),
    "psnr": ("PSNR, dB", 2, False),
    "lpips": ("LPIPS", 3, False),
    "count": ("count", 0, False),
    "train_cpu_seconds": ("training CPU s", 1, False),
    "frame_cpu_ms": ("frame CPU ms", 2, False),
    "l1": ("L1", 4, False),
    "l1_std": ("+-", 4, False),
    "l2": ("L2", 4, False),
    "l2_std": ("+-", 4, False),
    "coverage": ("coverage %", 2, False),
    "voxel": ("voxel", 4, False),
    "chamfer": ("Chamfer", 4, False),
    "standard_error": ("+-", 4, False),
    "accuracy": ("accuracy", 4, False),
    "completeness": ("completeness", 4, False),
    "frame_ms": ("frame ms", 2, False),
    "preprocess_ms": ("preprocess ms", 2, False),
    "sort_tile_ms": ("sort+tile", 2, False),
    "render_ms": ("render", 2, False),
    "file_mb": ("file MB", 0, False),
    "in_frustum": ("in frustum", 0, False),
    "tile_entries": ("tile entries", 0, False),
    "iterated": ("iterated", 0, False),
    "intersected": ("intersected", 0, False),
}


@dataclass(frozen=True)
class Table:
    """The title of a table, the function that returns the rows of a scene, and the note needed to quote it."""

    title: str
    rows: Callable[[Case], list[dict]]
    note: str


TABLES = {
    "2": Table(
        "Table 2: degree of the view-dependent colour",
        paper_studies.degrees,
        "Changes of PSNR in dB against degree 3.",
    ),
    "3": Table(
        "Table 3: PSNR by class",
        classes,
        "From the mean squared error over all pixels of a class in all held-out views; the paper does not state its "
        "way of averaging.",
    ),
    "4": Table(
        "Table 4: zooming out, trained at full size",
        paper_studies.zooming_out,
        "Photographs are averaged down; renders have one ray per pixel of the smaller image (--samples).",
    ),
    "7": Table(
        "Tables 7 and 11: fixed counts, MCMC",
        paper_studies.fixed_counts,
        ":3dgs and :mcmc are the densification rules of these papers in the same trainer; :3dgs has the largest of "
        "--caps.",
    ),
    "9": Table(
        "Table 9: depth",
        depths,
        "Median depth of all photographs. L1 and L2 per photograph over pixels that are valid in both; mean and "
        "standard deviation over photographs, in the data set's unit (published: metres).",
    ),
    "10": Table(
        "Table 10: Chamfer distance",
        chamfers,
        "TSDF of depth at half transmittance, with voxels of 5 cm, or 1/150 of the diagonal if the unit is not the "
        "metre; 5,000 points per surface; mean of both directions in the data set's unit (published: metres; perhaps "
        "the sum of both directions).",
    ),
    "12": Table(
        "Table 12: octahedra against tetrahedra",
        paper_studies.tetrahedra,
        "The same options and the same largest count.",
    ),
    "rays": Table(
        "Ablation: exact against affine rays",
        paper_studies.rays,
        "Each is trained and rendered with the same kind of rays; frames on one thread.",
    ),
}
SAME = {"11": "7"}


def table_text(table: Table, rows: list[dict]) -> str:
    """Return a table as plain text, with only the columns that any row has. The measured and the published rows of a
    scene are next to each other."""
    order = list(dict.fromkeys(row["scene"] for row in rows))
    rows = sorted(rows, key=lambda row: order.index(row["scene"]))
    names = [name for name in COLUMNS if any(name in row for row in rows)]
    lines = [
        [
            row["scene"],
            row["method"],
            row["source"],
            *(number(row.get(name), *COLUMNS[name][1:]) for name in names),
        ]
        for row in rows
    ]
    head = ["scene", "method", "source", *(COLUMNS[name][0] for name in names)]
    text = f"{table.title}\n{plain(head, lines, words=3)}\n  {table.note}"
    units = {row["scene"]: row["unit"] for row in rows if "unit" in row}
    return text + "".join(f"\n  {scene}: lengths in {unit}." for scene, unit in units.items())
