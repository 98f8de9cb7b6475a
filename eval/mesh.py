"""Mesh scores from exact distances between samples of one surface and the triangles of another, for `eval-mesh`.

The headline protocol: both surfaces are sampled uniformly by area, and the distance of each sample to the *surface* of
the other mesh is exact. Two meshes of one shape thus have distance 0 however they are triangulated. (Between two sets
of N point samples on an area A, the mean distance would be about sqrt(A / N) / 2 even for the same surface.) The
protocols of published tables are in `protocols`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import check
from linprim_geo.eval import open_run, write_results
from linprim_geo.eval.options import ScoreOptions, check_score_options
from linprim_geo.eval.shape import ShapeComparison, triangle_scores
from linprim_geo.eval.surface_samples import Comparison, SurfaceDistance, reduce_scores, sample_surface, with_percent
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, clean_mesh, face_normals
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.region import as_text, inside, read_box

DEFAULT_SAMPLES = 200_000
DEFAULT_TAU_SHARE = 0.01  # of the reference's diagonal
# Distance in front of a sample, in diagonals of its mesh, within which another face does not occlude it: sixteen times
# the single-precision error of Embree in a centred scene.
OCCLUSION_TOLERANCE = 1e-5
# Ratio of the number of samples on the surface to that on creases.
CREASE_PART = 10
HAUSDORFF_WARNING = (
    "largest sampled distance: a lower bound of the Hausdorff distance, which a single stray face can determine"
)


def score_mesh(
    prediction: Mesh,
    reference: Mesh,
    *,
    samples: int = DEFAULT_SAMPLES,
    tau: float | None = None,
    seed: int = 0,
    cameras: Sequence[Camera] | None = None,
    unit: str = "unit of the meshes",
) -> dict:
    """Score a mesh against a reference mesh in the same frame and unit, by the headline protocol.

    `accuracy` is the mean distance from the prediction's surface to the reference, `completeness` that from
    the reference's surface to the prediction, `chamfer` the mean of the two. `precision` and `recall` are the
    shares of the two surfaces' areas within `tau` (inclusive) of the other, `f1` their harmonic mean.
    `normal_consistency` is the mean |cos| between the normal at a sample and that of the closest face of the
    other mesh, averaged over the two directions. `normal_consistency_signed` keeps the sign (-1: inside out);
    it is None unless both meshes are consistently oriented. `accuracy_q50`, `_q90`, `_q95` and the same of
    completeness are quantiles. `hausdorff` is the largest sampled distance. Nothing is aligned, scaled or
    cropped. `shape` compares normals, creases and flat parts with those of the reference
    (`ShapeComparison.scores`), `triangles` describes the prediction's faces (`triangle_scores`).

    With `cameras`, `visible` holds the same scores over the samples that a camera sees: those inside its image, in
    front of it, and not hidden by the sample's own mesh. Only the samples are culled; distances are still
    taken to the whole other mesh. `kept_prediction` and `kept_reference` are the shares of the areas that
    were kept. `rays` holds the result of `compare_along_rays` on the cameras, with one ray per sample.

    Args:
        prediction, reference: triangle meshes; open, non-manifold and self-intersecting ones are fine. Faces
            that are degenerate, repeated or not finite are dropped first and counted under `dropped`.
        samples: points per surface, at least 2.
        tau: length; None takes 1 % of the diagonal of the reference's bounding box.
        seed: not negative; equal seeds give equal results.
        cameras: in the frame of the meshes.
        unit: name of the unit of lengths in the result.

    Returns:
        the scores; each length also as `*_percent_diagonal` of the reference's bounding box. `standard_error`
        is the one of `chamfer` due to sampling alone. A score over no samples (nothing visible) is NaN.

    Raises:
        LinprimError: a mesh has no usable face, or an option is out of range.

    Accuracy: distances are float64 around the centre of the mesh they are taken to: about 1e-15 of the
    extent of both meshes.
    """
    check(ScoreOptions(samples=samples, tau=tau, seed=seed))
    clean = clean_mesh(prediction, "prediction"), clean_mesh(reference, "reference")
    results, _, _ = _score_headline(
        clean[0][0], clean[1][0], samples=samples, tau=tau, seed=seed, cameras=cameras, unit=unit
    )
    return results | {"dropped": {"prediction": clean[0][1], "reference": clean[1][1]}}


def _score_headline(
    prediction, reference, *, samples, tau, seed, cameras, unit, box=None
) -> tuple[dict, Comparison, Comparison]:
    """Compute `score_mesh` of clean meshes, without `dropped`, and the two directions; with `box` only over the samples
    inside it."""
    start = time.perf_counter()
    diagonal = reference.diagonal
    tau = DEFAULT_TAU_SHARE * diagonal if tau is None else float(tau)
    oriented = _is_oriented(prediction) and _is_oriented(reference)

    forward = _compare(prediction, SurfaceDistance(reference), samples, (seed, 0))
    backward = _compare(reference, SurfaceDistance(prediction), samples, (seed, 1))
    results = {"protocol": "headline", "unit": unit, "tau": tau, "samples": samples, "seed": seed}
    if box is not None:
        forward, backward = _within(forward, box, "prediction"), _within(backward, box, "reference")
        results["box"] = box.tolist()
    results |= {"samples_reference": samples}
    results |= {"kept_prediction": float(forward.keep.mean()), "kept_reference": float(backward.keep.mean())}
    results["sampling"] = f"{samples} uniform points per surface, one in each equal share; point to triangle"
    culling = "none" if box is None else "samples in the box"
    results["culling"] = culling if cameras is None else f"{culling}; scores in visible: samples that a camera sees"
    results |= reduce_scores(forward, backward, tau, oriented=oriented)
    results["hausdorff_warning"] = HAUSDORFF_WARNING
    shape = ShapeComparison.of(prediction, reference, forward, backward, tau, samples // CREASE_PART, seed)
    on_creases = [np.ones(len(points), bool) if box is None else inside(points, box) for points, _ in shape.creases]
    results["shape"] = shape.scores((forward.keep, backward.keep), on_creases, diagonal)
    results["triangles"] = triangle_scores(prediction)
    if cameras is not None:
        from linprim_geo.eval.culling import compare_along_rays

        seen = _Seen(prediction, cameras), _Seen(reference, cameras)
        keep_prediction, keep_reference = (
            side.keep & by.shows(side.points, side.face) for side, by in zip((forward, backward), seen, strict=True)
        )
        on_creases = [
            on & by.shows(points) for on, by, (points, _) in zip(on_creases, seen, shape.creases, strict=True)
        ]
        visible = {"kept_prediction": float(keep_prediction.mean())}
        visible |= {"kept_reference": float(keep_reference.mean()), "cameras": len(cameras)}
        visible["recast_rays"] = sum(by.caster.recast for by in seen)
        sides = replace(forward, keep=keep_prediction), replace(backward, keep=keep_reference)
        visible |= reduce_scores(*sides, tau, oriented=oriented)
        visible["shape"] = shape.scores((keep_prediction, keep_reference), on_creases, diagonal)
        results["visible"] = with_percent(visible, diagonal)
        if box is None:  # rays would start outside of the box
            rays = compare_along_rays(prediction, reference, cameras, rays=samples, tau=tau, seed=seed)
            results["rays"] = with_percent(rays, diagonal)
    results = with_percent(results, diagonal)
    results["reference_diagonal"] = diagonal
    results["seconds"] = time.perf_counter() - start
    return results, forward, backward


def eval_mesh_files(
    prediction_path: str | os.PathLike,
    reference_path: str | os.PathLike,
    output: str | os.PathLike | None = None,
    options: ScoreOptions | None = None,
    *,
    run=None,
    **changes: Any,
) -> dict:
    """Score one mesh file against another and write the scores, two error-coloured surfaces and two plots.

    `results.json`, `error_pred.ply`, `error_ref.ply`, `precision_recall.png` and `error_histogram.png` go to
    `output`, by default to the run's `eval/mesh` (the headline) or `eval/mesh/PROTOCOL`. With neither, nothing is
    written. The surfaces are the cleaned inputs, refined so that colours show the error between distant corners. The
    `quality` of a vertex is its exact distance to the other surface. Its colour is that distance, from dark violet
    (0) to yellow (`color_max`, the larger 95 % quantile of the two directions, or beyond). The plots show the
    distances that the protocol scores.

    Args:
        options: the settings of the scoring. `mask`, `box` and `plane` are read by `protocols.files`. `cameras`
            replaces the run's cameras. `transform` maps the prediction to the reference's frame, and so does the
            transform that `align` finds (`align.align`), which also moves the run's cameras but not those of `cameras`.
        run: a run folder, or an open run. Its training cameras give the headline's `visible` and `rays` and
            the culling of scannetpp, its scene the unit.
        changes: fields of `options` by name, such as `samples=5000`.

    Returns:
        the result of `score_mesh` or `protocols.score_by_protocol`, with `align` (see `align.align`),
        `dropped`, `prediction`, `reference` (paths) and `color_max`.

    Raises:
        LinprimError: a file cannot be read or written, an option does not belong to the protocol, or the
            protocol rejects a mesh or an option.
    """
    options = replace(options or ScoreOptions(), **changes)
    check_score_options(options)
    protocol, settings = options.protocol, _settings(options)
    prediction = load_mesh(Path(prediction_path))
    if options.transform is not None:
        prediction = _transformed(prediction, options.transform)
    prediction, dropped_prediction = clean_mesh(prediction, os.fspath(prediction_path))
    from linprim_geo.eval.protocols.files import read_reference
    from linprim_geo.eval.protocols.score import TAKES_POINTS, score_by_protocol

    reference, dropped_reference = read_reference(reference_path, protocol in TAKES_POINTS)
    unit, seen_by = "unit of the files", None
    if run is not None:
        run = open_run(run)
        data_set = run.scene()
        seen_by, unit = [view.camera for view in data_set.train], data_set.unit
        folder = Path(run.path) / "eval" / "mesh"
        output = (folder if protocol == "headline" else folder / protocol) if output is None else output
    if options.cameras is not None:
        from linprim_geo.eval.culling import training_cameras

        seen_by = training_cameras(options.cameras)
    aligned: dict = {"way": options.align}
    if options.align != "none":
        from linprim_geo.eval.align import align

        motion, aligned = align(prediction, reference, options.align, options.seed)
        prediction = replace(prediction, vertices=motion.apply(prediction.vertices), normals=None)
        if run is not None and options.cameras is None:
            seen_by = [motion.moved(camera) for camera in seen_by or ()]
    if protocol == "headline":
        drawn = {"samples": options.samples or DEFAULT_SAMPLES, "tau": options.tau, "seed": options.seed}
        box = read_box(options.box or "", seen_by or ())
        results, forward, backward = _score_headline(
            prediction, reference, **drawn, cameras=seen_by, unit=unit, box=box
        )
    else:
        settings = replace(settings, cameras=seen_by)
        scored = score_by_protocol(protocol, prediction, reference, settings, unit)
        results, forward, backward = scored.results, scored.forward, scored.backward
    results |= {"align": aligned, "dropped": {"prediction": dropped_prediction, "reference": dropped_reference}}
    results |= {"prediction": os.fspath(prediction_path), "reference": os.fspath(reference_path)}
    results["color_max"] = max(results["accuracy_q95"], results["completeness_q95"])
    if output is not None:
        _write(Path(output), prediction, reference, forward, backward, results)
    return results


def _settings(options: ScoreOptions):
    """Return the `Settings` of a published protocol, with its small files read; None for the headline."""
    from linprim_geo.eval.protocols.files import read_crop, read_observed_volume, read_plane
    from linprim_geo.eval.protocols.score import METERS_PER_UNIT, Settings

    if options.protocol == "headline":
        return None
    return Settings(
        metre=1.0 / (options.meters_per_unit or METERS_PER_UNIT.get(options.protocol, 1.0)),
        tau=options.tau,
        samples=options.samples,
        seed=options.seed,
        observed=read_observed_volume(options.mask, options.box),
        plane=None if options.plane is None else read_plane(options.plane),
        scene=options.scene,
        crop=None if options.crop is None else read_crop(options.crop),
    )


def _transformed(mesh: Mesh, path: str | os.PathLike) -> Mesh:
    from linprim_geo.eval.protocols.files import read_transform

    matrix = read_transform(path)
    return Mesh(mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3], mesh.faces)


def _write(folder: Path, prediction, reference, forward, backward, results: dict) -> None:
    from linprim_geo.eval import figures

    diagonal, tau = results["reference_diagonal"], results["tau"]
    figures.write_error_meshes(folder, prediction, reference, results["color_max"], diagonal)
    name = Path(results["prediction"]).name
    title, unit = f"{name}, protocol {results['protocol']}", results["unit"]
    figures.plot_rates(folder / "precision_recall.png", forward, backward, tau, title, unit)
    figures.plot_histogram(folder / "error_histogram.png", forward, backward, tau, title, unit)
    write_results(folder, results)


def _within(side: Comparison, box: np.ndarray, name: str) -> Comparison:
    """Return the comparison restricted to the samples in a box."""
    keep = inside(side.points, box)
    if not keep.any():
        raise LinprimError(f"--box {as_text(box)} holds nothing of the {name}, wanted a box around a part of both")
    return replace(side, keep=keep)


def _compare(mesh: Mesh, other: SurfaceDistance, samples: int, seed) -> Comparison:
    points, face = sample_surface(mesh, samples, seed)
    distance, nearest = other.query(points)
    cosine = np.einsum("ij,ij->i", face_normals(mesh)[face], other.normals[nearest])
    return Comparison(distance, np.ones(samples, bool), cosine, points, face, stratified=True)


class _Seen:
    """Visibility of points of a mesh from some cameras."""

    def __init__(self, mesh: Mesh, cameras: Sequence[Camera]):
        from linprim_geo.geometry.raycast import RayCaster

        self.cameras, self.slack = cameras, OCCLUSION_TOLERANCE * mesh.diagonal
        self.caster = RayCaster(mesh.vertices, mesh.faces)

    def shows(self, points: np.ndarray, faces: np.ndarray | None = None) -> np.ndarray:
        """Return (P,) bool: whether any camera sees each of (P, 3) points of the mesh, on its (P,) faces."""
        from linprim_geo.eval.culling import count_views

        return count_views(self.caster, points, self.cameras, self.slack, faces=faces) > 0


def _is_oriented(mesh: Mesh) -> bool:
    """Return whether no directed edge is used twice: neighbouring faces are oriented alike, no edge has three faces."""
    starts, ends = mesh.faces.reshape(-1), np.roll(mesh.faces, -1, axis=1).reshape(-1)
    directed = np.sort(starts * len(mesh.vertices) + ends)
    return not (directed[1:] == directed[:-1]).any()
