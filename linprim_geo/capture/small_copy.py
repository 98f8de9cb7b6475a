"""Views whose photographs are averaged down."""

from __future__ import annotations

from dataclasses import dataclass, fields

from linprim_geo.capture.types import Photo, View
from linprim_geo.geometry.boxes import smaller
from linprim_geo.imaging.photos import box_downscale


@dataclass(frozen=True)
class SmallCopy(View):
    """A view whose photograph is averaged down by `factor` from that of `original`, which may be decoded already."""

    original: View | None = None
    factor: int = 1

    @staticmethod
    def of(view: View, factor: int) -> SmallCopy:
        """Means of `factor` by `factor` pixels; rows and columns that are left over are cut off."""
        own = {entry.name: getattr(view, entry.name) for entry in fields(View)}
        return SmallCopy(**own | {"camera": smaller(view.camera, factor)}, original=view, factor=factor)

    @staticmethod
    def within(view: View, longer_side: int) -> SmallCopy:
        """By the least factor with which the longer side has at most so many pixels."""
        return SmallCopy.of(view, -(-max(view.camera.width, view.camera.height) // longer_side))

    def load(self) -> Photo:
        assert self.original is not None
        photo = self.original.load()
        return Photo(*box_downscale(photo.rgb, photo.alpha, self.factor))
