"""The command `linprim-geo`: what each subcommand accepts, and how its result or its failure is reported.

Only the standard library is imported here, the rest where a subcommand runs, so that `--help` stays instant.
Exit status: 0 the thing asked for was made, 1 the input cannot be used, 2 the arguments are wrong, 70 an
error in this program, 130 interrupted, 141 the reader of the output went away.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import errno
import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.version import __version__
from linprim_geo.cli import commands

EXIT_UNUSABLE, EXIT_INTERNAL, EXIT_INTERRUPTED, EXIT_PIPE = 1, 70, 130, 141

SPLITS = ("train", "test", "all")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command line and returns its exit status; argparse itself leaves with 0 (--help) or 2."""
    # NumPy's matrices are small here, and OpenBLAS's threads wait for each other in a loop: on a busy machine many
    # times the work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # The two flags are known before and after the subcommand, so neither parser may set a default for them.
    parsed = build_parser().parse_args(arguments)
    parsed.json, parsed.debug = getattr(parsed, "json", False), getattr(parsed, "debug", False)
    try:
        with _stdout_for_result(parsed.json) as print_result:
            result = parsed.handler(parsed)
            print_result(result)
        return int(result.pop("_status", 0)) if isinstance(result, dict) else 0
    except BrokenPipeError:
        # Nothing more can be printed; without this the interpreter would complain while it closes stdout.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_PIPE
    except (Exception, KeyboardInterrupt) as error:
        if parsed.debug:
            traceback.print_exc()
        sentence, status = explain(error)
        with contextlib.suppress(OSError):
            print(f"linprim-geo: error: {sentence}", file=sys.stderr, flush=True)
        return status


def explain(error: BaseException) -> tuple[str, int]:
    """The one sentence and the exit status for an error."""
    if isinstance(error, LinprimError):
        return " ".join(str(error).split()), EXIT_UNUSABLE
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", EXIT_INTERRUPTED
    if isinstance(error, MemoryError):
        return (
            "out of memory: try --downscale, fewer primitives, or a machine with more memory",
            EXIT_UNUSABLE,
        )
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        where = f" while writing {error.filename}" if error.filename else ""
        return f"the disk is full{where}: free some space and run again", EXIT_UNUSABLE
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}", EXIT_UNUSABLE
    if isinstance(error, ModuleNotFoundError) and not str(error.name or "").startswith("linprim_geo"):
        return (
            f"the library {error.name} is not installed: run make env, or pip install linprim-geo",
            EXIT_UNUSABLE,
        )
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return f"internal error: {text}; run again with --debug", EXIT_INTERNAL


@contextlib.contextmanager
def _stdout_for_result(as_json: bool) -> Iterator[Callable[[Any], None]]:
    """Yields a function that prints the result; with `as_json` whatever else goes to stdout goes to stderr.

    Libraries print from C as well, so the file descriptor is redirected, not only Python's stream.
    """
    if not as_json:
        yield _print_for_people
        sys.stdout.flush()
        return
    results: list[Any] = []
    stdout = sys.stdout
    stdout.flush()
    descriptor: int | None = None
    saved = -1
    try:
        saved = os.dup(stdout.fileno())
        descriptor = stdout.fileno()
    except (OSError, ValueError):
        pass
    try:
        if descriptor is not None:
            os.dup2(sys.stderr.fileno(), descriptor)
        with contextlib.redirect_stdout(sys.stderr):
            yield results.append
    finally:
        if descriptor is not None:
            os.dup2(saved, descriptor)
            os.close(saved)
    from linprim_geo.base.files import json_ready

    shown = {key: value for key, value in (results[0] or {}).items() if not key.startswith("_")}
    stdout.write(json.dumps(json_ready(shown), allow_nan=False) + "\n")
    stdout.flush()


def _print_for_people(result: dict | None) -> None:
    """One `name: value` line per plain value; a handler that has words of its own puts them under `_text`."""
    if result is None:
        return
    if "_text" in result:
        print(result["_text"])
        return
    for key, value in result.items():
        if isinstance(value, bool | int | str) and not key.startswith("_"):
            print(f"{key}: {value}")
        elif isinstance(value, float):
            print(f"{key}: {value:.6g}")


# --- options ---------------------------------------------------------------------------------------------


