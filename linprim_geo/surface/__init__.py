"""Extracts a mesh with colours, texture and predicted error from trained primitives."""
