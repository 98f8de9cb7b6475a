"""The command line: options, exit statuses, output streams, and fast help."""

from __future__ import annotations

import dataclasses
import errno
import importlib
import inspect
import json
import os
import re
import signal
import subprocess
import sys
import types
from pathlib import Path

import pytest
from helpers.planted import plant_modules

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions, SceneOptions, TrainOptions, option
from linprim_geo.cli import arguments
from linprim_geo.cli import main as cli
from linprim_geo.cli.options import add_options
from linprim_geo.synthetic.options import SynthOptions

HEAVY = {
    "torch",
    "open3d",
    "pymeshlab",
    "trimesh",
    "igl",
    "pycolmap",
    "embreex",
    "manifold3d",
    "scipy",
    "PIL",
    "numpy",
    "viser",
    "filelock",
    "psutil",
    "jinja2",
    "matplotlib",
}
COMMANDS = (
    "train inspect render extract-mesh stereo eval-depth eval-images eval-mesh report view tradeoff synth "
    "convert doctor demo completion"
).split()


def run_python(code: str, *flags: str, **settings) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, *flags, "-c", code], capture_output=True, text=True, timeout=60, **settings)


def run_with_convert(body: str, *arguments: str) -> str:
    """Source of a program that runs `linprim-geo convert a b` with `body` as conversion."""
    return (
        "import os, sys, time\nimport linprim_geo.surface.convert as module\nfrom linprim_geo.cli.main import main\n"
        "module.describe = str\n"
        f"def convert(*_):\n    {body}\nmodule.convert = convert\n"
        f"sys.exit(main(['convert', 'a', 'b', *{arguments!r}]))"
    )


@pytest.fixture
def failing_convert(monkeypatch):
    def replace(error):
        def convert(*_):
            raise error

        monkeypatch.setattr("linprim_geo.surface.convert.convert", convert)

    return replace


@pytest.fixture
def recorded_train(monkeypatch):
    """Replace the training by a function that records its arguments."""
    calls = []

    def train(scene, run, scene_options, train_options, **settings):
        calls.append((str(scene), str(run), scene_options, train_options, settings))
        return {"psnr": float("nan"), "primitives": 7}

    monkeypatch.setitem(sys.modules, "linprim_geo.training.train", types.SimpleNamespace(train=train))
    return calls


@pytest.mark.parametrize("arguments", [["--help"], ["train", "--help"], ["eval-mesh", "--help"], ["--version"]])
def test_help_imports_no_library(arguments):
    done = run_python(f"from linprim_geo.cli.main import main; main({arguments!r})", "-X", "importtime")
    assert done.returncode == 0 and done.stdout
    imported = {line.split("|")[-1].strip().split(".")[0] for line in done.stderr.splitlines()}
    assert "argparse" in imported
    assert not imported & HEAVY


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as leaving:
        cli.main([command, "--help"])
    assert leaving.value.code == 0
    text = capsys.readouterr().out
    assert "--json" in text and "--debug" in text


