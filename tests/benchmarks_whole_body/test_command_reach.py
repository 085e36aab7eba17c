"""What is asked for is what the ranges say, and what is within reach is reached."""

import numpy as np

from benchmarks.command_reach import BASE, BODY, STILL, Config, goals, kinds, nearest


def test_goals_of_the_box_are_in_the_box():
    origins = np.array([points[0] for points in goals(kinds()["`--commands box`"], Config(goals=200))])
    low, high = origins.min(0), origins.max(0)
    assert (low >= [0.5 - 1e-6, -0.3 - 1e-6, 0.25 - 1e-6]).all()
    assert (high <= [0.8 + 1e-6, 0.3 + 1e-6, 1.0 + 1e-6]).all()
    np.testing.assert_allclose(high - low, [0.3, 0.6, 0.75], rtol=0.1)  # and fill it


def test_a_pose_that_the_robot_has_is_found_and_one_beyond_its_reach_is_not():
    x = np.hstack((BODY.pose + 0.2, STILL.mean(0)))
    assert nearest(BODY(x), STILL, Config(starts=1))[0] < 1e-3
    far = BODY(x) + np.array([1.0, 0.0, 0.0])
    assert nearest(far, BASE, Config(starts=1))[0] > 0.3


def test_a_base_that_helps_reaches_more():
    asked = goals(kinds()["`--commands box`"], Config(goals=8))
    helped, still = (np.mean([nearest(goal, base, Config())[0] for goal in asked]) for base in (BASE, STILL))
    assert helped < still - 0.005
