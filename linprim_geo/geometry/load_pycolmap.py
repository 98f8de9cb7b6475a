"""Import pycolmap in the only safe order; the rest of the package imports it from here.

pycolmap exports its bundled zlib. If pycolmap loads the system's zlib first, the system's library calls into the
bundled one, and the next PNG that Pillow saves (with the system's) corrupts memory. If Pillow loads it first, the
system's zlib calls itself.
"""

from __future__ import annotations

import PIL.Image  # noqa: F401

import pycolmap  # isort: skip


__all__ = ["pycolmap"]
