"""Textures of meshes: charts, their pixels, and files."""
