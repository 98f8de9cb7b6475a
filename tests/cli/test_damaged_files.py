"""Damaged and hostile files: readers raise a one-line error or return a correct result, and never execute code."""

from __future__ import annotations

import io
import json
import os
import pickle
import struct
import sys
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import savemat

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import forget_peak, memory_gib, peak_gib
from linprim_geo.base.progress import Progress
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.readers.ply_points import read_points_ply
from linprim_geo.capture.types import PointCloud
from linprim_geo.cli import main as cli
from linprim_geo.eval.protocols.files import read_crop, read_plane
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.primitives import load_primitives
from linprim_geo.imaging import photos
from linprim_geo.points import triangulate
from linprim_geo.runs.run import Run
from linprim_geo.surface.fusion.voxel_blocks import Lattice
from linprim_geo.surface.methods.tsdf_parts import load_lattice, load_part, save_lattice
from linprim_geo.synthetic.textured import load_textured
from linprim_geo.training.blocks.plan import load_points, save_points
from linprim_geo.training.checkpoint import read_checkpoint
from linprim_geo.training.train import train

TOOLS = Path(__file__).resolve().parents[2] / "tools"
sys.path.insert(0, str(TOOLS))
import fuzz  # noqa: E402


def refused(call, *arguments) -> str:
    """The message of the one-line error of the call."""
    with pytest.raises(LinprimError) as caught:
        call(*arguments)
    sentence = str(caught.value)
    assert sentence and "\n" not in sentence and len(sentence) <= LinprimError.LONGEST
    return sentence


def change_npz(path: Path, name: str, content: bytes, packed: bool = False) -> None:
    """Replace a member of the archive with a valid checksum."""
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED) as archive:
        for member, old in members.items():
            archive.writestr(member, content if member == name else old)


def as_npy(array: np.ndarray, header: str | None = None, allow_pickle: bool = False) -> bytes:
    """The array as .npy, or with `header` in place of its own."""
    out = io.BytesIO()
    np.save(out, array, allow_pickle=allow_pickle)
    data = out.getvalue()
    if header is None:
        return data
    end = data.index(b"\n") + 1
    return data[:10] + header.encode().ljust(end - 11) + b"\n" + data[end:]


# --- nothing is executed ----------------------------------------------------------------------------------


class Evil:
    """Unpickling it makes a file."""

    def __init__(self, marker: Path):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def test_the_hostile_pickle_runs_code(tmp_path):
    pickle.loads(pickle.dumps(Evil(tmp_path / "ran")))
    assert (tmp_path / "ran").exists()


@pytest.mark.parametrize("way", ["torch.save", "bare pickle", "archive"])
def test_checkpoints_with_code_are_refused_and_not_run(way, tiny_scene, run_copy, tmp_path):
    file, marker = run_copy / "checkpoints" / "step_000400.pt", tmp_path / "ran"
    if way == "torch.save":
        torch.save(torch.load(file, weights_only=True) | {"control": Evil(marker)}, file)
    elif way == "bare pickle":
        file.write_bytes(pickle.dumps({"step": Evil(marker)}))
    else:
        with zipfile.ZipFile(file) as archive:
            name = next(name for name in archive.namelist() if name.endswith("data.pkl"))
        change_npz(file, name, pickle.dumps({"step": Evil(marker)}))
    before = (run_copy / "scene.npz").read_bytes()
    sentence = refused(lambda: train(tiny_scene, run_copy, resume=True, quiet=True))
    assert str(file) in sentence and not marker.exists()
    assert (run_copy / "scene.npz").read_bytes() == before


@pytest.mark.parametrize("name", ["center", "kind", "format"])
def test_npz_files_with_code_are_refused_and_not_run(name, run_copy, tmp_path):
    marker = tmp_path / "ran"
    content = as_npy(np.array([Evil(marker)], dtype=object), allow_pickle=True)
    change_npz(run_copy / "training_frame.npz", f"{name}.npy", content)
    assert "training_frame.npz" in refused(Run.open(run_copy).primitives) and not marker.exists()


def test_depth_and_normals_with_code_are_refused_and_not_run(tmp_path):
    marker = tmp_path / "ran"
    evil = np.array([Evil(marker)], dtype=object)
    for suffix, save in ((".npy", np.save), (".npz", np.savez)):
        save(tmp_path / f"map{suffix}", evil, allow_pickle=True)
        refused(photos.read_depth, tmp_path / f"map{suffix}", 1.0, (1, 1))
    refused(photos.read_normals, tmp_path / "map.npy", (1, 1))
    assert not marker.exists()


