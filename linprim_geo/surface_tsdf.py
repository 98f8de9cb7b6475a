"""The surface of a run by fusing depth maps: depth of the training views at a transmittance level, into a signed distance field."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .errors import LinprimError
from .fuse import auto_voxel_size, fuse_tsdf
from .mesh import Mesh
from .options import ExtractOptions
from .run import Run
from .stages import Stages
from .tsdf import DepthFrame

# A ray with less opacity than this has seen through the scene: it votes for free space.
SEEN_THROUGH = 0.5
# Depth, colour and background of a pixel; frames of more than this in all are not kept.
BYTES_PER_PIXEL, KEPT_BYTES = 8, 2**30


def tsdf_surface(
    run: Run, options: ExtractOptions, stages: Stages, frames: DepthFrames | None = None
) -> tuple[Mesh, dict]:
    """Returns the fused mesh, with colours, and `level`, `voxel_size` and `truncation_voxels` for the statistics.

    `frames` of the same level, if there are any already, are taken in place of new ones.

    Raises:
        LinprimError: no ray crosses the level, or the grid would not fit into memory.
    """
    frames = DepthFrames(run, options.level) if frames is None else frames
    if not any((frame.depth > 0).any() for frame in frames):
        raise LinprimError(
            f"{run.path}: no ray of any training view crosses transmittance {options.level}, so there is no surface"
        )
    stages.lap("render")
    voxel = options.voxel_size if options.voxel_size > 0 else auto_voxel_size(frames)
    mesh = fuse_tsdf(
        frames,
        voxel_size=voxel,
        truncation_voxels=options.truncation,
        memory_limit=int(options.memory_limit * 2**30) if options.memory_limit > 0 else None,
        min_component=options.smallest_part,
        log=stages.note,
    )
    stages.lap("fuse")
    return mesh, {"level": options.level, "voxel_size": voxel, "truncation_voxels": options.truncation}


class DepthFrames(Sequence):
    """`tsdf.DepthFrame`s of the training views: depth at transmittance `level`, the photographs' colours, free background.

    Kept in memory if they are at most KEPT_BYTES in all, else rendered whenever they are asked for.
    """

    def __init__(self, run: Run, level: float):
        self.run, self.level = run, level
        self.views = run.scene().train
        size = sum(view.camera.width * view.camera.height * BYTES_PER_PIXEL for view in self.views)
        self.kept = list(self._render(self.views)) if size <= KEPT_BYTES else None

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index):
        return self.kept[index] if self.kept is not None else next(self._render([self.views[index]]))

    def __iter__(self):
        return iter(self.kept) if self.kept is not None else self._render(self.views)

    def _render(self, views):
        for view, depth, opacity in self.run.surface_depths(views, self.level):
            free = opacity < SEEN_THROUGH
            yield DepthFrame(
                view.camera, np.where(free, np.float32(0), depth), color=view.load().rgb, background=free
            )
