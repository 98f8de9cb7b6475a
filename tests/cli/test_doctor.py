"""The doctor: libraries, compiler, system libraries and the cache."""

from __future__ import annotations

import json
import sys
import types

from linprim_geo.base import system
from linprim_geo.cli import doctor
from linprim_geo.cli import main as cli


def test_doctor_shows_the_cache(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(doctor, "LIBRARIES", (("numpy", ("numpy",)),))
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "kept.npz").write_bytes(b"x" * 1000)
    monkeypatch.setenv("LINPRIM_GEO_CACHE", str(tmp_path / "cache"))
    cli.main(["doctor", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert (report["cache"], report["cache_bytes"]) == (str(tmp_path / "cache"), 1000)
    cli.main(["doctor"])
    assert f"cache: {tmp_path / 'cache'}" in capsys.readouterr().out
    monkeypatch.setenv("LINPRIM_GEO_CACHE", str(tmp_path / "cache" / "kept.npz" / "inside"))
    cli.main(["doctor", "--json"])
    problems = json.loads(capsys.readouterr().out)["problems"]
    assert any("LINPRIM_GEO_CACHE" in problem for problem in problems)


def test_doctor_names_missing_libraries(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "LIBRARIES", (("numpy", ("numpy",)), ("no_such_module", ("no-such-package",))))
    assert cli.main(["doctor", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["libraries"]["numpy"] and report["libraries"]["no_such_module"] is None
    assert any("no_such_module is not installed" in problem for problem in report["problems"])
    assert report["cores"] >= 1 and report["memory_bytes"] > 0
    cli.main(["doctor"])
    assert "no_such_module MISSING" in capsys.readouterr().out


def test_doctor_reports_low_memory_and_disk_space(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(doctor, "LIBRARIES", (("numpy", ("numpy",)),))
    monkeypatch.setattr(doctor, "_memory", lambda: (8 * 2**30, 3 * 2**30, 8 * 2**30))
    usage = types.SimpleNamespace(free=3 * 2**29)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda folder: usage)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["doctor"]) == 1
    shown = capsys.readouterr().out
    assert "only 3.0 GiB of memory are free" in shown and f"only 1.5 GiB are free on the disk of {tmp_path}" in shown
    monkeypatch.setattr(doctor, "_memory", lambda: (8 * 2**30, 4 * 2**30, 8 * 2**30))
    usage.free = 2 * 2**30
    assert cli.main(["doctor"]) == 0
    assert "are free on the disk" not in capsys.readouterr().out


def test_missing_system_libraries_come_with_an_install_command(monkeypatch):
    absent = system.SystemLibrary("libnosuch.so.9", "libnosuch9", "nosuch", "nothing")
    monkeypatch.setattr(system, "LINUX_LIBRARIES", (absent,))
    monkeypatch.setattr(sys, "platform", "linux")
    assert system.missing_libraries() == [absent]
    monkeypatch.setattr(system.shutil, "which", lambda name: name if name == "apt-get" else None)
    assert system.install_command([absent])[-1] == "libnosuch9"
    monkeypatch.setattr(system.shutil, "which", lambda name: name if name == "dnf" else None)
    assert system.install_command([absent])[-1] == "nosuch"
    monkeypatch.setattr(system.shutil, "which", lambda name: None)
    assert system.install_command([absent]) is None


def test_a_compiler_without_cxx20_is_named(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert "no-such-compiler does not compile C++20" in system.compiler_problem()


def test_doctor_reports_limits_of_containers(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "LIBRARIES", (("numpy", ("numpy",)),))
    monkeypatch.setattr(doctor, "container", lambda: "podman")
    monkeypatch.setattr(doctor, "usable_cores", lambda: 2)
    monkeypatch.setattr(doctor.os, "cpu_count", lambda: 16)
    monkeypatch.setattr(doctor, "core_quota", lambda: 1.5)
    monkeypatch.setattr(doctor, "_memory", lambda: (8 * 2**30, 6 * 2**30, 64 * 2**30))
    cli.main(["doctor"])
    shown = capsys.readouterr().out
    for line in (
        "2 cores, 8.0 GiB of memory (6.0 GiB free)",
        "container: podman",
        "quota: 1.5 of the machine's 16 cores",
        "limit: 8.0 GiB of the machine's 64.0 GiB of memory",
        "instruction set: ",
    ):
        assert line in shown
    monkeypatch.setattr(doctor, "core_quota", lambda: None)
    cli.main(["doctor"])
    assert "affinity: 2 of the machine's 16 cores" in capsys.readouterr().out