def test_no_module_unpickles_or_evaluates():
    package = Path(fuzz.__file__).parents[1]
    banned = (
        "import pickle",
        "pickle.load",
        "allow_pickle=True",
        "weights_only=False",
        "yaml.load",
        " eval(",
        " exec(",
        "os.system(",
    )
    files = [*(package / "linprim_geo").rglob("*.py"), *(package / "eval").rglob("*.py")]
    assert len(files) > 60
    for path in files:
        text = path.read_text()
        assert not [word for word in banned if word in text], path
        for call in ("torch.load(", "np.load("):
            for part in text.split(call)[1:]:
                assert "weights_only=True" in part[:80] or "allow_pickle=False" in part[:80], path


# --- what fuzzing has found -------------------------------------------------------------------------------


def test_a_flipped_bit_in_a_checkpoint_is_refused(tiny_scene, run_copy):
    file = run_copy / "checkpoints" / "step_000400.pt"
    data = bytearray(file.read_bytes())
    center = torch.load(file, weights_only=True)["parameters"]["center"].numpy().tobytes()
    data[bytes(data).index(center) + 5] ^= 16
    file.write_bytes(data)
    assert "checksum" in refused(lambda: train(tiny_scene, run_copy, resume=True, quiet=True))


BAD_STATES = {
    "NaN": lambda s: s["parameters"]["center"].view(-1)[:1].fill_(float("nan")),
    "an infinite moment": lambda s: s["second"]["rotation"].view(-1)[:1].fill_(float("inf")),
    "a negative second moment": lambda s: s["second"]["rotation"].view(-1)[:1].fill_(-1.0),
    "a row too few": lambda s: s["first"].update(sh_dc=s["first"]["sh_dc"][1:].clone()),
    "no row": lambda s: s["parameters"].update({k: v[:0].clone() for k, v in s["parameters"].items()}),
    "doubles": lambda s: s["parameters"].update(center=s["parameters"]["center"].double()),
    "no tensor": lambda s: s["parameters"].update(center=[1.0]),
    "rows that are one row": lambda s: s["parameters"].update(center=s["parameters"]["center"][:1].expand(300, 3)),
    "a step of a half": lambda s: s.update(step=1.5),
    "a negative step": lambda s: s.update(step=-1),
    "bounds of one": lambda s: s.update(bounds=[1.0]),
    "bounds of NaN": lambda s: s.update(bounds=[float("nan"), 1.0]),
    "no control": lambda s: s.update(control=[]),
    "control of NaN": lambda s: s.update(control=[float("nan")] * 5),
    "a loss that is a word": lambda s: s.update(loss="x"),
    "accumulated of another length": lambda s: s["accumulated"].update(screen_gradient=torch.zeros(3)),
    "steps of another type": lambda s: s.update(steps=s["steps"].float()),
}


@pytest.mark.parametrize("damage", BAD_STATES)
def test_inconsistent_checkpoints_are_refused(damage, tiny_scene, run_copy):
    file = run_copy / "checkpoints" / "step_000400.pt"
    state = torch.load(file, weights_only=True)
    BAD_STATES[damage](state)
    torch.save(state, file)
    assert "checkpoint" in refused(lambda: train(tiny_scene, run_copy, resume=True, quiet=True))


