"""Readers: one module per data format of a capture."""
