"""Kinds of primitives: reference lengths compared with closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.kinds import KINDS


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-5, 5), min_size=4, max_size=4))
def test_reference_length_of_a_tetrahedron_is_the_diameter_of_its_inscribed_sphere(logs):
    extent = np.exp([logs])
    vertices = extent.T * KINDS["tetrahedron"].directions
    volume = abs(np.linalg.det(vertices[1:] - vertices[0])) / 6
    area = sum(
        np.linalg.norm(np.cross(vertices[b] - vertices[a], vertices[c] - vertices[a])) / 2
        for a, b, c in KINDS["tetrahedron"].faces
    )
    # Cancellation in the determinant: 1e-16 times the ratio of the largest to the smallest volume, at most e^15.
    tolerance = 1e-9
    assert KINDS["tetrahedron"].reference_length(extent)[0] == pytest.approx(6 * volume / area, rel=tolerance)
    # numpy and torch agree, and the length is homogeneous of degree 1.
    tensor = torch.from_numpy(extent)
    assert float(KINDS["tetrahedron"].reference_length(tensor)[0]) == pytest.approx(6 * volume / area, rel=tolerance)
    assert KINDS["tetrahedron"].reference_length(3 * extent)[0] == pytest.approx(18 * volume / area, rel=tolerance)


def test_reference_lengths_of_regular_solids_and_their_gradients():
    assert KINDS["octahedron"].reference_length(np.array([[2.0, 3, 1]]))[0] == 2
    assert KINDS["tetrahedron"].reference_length(np.full((1, 4), 3.0))[0] == pytest.approx(2)
    extent = torch.tensor([[0.3, 0.5, 0.2, 0.9], [1.0, 1, 1, 1]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(KINDS["tetrahedron"].reference_length, extent)
    with pytest.raises(LinprimError, match="no reference length"):
        KINDS["gaussian"].reference_length(np.ones((1, 3)))
