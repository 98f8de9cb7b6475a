"""The built-in scenes, by name."""

from __future__ import annotations

from collections.abc import Callable

from linprim_geo.synthetic.hall import hall
from linprim_geo.synthetic.shapes import cad_part, furnished_room, smooth_body, wire_and_sheet
from linprim_geo.synthetic.textured import TexturedMesh

SHAPES: dict[str, Callable[..., TexturedMesh]] = {
    "cad": cad_part,
    "smooth": smooth_body,
    "room": furnished_room,
    "wires": wire_and_sheet,
    "hall": hall,
}
"""The functions that make them. Each takes `detail`, the contrast of the fine texture."""

TEXTURES = {"strong": 1.0, "weak": 0.1, "plain": 0.0}
"""Factors on `detail`, by name."""
