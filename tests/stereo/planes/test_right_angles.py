"""Planes that are nearly at right angles are made so, others are not."""

from __future__ import annotations

import numpy as np
import pytest

from linprim_geo.stereo.planes.right_angles import angles_to, frame_of, off_frame, orthogonalised


def turned(normal, degrees, axis, distance=1.0) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.append(Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis, float)).apply(normal), distance)


def moves(number: int, plane: np.ndarray) -> np.ndarray:
    first = np.cross(plane[:3], np.eye(3)[np.argmin(np.abs(plane[:3]))])
    first /= np.linalg.norm(first)
    return np.array([[*first, 0], [*np.cross(plane[:3], first), 0], [0, 0, 0, 1]])


def angle(one, other) -> float:
    return float(np.degrees(np.arccos(abs(one[:3] @ other[:3]))))


FLOOR = np.array([0.0, 0, 1, 0])


def test_walls_turn_to_right_angles_weighted_by_their_information():
    one, other = turned([1, 0, 0], 3, [0, 0.6, 0.8]), turned([0, 1, 0], 2, [0, 0, -1], 2.0)
    planes = np.array([FLOOR, one, other])
    found = orthogonalised(planes, [None, np.eye(3), 100 * np.eye(3)], moves)
    assert (found[0] == FLOOR).all()
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert angle(found[i], found[j]) == pytest.approx(90, abs=0.02)
    # The plane with more information turns less.
    assert angle(found[2], other) < 0.1 < 3 < angle(found[1], one) < 6
    assert found[1:, 3] == pytest.approx([1, 2], abs=0.01)
    np.testing.assert_allclose(np.linalg.norm(found[:, :3], axis=1), 1)


def test_planes_far_from_right_angles_stay():
    for leaning in (turned([1, 0, 0], 8, [0, 1, 0]), turned([0, 1, 0], 45, [1, 0, 0]), turned([0, 0, 1], 3, [0, 1, 0])):
        planes = np.array([FLOOR, leaning])
        assert (orthogonalised(planes, [None, np.eye(3)], moves) == planes).all()
    assert (orthogonalised(planes[:1], [None], moves) == planes[:1]).all()
    assert orthogonalised(np.zeros((0, 4)), [], moves).shape == (0, 4)


def test_contradicting_right_angles_leave_a_plane_unchanged():
    ramp = turned([0, 0, 1], 8, [0, 1, 0])
    between, clear = turned([1, 0, 0], 4, [0, 1, 0]), turned([0, 1, 0], 2, [1, 0, 0])
    found = orthogonalised(np.array([FLOOR, ramp, between, clear]), [None, None, np.eye(3), np.eye(3)], moves)
    assert (found[:3] == [FLOOR, ramp, between]).all()
    # This plane can be at right angles to the floor and the ramp at once.
    assert angle(found[3], FLOOR) == pytest.approx(90, abs=0.02) and angle(found[3], clear) > 1.5


def test_the_first_of_nearly_parallel_fixed_planes_counts():
    table, wall = turned([0, 0, 1], 2, [0, 1, 0]), turned([1, 0, 0], 3, [0, 1, 0])
    for stay in ([FLOOR, table], [table, FLOOR]):
        found = orthogonalised(np.array([*stay, wall]), [None, None, np.eye(3)], moves)
        assert (found[:2] == stay).all() and angle(found[2], stay[0]) == pytest.approx(90, abs=0.02)


def test_the_frame_of_a_room_follows_most_planes():
    room = [turned([0, 0, 1], 0.3, [1, 0, 0]), turned([1, 0, 0], 0.2, [0, 0, 1]), turned([0, -1, 0], 0.3, [0, 0, 1])]
    room += [turned([0, 0, -1], 0.2, [0, 1, 0]), turned([1, 0, 0], 0.3, [0, 1, 0])]
    furniture = [turned([0.6, 0.8, 0], 2, [1, 0, 0]), turned([-0.8, 0.6, 0], 1, [0, 0, 1])]
    leaning = [turned([1, 0, 0], 5, [0, 0, 1])]
    for order in (room + furniture + leaning, leaning + furniture + room):
        frame = frame_of(np.array(order)[:, :3])
        assert frame is not None
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-9)
        assert np.degrees(angles_to(frame, np.eye(3))).max() < 0.4
    assert frame_of(np.array([FLOOR, turned([0, 0, 1], 8, [0, 1, 0])])[:, :3]) is None
    assert frame_of(np.zeros((0, 3))) is None


def test_planes_count_for_the_frame_by_their_weight():
    """Two slopes of a roof have a frame with the gable, and the floor and the ceiling have another one."""
    gable, slopes = [1.0, 0, 0], [turned([0, 0.8, 0.6], 1, [1, 0, 0])[:3], turned([0, -0.6, 0.8], 2, [1, 0, 0])[:3]]
    normals = np.array([gable, *slopes, [0, 0, 1.0], turned([0, 0, 1], 2, [0, 1, 0])[:3]])
    by_slopes, by_floor = frame_of(normals, np.array([1, 1, 1, 0.1, 0.1])), frame_of(normals, np.array([1, 1, 1, 5, 1]))
    assert by_slopes is not None and by_floor is not None
    assert np.degrees(angles_to(by_slopes, np.array([[0, 0.8, 0.6]])))[0] < 2.1
    assert np.degrees(angles_to(by_floor, np.eye(3))).max() < 0.1


def test_angles_off_the_frame_are_those_to_an_axis_or_to_a_right_angle():
    near, slope, oblique = turned([1, 0, 0], 5, [0, 1, 0]), [0.0, 0.6, 0.8], [0.48, 0.64, 0.6]
    np.testing.assert_allclose(
        np.degrees(off_frame(np.eye(3), np.array([near[:3], slope, oblique]))), [5, 0, np.degrees(np.arcsin(0.48))]
    )
    assert np.isinf(off_frame(None, np.eye(3))).all()


@pytest.mark.parametrize("degrees", [3, 10])
def test_walls_turn_along_the_frame_despite_oblique_furniture(degrees):
    """The back of a chair and a box come first in the list. A wall is nearly at right angles to both."""
    chair, box = turned([1, 0, 0], 9, [0, 1, 0]), turned([1, 0, 0], 4.4, [0, 0, 1])
    stay = [chair, box, FLOOR, turned([1, 0, 0], 0, [0, 0, 1], 3.0), turned([0, 1, 0], 0, [0, 0, 1], 4.0)]
    wall, slope = turned([0, 1, 0], degrees, [0.6, 0, 0.8], 2.0), turned([0, 1, 0], 45, [1, 0, 0], 2.0)
    frame = frame_of(np.array(stay)[:, :3])
    found = orthogonalised(np.array([*stay, wall, slope]), [*[None] * 5, np.eye(3), np.eye(3)], moves, frame)
    assert (found[:5] == stay).all()
    assert angle(found[5], stay[4]) < 0.15 and found[5, 3] == pytest.approx(2, abs=0.05)
    # The slope is at a right angle to one of the walls only.
    assert angle(found[6], slope) < 0.01
