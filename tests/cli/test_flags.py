"""Flags of options: parsed values have the right type and pass the checks."""

from __future__ import annotations

import argparse
import dataclasses

import pytest

from linprim_geo.base.options import ExtractOptions, SceneOptions, TrainOptions, check, flag_of, kinds
from linprim_geo.cli.options import add_options
from linprim_geo.eval.options import ScoreOptions, TradeoffOptions
from linprim_geo.synthetic.options import SynthOptions

CLASSES = [SceneOptions, TrainOptions, ExtractOptions, ScoreOptions, TradeoffOptions, SynthOptions]


def numbers(options: type):
    """Fields that hold a number, and one within its range."""
    kind_of = kinds(options)
    for field in dataclasses.fields(options):
        kind, data = kind_of[field.name], field.metadata
        if kind in (int, float) and not data["parse"] and not data["choices"]:
            low = 1 if data["positive"] or data["low"] is None else data["low"]
            yield field, kind(low) if kind is int or data["high"] is None else 0.5 * (low + data["high"])


@pytest.mark.parametrize("options", CLASSES, ids=lambda cls: cls.__name__)
def test_flags_of_numbers_are_parsed_to_their_type(options):
    for field, value in numbers(options):
        parser = argparse.ArgumentParser()
        add_options(parser, options)
        given = vars(parser.parse_args([flag_of(field.name), str(value)]))
        assert given == {field.name: value} and type(given[field.name]) is type(value)
        check(options(**given))
        if word := field.metadata["number_or"]:
            check(options(**vars(parser.parse_args([flag_of(field.name), word]))))
