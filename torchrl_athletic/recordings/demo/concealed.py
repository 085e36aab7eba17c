"""A robot with one secret: the diagnosis without data, without a network, and with an answer to check against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_athletic.recordings.demo.effect import PARAMETERS, HiddenEffect, random_effect
from torchrl_athletic.recordings.demo.robot import two_link_arm
from torchrl_athletic.recordings.demo.takes import make_recordings
from torchrl_athletic.recordings.recording import Recording

CONCEALED = tuple(name for name in PARAMETERS if name != "gain_mismatch")
"""What may be hidden: the takes send torques, so that the gains of a position loop cannot show."""


@dataclass(frozen=True, eq=False)
class Demo:
    """What a user would bring to a diagnosis, and, apart from it, the answer."""

    model_xml: str
    recordings: list[Recording]
    heldout: list[Recording]
    """Takes of another kind."""
    secret: HiddenEffect


def concealed_demo(seed: int = 0, duration: float = 15.0) -> Demo:
    """Record a two-link arm that differs from its model by one effect, which the seed draws.

    Args:
        seed: Of the effect, its joint, its severity, and the noise.
        duration: Of each of the five takes [s].

    Example:
        >>> from torchrl_athletic.recordings.demo import concealed_demo
        >>> demo = concealed_demo(seed=0, duration=2.0)
        >>> len(demo.recordings), len(demo.heldout), demo.recordings[0].joint_names
        (3, 2, ('shoulder', 'elbow'))
    """
    robot = two_link_arm()
    rng = np.random.default_rng(seed)
    name, joint = str(rng.choice(CONCEALED)), str(rng.choice(robot.joint_names))
    draws = [int(draw) for draw in rng.integers(2**31, size=3)]
    secret = random_effect(robot, name, joint, draws[0])
    recordings = make_recordings(robot, [secret], ("gaussian", "square", "chirp"), draws[1], duration)
    heldout = make_recordings(robot, [secret], ("multisine", "sine"), draws[2], duration)
    return Demo(robot.model_xml, recordings, heldout, secret)
