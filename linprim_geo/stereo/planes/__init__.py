"""Planes of floors, walls and other regions without texture, and which depths lie on them."""
