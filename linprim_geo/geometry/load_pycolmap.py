"""pycolmap, imported in the one order that is safe: the rest of the package takes it from here.

pycolmap exports the zlib inside of it. Where it is the first to load the system's zlib, that one calls into it, and the
next PNG that Pillow, which uses the system's, saves corrupts memory. Loaded by Pillow first, the system's zlib calls
itself.
"""

from __future__ import annotations

import PIL.Image  # noqa: F401

import pycolmap  # isort: skip


__all__ = ["pycolmap"]
