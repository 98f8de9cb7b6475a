"""Parameters of sweeps: the registry is complete, defaults agree with the options, and all values are valid."""

from __future__ import annotations

import json

from linprim_geo.base.options import SceneOptions, TrainOptions, check_train_options
from linprim_geo.eval.tradeoff import parameters
from linprim_geo.eval.tradeoff.parameters import ERRORS, GROUPS, PARAMETERS, settings, training_options

# What the design lists: every parameter that trades time for accuracy.
LISTED = {
    "rays",
    "order",
    "scalar",
    "stop",
    "degree",
    "trained-degree",
    "primitive",
    "primitives",
    "iterations",
    "scale",
    "views",
    "extraction",
    "samples",
}


def test_the_registry_is_complete():
    assert set(PARAMETERS) == LISTED
    for name, each in PARAMETERS.items():
        assert each.name == name and each.group in GROUPS and set(each.errors) <= set(ERRORS) and each.errors
        names = [r.name for r in each.values]
        assert len(set(names)) == len(names) >= 2 and each.default in names
    shown = [
        json.dumps(settings(each, r), sort_keys=True)
        for each in PARAMETERS.values()
        for r in each.values
        if r.name != each.default
    ]
    assert len(set(shown)) == len(shown), "two values that are not the default set the same"


def test_defaults_of_the_registry_agree_with_the_options():
    rays = PARAMETERS["rays"]
    assert settings(rays, parameters.value_named(rays, "exact")) == parameters.RENDER_DEFAULTS
    options = TrainOptions()
    for name, value in (
        ("ray_model", options.ray_model),
        ("order", options.order),
        ("stop", options.stop),
        ("degree", options.sh_degree),
    ):
        assert parameters.RENDER_DEFAULTS[name] == value
    assert (
        settings(PARAMETERS["primitive"], parameters.value_named(PARAMETERS["primitive"], "octahedron")) == {}
        and options.primitive == "octahedron"
    )
    assert PARAMETERS["trained-degree"].default == str(options.sh_degree)
    for name in ("order", "stop", "scalar", "degree", "extraction", "samples"):
        each = PARAMETERS[name]
        base = parameters.RENDER_DEFAULTS | parameters.EXTRACT_DEFAULTS | parameters.EVALUATE_DEFAULTS
        assert parameters.value_named(each, each.default).changes.items() <= base.items(), name


def test_every_training_value_changes_an_option_that_is_allowed():
    options, scene = TrainOptions(iterations=100, max_primitives=80), SceneOptions(downscale=2)
    for each in PARAMETERS.values():
        if each.group != "train":
            continue
        found = [
            training_options(options, scene, 24, settings(each, value))
            for value in each.values
            if "equal_time" not in value.changes
        ]
        assert len({(str(a), str(b)) for a, b in found}) == len(found), each.name
        for changed, _ in found:
            check_train_options(changed)
    changed = {
        name: training_options(options, scene, 24, change)
        for name, change in {
            "half": {"iterations_times": 0.5},
            "cap": {"max_primitives_times": 2.0},
            "scale": {"downscale_times": 4},
            "views": {"views": 0.25},
        }.items()
    }
    assert (changed["half"][0].iterations, changed["cap"][0].max_primitives) == (50, 160)
    assert (changed["scale"][1].downscale, changed["views"][1].views) == (8, 6)
