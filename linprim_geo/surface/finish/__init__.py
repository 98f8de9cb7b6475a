"""Improves an extracted surface: vertex positions, creases, outlines, holes and number of faces."""
