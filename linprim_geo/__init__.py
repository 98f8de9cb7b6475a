"""Posed photographs to geometry that can be trusted: transparent polyhedra, trained and meshed on a CPU."""

from __future__ import annotations

__version__ = "0.1.0"
