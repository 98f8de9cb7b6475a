"""Shell completion: candidates of bash, and scripts of other shells with all commands and options."""

from __future__ import annotations

import subprocess
import sys

import pytest

from linprim_geo.cli import main as cli
from linprim_geo.cli.completion import _parsers

# Does in bash what it does itself at a tab.
TAB = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
function=$(complete -p linprim-geo | sed 's/.*-F \\([^ ]*\\).*/\\1/')
"$function" linprim-geo "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD - 1]}"
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def bash_script(tmp_path_factory):
    path = tmp_path_factory.mktemp("completion") / "linprim-geo.bash"
    done = subprocess.run(
        [sys.executable, "-m", "linprim_geo", "completion", "bash"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    path.write_text(done.stdout)
    return path


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("ev", {"eval-depth", "eval-images", "eval-mesh"}),
        ("train --max-pr", {"--max-primitives"}),
        ("train --order _", {"center", "entry", "overlap"}),
        ("eval-mesh a.ply b.ply --protocol d", {"dtu"}),
        ("train capt", {"capture"}),
        ("eval-mesh m", {"mesh.ply"}),
        ("extract-mesh run -o m", {"mesh.ply"}),
        ("render run -o _", {"capture"}),
    ],
)
def test_bash_completes_commands_options_choices_and_files(line, offered, bash_script, tmp_path):
    (tmp_path / "capture").mkdir()
    (tmp_path / "mesh.ply").touch()
    words = ["" if word == "_" else word for word in line.split()]
    done = subprocess.run(
        ["bash", "-c", TAB, "bash", str(bash_script), "linprim-geo", *words],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=60,
    )
    assert set(done.stdout.split()) == offered, done.stderr


@pytest.mark.parametrize(("shell", "first"), [("zsh", "#compdef linprim-geo"), ("fish", "complete -c linprim-geo")])
def test_scripts_of_other_shells_contain_every_command_and_option(shell, first, capsys):
    assert cli.main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert first in script
    for parser in _parsers(cli.build_parser()):
        assert parser.prog.split()[-1] in script
        for action in parser._actions:
            for option in action.option_strings:
                assert option.lstrip("-") in script, option


def test_missing_shtab_is_reported(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert cli.main(["completion", "zsh"]) == 1
    shown = capsys.readouterr()
    assert shown.out == "" and "pip install shtab" in shown.err and shown.err.count("\n") == 1
