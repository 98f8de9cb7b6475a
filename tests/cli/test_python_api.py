"""The package as a library: lazily imported names, and the Python examples of the documentation."""

from __future__ import annotations

import contextlib
import inspect
import io
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import linprim_geo as lg
from linprim_geo.cli import main as cli

ROOT = Path(__file__).resolve().parents[2]
README, PYTHON = ROOT / "README.md", ROOT / "docs" / "python.md"
DOCUMENTS = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "tests").glob("*.md")]


def examples(page: Path) -> list[str]:
    """The Python blocks of a page, each preceded by empty lines, so that errors have the line numbers of the page."""
    text = page.read_text(encoding="utf-8")
    found = [(m.start(1), m.group(1)) for m in re.finditer(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)]
    return ["\n" * text[:start].count("\n") + code for start, code in found]


def run_examples(page: Path) -> tuple[dict, str]:
    """Variables after all blocks have run in order, and the printed text."""
    names: dict = {"__name__": "__main__"}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        for code in examples(page):
            exec(compile(code, str(page), "exec"), names)
    return names, printed.getvalue()


def test_the_examples_of_the_readme_run(tiny_run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "mine").symlink_to(tiny_run, target_is_directory=True)
    names, printed = run_examples(README)
    assert len(examples(README)) >= 1 and printed
    assert all(float(tensor.grad.abs().sum()) > 0 for tensor in names["tensors"][:4])


def test_the_examples_of_the_page_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names, printed = run_examples(PYTHON)
    assert len(examples(PYTHON)) == 5
    # Measured (see tests/README.md): 23.38 to 23.76 dB, 0.84 to 0.96 %.
    assert names["trained"]["psnr"] > 22.3 and 0 < names["scores"]["chamfer_percent_diagonal"] < 1.2
    assert all(float(tensor.grad.abs().sum()) > 0 for tensor in names["tensors"])
    assert printed.splitlines()[-1].startswith("no such folder: ")
    for name in ("half.glb", "part.ply", "primitives.ply", "part.npz"):
        assert (tmp_path / name).stat().st_size > 1000


def anchors(page: Path) -> set[str]:
    """Anchors of a page: its headings as GitHub writes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_existing_files_and_headings(page):
    text = page.read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r"^\[[^\]]+\]: (\S+)$", text, re.MULTILINE)
    for link in links:
        file, _, heading = link.partition("#")
        if file.startswith("http"):
            continue
        target = (page.parent / file).resolve() if file else page
        assert target.exists(), link
        assert not heading or heading in anchors(target), link


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_and_modules_named_in_pages_exist(page):
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"(?<![\w./])(?:linprim_geo|eval|csrc|tools|tests|docs)/[\w./]*\w", text)
    named += [
        name.replace(".", "/").replace("linprim_geo/eval", "eval")
        for name in re.findall(r"-m (linprim_geo[\w.]+)", text)
    ]
    for name in named:
        assert any((ROOT / f"{name}{suffix}").exists() for suffix in ("", ".py")), name


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_shown_in_pages_are_valid(page):
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    shown = "".join(block for language, block in blocks if not language)
    for line in re.findall(r"^linprim-geo (.*)$", shown, re.MULTILINE):
        words = shlex.split(line, comments=True)
        if not any(word.isupper() for word in words):
            cli.build_parser().parse_args(words)


def test_documented_packages_agree_with_pyproject():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    wanted = [name for layer in layers for name in layer.split(" | ")]
    text = (ROOT / "docs" / "developing.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^\| \d* ?\| `(\w+)`", text, re.MULTILINE)) == sorted(wanted)


def test_figures_of_the_readme_are_in_the_results():
    rows = re.findall(r"^\| .* (?:dB|%) \| .*$", README.read_text(encoding="utf-8"), re.MULTILINE)
    measured = re.findall(r"\d[\d.]*", (ROOT / "docs" / "results.md").read_text(encoding="utf-8"))
    assert len(rows) == 5
    for row in rows:
        assert set(re.findall(r"(\d[\d.]*) (?:s|dB|%) ", row)) <= set(measured), row


def test_the_readme_is_short():
    lines = README.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 130 and max(map(len, lines)) <= 100


def test_the_page_names_every_command():
    text = PYTHON.read_text(encoding="utf-8")
    (commands,) = (
        action.choices for action in cli.build_parser()._actions if action.dest == "==SUPPRESS==" and action.choices
    )
    for command in commands.keys() - {"completion"}:
        # `stereo` is a package.
        name = {"stereo": "dense_stereo"}.get(command, command.replace("-", "_"))
        assert f"lg.{name}(" in text, command


def test_importing_the_package_imports_no_library():
    code = "import sys, linprim_geo as lg; print('torch' in sys.modules or 'numpy' in sys.modules, 'train' in dir(lg))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "False True\n"), done.stderr


def test_public_names_exist_and_agree_with_type_stubs():
    for name in lg._PUBLIC:
        assert callable(getattr(lg, name)) and name in dir(lg)
    assert list(inspect.signature(lg.train).parameters)[:2] == ["scene", "run"]
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        lg.nothing  # noqa: B018
    # Names for type checkers agree with the public ones.
    source = (ROOT / "linprim_geo" / "__init__.py").read_text()
    seen = re.findall(r"^    from linprim_geo\.([\w.]+) import (\w+) as (\w+)$", source, re.MULTILINE)
    assert {name: (module, inner) for module, inner, name in seen} == lg._PUBLIC