def add_options(parser: argparse._ActionsContainer, options: type) -> None:
    """Adds one `--field-name` per field of the dataclass `options`: its type and default, its metadata's
    help,
    choices and metavar. A bool becomes `--field` and `--no-field`."""
    for field in dataclasses.fields(options):
        flag = "--" + field.name.replace("_", "-")
        text = field.metadata.get("help", "").replace("%", "%%")
        shown = "" if field.default in ("", None) else f" (default {field.default})"
        # No default here: what is not given is told from what is given as it would be by default.
        settings: dict[str, Any] = {"dest": field.name, "default": argparse.SUPPRESS, "help": text + shown}
        if isinstance(field.default, bool):
            settings["action"] = argparse.BooleanOptionalAction
        else:
            settings["type"] = str if field.default is None else type(field.default)
            if field.metadata.get("number_or"):
                settings["type"] = _number_or(field.metadata["number_or"])
            settings["choices"] = field.metadata.get("choices") or None
            settings["metavar"] = field.metadata.get("metavar")
            if settings["metavar"] is None and settings["choices"] is None:
                settings["metavar"] = {int: "N", float: "X"}.get(settings["type"], "TEXT")
        parser.add_argument(flag, **settings)


def add_effects(parser: argparse._ActionsContainer, default: str) -> None:
    """Adds --effects and --effect, by which options are chosen that were not given."""
    text = (
        "none: the options as they are (default of train); auto: what the data call for (default of inspect); "
        "all: everything on."
    )
    text += " An option that is given stays"
    parser.add_argument("--effects", choices=("auto", "none", "all"), default=default, help=text)
    text = "decide about one by hand, such as exposure=on; may be repeated; linprim-geo inspect SCENE names them"
    parser.add_argument("--effect", action="append", default=[], metavar="NAME=on|off", help=text)


def add_workers(parser: argparse.ArgumentParser, workers: int | None = 0) -> argparse._ArgumentGroup:
    """Adds --cluster and --workers, of default `workers`, which say where the parts of a job are done."""
    group = parser.add_argument_group("workers")
    text = (
        "local: Ray on this machine; an address such as 10.0.0.1:6379: the Ray cluster there, whose machines "
        "all see the folders"
    )
    text += " (default: processes of this machine); needs pip install 'linprim-geo[cluster]'"
    group.add_argument("--cluster", metavar="local|ADDRESS", help=text)
    text = "at once at most; 0: one per core" + (" (default 0)" if workers == 0 else "")
    group.add_argument("--workers", type=_whole, default=workers, metavar="N", help=text)
    return group


def _blocks(text: str) -> int | str:
    return text if text == "auto" else _positive(text)


def _number_or(word: str) -> Callable[[str], float | str]:
    def parse(text: str) -> float | str:
        return word if text == word else float(text)

    parse.__name__ = f"number, or {word}:"  # as argparse puts it into its message
    return parse


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not positive")
    return value


