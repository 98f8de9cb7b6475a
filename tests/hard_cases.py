"""The corpus of hard cases for the tests: the generators that ship as `linprim_geo.eval.hard_cases`."""

from linprim_geo.eval.hard_cases import CLASSES as CLASSES
from linprim_geo.eval.hard_cases import generate as generate
from linprim_geo.eval.hard_cases import one_scene as one_scene
