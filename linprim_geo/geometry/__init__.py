"""Cameras, lenses, image sampling, meshes, primitives and ray casting, with their files."""
