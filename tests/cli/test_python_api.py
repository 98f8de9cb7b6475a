"""The package as a library: names that are imported when they are used, and every Python example of the pages as it
stands there."""

from __future__ import annotations

import contextlib
import inspect
import io
import re
import subprocess
import sys
from pathlib import Path

import pytest

import linprim_geo as lg
from linprim_geo.cli import main as cli

ROOT = Path(__file__).resolve().parents[2]
README, PYTHON = ROOT / "README.md", ROOT / "docs" / "python.md"


def examples(page: Path) -> list[str]:
    """The Python blocks of a page, each with as many empty lines before it as the page has, so that errors name the
    page's lines."""
    text = page.read_text(encoding="utf-8")
    found = [(m.start(1), m.group(1)) for m in re.finditer(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)]
    return ["\n" * text[:start].count("\n") + code for start, code in found]


def run_examples(page: Path) -> tuple[dict, str]:
    """What the names stand for after the blocks have run one after the other, and what they printed."""
    names: dict = {"__name__": "__main__"}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        for code in examples(page):
            exec(compile(code, str(page), "exec"), names)
    return names, printed.getvalue()


def test_the_examples_of_the_readme_run(tiny_run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "demo").mkdir(parents=True)
    (tmp_path / "runs" / "demo" / "run").symlink_to(tiny_run, target_is_directory=True)
    names, printed = run_examples(README)
    assert len(examples(README)) >= 1 and printed
    assert all(float(tensor.grad.abs().sum()) > 0 for tensor in names["tensors"][:4])


def test_the_examples_of_the_page_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names, printed = run_examples(PYTHON)
    assert len(examples(PYTHON)) == 5
    assert names["trained"]["psnr"] > 15 and 0 < names["scores"]["chamfer_percent_diagonal"] < 10
    assert all(float(tensor.grad.abs().sum()) > 0 for tensor in names["tensors"])
    assert printed.splitlines()[-1].startswith("no such folder: ")
    for name in ("half.glb", "part.ply", "primitives.ply", "part.npz"):
        assert (tmp_path / name).stat().st_size > 1000


def test_the_page_names_every_command():
    text = PYTHON.read_text(encoding="utf-8")
    (commands,) = (
        action.choices for action in cli.build_parser()._actions if action.dest == "==SUPPRESS==" and action.choices
    )
    for command in commands.keys() - {"completion"}:
        assert f"lg.{command.replace('-', '_')}(" in text, command


def test_importing_the_package_imports_no_library():
    code = "import sys, linprim_geo as lg; print('torch' in sys.modules or 'numpy' in sys.modules, 'train' in dir(lg))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "False True\n"), done.stderr


def test_every_public_name_is_there_and_no_other():
    for name in lg._PUBLIC:
        assert callable(getattr(lg, name)) and name in dir(lg)
    assert list(inspect.signature(lg.train).parameters)[:2] == ["scene", "run"]
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        lg.nothing  # noqa: B018
    # What type checkers see is what there is.
    source = (ROOT / "linprim_geo" / "__init__.py").read_text()
    seen = re.findall(r"^    from linprim_geo\.([\w.]+) import (\w+) as (\w+)$", source, re.MULTILINE)
    assert {name: (module, inner) for module, inner, name in seen} == lg._PUBLIC
