"""Invalid arguments and inputs: one-line errors with suggestions."""

from __future__ import annotations

import json
import sys

import pytest

from linprim_geo.cli import main as cli


@pytest.mark.parametrize(
    "arguments",
    [
        "",
        "nonsense",
        "train a --iter 5",
        "train a --iterations x",
        "eval-mesh a",
        "eval-mesh a b --tau x",
        "train a --primitive cube",
        "train a --filter 2d",
        "synth out --size 3x",
        "synth out --shading dark",
        "synth out --scene cad --mesh x.ply",
        "convert a",
        "render run --split x",
    ],
)
def test_wrong_arguments_exit_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as leaving:
        cli.main(arguments.split())
    assert leaving.value.code == 2
    assert "error:" in capsys.readouterr().err


def test_threads_have_a_range(capsys):
    with pytest.raises(SystemExit):
        cli.main(["render", "r", "--threads", "5000"])
    assert "5000 is not 0 to 4096" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["train", "extract-mesh"])
@pytest.mark.parametrize("given", ["--workers 3", "--cluster local"])
def test_workers_for_one_block_are_refused(command, given, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main([command, "a", *given.split()]) == cli.EXIT_UNUSABLE
    assert f"{given.replace(' ', ' is ')}, but there is one block" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="makes a symbolic link")
@pytest.mark.parametrize("command", ["train", "inspect", "tradeoff", "render"])
def test_a_circular_link_is_refused(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert cli.main([command, "loop"]) == cli.EXIT_UNUSABLE
    said = capsys.readouterr().err
    assert said.startswith("linprim-geo: error: loop") and said.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["loop"]


def test_non_finite_faces_are_reported_and_the_rest_is_scored(tmp_path, capsys):
    square = "\n0 0 0\n1 0 0\n1 1 0\n{} 1 0\n3 0 1 2\n3 0 2 3\n"
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 2\nproperty list uchar int vertex_indices\nend_header"
    (tmp_path / "whole.ply").write_text(head + square.format(0))
    (tmp_path / "broken.ply").write_text(head + square.format("nan"))
    assert (
        cli.main(["eval-mesh", str(tmp_path / "broken.ply"), str(tmp_path / "whole.ply"), "--samples", "100", "--json"])
        == 0
    )
    shown = capsys.readouterr()
    assert json.loads(shown.out)["dropped"]["prediction"]["not_finite"] == 1
    assert (
        shown.err == f"linprim-geo: {tmp_path / 'broken.ply'}: faces left out because a coordinate is not finite: 1\n"
    )


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("trian scene", "(did you mean train?); linprim-geo --help explains"),
        ("train scene -o run --iteration 5", "--iteration 5 (did you mean --iterations?); linprim-geo train --help"),
        ("eval-mesh a b --sampels=5", "(did you mean --samples?); linprim-geo eval-mesh --help explains"),
        ("synth out --scene rom", "(did you mean room?); linprim-geo synth --help explains"),
        ("train scene -o run --zzzz", "unrecognized arguments: --zzzz; linprim-geo train --help explains"),
    ],
)
def test_wrong_arguments_get_one_line_with_a_suggestion(line, said, capsys):
    with pytest.raises(SystemExit) as leaving:
        cli.main(line.split())
    out, error = capsys.readouterr()
    assert leaving.value.code == 2 and not out
    assert error.count("\n") == 1 and error.startswith("linprim-geo: error: ") and said in error


def test_a_folder_without_a_run_is_refused_with_a_hint(tmp_path, capsys):
    assert cli.main(["extract-mesh", str(tmp_path)]) == 1
    assert "config.json is missing" in (error := capsys.readouterr().err) and "linprim-geo train" in error