def test_every_field_of_the_training_options_is_an_option(capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", "--help"])
    text = capsys.readouterr().out
    for field in (*dataclasses.fields(SceneOptions), *dataclasses.fields(TrainOptions)):
        assert f"--{field.name.replace('_', '-')} " in text


def test_options_round_trip_to_their_dataclass():
    @dataclasses.dataclass(frozen=True)
    class Options:
        step_size: float = option(0.5, "share, up to 100%")
        kind: str = option("a", "which", choices=("a", "b"))
        count: int = option(3, "how many", metavar="COUNT")
        fast: bool = option(False, "hurry")

    parser = cli.argparse.ArgumentParser()
    add_options(parser, Options)
    assert "100%" in parser.format_help() and "COUNT" in parser.format_help()
    assert arguments.from_args(Options, parser.parse_args([])) == Options()
    given = parser.parse_args("--step-size 2 --kind b --count 9 --fast".split())
    assert arguments.from_args(Options, given) == Options(2.0, "b", 9, True)
    for wrong in ("--kind c", "--count 1.5", "--step-size x"):
        with pytest.raises(SystemExit) as leaving:
            parser.parse_args(wrong.split())
        assert leaving.value.code == 2


def test_train_receives_the_given_options(recorded_train, capsys):
    assert cli.main("train data/lego -o out --iterations 12 --downscale 4 --resume --quiet".split()) == 0
    assert cli.main(["train", "data/lego/"]) == 0
    (scene, run, scene_options, train_options, settings), (_, default_run, *_, by_default) = recorded_train
    assert (scene, run, default_run) == ("data/lego", "out", os.path.join("runs", "lego"))
    assert scene_options == SceneOptions(downscale=4)
    assert train_options == TrainOptions(iterations=12)
    choice = settings.pop("effects")
    # A run that goes on has its effects.
    assert (choice.mode, choice.asked, choice.given) == ("none", {}, {"iterations", "downscale"})
    assert (by_default["effects"].mode, by_default["effects"].given) == ("auto", frozenset())
    assert settings == {"resume": True, "quiet": True, "blocks": 1, "cluster": None, "workers": 0}
    assert "primitives: 7" in capsys.readouterr().out


def test_options_of_blocks_are_passed_on(recorded_train):
    assert cli.main("train data/lego --blocks auto".split()) == 0
    assert cli.main("train data/lego --blocks 4 --cluster local --workers 3".split()) == 0
    said = [tuple(call[4][name] for name in ("blocks", "cluster", "workers")) for call in recorded_train]
    assert said == [("auto", None, 0), (4, "local", 3)]
    with pytest.raises(SystemExit):
        cli.main("train data/lego --blocks some".split())


def test_options_of_3dgs_are_understood(recorded_train, tiny_scene):
    assert cli.main("train -s data/lego -m out -r 2 --eval --iterations 5".split()) == 0
    line = f"train --source_path {tiny_scene} --model_path out -r".split()
    for resolution in ("-1", "48", "47", "16", "5"):
        assert cli.main([*line, resolution]) == 0
    assert [call[0] for call in recorded_train] == ["data/lego", *[str(tiny_scene)] * 5]
    # Images are 48 wide; pixels are averaged, so a width is one that is at most what was asked for.
    assert [call[2].downscale for call in recorded_train] == [2, "auto", 1, 2, 3, 10]
    assert {call[1] for call in recorded_train} == {"out"}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("-r 0", "-r is 0, wanted 1, 2, 4, 8"),
        ("-r -7", "-r is -7"),
        ("-r 2 --downscale 2", "wanted one of them"),
        ("-r 300", "data/lego"),
    ],
)
def test_invalid_resolutions_are_refused(arguments, sentence, recorded_train, capsys):
    assert cli.main(["train", "-s", "data/lego", *arguments.split()]) == 1
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1 and not recorded_train


def test_kinds_and_rules_are_parsed(recorded_train):
    line = "train a --primitive tetrahedron --ray-model affine --order overlap --filter 3d+screen --population mcmc"
    assert cli.main(line.split()) == 0
    options = recorded_train[0][3]
    assert (options.primitive, options.ray_model, options.order) == ("tetrahedron", "affine", "overlap")
    assert (options.filter, options.population) == ("3d+screen", "mcmc")


@pytest.mark.parametrize("arguments", ["train", "train a -s b"])
def test_train_requires_exactly_one_scene(arguments, capsys):
    assert cli.main(arguments.split()) == 1
    assert "one scene" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "status", "sentence"),
    [
        (LinprimError("photos: no images\nwere found"), 1, "photos: no images were found"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (
            OSError(errno.ENOSPC, "No space left on device", "x.ply"),
            1,
            "the disk is full while writing x.ply",
        ),
        (PermissionError(errno.EACCES, "Permission denied", "x.ply"), 1, "x.ply: Permission denied"),
        (MemoryError(), 1, "out of memory"),
        (
            ModuleNotFoundError("No module named 'open3d'", name="open3d"),
            1,
            "the library open3d is not installed",
        ),
        (ZeroDivisionError("division\nby zero"), 70, "internal error: ZeroDivisionError: division by zero"),
    ],
)
def test_errors_are_printed_in_one_line(error, status, sentence, failing_convert, capsys):
    failing_convert(error)
    assert cli.main(["convert", "a", "b"]) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"linprim-geo: error: {sentence}")
    assert captured.err.count("\n") == 1
    if status == 70:
        assert "--debug" in captured.err
    assert cli.main(["convert", "a", "b", "--debug"]) == status
    assert "Traceback" in capsys.readouterr().err


def test_json_is_the_only_output_on_stdout():
    noise = "os.write(1, b'from C'); print('from Python')"
    result = "return {'x': float('nan'), 'y': [1, 2.5]}"
    done = run_python(run_with_convert(f"{noise}; {result}", "--json"))
    assert done.returncode == 0
    assert json.loads(done.stdout) == {"x": None, "y": [1, 2.5]} and done.stdout.count("\n") == 1
    assert "from C" in done.stderr and "from Python" in done.stderr


def test_json_prints_nothing_on_stdout_after_an_error():
    done = run_python(run_with_convert("raise ValueError('no')", "--json"))
    assert (done.returncode, done.stdout) == (70, "")


def test_json_may_precede_the_command(recorded_train, capsys):
    assert cli.main(["--json", "train", "a"]) == 0
    assert json.loads(capsys.readouterr().out) == {"psnr": None, "primitives": 7}
    assert len(recorded_train) == 1


