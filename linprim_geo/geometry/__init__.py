"""Cameras, lenses, samples of images, meshes, primitives, ray casting, and their files."""
