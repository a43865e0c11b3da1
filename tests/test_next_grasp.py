"""Which grasp of a plan is tried next."""

from dataclasses import replace

import numpy as np

from envs.execution import GraspOutcome
from envs.next_grasp import ROOM_OVER_TOUCH, Failures, elsewhere_first, first_untried, no_deeper
from tests.helpers.cubes import cube_grasp
from utils.transforms import Grasp


def test_after_a_failure_another_object_comes_first() -> None:
    near, far = cube_grasp(offset=(0.03, 0, 0)), cube_grasp(offset=(0.06, 0, 0))
    poor = replace(cube_grasp(offset=(0.1, 0, 0)), quality=0.4)
    failed = cube_grasp()
    assert elsewhere_first([near, poor, far], [failed]) == [far, near, poor]
    assert elsewhere_first([near, far], []) == [near, far]


def test_a_miss_is_forgotten_where_something_was_picked() -> None:
    failures = Failures()
    for x, reason in ((0.40, "missed"), (0.50, "slipped"), (0.54, "success")):
        failures.note(Grasp(np.array([x, 0.0, 0.05]), 0.0, 0.08, 1.0), GraspOutcome(reason, 3.0))
    assert [float(one.position[0]) for one in failures.in_round] == [0.40]
    assert failures.in_a_row == failures.palm_stops == []


def test_what_failed_is_not_tried_again_while_there_is_another() -> None:
    first, again, beside, turned = (
        Grasp(np.array([x, 0.0, 0.05]), angle, 0.08, 1.0)
        for x, angle in ((0.5, 0.0), (0.51, 0.1), (0.53, 0.0), (0.5, 1.0))
    )
    assert first_untried([first, beside], []) is first
    assert first_untried([again, beside, turned], [first]) is beside
    assert first_untried([again, turned], [first]) is turned
    assert first_untried([again, first], [first]) is again  # nothing else is left
    assert first_untried([], [first]) is None


def test_no_grasp_goes_as_deep_as_the_palm_was_stopped_there() -> None:
    here, near, far, above = (
        Grasp(np.array([x, 0.0, z]), 0.0, 0.08, 1.0)
        for x, z in ((0.5, 0.01), (0.515, 0.01), (0.525, 0.01), (0.5, 0.06))
    )
    stop = np.array([0.5, 0.0, 0.04])
    raised = no_deeper(near, [above, here], [None, stop])
    np.testing.assert_allclose(raised.position, [0.515, 0.0, 0.04 + ROOM_OVER_TOUCH])
    assert no_deeper(far, [here], [stop]) is far
    assert no_deeper(above, [here], [stop]) is above
    assert no_deeper(near, [here], [None]) is near
    assert no_deeper(near, [], []) is near


def test_a_tilted_grasp_is_drawn_back_along_its_approach() -> None:
    """The hand comes at 45 degrees and was stopped 2 cm before the grasp."""
    slope = np.array([0.0, np.sqrt(0.5), -np.sqrt(0.5)])
    grasp = Grasp(np.array([0.5, 0.0, 0.02]), 0.0, 0.08, 1.0, slope)
    stop = grasp.position - 0.02 * slope
    back = no_deeper(grasp, [grasp], [stop])
    np.testing.assert_allclose(back.position, stop - ROOM_OVER_TOUCH * slope)
    above = replace(grasp, approach=np.array([0.0, 0.0, -1.0]))
    assert no_deeper(above, [grasp], [stop]) is above  # another way
