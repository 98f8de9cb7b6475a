"""The report of `linprim-geo inspect`: which effects a scene needs, with the evidence."""

from __future__ import annotations

from dataclasses import asdict

from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.training.effects import REASONS, Choice, Decision, chosen_options

# Effects whose cost factor is below this are reported as costing no time.
FREE = 1.05


def inspect_scene(
    path,
    scene_options: SceneOptions = SceneOptions(),  # noqa: B008 (all three are frozen)
    options: TrainOptions = TrainOptions(),  # noqa: B008
    choice: Choice = Choice(),  # noqa: B008
    log=None,
) -> dict:
    """Read a scene and decide about its effects.

    Returns the number of views and points, `effects`, a list of decisions as tables, and `options`, the option values
    that follow.

    Raises:
        LinprimError: the scene or an option cannot be used.
    """
    from linprim_geo.training.start import decided_scene

    decisions, scene, scene_options, options = decided_scene(
        path, scene_options, options, choice, log or (lambda text: None)
    )
    chosen = chosen_options(decisions)
    return {
        "scene": str(path),
        "views": len(scene.train),
        "held_out_views": len(scene.test),
        "points": 0 if scene.points is None else len(scene.points.xyz),
        "effects": [asdict(decision) for decision in decisions],
        "options": chosen,
    }


def describe(result: dict) -> str:
    """Format the result of `inspect_scene`, one block per effect: on or off, the reason, the cost and the evidence."""
    lines = []
    for d in (Decision(**each) for each in result["effects"]):
        cost = "no time" if d.cost < FREE else f"about {d.cost:.2f} times the time"
        why = f"{REASONS[d.reason]}{': ' + d.note if d.note else ''}"
        lines.append(f"{d.name:<15} {'on ' if d.on else 'off'}  {why}. Costs {cost}: {d.what}")
        value = "not measured" if d.value is None else f"{d.value:.3g} {d.unit}"
        lines.append(f"{'':<20}{d.evidence}: {value}; on from {d.threshold:g} {d.unit}")
    return "\n".join(lines)
