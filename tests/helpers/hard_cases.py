"""The corpus of hard cases for the tests: the generators that ship as `linprim_geo.eval.hard_cases.classes`."""

from linprim_geo.eval.hard_cases.classes import CLASSES as CLASSES
from linprim_geo.eval.hard_cases.classes import generate as generate
from linprim_geo.eval.hard_cases.classes import one_scene as one_scene
