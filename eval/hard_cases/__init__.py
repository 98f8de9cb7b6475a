"""Numerical stability: hard cases against a reference in double precision."""
