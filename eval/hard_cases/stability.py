"""Measures the errors of the compiled rasterizer on hard cases, against a reference in float64.

    python -m linprim_geo.eval.hard_cases.stability [--json]

Every class of `classes.py` is rendered and differentiated by every variant of the kernels (primitive, ray model, order,
scalar) that the core has, and compared with `linprim_geo.eval.hard_cases.many_scenes`. A forward case is one ray of one
scene. A gradient case is the gradient of a randomly weighted sum of the rgb and opacity of one scene. The exit status
is 1 unless all of this holds:

    finite      no NaN or infinity in any image or gradient, including those of the geometric images
    share       0 <= opacity <= 1
    forward     every ray is within the bound that `rounding_bounds.rounding` derives for it, times BOUND
    gradient    resolved scenes are within 1e-3 of the reference, and no error exceeds the gradient's own magnitude; for
                polyhedra in 99.9 % of the cases, as a ray within rounding of an edge has the gradient of either face

A scene is resolved if the same bound leaves the sum of its rays' alphas accurate to 1e-4. A needle a millionth of a
pixel wide has no gradient in single precision, and neither has a face within 1e-6 of edge-on. The table shows the share
of resolved scenes.

A gradient is the difference of the contributions of a ray's entry and exit, and is small behind opaque primitives. A
gradient that cancels to less than a few eps of these contributions without absorption cannot be resolved in any
precision. Such errors are taken relative to that many eps / 1e-3 of the contributions. The factor counts the roundings
of the sums and the condition of the gradient that rounding_bounds.py derives, `gradient_condition` for polyhedra and
`gaussian_gradient_rounding` for Gaussians. No limit is fitted to the results of a processor.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from linprim_geo.eval.hard_cases import classes as hard_cases
from linprim_geo.eval.hard_cases import many_scenes, rounding_bounds
from linprim_geo.eval.hard_cases.class_scenes import WINDOW
from linprim_geo.eval.hard_cases.compiled import SCALARS, Variant, run_core, variants
from linprim_geo.eval.hard_cases.many_scenes import PARAMETERS, Scenes
from linprim_geo.kernels import ops

BOUND = 1.0  # allowed error, in units of the bound of `rounding_bounds.rounding`
CLOSE, SHARE_CLOSE = 1e-3, 0.999
# Roundings, in eps, of a gradient's sum over 16 pixels and of the colour and exponential in it; and those that each
# primitive adds: of the remaining light, the light behind it, their product and the exponential.
RESOLUTION, RESOLUTION_EACH = 16, 4
FACES_TIED = 4  # faces that meet in a vertex of an octahedron
TABLE = 2_000_000  # largest number of (scene, ray, primitive, face) entries that the reference holds at once


@dataclass
class Figures:
    """Results of one class on one variant. `forward` is the largest of |rgb - reference| over the scene's largest
    reference value, and of |opacity - reference|."""

    name: str
    primitive: str
    variant: str
    cases: int = 0
    gradient_cases: int = 0
    nonfinite: int = 0
    outside: int = 0  # scenes with an opacity below 0 or above 1
    resolved: float = 1.0  # share of the gradient cases
    forward: float = 0.0
    over_bound: float = 0.0  # worst error in units of its own bound
    gradient: float = 0.0  # worst error of the resolved cases
    close: float = 1.0  # share of the resolved gradients within CLOSE
    worst_scene: int = -1
    worst_gradient_scene: int = -1

    def problems(self) -> list[str]:
        """Return one text for each requirement that is not met."""
        # A ray within rounding of an edge between two faces has the gradient of the other; Gaussians have no edges.
        share, chance = (1.0, 0.0) if self.primitive == "gaussian" else (SHARE_CLOSE, 1.01)
        found = []
        if self.nonfinite:
            found.append(f"{self.nonfinite} cases with NaN or infinity")
        if self.outside:
            found.append(f"{self.outside} scenes with an opacity outside [0, 1]")
        if not self.over_bound <= BOUND:
            found.append(f"forward {self.over_bound:.3g} times its bound (scene {self.worst_scene})")
        # One gradient more than the share allows may be chance in a small sample.
        count = self.resolved * self.gradient_cases
        if (1 - self.close) * count > max(chance, (1 - share) * count):
            found.append(f"only {100 * self.close:.2f} % of the gradients within {CLOSE:g}")
        if not self.gradient <= 1.0:
            found.append(f"a gradient off by {self.gradient:.3g} of its magnitude (scene {self.worst_gradient_scene})")
        return found


@dataclass(frozen=True)
class Truth:
    """Images and gradients of the reference for some scenes in one order."""

    rgb: Tensor  # (B, 3, R)
    opacity: Tensor  # (B, R)
    gradients: list[list[Tensor]]  # one list for each choice among tied faces
    contributions: list[
        Tensor
    ]  # (B,) each: norm of the contributions of entries and exits to each gradient, without absorption
    doubtful: Tensor  # (B, R)
    found: many_scenes.Chords


def _chunks(scenes: Scenes) -> Iterator[slice]:
    count, many = scenes.center.shape[:2]
    step = max(1, TABLE // (scenes.width * scenes.height * many * 8))
    return (slice(i, min(i + step, count)) for i in range(0, count, step))


def _gradients(loss: Tensor, leaves: dict[str, Tensor]) -> list[Tensor]:
    grads = [None] * len(leaves)
    if loss.requires_grad:
        grads = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True, retain_graph=True)
    grads = [torch.zeros_like(x) if g is None else g for x, g in zip(leaves.values(), grads, strict=True)]
    # Gradients to a quaternion of length 1.
    length = leaves["rotation"].detach().norm(dim=-1, keepdim=True)
    return [g * torch.where(length > 0, length, torch.ones_like(length)) if i == 1 else g for i, g in enumerate(grads)]


def reference(scenes: Scenes, order: str, weights: Tensor, ties: bool, gradients: int) -> Truth:
    """Return images and, for the first `gradients` scenes, gradients; with `ties` one gradient for every choice of
    faces, and the zero gradient of a miss."""
    images, sets, sizes = [], [], []
    choices = list(itertools.product(range(FACES_TIED), repeat=2)) if ties else [(0, 0)]
    for part in _chunks(scenes):
        with torch.no_grad():
            found = many_scenes.chords(scenes.rows(part))
            images.append((*many_scenes.render(scenes.rows(part), order, found=found), found))
        part = slice(part.start, min(part.stop, gradients))
        if part.start >= part.stop:
            continue
        leaves = {name: getattr(scenes, name)[part].clone().requires_grad_() for name in PARAMETERS}
        some, weight, of_choice = replace(scenes.rows(part), **leaves), weights[part], []
        size = torch.zeros(len(PARAMETERS), 1, dtype=torch.float64)
        for entry, leave in choices:
            found = many_scenes.chords(some, entry, leave, grazing=ties)
            rgb, opacity = many_scenes.render(some, order, found=found)
            of_choice.append(_gradients((rgb * weight[:, :3]).sum() + (opacity * weight[:, 3]).sum(), leaves))
            color = torch.relu(many_scenes.C0 * some.sh[:, :, 0] + 0.5)
            pull = (weight[:, :3].abs().mT @ color.mT + weight[:, 3, :, None].abs()).detach()
            for contribution in ((found.of_entry * pull).sum(), (found.of_exit * pull).sum()):
                sides = torch.stack([_norm(g) for g in _gradients(contribution, leaves)])
                size = torch.maximum(sides, size.expand_as(sides)) if ties else size + sides
        # The contributions to colours are the weights themselves; that to a density is the length of its chord, for
        # which the primitive's largest extent is taken.
        if scenes.primitive != "gaussian":
            across = (found.hit * pull).sum(1) * some.extent.detach().abs().amax(-1)
            size[3] = torch.maximum(size[3], across.norm(dim=-1))
        shown = (found.hit[..., None] * weight[:, :3].abs().mT[:, :, None]).sum((1, 2))
        size[4] = many_scenes.C0 * shown.norm(dim=-1)
        if ties:
            of_choice.append([torch.zeros_like(g) for g in of_choice[0]])
        sets.append(of_choice), sizes.append(size)
    columns = [[torch.cat(parts) for parts in zip(*choice, strict=True)] for choice in zip(*sets, strict=True)]
    found = many_scenes.Chords(*[torch.cat([getattr(i[2], k) for i in images]) for k in vars(images[0][2])])
    contributions = list(torch.cat(sizes, 1)) if sizes else []
    rgb, opacity = (torch.cat([i[k] for i in images]) for k in (0, 1))
    return Truth(rgb, opacity, columns, contributions, found.doubtful.any(-1), found)


def _norm(x: Tensor) -> Tensor:
    return x.detach().flatten(1).norm(dim=1)


def gradient_errors(scenes: Scenes, got: list[Tensor], wanted: list[Tensor], slack: list[Tensor]) -> Tensor:
    """Return (B,) the largest over PARAMETERS of |got - wanted| / max(|wanted|, slack / CLOSE), with norms over whole
    scenes; `slack`: error bounds (B,) from rounding, for each parameter."""
    length = scenes.rotation[: len(got[0])].norm(dim=-1, keepdim=True)
    got = [g * torch.where(length > 0, length, torch.ones_like(length)) if i == 1 else g for i, g in enumerate(got)]
    errors = []
    for a, b, least in zip(got, wanted, slack, strict=True):
        off, size = _norm(a - b), torch.maximum(_norm(b), least / CLOSE)
        errors.append(torch.where(off <= 1e-37, torch.zeros_like(off), off / size.clamp(min=1e-300)))
    return torch.stack(errors).amax(0)


def gradient_rounding(
    scenes: Scenes, found: many_scenes.Chords, off: Tensor, weights: Tensor, contributions: list[Tensor], eps: float
) -> list[Tensor]:
    """Return error bounds (B,) of the gradients to each of PARAMETERS; `off` is the result of `rounding`."""
    part = (RESOLUTION + RESOLUTION_EACH * scenes.center.shape[1]) * eps
    if scenes.primitive != "gaussian":
        part = part + rounding_bounds.gradient_condition(scenes, found, eps)
        return [part * c for c in contributions]
    color = torch.relu(many_scenes.C0 * scenes.sh[:, :, 0] + 0.5)
    pull = weights[:, :3].abs().mT @ color.mT + weights[:, 3, :, None].abs()
    bounds = rounding_bounds.gaussian_gradient_rounding(scenes, found, off, pull, eps)
    return [
        torch.maximum(a, part * c) for a, c in zip([*bounds, torch.zeros_like(bounds[0])], contributions, strict=True)
    ]


def judge(name: str, variant: Variant, scenes: Scenes, truth: Truth, weights: Tensor, gradients: int) -> Figures:
    """Run the core on the scenes and compare its images and gradients with `truth`."""
    what = hard_cases.CLASSES[name]
    rgb, opacity, grads, finite = run_core(scenes, variant, weights, gradients)
    figures = Figures(name, variant.primitive, variant.name, cases=opacity.numel(), gradient_cases=gradients)
    figures.nonfinite = int((~finite).sum())
    figures.outside = int(((opacity < 0) | (opacity > 1)).any(1).sum())
    if not what.value:
        return figures
    clear = ~truth.doubtful
    color_off = (rgb - truth.rgb).abs().amax(1) * clear
    opacity_off = (opacity - truth.opacity).abs() * clear
    overlap = variant.order == "overlap"
    off = torch.cat(
        [rounding_bounds.rounding(scenes.rows(p), _rows(truth.found, p), variant.eps, overlap) for p in _chunks(scenes)]
    )
    brightest = torch.relu(many_scenes.C0 * scenes.sh + 0.5).flatten(1).amax(1)[:, None]
    alpha = -torch.expm1(-truth.found.tau).sum(-1)
    # Each of M factors exp(-tau) is accurate to 3e-7 = 2.5 eps in single precision.
    allowed = off.sum(-1) + 4 * variant.eps * off.shape[2] * alpha
    if overlap and off.shape[2] > 1:
        # With an end that is off by d, each primitive also absorbs the others' light over an extra length d.
        found = truth.found
        length = torch.where(found.hit, found.t_out - found.t_in, torch.ones_like(found.tau))
        ends = 4 * variant.eps * (found.t_in.abs() + found.t_out.abs()).sum(-1, keepdim=True)
        allowed = allowed - torch.expm1(-found.tau / length.clamp(min=1e-30) * ends).sum(-1)
    # A colour is a sum of two terms, each rounded; a dark one is their difference.
    terms = (many_scenes.C0 * scenes.sh.abs() + 0.5).flatten(1).amax(1)[:, None]
    color_bound = brightest * (2 * allowed + 16 * variant.eps * alpha) + 2 * variant.eps * terms * alpha + 1e-30
    opacity_bound = allowed + 4 * variant.eps * off.shape[2]
    ratio = torch.maximum(color_off / color_bound, opacity_off / opacity_bound).nan_to_num(math.inf).amax(1)
    # In scenes whose values are below the rounding error, relative to that error.
    largest = torch.maximum(truth.rgb.flatten(1).amax(1), color_bound.amax(1))
    figures.forward = float(torch.maximum(color_off.amax(1) / largest, opacity_off.amax(1)).nan_to_num(math.inf).max())
    figures.over_bound, figures.worst_scene = float(ratio.max()), int(ratio.argmax())

    if gradients:
        some = scenes.rows(slice(0, gradients))
        found = _rows(truth.found, slice(0, gradients))
        slack = gradient_rounding(some, found, off[:gradients], weights[:gradients], truth.contributions, variant.eps)
        errors = [gradient_errors(scenes, grads, choice, slack) for choice in truth.gradients]
        errors = torch.stack(errors).amin(0)
        errors = errors.nan_to_num(math.inf, math.inf)
        resolved = (off.sum((1, 2)) <= CLOSE / 10 * alpha.sum(1))[:gradients] | (off.sum((1, 2)) == 0)[:gradients]
        figures.resolved = float(resolved.double().mean())
        if resolved.any():
            errors = torch.where(resolved, errors, torch.zeros_like(errors))
            figures.gradient, figures.worst_gradient_scene = float(errors.max()), int(errors.argmax())
            figures.close = float((errors[resolved] <= CLOSE).double().mean())
    return figures


def _rows(found: many_scenes.Chords, part: slice) -> many_scenes.Chords:
    return many_scenes.Chords(*[getattr(found, k)[part] for k in vars(found)])


def measure(
    names: Sequence[str], chosen: Sequence[Variant], cases: int = 10_000, gradients: int = 200, seed: int = 0
) -> Iterator[Figures]:
    """Yield the figures of every class on every variant, each from at least `cases` rays and `gradients` scenes with a
    gradient; `chosen` has the order of `variants`."""
    for name in names:
        what = hard_cases.CLASSES[name]
        groups = itertools.groupby(chosen, key=lambda r: (r.primitive, r.ray_model))
        for (primitive, ray_model), group in groups:
            if primitive not in what.primitives:
                continue
            count = max(1, gradients, math.ceil(cases / WINDOW**2))
            scenes = hard_cases.generate(name, primitive, ray_model, count, seed)
            weights = torch.from_numpy(
                np.random.default_rng(seed).normal(size=(count, 4, scenes.width * scenes.height))
            )
            if what.ties:
                only = torch.zeros(count, 1, weights.shape[2], dtype=torch.float64)
                only[torch.arange(count), 0, scenes.aimed] = 1
                weights = weights * only
            with torch.no_grad():
                doubtful = torch.cat([many_scenes.chords(scenes.rows(p)).doubtful.any(-1) for p in _chunks(scenes)])
            weights = weights * ~doubtful[:, None]
            for order, same in itertools.groupby(group, key=lambda r: r.order):
                truth = reference(scenes, order, weights, what.ties, gradients if what.value else 0)
                for variant in same:
                    yield judge(name, variant, scenes, truth, weights, gradients)


def table(rows: Sequence[Figures]) -> str:
    """Return the figures as a text table."""
    lines = [
        f"{'class':26} {'primitive':12} {'variant':24} {'cases':>7} {'worst':>9} {'of bound':>9}"
        f" {'gradients':>9} {'resolved':>9} {'<= 1e-3':>9} {'worst':>9} {'NaN':>4}"
    ]
    for r in rows:
        lines.append(
            f"{r.name:26} {r.primitive:12} {r.variant:24} {r.cases:7} {r.forward:9.1e} {r.over_bound:9.2g}"
            f" {r.gradient_cases:9} {100 * r.resolved:8.2f}% {100 * r.close:8.2f}% {r.gradient:9.1e} {r.nonfinite:4}"
        )
    return "\n".join(lines)


def report(rows: Sequence[Figures], seed: int) -> dict:
    """Return the figures as the JSON document that `--json` prints."""
    classes = [
        {
            "name": r.name,
            "primitive": r.primitive,
            "variant": r.variant,
            "cases": r.cases,
            "worst_relative_error": r.forward,
            "nonfinite": r.nonfinite,
            "opacity_outside": r.outside,
            "worst_over_bound": r.over_bound,
            "gradient_cases": r.gradient_cases,
            "gradient_resolved": r.resolved,
            "gradient_within": r.close,
            "worst_gradient_error": r.gradient,
            "compared": hard_cases.CLASSES[r.name].value,
            "problems": r.problems(),
        }
        for r in rows
    ]
    return {"instruction_set": ops.instruction_set(), "seed": seed, "classes": classes}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0 if all requirements are met, else 1."""
    parser = argparse.ArgumentParser(
        prog="python -m linprim_geo.eval.hard_cases.stability", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument(
        "--cases",
        type=int,
        default=10_000,
        metavar="N",
        help="least number of rays per class and variant (default: %(default)s)",
    )
    parser.add_argument(
        "--gradients",
        type=int,
        default=2_000,
        metavar="N",
        help="least number of scenes with a gradient per class and primitive (default: %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    parser.add_argument(
        "--classes",
        nargs="+",
        choices=hard_cases.CLASSES,
        metavar="CLASS",
        help="only these classes; --list prints them",
    )
    parser.add_argument("--primitives", nargs="+", choices=ops.KINDS, default=ops.KINDS)
    parser.add_argument("--scalars", nargs="+", choices=tuple(SCALARS), default=tuple(SCALARS))
    parser.add_argument("--list", action="store_true", help="describe the classes and exit")
    options = parser.parse_args(arguments)
    if options.list:
        for name, what in hard_cases.CLASSES.items():
            print(f"{name:26} {' '.join(what.about.split())}")
        return 0
    if options.cases < 1 or options.gradients < 1:
        parser.error("--cases and --gradients have to be at least 1")
    chosen = [r for r in variants(options.scalars) if r.primitive in options.primitives]
    before, rows, begin = (torch.get_num_threads(), ops.threads()), [], time.monotonic()
    torch.set_num_threads(1), ops.set_threads(1)  # the scenes are tiny
    try:
        if not options.json:
            print(table([]), flush=True)
        for name, primitive in itertools.product(options.classes or hard_cases.CLASSES, options.primitives):
            mine = [r for r in chosen if r.primitive == primitive]
            gradients = math.ceil(options.gradients / max(1, len(mine)))
            for row in measure([name], mine, options.cases, gradients, options.seed):
                rows.append(row)
                if not options.json:
                    print(table([row]).splitlines()[1], flush=True)
    finally:
        torch.set_num_threads(before[0]), ops.set_threads(before[1])
    failed = [(row, problem) for row in rows for problem in row.problems()]
    if options.json:
        print(json.dumps(report(rows, options.seed), indent=1))
    else:
        print(
            f"\n{sum(r.cases for r in rows)} rays, {sum(r.gradient_cases for r in rows)} gradients, "
            f"{time.monotonic() - begin:.0f} s"
        )
        for row, problem in failed:
            print(f"FAILED: {row.name}, {row.primitive}, {row.variant}: {problem}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
