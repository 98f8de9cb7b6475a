"""Content of the source distribution, from which wheels are built."""

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_source_distribution_contains_every_file_of_the_packages():
    pathspec = pytest.importorskip("pathspec", reason="comes with mypy, of the extra dev")
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["scikit-build"]
    left_out = pathspec.GitIgnoreSpec.from_lines(settings["sdist"]["exclude"])
    folders = [ROOT / name for name in ("linprim_geo", "eval", "csrc")]
    files = [file for folder in folders for file in folder.rglob("*") if file.is_file() and file.suffix != ".pyc"]
    assert len(files) > 200
    assert not [name for file in files if left_out.match_file(name := file.relative_to(ROOT).as_posix())]
    assert left_out.match_file("runs/demo/report.html")
