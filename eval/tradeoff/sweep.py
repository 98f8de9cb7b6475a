"""Measures accuracy against time on a scene: sweeps each parameter of `parameters.py` around the defaults.

Writes `tradeoff.csv`, `tradeoff.json` and `tradeoff.html`. All settings of a group are timed in turn, round after
round, so that other load on the machine affects all of them alike. A timing is the median over the rounds, with
quartiles. Measurements are kept in `measured.json` of the folder and reused.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from linprim_geo.base.cores import usable_cores
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions, TrainOptions, with_changes
from linprim_geo.base.progress import Progress
from linprim_geo.eval.options import TradeoffOptions
from linprim_geo.eval.tradeoff.parameters import (
    PARAMETERS,
    Parameter,
    Value,
    describe_setting,
    setting_key,
    setting_name,
    settings,
    training_options,
)
from linprim_geo.eval.tradeoff.rendering import RenderedRun
from linprim_geo.eval.tradeoff.results import write_report
from linprim_geo.eval.tradeoff.store import Store
from linprim_geo.eval.tradeoff.training import SurfaceScores, copy_run, training_errors
from linprim_geo.jobs.executor import Executor, Task
from linprim_geo.jobs.open import open_executor
from linprim_geo.runs.run import Run
from linprim_geo.training.budget.memory import memory_estimate
from linprim_geo.training.step.training_images import photo_bytes

# The training around which parameters are varied: the defaults at a modest size, with images downscaled to at most
# WIDEST pixels in width.
MODEST = {"iterations": 2000, "max_primitives": 2000}
QUICK = {"iterations": 200, "max_primitives": 200}
WIDEST, QUICK_WIDEST = 400, 128
ROUNDS, QUICK_ROUNDS = 3, 2
# Number of held-out views for measuring render parameters.
RENDERED_VIEWS, QUICK_VIEWS = 8, 2


def tradeoff(
    scene: str | os.PathLike,
    output: str | os.PathLike,
    options: TradeoffOptions | None = None,
    *,
    cluster: str | None = None,
    workers: int | None = None,
    quiet: bool = False,
    **changes: Any,
) -> dict:
    """Sweep the parameters on a scene and write the tables and the HTML report to the folder `output`.

    Args:
        options: the settings of the sweep. `run` is not modified; without it, one is trained with the defaults at the
            size `MODEST`, or with `quick` at `QUICK`, around which training parameters are varied in any case.
            `reference` is used for Chamfer distances and depth.
        cluster, workers: where trainings run and how many at once, see `jobs.open.open_executor`; they share the cores
            of a machine, and are timed so. With neither, trainings run in this process, one after another. All other
            measurements are made in this process.
        changes: fields of `options` by name, such as `quick=True`.

    Returns: the content of tradeoff.json: `rows` (one per value of each parameter), `sentences`, `rule`, `about`,
        `files`.

    Raises:
        LinprimError: a parameter is unknown, the scene or the run cannot be used, or the folder holds another
        sweep.
    """
    options = with_changes(TradeoffOptions, options, changes)
    parameters, threads = options.parameters, options.threads
    unknown = [name for name in parameters if name not in PARAMETERS]
    if unknown:
        raise LinprimError(f"--parameters {unknown[0]} is unknown, wanted some of {', '.join(PARAMETERS)}")
    sweep = Sweep(Path(scene), Path(output), options, quiet)
    chosen = [PARAMETERS[name] for name in PARAMETERS if not parameters or name in parameters]
    if cluster is None and workers is None:
        return sweep.measure(chosen)
    cores, own_machines = usable_cores(), cluster not in (None, "local")
    with open_executor(cluster, sweep.folder / "runs", workers or 0) as executor:
        sweep.executor = executor
        sweep.cores = threads or (cores if own_machines else max(1, cores // (workers or cores)))
        sweep.slot = sweep.cores if own_machines else 1
        return sweep.measure(chosen)


class Sweep:
    """One folder of measurements. With an `executor`, trainings are its tasks; each has `cores` threads and occupies
    `slot` of the executor's cores."""

    executor: Executor | None = None
    cores = slot = 1

    def __init__(self, scene: Path, folder: Path, options: TradeoffOptions, quiet: bool):
        from linprim_geo.capture.load import load_scene
        from linprim_geo.stereo.poses.refine_found_poses import prepare

        run, reference, quick, threads = options.run, options.reference, options.quick, options.threads
        self.scene_path, self.folder, self.given = Path(os.path.realpath(scene)), folder, run
        self.quick, self.threads = quick, threads
        given = {"iterations": options.iterations, "max_primitives": options.max_primitives}
        size = (QUICK if quick else MODEST) | {name: value for name, value in given.items() if value is not None}
        self.rounds = options.rounds or (QUICK_ROUNDS if quick else ROUNDS)
        self.progress = Progress("tradeoff", 1, quiet=quiet)
        # The first run of each kind loads libraries, and is not timed.
        self.warm = self.warm_score = self.warm_train = False
        prepare(scene, threads=threads, log=self.progress.note)
        self.scene = load_scene(scene, downscale=1)
        widest = max(view.camera.width for view in self.scene.train)
        self.scene_options = SceneOptions(downscale=-(-widest // (QUICK_WIDEST if quick else WIDEST)))
        self.options = TrainOptions(**size, threads=threads, evaluate_every=0, checkpoint_every=10**9)
        found = Path(reference) if reference else self.scene_path / "reference.ply"
        if reference and not found.exists():
            raise LinprimError(f"{found}: no such file, wanted a reference mesh")
        self.reference = found if found.exists() else None
        about = {
            "scene": str(self.scene_path),
            "run": str(Path(run).resolve()) if run else None,
            "reference": str(self.reference) if self.reference else None,
            "options": asdict(self.options) | {"threads": threads},
            "scene_options": asdict(self.scene_options),
        }
        self.store = Store(folder, about)

    # --- what is measured -------------------------------------------------------------------------------

    def measure(self, parameters: Sequence[Parameter]) -> dict:
        """Run the missing measurements, and write the results."""
        import torch

        from linprim_geo.kernels import ops

        before = torch.get_num_threads()
        torch.set_num_threads(1)
        ops.set_threads(self.threads)
        try:
            parameters = [self._fitting(parameter) for parameter in parameters]
            for group, measure in (
                ("train", self._train),
                ("render", self._render),
                ("extract", self._extract),
                ("evaluate", self._evaluate),
            ):
                mine = [parameter for parameter in parameters if parameter.group == group]
                if group in ("extract", "evaluate") and self.reference is None and mine:
                    self.progress.note(
                        f"no reference mesh, so {', '.join(k.name for k in mine)}: time only, or no measurement"
                    )
                    if group == "evaluate":
                        continue
                self._in_turn(group, mine, measure)
        finally:
            torch.set_num_threads(before)
        return self._report(parameters)

    def _fitting(self, parameter: Parameter) -> Parameter:
        """Return the parameter without values that the run, or this installation, does not support."""
        from linprim_geo.surface.extract import METHODS

        values = parameter.values
        if parameter.name == "degree":
            degree = self.rendered.defaults["degree"]
            return replace(
                parameter,
                values=tuple(value for value in values if value.changes["degree"] <= degree),
                default=str(degree),
            )
        if parameter.group == "extract":
            return replace(parameter, values=tuple(value for value in values if value.changes["method"] in METHODS))
        return parameter

    def _setting(self, parameter: Parameter, value: Value) -> dict:
        found = settings(parameter, value)
        return (
            found
            if parameter.group != "render"
            else found | {"degree": value.changes.get("degree", self.rendered.defaults["degree"])}
        )

    def _in_turn(
        self, group: str, parameters: Sequence[Parameter], measure: Callable[[str, dict, set, int], None]
    ) -> None:
        """Measure every setting of a group once per round, unless that round was measured before."""
        wanted: dict[str, tuple[dict, set]] = {}
        for parameter in parameters:
            for value in parameter.values:
                setting = self._setting(parameter, value)
                wanted.setdefault(setting_key(group, setting), (setting, set()))[1].update(parameter.errors)
        for turn in range(self.rounds):
            if group == "train" and self.executor:
                each = [setting for setting, _ in wanted.values()]
                self._train_at_once([setting for setting in each if "equal_time" not in setting], turn)
                self._train_at_once([setting for setting in each if "equal_time" in setting], turn)
            for key, (setting, errors) in wanted.items():
                entry = self.store.entry(key, setting)
                if "failed" in entry or (
                    len(entry["times"]) > turn and errors <= entry["errors"].keys() | {"photo_percent"}
                ):
                    continue
                self.progress.note(f"{group}, round {turn + 1} of {self.rounds}: {describe_setting(setting)}")
                try:
                    measure(key, setting, errors, turn)
                except LinprimError as error:
                    entry["failed"] = str(error)
                    self.progress.note(f"  {error}")
                self.store.save()

    # --- the run that is measured -----------------------------------------------------------------------

    @cached_property
    def base(self) -> Path:
        """The folder of the run on which render, extraction and evaluation parameters are measured: a copy of the given
        run, or the trained base."""
        if self.given is None:
            key = setting_key("train", {})
            if not self.store.get(key).get("errors"):
                self.store.entry(key, {})
                self.progress.note("training with the defaults")
                self._train(key, {}, set(PARAMETERS["primitive"].errors), 0)
                if self.executor:
                    self.store[key]["times"].clear()  # it ran alone, while the others share the cores
                self.store.save()
            return self.folder / "runs" / setting_name({})
        return copy_run(Path(self.given), self.folder / "runs" / "given")

    @cached_property
    def run(self):
        return Run.open(self.base)

    @cached_property
    def rendered(self) -> RenderedRun:
        return RenderedRun(self.run, QUICK_VIEWS if self.quick else RENDERED_VIEWS)

    # --- render -----------------------------------------------------------------------------------------

    def _render(self, key: str, setting: dict, errors: set, turn: int) -> None:
        from linprim_geo.base.progress import Stages

        entry = self.store[key]
        if not errors <= entry["errors"].keys():
            entry["errors"] |= self.rendered.errors(setting, errors)
        if len(entry["times"]) > turn:
            return
        stages = Stages(self.progress)
        frame, with_gradient = self.rendered.seconds(setting)
        stages.lap("draw")
        self.store.note(key, frame, stages.peak_gib["draw"])
        entry.setdefault("gradient_times", []).append(with_gradient)

    # --- train ------------------------------------------------------------------------------------------

    def _options(self, key: str, setting: dict) -> tuple[TrainOptions, SceneOptions]:
        """Return the options of a training, which are determined once."""
        entry = self.store[key]
        if "options" not in entry:
            options, scene_options = training_options(self.options, self.scene_options, len(self.scene.train), setting)
            if setting.get("equal_time"):
                options = replace(options, iterations=self._equal_time(setting, options.iterations))
            entry["options"] = asdict(options), asdict(scene_options)
        return TrainOptions(**entry["options"][0]), SceneOptions(**entry["options"][1])

    def _train_at_once(self, settings: Sequence[dict], turn: int) -> None:
        """Run the missing trainings of a round on the executor. Raises LinprimError for an error that ends all of
        them."""
        assert self.executor is not None
        tasks = {}
        folder = self.folder / "runs" / f"round_{turn}_{self.cores}"
        largest = max(view.camera.width * view.camera.height for view in self.scene.train)
        for setting in settings:
            key = setting_key("train", setting)
            entry = self.store.entry(key, setting)
            if "failed" in entry or len(entry["times"]) > turn:
                continue
            options, scene_options = self._options(key, setting)
            square = scene_options.downscale**2
            arguments = {"scene": str(self.scene_path), "scene_options": asdict(scene_options)}
            tasks[key] = Task(
                describe_setting(setting),
                "linprim_geo.eval.tradeoff.training:train_task",
                arguments | {"options": asdict(replace(options, threads=self.cores))},
                folder / setting_name(setting),
                memory_estimate((), options, photo_bytes(self.scene.train) // square, largest // square),
                self.slot,
                "fewer --workers, or more memory",
            )
        self.store.save()
        progress = Progress(f"train, round {turn + 1} of {self.rounds}", 1, quiet=self.progress.quiet)
        for key, found in zip(tasks, self.executor.run(list(tasks.values()), progress), strict=True):
            if "failed" in found:
                self.store[key]["failed"] = found["failed"]
                self.progress.note(f"  {found['failed']}")
                self.store.save()
                continue
            trained, kept = tasks[key].folder / "run", self.folder / "runs" / setting_name(self.store[key]["setting"])
            if not self.store[key]["errors"] and trained.exists():
                shutil.rmtree(kept, ignore_errors=True)
                trained.rename(kept)
            self.store.note(key, found["seconds"], found["task_peak_gib"], primitives=found["primitives"])
            self.store.save()
        shutil.rmtree(folder, ignore_errors=True)

    def _train(self, key: str, setting: dict, errors: set, turn: int) -> None:
        from linprim_geo.base.progress import Stages
        from linprim_geo.training.train import train

        entry = self.store[key]
        options, scene_options = self._options(key, setting)
        if len(entry["times"]) <= turn:
            folder = self.folder / "runs" / (setting_name(setting) if not entry["errors"] else "again")
            shutil.rmtree(folder, ignore_errors=True)
            if not self.warm_train:
                self.warm_train = True
                aside = self.folder / "runs" / "warm_up"
                shutil.rmtree(aside, ignore_errors=True)
                train(
                    self.scene_path,
                    aside,
                    scene_options,
                    replace(options, iterations=min(20, options.iterations)),
                    quiet=True,
                )
                shutil.rmtree(aside)
            stages = Stages(self.progress)
            trained = train(self.scene_path, folder, scene_options, options, quiet=True)
            stages.lap("train")
            self.store.note(key, trained["seconds"], stages.peak_gib["train"], primitives=trained["primitives"])
            if folder.name == "again":
                shutil.rmtree(folder)
        if not entry["errors"]:
            entry["errors"] = self._train_errors(self.folder / "runs" / setting_name(setting))

    def _equal_time(self, setting: dict, iterations: int) -> int:
        """Return the number of steps that take as long as the base's, from the timings of both at equal steps."""
        count = {name: value for name, value in setting.items() if name != "equal_time"}
        both = [setting_key("train", {}), setting_key("train", count)]
        for key, of in zip(both, ({}, count), strict=True):
            if not self.store.get(key).get("times"):
                self.store.entry(key, of)
                self._train(key, of, set(), 0)
        base, other = (float(np.median(self.store[key]["times"])) for key in both)
        return max(1, round(iterations * base / other))

    def _train_errors(self, folder: Path) -> dict:
        run = Run.open(folder)
        run = replace(run, scene_options=replace(run.scene_options, downscale=self.scene_options.downscale))
        return training_errors(run, self.scores, self.progress.note)

    @cached_property
    def scores(self) -> SurfaceScores:
        return SurfaceScores(self.scene.train, self.reference)

    # --- extract and evaluate ---------------------------------------------------------------------------

    @cached_property
    def supported_voxel(self) -> float:
        """The voxel size supported by the run's views."""
        from linprim_geo.surface.fusion.tsdf_fusion import auto_voxel_size
        from linprim_geo.surface.methods.method_tsdf import DepthFrames

        return auto_voxel_size(DepthFrames(self.run, 0.5))

    def _extract(self, key: str, setting: dict, errors: set, turn: int) -> None:
        from linprim_geo.base.options import ExtractOptions
        from linprim_geo.geometry.mesh_files import load_mesh
        from linprim_geo.surface.extract import extract_mesh

        entry = self.store[key]
        if not self.warm:
            self.warm = True
            coarse = ExtractOptions(voxel_size=8 * self.supported_voxel)
            with contextlib.suppress(LinprimError):  # too coarse for a surface
                extract_mesh(self.base, "tsdf", self.folder / "meshes" / "warm_up.ply", coarse, quiet=True)
        options = (
            ExtractOptions(voxel_size=self.supported_voxel * setting["voxel"])
            if setting["method"] == "tsdf"
            else ExtractOptions()
        )
        target = self.folder / "meshes" / f"{setting_name(setting)}.ply"
        stats = extract_mesh(self.base, setting["method"], target, options, quiet=True)
        if len(entry["times"]) <= turn:
            self.store.note(
                key,
                stats["seconds"]["total"],
                stats["peak_gib"]["total"],
                faces=stats["faces"],
                topology=stats["watertight"],
            )
        if not entry["errors"]:
            found = {"boundary_edges": float(stats["boundary_edges"])} | dict.fromkeys(
                ("chamfer_percent", "normal_percent"), math.nan
            )
            if self.reference:
                scores = self.scores.of(load_mesh(target))
                found["chamfer_percent"] = scores["chamfer_percent_diagonal"]
                found["normal_percent"] = 100 * (1 - scores["normal_consistency"])
            entry["errors"] = found

    @cached_property
    def scored_mesh(self):
        """The surface of the run, extracted with the defaults."""
        from linprim_geo.geometry.mesh_files import load_mesh
        from linprim_geo.surface.extract import extract_mesh

        target = self.folder / "meshes" / "scored.ply"
        if not target.exists():
            extract_mesh(self.base, output=target, quiet=True)
        return load_mesh(target)

    def _evaluate(self, key: str, setting: dict, errors: set, turn: int) -> None:
        from linprim_geo.base.progress import Stages
        from linprim_geo.eval.mesh import score_mesh

        prediction, reference = self.scored_mesh, self.scores.truth
        if not self.warm_score:
            self.warm_score = True
            score_mesh(prediction, reference, samples=1000)
        stages = Stages(self.progress)
        scores = score_mesh(prediction, reference, samples=setting["samples"])
        stages.lap("score")
        self.store.note(key, scores["seconds"], stages.peak_gib["score"], chamfer=scores["chamfer_percent_diagonal"])
        self.store[key]["errors"] = {"standard_error_percent": scores["standard_error_percent_diagonal"]}

    # --- results ----------------------------------------------------------------------------------------

    def _report(self, parameters: Sequence[Parameter]) -> dict:
        measured: dict[str, list[tuple[Value, dict]]] = {}
        for parameter in parameters:
            entries = [
                (value, self.store.get(setting_key(parameter.group, self._setting(parameter, value))))
                for value in parameter.values
            ]
            measured[parameter.name] = [(value, entry) for value, entry in entries if entry and entry["times"]]
        about = self.store.about | {"rounds": self.rounds, "load": os.getloadavg()[0], "cores": usable_cores()}
        return write_report(self.folder, about, parameters, measured)
