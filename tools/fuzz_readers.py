"""Lists all readers of the package for the fuzzer: valid inputs, the files to damage with their kinds, and checks of
results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import fuzz_captures as captures
import fuzz_files as files


@dataclass(frozen=True)
class Reader:
    """`make` writes valid inputs to a folder. `files` are those to damage, each with its kind of mutation. `read` reads
    the input to which a damaged file belongs, and checks the result."""

    name: str
    make: Callable[[Path], None]
    files: tuple[tuple[str, str], ...]  # (glob, kind)
    read: Callable[[Path], None]


READERS = (
    Reader("primitives ply", files.make_primitive_ply, (("*.ply", "ply"),), files.read_primitive_ply_file),
    Reader("primitives npz", files.make_npz, (("*.npz", "zip"),), files.read_npz_file),
    Reader(
        "points ply",
        files.make_points,
        (("ascii.ply", "text"), ("*.ply", "ply")),
        files.read_points_file,
    ),
    Reader("mesh ply", files.make_meshes, (("*.ply", "ply"), ("ascii.ply", "text")), files.read_mesh_file),
    Reader(
        "mesh obj",
        files.make_meshes,
        (("*.obj", "text"), ("*.mtl", "text"), ("*.png", "png")),
        files.read_mesh_file,
    ),
    Reader("mesh glb", files.make_meshes, (("*.glb", "glb"),), files.read_mesh_file),
    Reader(
        "mesh stl",
        files.make_meshes,
        (("mesh.stl", "binary"), ("ascii.stl", "text")),
        files.read_mesh_file,
    ),
    Reader(
        "photo",
        files.make_photos,
        (("*.png", "png"), ("*.[jwbt]*", "binary"), ("*.tiff", "binary")),
        files.read_photo_file,
    ),
    Reader("mask", files.make_masks, (("*.png", "png"), ("*.jpg", "binary")), files.read_mask_file),
    Reader(
        "depth",
        files.make_depths,
        (("*.png", "png"), ("*.tif", "binary"), ("*.npy", "npy"), ("*.npz", "zip")),
        files.read_depth_file,
    ),
    Reader("normals", files.make_normals, (("*.png", "png"), ("*.npy", "npy")), files.read_normals_file),
    Reader("transforms json", captures.make_transforms, (("*.json", "json"),), captures.read_scene_file),
    Reader("dtu", captures.make_dtu, (("*.npz", "zip"),), captures.read_scene_file),
    Reader(
        "redwood",
        captures.make_redwood,
        (("*.log", "text"), ("*.json", "json")),
        captures.read_trajectory_file,
    ),
    Reader(
        "tanks and temples",
        captures.make_tanks,
        (("*.log", "text"), ("*.json", "json")),
        captures.read_trajectory_file,
    ),
    Reader("tum", captures.make_tum, (("*.txt", "text"),), captures.read_scene_file),
    Reader(
        "scannet++",
        captures.make_scannetpp,
        (("dslr/*.json", "json"), ("dslr/nerfstudio/*.json", "json")),
        captures.read_scannetpp_file,
    ),
    Reader(
        "adjusted poses",
        captures.make_adjusted_poses,
        (("adjusted_poses.json", "json"),),
        captures.read_adjusted_poses_file,
    ),
    Reader("found poses", captures.make_found_poses, (("**/summary.json", "json"),), captures.read_summary_file),
    Reader(
        "colmap bin",
        lambda folder: captures.make_colmap(folder, False),
        (("*.bin", "binary"), ("old/*.bin", "binary")),
        captures.read_colmap_file,
    ),
    Reader(
        "colmap txt",
        lambda folder: captures.make_colmap(folder, True),
        (("*.txt", "text"), ("old/*.txt", "text")),
        captures.read_colmap_file,
    ),
    Reader(
        "protocol files",
        captures.make_protocol,
        (("*.json", "json"), ("*.txt", "text"), ("*.mat", "binary")),
        captures.read_protocol_file,
    ),
    Reader(
        "run",
        captures.make_run,
        (("run/*.json", "json"), ("run/metrics.jsonl", "text"), ("run/*.npz", "zip")),
        captures.read_run_file,
    ),
    Reader(
        "checkpoint",
        captures.make_run,
        (("run/checkpoints/*.pt", "zip"), ("run/checkpoints/latest", "text")),
        captures.read_checkpoint_file,
    ),
)
