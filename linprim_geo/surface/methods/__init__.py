"""Extracts the surface of a run by one of three methods."""
