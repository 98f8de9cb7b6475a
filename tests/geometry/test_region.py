"""The region of space given by --box."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.region import as_text, focus_box, inside, read_box


def around(place, distance=3.0, count=12):
    """Cameras of 40x30 pixels and a focal length of 35 on a ring above a place, which they look at."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = np.stack([np.cos(angles), np.sin(angles), np.full(count, 0.6)], 1)
    eyes *= distance / np.linalg.norm(eyes, axis=1, keepdims=True)
    return [look_at(tuple(np.array(place) + eye), target=place, size=(40, 30), focal=35.0) for eye in eyes]


def test_focus_box_of_cameras_around_a_place_is_their_common_field_of_view():
    place = (5.0, -2.0, 1.0)
    box = focus_box(around(place))
    # 15 pixels from the middle to the border, at a depth of 3.
    reach = 3.0 * 15 / 35
    np.testing.assert_allclose(box, [np.subtract(place, reach), np.add(place, reach)], atol=1e-9)
    # One outlier camera moves it little.
    other = [*around(place, count=24), look_at((9.0, 0.0, 1.0), target=(9.0, 5.0, 1.0), size=(40, 30), focal=35.0)]
    assert np.abs(focus_box(other) - box).max() < 0.3


def test_cameras_without_a_common_focus_are_refused():
    outward = [look_at((0, 0, 0), target=tuple(camera.center), size=(40, 30)) for camera in around((0, 0, 0))]
    outward += [look_at(tuple(c.center), target=tuple(2 * c.center), size=(40, 30)) for c in around((0, 0, 0))]
    along = [look_at((0.1 * k, 0, 0), target=(0.1 * k, 5, 0), size=(40, 30)) for k in range(9)]
    for cameras, sentence in (
        (outward, "look at no one place"),
        (along, "look at no one place"),
        (along[:1], "1 cameras are known"),
    ):
        with pytest.raises(LinprimError, match=f"--box auto: .*{sentence}"):
            focus_box(cameras)


def test_box_text_round_trip_and_invalid_text():
    assert read_box("") is None
    box = read_box("-1,0.1,2e3,1,2,3e3")
    np.testing.assert_array_equal(box, [[-1, 0.1, 2000], [1, 2, 3000]])
    np.testing.assert_array_equal(read_box(as_text(box)), box)
    assert inside(np.array([[-1, 0.1, 2000], [1.1, 1, 2500]]), box).tolist() == [True, False]
    for text, sentence in (("1,2,3", "six numbers"), ("0,0,0,1,1,x", "six numbers"), ("0,0,0,1,1,nan", "six numbers")):
        with pytest.raises(LinprimError, match=sentence):
            read_box(text)
    with pytest.raises(LinprimError, match="smaller corner first"):
        read_box("0,0,0,1,1,-1")