def test_compressed_checkpoints_are_refused(run_copy):
    with zipfile.ZipFile(run_copy / "checkpoints" / "step_000400.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(10**8))
    begin = time.perf_counter()
    assert "compressed" in refused(read_checkpoint, run_copy)
    assert time.perf_counter() - begin < 1


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the peak cannot be set back")
def test_checkpoints_that_allocate_memory_are_refused(run_copy):
    """A file of 300 bytes lets torch's safe unpickler allocate 400 MB."""
    size = (400_000_000).to_bytes(4, "little")
    content = b"\x80\x02}X\x01\x00\x00\x00ac__builtin__\nbytearray\nJ" + size + b"\x85Rs."
    with zipfile.ZipFile(run_copy / "checkpoints" / "step_000400.pt", "w") as archive:
        archive.writestr("archive/data.pkl", content)
        archive.writestr("archive/version", "3\n")
    forget_peak()
    before = memory_gib()
    assert "holds '__builtin__ bytearray', wanted tensors" in refused(read_checkpoint, run_copy)
    assert peak_gib() < before + 0.02


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the peak cannot be set back")
def test_huge_array_headers_are_refused_without_allocation(tmp_path):
    """256 MiB of header pack into 256 KiB, and numpy reads a header whole."""
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.npy", b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**28) + b" " * 2**28)
    forget_peak()
    before = memory_gib()
    said = refused(photos.read_depth, tmp_path / "bomb.npz", 1.0, (6, 4))
    assert "bomb.npz: " in said and "claims 268435456 bytes" in said
    assert peak_gib() < before + 0.02


def test_unterminated_array_headers_are_refused(run_copy):
    content = as_npy(np.zeros((3, 3), np.float32), "{'descr': '<f4', 'shape': (")
    change_npz(run_copy / "scene.npz", "center.npy", content)
    assert "scene.npz" in refused(load_primitives, run_copy / "scene.npz")


def test_npz_members_before_the_file_start_are_refused(run_copy):
    file = run_copy / "scene.npz"
    data = bytearray(file.read_bytes())
    data[data.rindex(b"PK\5\6") + 16 :][:4] = b""
    start = bytes(data).rindex(b"PK\5\6") + 16
    data[start : start + 4] = (2**31 - 1).to_bytes(4, "little")
    file.write_bytes(data)
    assert "scene.npz" in refused(load_primitives, file)


def test_npz_files_that_claim_too_much_are_refused(tmp_path):
    shape = (10**9, 3)
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("format.npy", as_npy(np.array("linprim-geo primitives 2")))
        archive.writestr("kind.npy", as_npy(np.array("octahedron")))
        archive.writestr(
            "center.npy",
            as_npy(np.zeros(9, np.float32), f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}}}"),
        )
    assert "center claims" in refused(load_primitives, tmp_path / "bomb.npz")


def test_highly_compressed_primitives_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("format.npy", as_npy(np.array("linprim-geo primitives 2")))
        archive.writestr("kind.npy", as_npy(np.array("octahedron")))
        archive.writestr("center.npy", as_npy(np.zeros((5_000_000, 3), np.float32)))
    assert "center claims" in refused(load_primitives, tmp_path / "bomb.npz")


def write_own_arrays(folder: Path) -> dict:
    """Write files of internal arrays; return the reader of each."""
    grid = np.zeros((4, 3), np.int64)
    save_points(folder / "points.npz", PointCloud(np.zeros((5, 3)), np.zeros((5, 3), np.uint8)))
    save_lattice(
        folder / "lattice.npz",
        Lattice(grid, grid[:, 0], grid[:, 0], np.zeros(3), 0.1, 8, 3.0, (1.0, 0.5)),
        np.zeros(4, dtype=np.int64),
    )
    np.savez(folder / "part.npz", vertices=np.zeros((4, 3)), faces=grid)
    cloud = PointCloud(np.zeros((5, 3)), np.zeros((5, 3), np.uint8), np.zeros(5, np.float32))
    triangulate._store(folder / "stored.npz", cloud)
    return {
        "points.npz": load_points,
        "lattice.npz": load_lattice,
        "part.npz": load_part,
        "stored.npz": lambda path: triangulate._stored(path) or raise_none(path),
    }


