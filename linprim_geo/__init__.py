"""Posed photographs to geometry that can be trusted: transparent polyhedra, trained and meshed on a CPU.

`import linprim_geo as lg` offers a function for each command (`lg.train`, `lg.extract_mesh`, ...) and the types that
they take and give; docs/python.md shows them at work. Each is imported where it is first used, so that the package
itself costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from linprim_geo.base.version import __version__ as __version__

if TYPE_CHECKING:
    from linprim_geo.base.errors import LinprimError as LinprimError
    from linprim_geo.base.options import ExtractOptions as ExtractOptions
    from linprim_geo.base.options import SceneOptions as SceneOptions
    from linprim_geo.base.options import StereoOptions as StereoOptions
    from linprim_geo.base.options import TrainOptions as TrainOptions
    from linprim_geo.capture.load import load_scene as load_scene
    from linprim_geo.capture.types import Scene as Scene
    from linprim_geo.cli.demo import run_demo as demo
    from linprim_geo.cli.doctor import doctor as doctor
    from linprim_geo.display.report import report_run as report
    from linprim_geo.display.stereo_report import dense_stereo as dense_stereo
    from linprim_geo.display.viewer import view_run as view
    from linprim_geo.eval.depth import eval_depth_run as eval_depth
    from linprim_geo.eval.images import eval_images_run as eval_images
    from linprim_geo.eval.mesh import eval_mesh_files as eval_mesh
    from linprim_geo.eval.mesh import score_mesh as score_mesh
    from linprim_geo.eval.options import ScoreOptions as ScoreOptions
    from linprim_geo.eval.options import TradeoffOptions as TradeoffOptions
    from linprim_geo.eval.tradeoff.sweep import tradeoff as tradeoff
    from linprim_geo.geometry.camera import Camera as Camera
    from linprim_geo.geometry.mesh import Mesh as Mesh
    from linprim_geo.geometry.mesh_files import load_mesh as load_mesh
    from linprim_geo.geometry.mesh_files import save_mesh as save_mesh
    from linprim_geo.geometry.primitives import Primitives as Primitives
    from linprim_geo.geometry.primitives import load_primitives as load_primitives
    from linprim_geo.geometry.primitives import save_primitives as save_primitives
    from linprim_geo.kernels.ops import rasterize as rasterize
    from linprim_geo.runs.render import render_run as render
    from linprim_geo.runs.run import Run as Run
    from linprim_geo.surface.convert import convert as convert
    from linprim_geo.surface.dry_run import extraction_memory as extraction_memory
    from linprim_geo.surface.extract import extract_mesh as extract_mesh
    from linprim_geo.synthetic.options import SynthOptions as SynthOptions
    from linprim_geo.synthetic.synth import synthesize as synth
    from linprim_geo.training.dry_run import dry_run as dry_run
    from linprim_geo.training.effects import Choice as Choice
    from linprim_geo.training.inspect import inspect_scene as inspect
    from linprim_geo.training.train import train as train

# Where each name of `linprim_geo` is: module, and name in it.
_PUBLIC = {
    "load_scene": ("capture.load", "load_scene"),
    "inspect": ("training.inspect", "inspect_scene"),
    "dry_run": ("training.dry_run", "dry_run"),
    "train": ("training.train", "train"),
    "render": ("runs.render", "render_run"),
    "extract_mesh": ("surface.extract", "extract_mesh"),
    "extraction_memory": ("surface.dry_run", "extraction_memory"),
    "dense_stereo": ("display.stereo_report", "dense_stereo"),
    "eval_depth": ("eval.depth", "eval_depth_run"),
    "eval_images": ("eval.images", "eval_images_run"),
    "eval_mesh": ("eval.mesh", "eval_mesh_files"),
    "report": ("display.report", "report_run"),
    "view": ("display.viewer", "view_run"),
    "tradeoff": ("eval.tradeoff.sweep", "tradeoff"),
    "synth": ("synthetic.synth", "synthesize"),
    "convert": ("surface.convert", "convert"),
    "doctor": ("cli.doctor", "doctor"),
    "demo": ("cli.demo", "run_demo"),
    "rasterize": ("kernels.ops", "rasterize"),
    "score_mesh": ("eval.mesh", "score_mesh"),
    "load_mesh": ("geometry.mesh_files", "load_mesh"),
    "save_mesh": ("geometry.mesh_files", "save_mesh"),
    "load_primitives": ("geometry.primitives", "load_primitives"),
    "save_primitives": ("geometry.primitives", "save_primitives"),
    "Camera": ("geometry.camera", "Camera"),
    "Choice": ("training.effects", "Choice"),
    "ExtractOptions": ("base.options", "ExtractOptions"),
    "LinprimError": ("base.errors", "LinprimError"),
    "Mesh": ("geometry.mesh", "Mesh"),
    "Primitives": ("geometry.primitives", "Primitives"),
    "Run": ("runs.run", "Run"),
    "Scene": ("capture.types", "Scene"),
    "SceneOptions": ("base.options", "SceneOptions"),
    "ScoreOptions": ("eval.options", "ScoreOptions"),
    "StereoOptions": ("base.options", "StereoOptions"),
    "SynthOptions": ("synthetic.options", "SynthOptions"),
    "TradeoffOptions": ("eval.options", "TradeoffOptions"),
    "TrainOptions": ("base.options", "TrainOptions"),
}


def __getattr__(name: str):
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, inner = _PUBLIC[name]
    globals()[name] = value = getattr(import_module(f"{__name__}.{module}"), inner)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