def _whole(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def _not_negative(text: str) -> float:
    value = float(text)
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a number from 0 on")
    return value


def _seconds(text: str) -> float:
    """90, 90s, 5m or 1.5h as seconds."""
    units = {"s": 1, "m": 60, "h": 3600}
    value = float(text[:-1]) * units[text[-1]] if text[-1:] in units else float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a time such as 90s, 5m or 1h")
    return value


def _length(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive length")
    return value


def _pair(text: str) -> tuple[float, float]:
    x, y = (float(part) for part in text.split(","))
    if not (abs(x) < float("inf") and abs(y) < float("inf")):
        raise argparse.ArgumentTypeError(f"{text!r} is not a pair of numbers, such as 5,-3")
    return x, y


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition("x")
    height = height if cross else width
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size in pixels, such as 640x480 or 320")
    return int(width), int(height)


# argparse names the type in its message: "invalid count value", not "invalid _positive value".
_positive.__name__ = _whole.__name__ = "count"
_not_negative.__name__ = _length.__name__ = "number"
_blocks.__name__ = "count, or auto:"
_size.__name__, _pair.__name__, _seconds.__name__ = "size", "pair X,Y", "time such as 90s, 5m or 1h"


# --- subcommands -----------------------------------------------------------------------------------------


def build_parser() -> argparse.ArgumentParser:
    """The whole command line."""
    from linprim_geo.base.options import ExtractOptions, SceneOptions, TrainOptions

    common = argparse.ArgumentParser(add_help=False)
    group = common.add_argument_group("output")
    hidden = argparse.SUPPRESS
    group.add_argument("--json", action="store_true", default=hidden, help="print one JSON object and nothing else")
    group.add_argument("--debug", action="store_true", default=hidden, help="show the traceback of an error")

    parser = argparse.ArgumentParser(
        prog="linprim-geo",
        description="From posed photographs to a scored mesh, through transparent polyhedra, on a CPU.",
        epilog="linprim-geo COMMAND --help explains a command.",
        parents=[common],
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"linprim-geo {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add_quiet(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("--quiet", action="store_true", help="no progress")

    def command(name: str, handler: Callable[[argparse.Namespace], dict], text: str) -> argparse.ArgumentParser:
        sub = subparsers.add_parser(
            name,
            parents=[common],
            help=text,
            description=text[0].upper() + text[1:] + ".",
            allow_abbrev=False,
        )
        sub.set_defaults(handler=handler, command=name)
        return sub

    sub = command("train", commands.train, "train a scene: posed photographs to primitives")
    sub.add_argument("scene", nargs="?", metavar="SCENE", help="folder of a capture, of plain photographs, or a video")
    sub.add_argument("-s", "--source", "--source_path", dest="source", metavar="SCENE", help="the same, as in 3DGS")
    sub.add_argument(
        "-o",
        "--output",
        "-m",
        "--model_path",
        dest="run",
        metavar="RUN",
        help="folder to make (default runs/SCENE)",
    )
    sub.add_argument("--resume", action="store_true", help="go on from the latest checkpoint in RUN")
    add_quiet(sub)
    text = (
        "say what would be trained, how long it takes and how much memory, by timing a few steps; nothing but "
        "the cache is written"
    )
    sub.add_argument("--dry-run", action="store_true", help=text)
    text = (
        "choose steps and primitives so that everything takes this long, by what a step costs here; one of "
        "the two may be given"
    )
    sub.add_argument("--time-budget", type=_seconds, metavar="TIME", help=text)
    sub.add_argument(
        "--view", action="store_true", help="show the run in a browser meanwhile, as linprim-geo view RUN --follow does"
    )
    resolution = "as in 3DGS: divide the size by 1, 2, 4 or 8, or a width to go down to; -1: to 1600 if it is more"
    sub.add_argument("-r", "--resolution", type=int, metavar="K", help=resolution)
    sub.add_argument("--eval", action="store_true", help="accepted as in 3DGS: views are always held out")
    add_effects(sub.add_argument_group("effects"), "none")
    text = (
        "train in so many blocks of space, each by a worker of its own; auto: as few as a worker's memory allows "
        "(default 1); "
        "a block's photographs lie in a temporary file, see TMPDIR"
    )
    several = add_workers(sub)
    several.add_argument("--blocks", type=_blocks, default=1, metavar="auto|K", help=text)
    add_options(sub.add_argument_group("scene"), SceneOptions)
    add_options(sub.add_argument_group("training"), TrainOptions)

    sub = command(
        "inspect", commands.inspect, "say which effects a scene calls for, by which evidence, and what they cost"
    )
    sub.add_argument("scene", metavar="SCENE", help="folder of a capture, of plain photographs, or a video")
    add_quiet(sub)
    add_effects(sub.add_argument_group("effects"), "auto")
    add_options(sub.add_argument_group("scene"), SceneOptions)
    add_options(sub.add_argument_group("training"), TrainOptions)

    sub = command("render", commands.render, "render colour, depth, normals and opacity of a run's views")
    sub.add_argument("run", metavar="RUN", help="folder that train has made")
    sub.add_argument("--split", choices=SPLITS, default="test", help="which views (default test)")
    sub.add_argument("-o", "--output", metavar="DIR", help="folder to write to (default RUN/renders)")
    add_quiet(sub)

    sub = command("extract-mesh", commands.extract_mesh, "extract a triangle mesh from a run")
    sub.add_argument("run", metavar="RUN", help="folder that train has made")
    text = (
        "tsdf: fuse depth maps (default); polyhedra: unite the primitives, cut back to the surface, closed "
        "and manifold;"
    )
    text += " opacity-field: where light stops reaching the cameras, closed and without a grid"
    sub.add_argument("--method", choices=("tsdf", "polyhedra", "opacity-field"), default="tsdf", help=text)
    sub.add_argument("-o", "--output", metavar="FILE", help=".ply .obj .glb .stl (default RUN/mesh/METHOD/mesh.ply)")
    text = "choose the voxel size so that everything takes this long, by what coarse passes take"
    sub.add_argument("--time-budget", type=_seconds, metavar="TIME", help=text)
    add_quiet(sub)
    text = "fuse in so many parts of one grid, each by a worker of its own, with the same result (default 1)"
    add_workers(sub).add_argument("--blocks", type=_positive, default=1, metavar="K", help=text)
    add_options(sub.add_argument_group("extraction"), ExtractOptions)

    sub = command(
        "eval-depth", commands.eval_depth, "score a run's depth and normals against a mesh or the data set's depth"
    )
    sub.add_argument("run", metavar="RUN", help="folder that train has made")
    sub.add_argument("--reference", metavar="MESH", help="mesh in the data set's frame (default: its depth images)")
    sub.add_argument("--split", choices=SPLITS, default="test", help="which views (default test)")
    depth = (
        "which depth: at half transmittance by exact overlap (default), or in the order of blending, the "
        "mean, the first surface"
    )
    sub.add_argument("--depth", choices=("overlap", "median", "expected", "first"), default="overlap", help=depth)
    sub.add_argument("-o", "--output", metavar="DIR", help="folder to write to (default RUN/eval/depth)")

    sub = command("eval-images", commands.eval_images, "score a run's colours: PSNR, SSIM and LPIPS on held-out views")
    sub.add_argument("run", metavar="RUN", help="folder that train has made")
    sub.add_argument("--split", choices=SPLITS, default="test", help="which views (default test)")
    sub.add_argument("-o", "--output", metavar="DIR", help="folder to write to (default RUN/eval/images)")
    text = (
        "weights of LPIPS, file or folder (default: torch's cache, and packages lpips or torchmetrics; none: "
        "leaves it out)"
    )
    sub.add_argument("--lpips-weights", metavar="PATH", help=text)

    sub = command(
        "eval-mesh", commands.eval_mesh, "score a mesh against a reference mesh: Chamfer distance and the rest"
    )
    sub.add_argument("mesh", metavar="MESH", help="mesh to score")
    sub.add_argument(
        "reference", metavar="REFERENCE", help="mesh taken as the truth (dtu, tnt: or a scan's points as PLY)"
    )
    named = ("headline", "linprim", "dtu", "tnt", "scannetpp")
    text = "headline: exact point to surface (default); the others as in the tables of that name"
    sub.add_argument("--protocol", choices=named, default="headline", help=text)
    text = "points per mesh (headline 200000, linprim 5000)"
    sub.add_argument("--samples", type=_positive, metavar="N", help=text)
    text = "threshold of the rates, in the meshes' unit (default the protocol's, else 1 %% of the diagonal)"
    sub.add_argument("--tau", type=_length, metavar="LENGTH", help=text)
    sub.add_argument("--seed", type=_whole, default=0, metavar="N", help="seed of the points (default 0)")
    sub.add_argument("--run", metavar="RUN", help="cull to what the training cameras of this run see")
    sub.add_argument("--cameras", metavar="SCENE", help="the same with those of a scene's folder")
    text = "metres in one unit of the meshes, for dtu, tnt and scannetpp (default 1, dtu 0.001)"
    sub.add_argument("--meters-per-unit", type=_length, metavar="X", help=text)
    text = "folder for results.json, error-coloured PLYs and plots (default RUN/eval/mesh)"
    sub.add_argument("-o", "--output", metavar="DIR", help=text)
    dtu, tnt = sub.add_argument_group("protocol dtu"), sub.add_argument_group("protocol tnt")
    dtu.add_argument("--mask", metavar="FILE", help="ObsMask .mat of the scan")
    dtu.add_argument("--box", metavar="X0,Y0,Z0,X1,Y1,Z1", help="the box alone; written --box=...")
    dtu.add_argument("--plane", metavar="PLANE", help="Plane .mat, or --plane=A,B,C,D; above it counts")
    tnt.add_argument("--scene", metavar="NAME", help="Barn, Truck, ...: sets the threshold")
    tnt.add_argument("--crop", metavar="FILE", help="crop volume, .json")
    tnt.add_argument("--transform", metavar="FILE", help="4x4 matrix as text, takes MESH to REFERENCE")

    sub = command("report", commands.report, "write one self-contained HTML page about a run")
    sub.add_argument("run", metavar="RUN", help="folder that train has made")
    sub.add_argument("-o", "--output", metavar="FILE", help="page to write (default RUN/report.html)")
    text = (
        "mesh in the data set's frame to score depth and meshes against (default: what RUN/eval holds, and "
        "the data set's depth)"
    )
    sub.add_argument("--reference", metavar="MESH", help=text)

    sub = command("view", commands.view, "show a run in a browser: primitives, meshes, cameras")
    sub.add_argument("run", metavar="RUN", help="folder that train has made")
    sub.add_argument(
        "--follow", action="store_true", help="wait for a run's first save, and show every save and mesh as it comes"
    )
    sub.add_argument("--reference", metavar="MESH", help="mesh in the data set's frame, for the true error of meshes")
    text = "port on this machine, which alone can reach it (default 8080; 0: any that is free)"
    sub.add_argument("--port", type=_whole, default=8080, metavar="N", help=text)
    sub.add_argument("--no-browser", dest="browser", action="store_false", help="only print the address")

    sub = command(
        "tradeoff",
        commands.tradeoff,
        "sweep every knob that trades time for accuracy: tables, plots, and a sentence for each",
    )
    sub.add_argument("scene", metavar="SCENE", help="folder of a capture, of plain photographs, or a video")
    sub.add_argument(
        "-o", "--output", metavar="DIR", help="folder to make, or to go on with (default runs/SCENE_tradeoff)"
    )
    text = "knobs to sweep; a wrong name lists them (default all)"
    sub.add_argument("--knobs", nargs="+", default=[], metavar="NAME", help=text)
    text = (
        "run of this scene that knobs of rendering, extraction and evaluation are measured on (default: "
        "trains one of modest size)"
    )
    sub.add_argument("--run", metavar="RUN", help=text)
    text = "mesh in the data set's frame (default: reference.ply in the scene, if there)"
    sub.add_argument("--reference", metavar="MESH", help=text)
    sub.add_argument("--quick", action="store_true", help="a tiny size, to see that all of it runs")
    sub.add_argument(
        "--rounds", type=_positive, metavar="N", help="how often everything is timed, in turn (default 3, quick 2)"
    )
    for name in ("iterations", "max-primitives"):
        sub.add_argument(
            f"--{name}",
            type=_positive,
            metavar="N",
            help="of the training that is swept around (default 2000, quick 200)",
        )
    sub.add_argument("--threads", type=_whole, default=0, metavar="N", help="0 uses every core (default)")
    add_workers(sub, None).description = "trainings at once; without either, here, one after another"
    add_quiet(sub)

    sub = command(
        "synth", commands.synth, "render posed images, depth, normals and points of a mesh or a built-in scene"
    )
    sub.add_argument("output", metavar="OUT", help="folder to make")
    shape = sub.add_mutually_exclusive_group()
    shape.add_argument("--scene", choices=("cad", "smooth", "room", "wires"), help="built-in (default cad)")
    shape.add_argument("--mesh", metavar="FILE", help="any mesh with a texture or vertex colours")
    sub.add_argument("--views", type=_positive, default=60, metavar="N", help="training views (default 60)")
    sub.add_argument("--test-views", type=_whole, default=12, metavar="N", help="held-out views (default 12)")
    sub.add_argument("--size", type=_size, default=(320, 320), metavar="WxH", help="pixels (default 320x320)")
    paths = ("orbit", "hemisphere", "sphere", "arc", "inside-out")
    sub.add_argument("--path", choices=paths, help="of the cameras (default: what suits the scene)")
    sub.add_argument("--fov", type=_length, metavar="DEGREES", help="horizontal (default 45, inside 75)")
    sub.add_argument("--distance", type=_length, metavar="LENGTH", help="from the middle, in the mesh's unit")
    offset = "from the middle of the image, in pixels (default 0,0); a negative one is written --...=-5,3"
    sub.add_argument("--principal-point-offset", type=_pair, default=(0.0, 0.0), metavar="X,Y", help=offset)
    sub.add_argument("--shading", choices=("albedo", "shaded"), default="albedo", help="default albedo")
    sub.add_argument("--background", metavar="COLOR", help="transparent, black, white or r,g,b in [0,1]")
    sub.add_argument("--points", type=_whole, default=20_000, metavar="N", help="on it (default 20000)")
    noise = "standard deviation per axis of the points, in the mesh's unit (default 0)"
    sub.add_argument("--point-noise", type=_not_negative, default=0.0, metavar="LENGTH", help=noise)
    sub.add_argument("--supersample", type=_positive, default=3, metavar="K", help="K*K rays a pixel (default 3)")
    sub.add_argument("--depth-format", choices=("png", "npy"), default="png", help="default png")
    detail = "contrast of a built-in scene's texture (default 1)"
    sub.add_argument("--detail", type=_not_negative, default=1.0, metavar="X", help=detail)
    drift = "gains of the training photographs vary by up to exp(X) each way (default 0)"
    sub.add_argument("--exposure-drift", type=_not_negative, default=0.0, metavar="X", help=drift)
    lens = "k1 of a lens with radial distortion (default 0); a negative one is written --...=-0.1"
    sub.add_argument("--distortion", type=float, default=0.0, metavar="K1", help=lens)
    text = "strength of highlights that move with the camera (default 0)"
    sub.add_argument("--specular", type=_not_negative, default=0.0, metavar="X", help=text)
    text = "every third camera has X times the focal length (default 1)"
    sub.add_argument("--zoom", type=_length, default=1.0, metavar="X", help=text)
    text = "stand it on a table X times as wide as it is (default 0, none)"
    sub.add_argument("--table", type=_not_negative, default=0.0, metavar="X", help=text)
    text = "a room at infinity, drawn by seed N, in place of a background"
    sub.add_argument("--environment", type=_whole, metavar="N", help=text)
    text = "of azimuth that the path arc covers (default 300)"
    sub.add_argument("--arc", type=_length, metavar="DEGREES", help=text)
    text = "standard deviation of sensor noise at middle grey, in units of 1/255 (default 0)"
    sub.add_argument("--noise", type=_not_negative, default=0.0, metavar="X", help=text)
    text = "photographs as .jpg of this quality (default 0, .png)"
    sub.add_argument("--jpeg", type=_whole, default=0, metavar="QUALITY", help=text)
    sub.add_argument("--seed", type=_whole, default=0, metavar="N", help="seed of everything random (default 0)")
    sub.add_argument("--threads", type=_whole, default=0, metavar="N", help="0 uses every core (default)")
    sub.add_argument("--overwrite", action="store_true", help="replace OUT if synth has made it")

    sub = command(
        "convert",
        commands.convert,
        "convert primitives (npz, LinPrim's and 3DGS's ply) and meshes (ply, obj, glb, stl)",
    )
    sub.add_argument("source", metavar="IN", help="run folder, .npz, .ply, .obj, .glb or .stl")
    sub.add_argument("target", metavar="OUT", help="file to write; its suffix says the format")
    sub.add_argument(
        "--as",
        dest="write_as",
        choices=("auto", "primitives", "mesh", "gaussians"),
        default="auto",
        help="what a .ply of primitives holds: their properties (default), triangles for MeshLab, or Gaussians "
        "like octahedra",
    )

    sub = command(
        "doctor", commands.doctor, "check versions, libraries, cores and memory; exit 1 if something is missing"
    )

    sub = command("demo", commands.demo, "synthesize, train, extract and score a built-in scene")
    sub.add_argument("-o", "--output", default="runs/demo", metavar="RUN", help="folder to make (default runs/demo)")
    sub.add_argument("--size", choices=("small", "normal"), default="normal", help="small: a quick check of it all")
    add_quiet(sub)

    sub = command("completion", commands.completion, "print a script that completes this command line in a shell")
    sub.set_defaults(parser=parser)
    sub.add_argument("shell", choices=("bash", "zsh", "fish"))
    return parser
