"""Atomic writes: the old file stays until the new one is complete, and no partial file is left."""

from __future__ import annotations

import errno
import json
import os
import stat
import subprocess
import sys

import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write, locked, remove_temporary, write_json


@pytest.fixture
def old(tmp_path):
    path = tmp_path / "mesh.ply"
    path.write_text("old")
    return path


def assert_untouched(old):
    assert old.read_text() == "old"
    assert [entry.name for entry in old.parent.iterdir()] == ["mesh.ply"]


def test_atomic_write_replaces_the_file_only_at_the_end(old):
    with atomic_write(old) as temporary:
        assert temporary.suffix == ".ply" and temporary.parent == old.parent and temporary != old
        temporary.write_text("new")
        assert old.read_text() == "old"
    assert old.read_text() == "new"
    assert [entry.name for entry in old.parent.iterdir()] == ["mesh.ply"]


def test_missing_folders_are_created(tmp_path):
    with atomic_write(tmp_path / "a" / "b" / "c.json") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "a" / "b" / "c.json").read_text() == "new"


def test_permissions_follow_the_umask(tmp_path):
    # Runs in a separate process because the mask is read once, at import.
    code = "import os, sys; os.umask(0o027); from linprim_geo.base.files import write_json; write_json(sys.argv[1], {})"
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "x.json")], check=True)
    assert stat.S_IMODE((tmp_path / "x.json").stat().st_mode) == 0o640


@pytest.mark.parametrize("error", [ValueError("wrong"), KeyboardInterrupt(), SystemExit(3), MemoryError()])
def test_an_error_inside_keeps_the_old_file(old, error):
    with pytest.raises(type(error)), atomic_write(old) as temporary:
        temporary.write_text("half")
        raise error
    assert_untouched(old)


def test_an_error_without_an_old_file_leaves_nothing(tmp_path):
    with pytest.raises(ValueError), atomic_write(tmp_path / "new.ply") as temporary:
        temporary.write_text("half")
        raise ValueError
    assert list(tmp_path.iterdir()) == []


def test_full_disk_while_writing_is_reported(old):
    with (
        pytest.raises(LinprimError, match=r"mesh\.ply.*(disk is full|no space)"),
        atomic_write(old) as temporary,
    ):
        temporary.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")
    assert_untouched(old)


@pytest.mark.parametrize("function", ["fsync", "replace"])
def test_full_disk_at_fsync_or_rename_is_reported(old, function, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, function, full)
    with (
        pytest.raises(LinprimError, match=r"mesh\.ply.*(disk is full|no space)"),
        atomic_write(old) as temporary,
    ):
        temporary.write_text("new")
    monkeypatch.undo()
    assert_untouched(old)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_full_device_is_reported(old):
    with pytest.raises(LinprimError, match=r"(disk is full|no space)"), atomic_write(old):
        with open("/dev/full", "wb") as file:
            file.write(b"x" * 100_000)
    assert_untouched(old)


def test_file_size_limit_is_reported(old):
    """A limit of the file size stands in for a quota. Python and torch raise different errors."""
    import resource

    import torch

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for write in (lambda file: file.write(bytes(100_000)), lambda file: torch.save({"x": torch.zeros(9000)}, file)):
        with pytest.raises(LinprimError, match=r"mesh\.ply: no space left"), atomic_write(old) as temporary:
            try:
                resource.setrlimit(resource.RLIMIT_FSIZE, (1024, hard))
                with open(temporary, "wb") as file:
                    write(file)
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert_untouched(old)


def test_file_is_synced_before_the_rename_and_its_folder_after(old, monkeypatch):
    happened = []
    fsync, replace = os.fsync, os.replace

    def synced(handle):
        happened.append("folder" if stat.S_ISDIR(os.fstat(handle).st_mode) else "file")
        fsync(handle)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", lambda *names: (happened.append("rename"), replace(*names)))
    write_json(old, {})
    assert happened == ["file", "rename", "folder"]


def test_remove_temporary_deletes_only_leftovers_of_that_file(tmp_path):
    for name in (".mesh.abc.tmp.ply", ".mesh_visible.abc.tmp.ply", ".mesh.abc.tmp.obj", "mesh.ply", "mesh.tmp.ply"):
        (tmp_path / name).touch()
    remove_temporary(tmp_path / "mesh.ply")
    left = [".mesh.abc.tmp.obj", ".mesh_visible.abc.tmp.ply", "mesh.ply", "mesh.tmp.ply"]
    assert sorted(path.name for path in tmp_path.iterdir()) == left


def test_write_below_a_file_is_refused(old):
    with pytest.raises(LinprimError, match="mesh.ply"), atomic_write(old / "inside.json") as temporary:
        temporary.write_text("new")
    assert_untouched(old)


def test_locked_names_the_file_in_place_of_a_folder(old):
    for name in ("", "mesh.ply"):
        with (
            pytest.raises(LinprimError, match=r"mesh\.ply: is a file, wanted a folder"),
            locked(old / "runs" / "one", "written", name),
        ):
            pass
    assert_untouched(old)


def test_write_json_converts_arrays_paths_and_non_finite_numbers(tmp_path):
    import numpy as np

    value = {
        "nan": float("nan"),
        "inf": [np.float32("inf")],
        "array": np.arange(3),
        "path": tmp_path,
        1: "key",
    }
    write_json(tmp_path / "x.json", value)
    text = (tmp_path / "x.json").read_text()
    read = json.loads(text, parse_constant=pytest.fail)
    assert read == {"nan": None, "inf": [None], "array": [0, 1, 2], "path": str(tmp_path), "1": "key"}
