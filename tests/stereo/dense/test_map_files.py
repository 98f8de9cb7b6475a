"""Maps in COLMAP's format: header, order of values, and damaged files."""

from __future__ import annotations

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.stereo.dense.map_files import read_map, write_map


@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 3)])
def test_maps_survive_a_round_trip(tmp_path, shape):
    values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    write_map(tmp_path / "map.bin", values)
    assert np.array_equal(read_map(tmp_path / "map.bin"), values)


def test_files_have_a_text_header_and_channels_in_order(tmp_path):
    write_map(tmp_path / "map.bin", np.arange(12, dtype=np.float32).reshape(2, 2, 3))
    data = (tmp_path / "map.bin").read_bytes()
    assert data.startswith(b"2&2&3&")
    assert np.frombuffer(data[6:], "<f4").tolist() == [0, 3, 6, 9, 1, 4, 7, 10, 2, 5, 8, 11]


@pytest.mark.parametrize("data", [b"", b"2&2&", b"a&2&1&", b"2&2&1&123", b"2&2&1&" + bytes(20), b"\xff" * 40])
def test_damaged_files_are_refused(tmp_path, data):
    (tmp_path / "map.bin").write_bytes(data)
    with pytest.raises(LinprimError, match="map.bin"):
        read_map(tmp_path / "map.bin")
    with pytest.raises(LinprimError, match="cannot be read"):
        read_map(tmp_path / "none.bin")
