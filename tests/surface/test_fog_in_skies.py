"""What training fills a sky with beside a house, and stereo gives the depth of the house's outline."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.surface.stereo_frames import _seen_past
from linprim_geo.surface.tsdf_field import DepthFrame

CAMERA = look_at((0, -4, 0), target=(0, 0, 0), size=(80, 60), focal=70.0)
ROWS = np.arange(60)[:, None] + np.zeros((60, 80), int)
ROOF = 35  # the first row of the house


def photograph(cloud: bool) -> SimpleNamespace:
    grey = np.where(ROWS < ROOF, 200, 60)
    if cloud:
        grey[10:20, 20:50] = 240
    return SimpleNamespace(grey=grey.astype(np.uint8), noise=1.0, most_noise=np.inf)


def rendered(fog: int, clamped: bool = False) -> DepthFrame:
    """The house, and so many rows of fog above it; free above that."""
    free = ROWS < ROOF - fog
    depth = np.where(free, 0, np.where(ROWS < ROOF, 4.2, 4.0)).astype(np.float32)
    return DepthFrame(CAMERA, depth, background=free, clamped=ROWS >= ROOF - fog if clamped else None)


@pytest.mark.parametrize("cloud", [False, True])
def test_a_sky_is_free_down_to_the_outline_of_a_house(cloud):
    known = ROWS >= ROOF - 2  # beside the outline stereo has the depth of the house
    nothing = np.zeros(known.shape, bool)
    found = _seen_past(rendered(12, clamped=True), photograph(cloud), nothing, ~known)
    sky = ROWS < ROOF - 1
    assert found.background is not None and found.clamped is not None
    assert found.background[sky].all() and not found.background[ROWS > ROOF].any()
    assert not found.depth[sky].any() and (found.depth[ROWS > ROOF] == 4).all()
    assert not found.clamped[sky].any() and found.clamped[ROWS > ROOF].all()


@pytest.mark.parametrize(("fog", "known"), [(20, 0), (12, 6)], ids=["mostly-rendered", "partly-known"])
def test_a_part_between_edges_that_is_not_mostly_background_stays(fog, known):
    """A wall of which training explains less than half by the background, and one of which stereo knows a sixth."""
    frame = rendered(fog)
    assert frame.background is not None
    unknown = (ROWS < ROOF - known) & (ROWS < ROOF)
    found = _seen_past(frame, photograph(False), np.zeros(unknown.shape, bool), unknown)
    assert (found.background == frame.background).all() and (found.depth == frame.depth).all()
