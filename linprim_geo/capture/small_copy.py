"""Views with reduced photographs."""

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
        """Return a copy that averages `factor` by `factor` pixels; remaining rows and columns are cut off."""
        own = {entry.name: getattr(view, entry.name) for entry in fields(View)}
        return SmallCopy(**own | {"camera": smaller(view.camera, factor)}, original=view, factor=factor)

    @staticmethod
    def within(view: View, longer_side: int) -> SmallCopy:
        """Return a copy reduced by the smallest factor for which the longer side has at most `longer_side` pixels."""
        return SmallCopy.of(view, -(-max(view.camera.width, view.camera.height) // longer_side))

    def load(self) -> Photo:
        assert self.original is not None
        photo = self.original.load()
        return Photo(*box_downscale(photo.rgb, photo.alpha, self.factor))
