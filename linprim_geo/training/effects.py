"""Decide which effects of effect_registry.py a scene needs, and return the options that follow.

An effect whose evidence cannot be measured keeps its usual setting. Options given by the user are never changed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.capture.types import Scene
from linprim_geo.training.effect_registry import EFFECTS, Data, Effect

MODES = ("auto", "none", "all")


@dataclass(frozen=True)
class Decision:
    """The decision about one effect. `reason` is a key of REASONS; `options` are the option values that follow from
    it."""

    name: str
    what: str
    evidence: str
    value: float | None
    unit: str
    threshold: float
    on: bool
    reason: str
    cost: float
    options: dict[str, object]
    note: str = ""


REASONS = {
    "data": "the data say so",
    "kept": "evidence does not switch it off",
    "unknown": "the data do not say; the usual setting",
    "request": "only when asked for",
    "asked": "--effect asks for it",
    "all": "--effects all",
    "option": "the option was given",
    "impossible": "the scene or the options rule it out",
}


@dataclass(frozen=True)
class Choice:
    """How effects are decided.

    `mode` is "auto" (by the evidence), "all" (all on) or "none" (options stay as they are). `asked`, {name: on},
    overrides the mode. `given`, names of options that the user has set, overrides both.
    """

    mode: str = "auto"
    asked: dict[str, bool] = field(default_factory=dict)
    given: frozenset[str] = frozenset()

    def __post_init__(self):
        if self.mode not in MODES:
            raise LinprimError(f"--effects is {self.mode!r}, wanted one of {', '.join(MODES)}")
        for name in self.asked:
            if name not in EFFECTS:
                raise LinprimError(f"--effect {name}: no such effect, wanted one of {', '.join(EFFECTS)}")


def parse_asked(words: Iterable[str]) -> dict[str, bool]:
    """Return {name: on} from words such as "exposure=on".

    Raises:
        LinprimError: a word is not NAME=on or NAME=off, or the name is unknown.
    """
    asked = {}
    for word in words:
        name, _, value = word.partition("=")
        if name not in EFFECTS:
            raise LinprimError(f"--effect {word}: no effect {name!r}, wanted one of {', '.join(EFFECTS)}")
        if value not in ("on", "off"):
            raise LinprimError(f"--effect {word}: wanted {name}=on or {name}=off")
        asked[name] = value == "on"
    return asked


def decide(scene: Scene, scene_options: SceneOptions, options: TrainOptions, choice: Choice) -> list[Decision]:
    """Return a decision for each effect, in the registry's order.

    `scene` must have initial points and be read with `scene_options`, except `pinhole_below` 0. Takes seconds and is
    deterministic.
    """
    data = Data(scene, options)
    decisions = []
    for effect in EFFECTS.values():
        if choice.mode == "none" and effect.name not in choice.asked:
            continue
        decisions.append(_decide(effect, data, {**vars(scene_options), **vars(options)}, choice))
    return decisions


def _decide(effect: Effect, data: Data, settings: dict, choice: Choice) -> Decision:
    ruled_out = effect.needs(data)
    value = None if ruled_out else effect.measure(data)
    given = sorted(effect.options & choice.given)
    note = ""
    if given:
        on = any(_is_on(effect, name, settings[name]) for name in given)
        reason = "option"
        note = ", ".join(f"--{name.replace('_', '-')} {settings[name]}" for name in given)
        if effect.name in choice.asked and choice.asked[effect.name] != on:
            note += f" overrules --effect {effect.name}={'on' if choice.asked[effect.name] else 'off'}"
    elif ruled_out:
        on, reason, note = False, "impossible", ruled_out
    elif effect.name in choice.asked:
        on, reason = choice.asked[effect.name], "asked"
    elif choice.mode == "all":
        on, reason = True, "all"
    elif effect.on_request:
        on, reason, note = False, "request", effect.on_request
    elif value is None:
        on, reason = bool(effect.kept), "unknown"
    elif effect.kept and value < effect.threshold:
        on, reason, note = True, "kept", effect.kept
    else:
        on, reason = value >= effect.threshold, "data"
    settings_off = effect.left if reason == "data" and effect.left is not None else effect.off
    return Decision(
        name=effect.name,
        what=effect.what,
        evidence=effect.evidence,
        value=None if value is None else float(value),
        unit=effect.unit,
        threshold=effect.threshold,
        on=bool(on),
        reason=reason,
        cost=effect.cost,
        options={k: v for k, v in (effect.on if on else settings_off).items() if not given and k not in choice.given},
        note=note,
    )


def _is_on(effect: Effect, name: str, value: object) -> bool:
    """Return whether a value that the user gave for option `name` switches this effect on: it differs from the effect's
    `off` value and is not the `on` value of another effect."""
    others = [other.on.get(name) for other in EFFECTS.values() if other is not effect]
    return value != effect.off.get(name, value) and value not in others


def settle(
    scene_options: SceneOptions, options: TrainOptions, decisions: Iterable[Decision]
) -> tuple[SceneOptions, TrainOptions]:
    """Return both option objects with the decided values filled in."""
    chosen = chosen_options(decisions)
    of_scene = {name: value for name, value in chosen.items() if name in vars(scene_options)}
    of_training = {name: value for name, value in chosen.items() if name in vars(options)}
    return replace(scene_options, **of_scene), replace(options, **of_training)


def chosen_options(decisions: Iterable[Decision]) -> dict[str, Any]:
    """Return {name: value} of the decided options.

    If two effects set the same option, the one that is on wins. If both are off, the one decided for a reason other
    than the data wins.
    """
    ordered = sorted(decisions, key=lambda decision: (decision.on, decision.reason != "data"))
    return {name: value for decision in ordered for name, value in decision.options.items()}


def summary(decisions: Iterable[Decision]) -> str:
    """Return one line about all decisions for the training log."""
    decisions = list(decisions)
    shown = [f"{d.name} {'on' if d.on else 'off'}{' (as given)' if d.reason == 'option' else ''}" for d in decisions]
    return "effects: " + ", ".join(shown)
