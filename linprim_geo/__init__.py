"""Posed photographs to geometry that can be trusted: transparent polyhedra, trained and meshed on a CPU.

`import linprim_geo as lg` offers a function for each command (`lg.train`, `lg.extract_mesh`, ...) and the types that
they take and give; linprim_geo/PYTHON.md shows them at work. Each is imported where it is first used, so that the
package itself costs nothing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .camera import Camera as Camera
    from .convert import convert as convert
    from .demo import run_demo as demo
    from .doctor import doctor as doctor
    from .dry_run import dry_run as dry_run
    from .effects import Choice as Choice
    from .effects import inspect_scene as inspect
    from .errors import LinprimError as LinprimError
    from .eval.depth import eval_depth_run as eval_depth
    from .eval.images import eval_images_run as eval_images
    from .eval.mesh import eval_mesh_files as eval_mesh
    from .eval.mesh import score_mesh as score_mesh
    from .eval.tradeoff import tradeoff as tradeoff
    from .extract import extract_mesh as extract_mesh
    from .mesh import Mesh as Mesh
    from .mesh import load_mesh as load_mesh
    from .mesh import save_mesh as save_mesh
    from .ops import rasterize as rasterize
    from .options import ExtractOptions as ExtractOptions
    from .options import SceneOptions as SceneOptions
    from .options import TrainOptions as TrainOptions
    from .primitives import Primitives as Primitives
    from .primitives import load_primitives as load_primitives
    from .primitives import save_primitives as save_primitives
    from .render import render_run as render
    from .report import report_run as report
    from .run import Run as Run
    from .scene import Scene as Scene
    from .scene import load_scene as load_scene
    from .synth import synthesize as synth
    from .train import train as train
    from .view import view_run as view

# Where each name of `linprim_geo` is: module, and name in it.
_PUBLIC = {
    "load_scene": ("scene", "load_scene"),
    "inspect": ("effects", "inspect_scene"),
    "dry_run": ("dry_run", "dry_run"),
    "train": ("train", "train"),
    "render": ("render", "render_run"),
    "extract_mesh": ("extract", "extract_mesh"),
    "eval_depth": ("eval.depth", "eval_depth_run"),
    "eval_images": ("eval.images", "eval_images_run"),
    "eval_mesh": ("eval.mesh", "eval_mesh_files"),
    "report": ("report", "report_run"),
    "view": ("view", "view_run"),
    "tradeoff": ("eval.tradeoff", "tradeoff"),
    "synth": ("synth", "synthesize"),
    "convert": ("convert", "convert"),
    "doctor": ("doctor", "doctor"),
    "demo": ("demo", "run_demo"),
    "rasterize": ("ops", "rasterize"),
    "score_mesh": ("eval.mesh", "score_mesh"),
    "load_mesh": ("mesh", "load_mesh"),
    "save_mesh": ("mesh", "save_mesh"),
    "load_primitives": ("primitives", "load_primitives"),
    "save_primitives": ("primitives", "save_primitives"),
    "Camera": ("camera", "Camera"),
    "Choice": ("effects", "Choice"),
    "ExtractOptions": ("options", "ExtractOptions"),
    "LinprimError": ("errors", "LinprimError"),
    "Mesh": ("mesh", "Mesh"),
    "Primitives": ("primitives", "Primitives"),
    "Run": ("run", "Run"),
    "Scene": ("scene", "Scene"),
    "SceneOptions": ("options", "SceneOptions"),
    "TrainOptions": ("options", "TrainOptions"),
}


class _Command(ModuleType):
    """A module that is named as a command is: calling it calls the command's function, so that `lg.train` is both."""

    def __call__(self, *arguments, **settings):
        return self._function(*arguments, **settings)

    @property
    def _function(self):
        return getattr(self, _PUBLIC[self.__name__.rpartition(".")[2]][1])

    @property
    def __signature__(self):
        from inspect import signature

        return signature(self._function)


class _Package(ModuleType):
    """This package. The import system binds a submodule by setting it here, which is where those named as commands
    become callable."""

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, ModuleType) and _PUBLIC.get(name, ("",))[0] == name:
            value.__class__ = _Command
        super().__setattr__(name, value)


def __getattr__(name: str):
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, inner = _PUBLIC[name]
    found = import_module(f"{__name__}.{module}")
    if module == name:
        return found
    globals()[name] = value = getattr(found, inner)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})


sys.modules[__name__].__class__ = _Package