def test_a_closed_pipe_gives_no_traceback():
    reading, writing = os.pipe()
    os.close(reading)
    try:
        code = run_with_convert("return {'text': 'x' * 200000}")
        done = subprocess.run(
            [sys.executable, "-c", code], stdout=writing, stderr=subprocess.PIPE, text=True, timeout=60
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


def test_ctrl_c_prints_one_line():
    code = run_with_convert("print('ready', flush=True); time.sleep(30)")
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell's background job ignores it
    )
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    _, shown = process.communicate(timeout=30)
    assert (process.returncode, shown) == (130, "linprim-geo: error: interrupted\n")


def test_python_m_runs_the_same_program():
    done = subprocess.run(
        [sys.executable, "-m", "linprim_geo", "--version"], capture_output=True, text=True, timeout=60
    )
    assert re.fullmatch(r"linprim-geo \d+\.\d+\.\d+\n", done.stdout)


@pytest.mark.parametrize("words", [["linprim-geo"], ["python", "-m", "linprim_geo"]])
def test_commands_import_nothing_from_the_working_directory(words, tmp_path):
    plant_modules(tmp_path)
    words = [str(Path(sys.executable).with_name(words[0])), *words[1:]]
    done = subprocess.run([*words, "inspect", "."], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and ".: " in done.stderr, done.stderr
    assert not (tmp_path / "imported").exists()


def test_synth_passes_on_only_given_options(monkeypatch, capsys):
    calls = []
    stand_in = types.SimpleNamespace(
        synthesize=lambda out, options, **surface: calls.append((out, options, surface)) or {}
    )
    monkeypatch.setitem(sys.modules, "linprim_geo.synthetic.synth", stand_in)
    room = "synth out --scene room --size 64x48 --fov 60 --background 0,0.5,1 --overwrite"
    for line in ("synth out", room, "synth out --mesh x.glb --size 64 --point-noise 0.01 --quiet"):
        assert cli.main(line.split()) == 0
    nothing = {"shape": None, "mesh": None, "overwrite": False, "quiet": False}
    assert calls == [
        ("out", SynthOptions(), nothing),
        (
            "out",
            SynthOptions(size=(64, 48), fov=60.0, background="0,0.5,1"),
            nothing | {"shape": "room", "overwrite": True},
        ),
        ("out", SynthOptions(size=(64, 64), point_noise=0.01), nothing | {"mesh": "x.glb", "quiet": True}),
    ]


# The function behind each command whose arguments are passed on by name, and the names that differ.
PASSED_ON = {
    "synth out": ("synthetic.synth.synthesize", {"output": "out", "scene": "shape"}),
    "render run": ("runs.render.render_run", {}),
    "extract-mesh run": ("surface.extract.extract_mesh", {}),
    "eval-depth run": ("eval.depth.eval_depth_run", {}),
    "report run": ("display.report.report_run", {}),
    "view run": ("display.viewer.view_run", {}),
    "eval-images run": ("eval.images.eval_images_run", {}),
    "eval-mesh a b": (
        "eval.mesh.eval_mesh_files",
        {"mesh": "prediction_path", "reference": "reference_path"},
    ),
}


@pytest.mark.parametrize("line", PASSED_ON)
def test_functions_accept_the_arguments_of_commands(line):
    path, renamed = PASSED_ON[line]
    module, _, name = path.rpartition(".")
    function = getattr(importlib.import_module(f"linprim_geo.{module}"), name)
    options = {field.name for field in dataclasses.fields(ExtractOptions)} if line.startswith("extract") else set()
    passed = (
        vars(cli.build_parser().parse_args(line.split())).keys()
        - {"run_command", "parser", "command_parser", "most_threads", "dry_run"}  # the last calls another function
        - options
    )
    assert {renamed.get(key, key) for key in passed} <= set(inspect.signature(function).parameters)


def test_principal_point_and_detail_reach_synth(monkeypatch):
    calls = []
    stand_in = types.SimpleNamespace(synthesize=lambda out, options, **_: calls.append(options) or {})
    monkeypatch.setitem(sys.modules, "linprim_geo.synthetic.synth", stand_in)
    assert cli.main("synth out --principal-point-offset=-5,3.5 --detail 0.5 --distance 4".split()) == 0
    assert cli.main("synth out --principal-point-offset 5,-3".split()) == 0
    assert [call.principal_point_offset for call in calls] == [(-5.0, 3.5), (5.0, -3.0)]
    assert (calls[0].detail, calls[0].distance) == (0.5, 4.0)
    for wrong in ("1", "1,2,3", "a,b", "inf,0", "nan,1", ","):
        with pytest.raises(SystemExit) as leaving:
            cli.main(["synth", "out", "--principal-point-offset", wrong])
        assert leaving.value.code == 2
    assert len(calls) == 2


def command_help(command: str) -> str:
    (commands,) = (
        action.choices for action in cli.build_parser()._actions if isinstance(action, cli.argparse._SubParsersAction)
    )
    return commands[command].format_help()


@pytest.mark.parametrize(
    "line",
    [
        "synth .",
        "train gone",
        "train . -o x",
        "render gone",
        "extract-mesh gone",
        "stereo gone -o x",
        "stereo . -o x",
        "stereo . -o here",
        "eval-images gone",
        "eval-depth gone",
        "eval-mesh gone.ply gone.ply",
        "convert gone a.ply",
        "convert here b.xyz",
        "train gone -o here --resume",
        "synth x --mesh gone.glb",
        "synth x --size 4",
        "synth x --views 0",
        "eval-mesh here here --tau -1",
        "synth x --background pink",
        "extract-mesh . --level 2",
        "demo -o .",
    ],
)
def test_invalid_input_is_refused_and_leaves_no_files(line, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here").write_text("mine")
    assert cli.main([*line.split(), "--json"]) == 1
    shown = capfd.readouterr()
    assert shown.out == "" and shown.err.startswith("linprim-geo: error: ") and shown.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


WITH_THREADS = {
    "render r": "linprim_geo.runs.render.render_run",
    "extract-mesh r": "linprim_geo.surface.extract.extract_mesh",
    "eval-depth r": "linprim_geo.eval.depth.eval_depth_run",
    "eval-images r": "linprim_geo.eval.images.eval_images_run",
    "eval-mesh a b": "linprim_geo.eval.mesh.eval_mesh_files",
    "report r": "linprim_geo.display.report.report_run",
    "view r": "linprim_geo.display.viewer.view_run",
    "demo": "linprim_geo.cli.demo.run_demo",
}


@pytest.mark.parametrize(("line", "function"), WITH_THREADS.items())
def test_threads_limits_the_cores_of_a_command(line, function, monkeypatch):
    from linprim_geo.base.cores import usable_cores
    from linprim_geo.kernels import ops

    found = []

    def stand_in(*_, **__):
        found.append((usable_cores(), ops.threads(), os.environ["OMP_NUM_THREADS"]))
        raise LinprimError("enough")

    before = usable_cores(), ops.threads(), os.environ.get("OMP_NUM_THREADS")
    monkeypatch.setattr(function, stand_in)
    assert cli.main([*line.split(), "--threads", "1"]) == 1 and found == [(1, 1, "1")]
    assert (usable_cores(), ops.threads(), os.environ.get("OMP_NUM_THREADS")) == before


# Commands that leave --threads to the options of their stage, and those that compute nothing in the core.
THREADS_OF_OPTIONS = {"train", "inspect", "stereo", "tradeoff", "synth"}
NO_THREADS = {"convert", "doctor", "completion"}


def test_every_computing_command_has_threads():
    (commands,) = (
        action.choices for action in cli.build_parser()._actions if isinstance(action, cli.argparse._SubParsersAction)
    )
    taken_by: dict[str, set[str]] = {"threads": set(), "most_threads": set(), "": set()}
    for command, parser in commands.items():
        (dest,) = [action.dest for action in parser._actions if "--threads" in action.option_strings] or [""]
        taken_by[dest].add(command)
    assert taken_by["threads"] == THREADS_OF_OPTIONS and taken_by[""] == NO_THREADS
    assert taken_by["most_threads"] == {line.split()[0] for line in WITH_THREADS}


@pytest.mark.parametrize("line", ["RUN p.npz", "RUN p.ply", "RUN p.glb", "SCENE/reference.ply m.obj", "BALL m.ply"])
def test_convert_does_not_use_the_core(line, tiny_run, tiny_scene, tmp_path, monkeypatch):
    from helpers.surfaces import sphere

    from linprim_geo.geometry.mesh_files import save_mesh
    from linprim_geo.kernels import surface_ops

    save_mesh(tmp_path / "ball.glb", sphere(rounds=2))
    for name in [name for name in sys.modules if name.startswith("linprim_geo.kernels.")]:
        if hasattr(sys.modules[name], "_core"):
            monkeypatch.setattr(sys.modules[name], "_core", None)
    assert surface_ops._core is None
    monkeypatch.chdir(tmp_path)
    for name, path in (("RUN", tiny_run), ("SCENE", tiny_scene), ("BALL", tmp_path / "ball.glb")):
        line = line.replace(name, str(path))
    assert cli.main(["convert", *line.split()]) == 0
