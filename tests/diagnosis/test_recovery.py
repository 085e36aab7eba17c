"""What the demo hides in a robot, the diagnosis finds. The data come from an integrator that is not MuJoCo's."""

import pytest

from torchrl_athletic.diagnosis import diagnose
from torchrl_athletic.diagnosis.result import Answer, Finding
from torchrl_athletic.recordings.demo import (
    HiddenEffect,
    Robot,
    make_recordings,
    pendulum,
    random_effect,
    slider,
    two_link_arm,
)

SEED = 61
"""Nothing was tuned on it; seeds from 500 on served for that."""


def answer_to(robot: Robot, secret: HiddenEffect, seed: int = SEED, duration: float = 7.0) -> Answer:
    """What the diagnosis of two takes says, with a third of another kind kept aside."""
    field = "position_target" if secret.name == "gain_mismatch" else "torque_command"
    takes = make_recordings(robot, [secret], ("gaussian", "square"), seed + 1, duration, field=field)
    heldout = make_recordings(robot, [secret], ("multisine",), seed + 2, duration, field=field)
    return diagnose(robot.model_xml, takes, heldout, seed=0).answer


def values(finding: Finding) -> dict[str, float]:
    return {name: estimate.value for name, estimate in finding.parameters.items()}


def assert_named(answer: Answer, secret: HiddenEffect) -> None:
    assert answer.verdict == "explained"
    assert [(f.effect, f.joint) for f in answer.findings] == [(secret.name, secret.joint)]
    found = {name: value for name, value in values(answer.findings[0]).items() if name in secret.parameters}
    assert found == pytest.approx(dict(secret.parameters), rel=0.1)
    assert answer.fit["heldout"].share_closed > 0.9


@pytest.mark.parametrize(
    "effect",
    [
        "viscous_friction",
        "reflected_inertia",
        "actuation_delay",
        "actuation_lag",
        pytest.param("torque_scale", marks=pytest.mark.slow),  # this and the encoder's offset are asked of an arm
        "torque_offset",
        pytest.param("encoder_offset", marks=pytest.mark.slow),
        "link_mass",
    ],
)
def test_what_a_pendulum_hides_is_named_alone_with_its_parameters(effect):
    robot = pendulum()
    secret = random_effect(robot, effect, "pendulum", SEED)
    assert_named(answer_to(robot, secret), secret)


@pytest.mark.parametrize(
    "robot", [pytest.param(pendulum(), id="pendulum"), pytest.param(slider(), id="slider", marks=pytest.mark.slow)]
)
def test_dry_friction_is_named_alone_with_its_level(robot):
    secret = random_effect(robot, "coulomb_friction", robot.joint_names[0], SEED)
    assert_named(answer_to(robot, secret), secret)


@pytest.mark.parametrize(
    ("effect", "joint"),
    [
        pytest.param("link_mass", "elbow", marks=pytest.mark.slow),
        ("torque_scale", "shoulder"),
        ("encoder_offset", "elbow"),
    ],
)
def test_on_an_arm_the_joint_is_right_too(effect, joint):
    robot = two_link_arm()
    secret = random_effect(robot, effect, joint, SEED)
    assert_named(answer_to(robot, secret), secret)


@pytest.mark.slow  # its law is simulated step by step
def test_friction_that_depends_on_the_direction_is_named_with_all_four_levels():
    """How dry friction is shared between both ways is told from a centre of mass off by 3 mm by its interval alone."""
    robot = pendulum()
    secret = random_effect(robot, "asymmetric_friction", "pendulum", SEED)
    answer, true = answer_to(robot, secret, duration=6.0), dict(secret.parameters)
    assert [(f.effect, f.joint) for f in answer.findings] == [(secret.name, secret.joint)]
    found = answer.findings[0].parameters
    for side in ("positive", "negative"):
        assert found[f"viscous_{side}"].value == pytest.approx(true[f"viscous_{side}"], rel=0.1)
    for name, value in true.items():
        low, high = found[name].ci95
        assert low <= value <= high
    dry = found["coulomb_positive"].value + found["coulomb_negative"].value
    assert dry == pytest.approx(true["coulomb_positive"] + true["coulomb_negative"], rel=0.05)
    assert answer.fit["heldout"].share_closed > 0.9


@pytest.mark.slow  # a position loop is simulated step by step
def test_gains_that_differ_from_the_logged_ones_are_named():
    robot = pendulum()
    secret = random_effect(robot, "gain_mismatch", "pendulum", SEED)
    assert_named(answer_to(robot, secret, duration=6.0), secret)


def test_a_mass_that_slides_without_gravity_may_as_well_be_a_rotor():
    robot = slider()
    secret = random_effect(robot, "link_mass", "carriage", SEED)
    answer = answer_to(robot, secret)
    (found,) = answer.findings
    added = secret.parameters["mass"] - robot.links[0].mass
    assert {found.effect, *(r.effect for r in found.rivals)} >= {"link_mass", "reflected_inertia"}
    assert found.probability < 0.9
    assert values(found) == pytest.approx(
        {"mass": secret.parameters["mass"]} if found.effect == "link_mass" else {"armature": added}, rel=0.1
    )
