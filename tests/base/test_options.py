"""Options with defaults and ranges. A value outside its range is refused with one sentence."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import (
    ExtractOptions,
    SceneOptions,
    TrainOptions,
    changed_options,
    check,
    check_train_options,
    flags,
    from_saved,
    option,
    with_changes,
)


@dataclass(frozen=True)
class Options:
    count: int = option(3, "how many", low=2, high=8)
    most: int = option(0, "no more than", low=0)
    share: float = option(0.5, "how much", low=0, high=1)
    shift: float = option(0.0, "whereto")
    level: float | str = option("auto", "where", low=0.1, high=0.9, number_or="auto")
    size: float | None = option(None, "how large", low=1)
    step: float = option(1.0, "how far", positive=True)
    kind: str = option("a", "which", choices=("a", "b"))


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"count": 1}, "--count is 1, wanted 2 to 8"),
        ({"count": 9}, "--count is 9, wanted 2 to 8"),
        ({"count": 2.5}, "--count is 2.5, wanted a whole number"),
        ({"count": True}, "--count is True, wanted a whole number"),
        ({"most": -1}, "--most is -1, wanted at least 0"),
        ({"share": float("nan")}, "--share is nan, wanted 0 to 1"),
        ({"share": "half"}, "--share is 'half', wanted a number"),
        ({"shift": float("inf")}, "--shift is inf, wanted a finite number"),
        ({"size": 0.5}, "--size is 0.5, wanted at least 1"),
        ({"step": 0.0}, "--step is 0.0, wanted a positive number"),
        ({"level": 1.0}, "--level is 1.0, wanted auto, or 0.1 to 0.9"),
        ({"level": "best"}, "--level is 'best', wanted auto, or a number"),
        ({"kind": "c"}, "--kind is 'c', wanted one of a, b"),
    ],
)
def test_a_value_outside_its_range_is_one_sentence(wrong, sentence):
    with pytest.raises(LinprimError) as caught:
        check(replace(Options(), **wrong))
    assert str(caught.value) == sentence
    with pytest.raises(LinprimError):
        with_changes(Options, None, wrong)


def test_range_limits_defaults_and_numpy_numbers_are_accepted():
    for options in (
        Options(),
        Options(count=2, share=0, level=0.1, size=1),
        Options(count=8, most=10**400, share=1, level=0.9, size=1e300),
        Options(count=np.int64(4), share=np.float32(0.25)),
    ):
        check(options)
    assert with_changes(Options, Options(kind="b"), {"count": 5}) == Options(count=5, kind="b")


@pytest.mark.parametrize("cls", [SceneOptions, TrainOptions, ExtractOptions])
def test_every_default_is_valid_and_every_number_has_a_range(cls):
    check(cls())
    for entry in fields(cls):
        if not isinstance(entry.default, str | bool) and not entry.metadata["choices"]:
            assert entry.metadata["low"] is not None, entry.name


def test_flags_list_only_options_that_differ_from_their_defaults():
    from argparse import ArgumentParser

    from linprim_geo.cli.arguments import from_args
    from linprim_geo.cli.options import add_options

    parser = ArgumentParser()
    add_options(parser, Options)
    options = Options(count=4, shift=-0.5, level=0.25, size=2.0, kind="b")
    assert flags(options) == "--count 4 --shift=-0.5 --level 0.25 --size 2.0 --kind b".split()
    assert from_args(Options, parser.parse_args(flags(options))) == options
    assert (
        flags(Options()) == []
        and [entry.name for entry in changed_options(options)] == "count shift level size kind".split()
    )


def test_contradictory_options_are_refused():
    with pytest.raises(LinprimError, match="--initial-primitives is 20, wanted at most --max-primitives, 10"):
        check_train_options(TrainOptions(initial_primitives=20, max_primitives=10))


def test_saved_options_are_converted_to_the_types_of_the_fields():
    assert from_saved(Options, {"level": 0.5, "size": 2, "gone": 1}, "f") == Options(level=0.5, size=2.0)
    assert from_saved(Options, {"level": "auto", "size": None}, "f") == Options()
    for wrong in ({"count": 1.5}, {"kind": 3}, {"level": "best"}, {"count": None}):
        with pytest.raises(LinprimError, match=f"^f: {next(iter(wrong))} is "):
            from_saved(Options, wrong, "f")
