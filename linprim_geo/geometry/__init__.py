"""Cameras, lenses, meshes, primitives, ray casting, and their files."""