def raise_none(path: Path):
    """Raise an error for an unusable cache entry, which trainings ignore silently."""
    raise LinprimError(f"{path}: claims nothing")


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("points.npz", "xyz"),
        ("points.npz", "rgb"),
        ("lattice.npz", "blocks"),
        ("lattice.npz", "rules"),
        ("part.npz", "faces"),
        ("stored.npz", "error_px"),
    ],
)
@pytest.mark.parametrize("packed", [False, True])
def test_internal_arrays_that_claim_too_much_are_refused_without_allocation(file, name, packed, tmp_path):
    """Either a header claims 100 MB, or 100 MB of zeros are compressed into 100 kB."""
    read = write_own_arrays(tmp_path)[file]
    assert read(tmp_path / file) is not None
    with np.load(tmp_path / file) as arrays:
        array = arrays[name]
    shape = (100_000_000 // array[:1].nbytes, *array.shape[1:])
    header = f"{{'descr': '{array.dtype.str}', 'fortran_order': False, 'shape': {shape}}}"
    content = as_npy(np.zeros((40, *array.shape[1:]), array.dtype), header)
    change_npz(tmp_path / file, f"{name}.npy", content + bytes(100_000_000 if packed else 0), packed)
    assert (tmp_path / file).stat().st_size < 1e6
    tracemalloc.start()
    said = refused(read, tmp_path / file)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert f"{file}: " in said and "claims" in said and peak < 10e6


@pytest.mark.parametrize("content", [b"PK", b"", as_npy(np.zeros(3))], ids=["a piece", "nothing", "an array"])
def test_damaged_internal_arrays_are_refused(content, tmp_path):
    for file, read in write_own_arrays(tmp_path).items():
        (tmp_path / file).write_bytes(content)
        assert f"{file}: " in refused(read, tmp_path / file)
    assert "no.npz: " in refused(load_points, tmp_path / "no.npz")


def test_internal_arrays_of_wrong_shape_or_type_are_refused(tmp_path):
    write_own_arrays(tmp_path)
    file = tmp_path / "points.npz"
    for rgb, sentence in (
        (np.zeros((5, 4), np.uint8), "rgb is uint8 of shape (5, 4), wanted kind u of shape (any, 3)"),
        (np.zeros((5, 3)), "rgb is float64 of shape (5, 3), wanted kind u"),
        (np.zeros((4, 3), np.uint8), "holds 5 points and 4 colours"),
    ):
        change_npz(file, "rgb.npy", as_npy(rgb))
        assert sentence in refused(load_points, file)
    np.savez(file, xyz=np.zeros((5, 3)))
    assert "the array rgb is missing" in refused(load_points, file)


@pytest.mark.parametrize("claim", ["a part", "an array"])
def test_glb_files_that_claim_too_much_are_refused(claim, tmp_path):
    content = {"asset": {"version": "2.0"}, "accessors": [{"componentType": 5126, "type": "VEC3", "count": 10**8}]}
    primitive = {"attributes": {"POSITION": 0}}
    content |= {"meshes": [{"primitives": [primitive]}], "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0}
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    parts = struct.pack("<I4s", len(text), b"JSON") + text
    if claim == "a part":
        parts += struct.pack("<I4s", 2**31, b"BIN\0")
    (tmp_path / "x.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts)
    for read in (load_mesh, load_textured):
        said = refused(read, tmp_path / "x.glb")
        assert "x.glb: " in said and "more than the file has" in said


def test_depths_beyond_float32_are_zero(tmp_path):
    np.save(tmp_path / "depth.npy", np.array([[1e300, 2.0], [-1e300, np.nan]]))
    assert photos.read_depth(tmp_path / "depth.npy", 1.0, (2, 2)).tolist() == [[0, 2], [0, 0]]


@pytest.mark.parametrize("kind", ["<c16", "S3", "<U2"])
def test_normals_of_wrong_type_are_refused(kind, tmp_path):
    np.save(tmp_path / "normal.npy", np.zeros((4, 5, 3), kind))
    assert "wanted three numbers" in refused(photos.read_normals, tmp_path / "normal.npy", (5, 4))


@pytest.mark.parametrize("value", [10**400, -1e300, float("inf"), "é" * 3000, [1], {}, True])
@pytest.mark.parametrize("key", ["fl_x", "cx", "k1", "w"])
def test_absurd_numbers_in_transforms_are_refused(key, value, tiny_scene, tmp_path):
    content = json.loads((tiny_scene / "transforms_train.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] = str(tiny_scene / frame["file_path"])
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps(content | {"w": 48, "h": 48, key: value}))
    refused(load_scene, file)


@pytest.mark.parametrize("path", ["a/" * 3000 + "x.png", "x" * 3000, "a\x00b.png", "\ud800.png", ""])
@pytest.mark.parametrize("key", ["file_path", "depth_file_path", "mask_path"])
def test_impossible_paths_are_refused(key, path, tiny_scene, tmp_path):
    content = json.loads((tiny_scene / "transforms_train.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] = str(tiny_scene / frame["file_path"])
        for other in ("depth_file_path", "normal_file_path"):
            frame.pop(other, None)
    content.pop("ply_file_path", None)
    content["frames"][1][key] = path
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    if path or key == "file_path":
        refused(load_scene, tmp_path)
    else:
        assert load_scene(tmp_path).views


def test_deeply_nested_json_is_refused(run_copy, tmp_path):
    for name in ("config.json", "run.json"):
        before = (run_copy / name).read_bytes()
        (run_copy / name).write_text("[" * 100_000)
        assert name in refused(lambda: Run.open(run_copy).state)
        (run_copy / name).write_bytes(before)
    for name, read in (("transforms.json", load_scene), ("crop.json", read_crop)):
        (tmp_path / name).write_text('{"frames": ' + "[" * 100_000)
        assert name in refused(read, tmp_path / name)


@pytest.mark.parametrize("name", ["iteration", "primitives", "seconds"])
@pytest.mark.parametrize("value", ["9", None, -1, True, float("nan")], ids=str)
def test_damaged_numbers_of_a_run_are_refused(name, value, run_copy):
    state = json.loads((run_copy / "run.json").read_text())
    (run_copy / "run.json").write_text(json.dumps(state | {name: value}))
    assert f"run.json: {name} is" in refused(lambda: Run.open(run_copy).state)


BENT_BACK = {"seconds": 9, "correction": {"step": 5, "iterations": 2}}
BAD_BUDGETS = ("x", [], {}, {"seconds": "x"}, {"seconds": 9, "finish_seconds": []}, BENT_BACK)


@pytest.mark.parametrize("budget", BAD_BUDGETS, ids=str)
def test_damaged_time_budgets_of_a_run_are_refused(budget, tiny_scene, run_copy):
    config = json.loads((run_copy / "config.json").read_text())
    (run_copy / "config.json").write_text(json.dumps(config | {"time_budget": budget}))
    assert "config.json" in refused(lambda: train(tiny_scene, run_copy, resume=True, quiet=True))


def test_points_with_duplicate_coordinates_are_refused(tmp_path):
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n" + "".join(
        f"property float {x}\n" for x in "xyyz"
    )
    (tmp_path / "points.ply").write_bytes(header.encode() + b"end_header\n" + bytes(16))
    assert "nothing twice" in refused(read_points_ply, tmp_path / "points.ply")


def test_meshes_with_two_coordinates_are_refused(tmp_path):
    (tmp_path / "flat.obj").write_text("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n")
    assert "three numbers" in refused(load_mesh, tmp_path / "flat.obj")


@pytest.mark.parametrize(
    "changes",
    [
        {176: 0x01000200},  # the numbers are of a type that does not exist
        {140: 0, 164: 15, 176: 15},  # the flags are empty, and name and numbers compressed
    ],
)
def test_matlab_files_that_crash_scipy_are_refused(changes, tmp_path):
    """scipy's reader would end the process on both."""
    savemat(tmp_path / "plane.mat", {"P": np.array([0, 0, 1.0, 2])})
    data = bytearray((tmp_path / "plane.mat").read_bytes())
    assert data[176:184] == (9).to_bytes(4, "little") + (32).to_bytes(4, "little")  # doubles, four of them
    for place, value in changes.items():
        data[place : place + 4] = value.to_bytes(4, "little")
    (tmp_path / "plane.mat").write_bytes(data)
    said = refused(read_plane, tmp_path / "plane.mat")
    assert "plane.mat: is not a MATLAB file up to version 7" in said


@pytest.mark.parametrize("value", ["text", np.array([1 + 2j]), {"a": 1.0}, np.array([1.0, "x"], object)])
def test_matlab_arrays_of_other_types_are_refused(value, tmp_path):
    savemat(tmp_path / "plane.mat", {"P": value})
    assert "expected real numbers" in refused(read_plane, tmp_path / "plane.mat")


def test_error_messages_are_one_line_of_bounded_length():
    text = str(LinprimError("a.ply: \n\n line" + "x" * 100_000 + " wanted y"))
    assert (
        text.startswith("a.ply: line")
        and text.endswith("wanted y")
        and len(text) <= LinprimError.LONGEST
        and "\n" not in text
    )


# --- the fuzzing itself -----------------------------------------------------------------------------------


def test_control_characters_in_names_are_not_printed(capsys, tmp_path):
    name = "\x1b]0;title\x07\x1b[2J\udcff.png"
    assert str(LinprimError(f"{name}: is none")) == "?]0;title??[2J?.png: is none"
    Progress("x", 1).note(f"{name}: left out\n  and so on")
    assert capsys.readouterr().err == "?]0;title??[2J?.png: left out\n  and so on\n"
    assert cli.main(["report", str(tmp_path / "\x1b[2J")]) == 1
    assert "\x1b" not in capsys.readouterr().err
