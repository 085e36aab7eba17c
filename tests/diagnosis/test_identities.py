"""One piece of physics is one answer, under all of its names, and only while they mean the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnosis.sample import slider

from torchrl_athletic.diagnosis.identities import with_alternatives
from torchrl_athletic.diagnosis.report import terminal_summary
from torchrl_athletic.diagnosis.report.page import render
from torchrl_athletic.diagnosis.report.words import same_as
from torchrl_athletic.diagnosis.result import Answer, Estimate, Finding, Name, Rival
from torchrl_athletic.diagnosis.state import _damped
from torchrl_athletic.effects import CATALOGUE, CoulombFriction
from torchrl_athletic.recordings import Recording


def finding(effect: str, joint: str | None, **values: tuple[float, float]) -> Finding:
    return Finding(effect, joint, 0.9, "", {n: Estimate(sum(v) / 2, v, "1") for n, v in values.items()}, "everywhere")


TORQUES = [effect for effect in CATALOGUE if effect.name != "gain_mismatch"]
"""What applies where torques are commanded."""


def names(
    *findings: Finding, joints=("hip", "knee"), catalogue=CATALOGUE, damped=("hip", "knee")
) -> list[set[tuple[Name, ...]]]:
    return [set(f.alternatives) for f in with_alternatives(findings, joints, catalogue, damped)]


def asymmetric(positive: tuple[float, float], negative: tuple[float, float]) -> Finding:
    return finding("asymmetric_friction", "knee", viscous_positive=positive, viscous_negative=negative)


def test_friction_by_direction_is_dry_friction_and_an_offset_unless_it_grows_differently_with_speed():
    both = (Name("coulomb_friction", "knee"), Name("torque_offset", "knee"))
    assert names(asymmetric((0.0, 2.0), (0.0, 2.5))) == [{both}]
    assert names(asymmetric((1.0, 2.0), (1.5, 2.5))) == [{(*both, Name("viscous_friction", "knee"))}]
    assert names(asymmetric((0.1, 0.2), (0.0, 0.2))) == [{(*both, Name("viscous_friction", "knee"))}]
    assert names(asymmetric((0.0, 2.0), (1.5, 2.5))) == [{(*both, Name("viscous_friction", "knee"))}]
    assert names(asymmetric((1.0, 2.0), (2.1, 2.5))) == [set()]
    assert names(finding("asymmetric_friction", "knee", viscous_positive=(1.0, 2.0))) == [set()]


def test_dry_friction_and_an_offset_on_one_joint_are_friction_by_direction():
    pair = finding("coulomb_friction", "knee"), finding("torque_offset", "knee")
    assert names(*pair) == [{(Name("asymmetric_friction", "knee"),)}] * 2
    viscous = finding("viscous_friction", "knee")
    assert names(*pair, viscous, catalogue=TORQUES) == [{(Name("asymmetric_friction", "knee"),)}] * 3
    assert names(pair[0], viscous, catalogue=TORQUES) == [set(), set()]
    apart = finding("coulomb_friction", "knee"), finding("torque_offset", "hip")
    assert names(*apart, viscous, catalogue=TORQUES) == [set()] * 3
    assert names(*pair, finding("backlash", "knee"))[2] == set()  # which has no part in it


def test_gains_that_are_off_by_one_factor_are_a_torque_scale_where_targets_are_followed():
    scale, gains = (Name("torque_scale", "knee"),), (Name("gain_mismatch", "knee"),)
    assert names(finding("torque_scale", "knee", scale=(1.1, 1.3))) == [{gains}]
    assert names(finding("gain_mismatch", "knee", kp_scale=(1.1, 1.3), kd_scale=(1.2, 1.4))) == [{scale}]
    assert names(finding("gain_mismatch", "knee", kp_scale=(1.1, 1.3), kd_scale=(1.4, 1.5))) == [set()]
    assert names(finding("torque_scale", "knee", scale=(1.1, 1.3)), catalogue=TORQUES) == [set()]
    assert names(finding("gain_mismatch", "knee", kd_scale=(1.2, 1.4))) == [{scale}]  # kp is not there to agree
    assert names(finding("gain_mismatch", "knee", kp_scale=(0.9, 1.4))) == [{scale}]


def test_a_loop_that_damps_too_much_has_a_larger_kd_or_viscous_friction():
    friction, gains = (Name("viscous_friction", "knee"),), (Name("gain_mismatch", "knee"),)
    assert names(finding("gain_mismatch", "knee", kp_scale=(0.9, 1.1), kd_scale=(1.2, 1.4))) == [{friction}]
    assert names(finding("gain_mismatch", "knee", kp_scale=(1.05, 1.1), kd_scale=(1.2, 1.4))) == [set()]
    assert names(finding("gain_mismatch", "knee", kp_scale=(0.95, 1.05), kd_scale=(0.7, 0.9))) == [set()]
    assert names(finding("viscous_friction", "knee", damping=(1.0, 2.0))) == [{gains}]
    assert names(finding("viscous_friction", "knee", damping=(1.0, 2.0)), catalogue=TORQUES) == [set()]
    for f in (finding("viscous_friction", "knee", damping=(1.0, 2.0)),
              finding("gain_mismatch", "knee", kp_scale=(0.9, 1.1), kd_scale=(1.2, 1.4))):  # fmt: skip
        assert names(f, damped=("hip",)) == [set()]


def test_a_kd_that_differs_between_recordings_or_is_zero_tells_it_from_friction():
    time, still = np.arange(3) / 100, np.zeros((3, 2))

    def take(*kd: float) -> Recording:
        return Recording(time, ("hip", "knee"), still, position_target=still, kp=np.ones(2), kd=np.array(kd))

    torques = Recording(time, ("hip", "knee"), still, torque_command=still)
    assert _damped([take(1, 2), take(1, 2)]) == ["hip", "knee"]
    assert _damped([take(1, 2), take(1, 3)]) == ["hip"]
    assert _damped([take(1, 0)]) == ["hip"]
    assert _damped([take(1, 2), torques]) == []


def test_a_late_clock_is_a_delay_of_every_joint_and_an_early_one_is_not():
    delays = (Name("actuation_delay", "hip"), Name("actuation_delay", "knee"))
    assert names(finding("clock_offset", None, offset=(0.004, 0.006))) == [{delays}]
    assert names(finding("clock_offset", None, offset=(-0.006, -0.004))) == [set()]


def test_delays_are_a_clock_only_where_all_joints_have_the_same():
    def delays(hip: tuple[float, float], knee: tuple[float, float]) -> list[set[tuple[Name, ...]]]:
        return names(finding("actuation_delay", "hip", delay=hip), finding("actuation_delay", "knee", delay=knee))

    clock = {(Name("clock_offset", None),)}
    assert delays((0.004, 0.006), (0.005, 0.007)) == [clock, clock]
    assert delays((0.004, 0.006), (0.008, 0.009)) == [set(), set()]
    assert delays((0.004, 0.006), (0.0055, 0.0095)) == [clock, clock]  # 7.5 ms is no delay of the hip; 5.8 ms is
    assert names(finding("actuation_delay", "hip", delay=(0.004, 0.006)), finding("actuation_delay", "knee")) == [
        set(), set()
    ]  # fmt: skip
    assert names(finding("actuation_delay", "hip", delay=(0.004, 0.006))) == [set()]
    assert names(finding("actuation_delay", "hip", delay=(0.004, 0.006)), joints=("hip",)) == [clock]
    beside = finding("viscous_friction", "hip", damping=(1.0, 2.0)), finding("actuation_delay", "hip", delay=(0.4, 0.6))
    assert names(*beside, joints=("hip",), catalogue=TORQUES) == [set(), clock]


def of_rival(name: str, joint: str | None, joints: tuple[str, ...], *others: Finding) -> set[tuple[Name, ...]]:
    """What is the same as the rival of a lag at the hip."""
    lag = replace(finding("actuation_lag", "hip"), rivals=(Rival(name, joint, 0.4, ""),))
    (rival,) = with_alternatives([lag, *others], joints, CATALOGUE)[0].rivals
    return set(rival.alternatives)


def test_a_rival_has_the_names_that_are_its_own_at_any_values():
    clock = {(Name("clock_offset", None),)}
    assert of_rival("actuation_delay", "hip", ("hip",)) == clock
    assert of_rival("actuation_delay", "hip", ("hip", "knee")) == set()
    beside = finding("actuation_delay", "knee", delay=(0.004, 0.006))  # whether both are alike is not known
    assert of_rival("actuation_delay", "hip", ("hip", "knee"), beside) == set()
    assert of_rival("clock_offset", None, ("hip",)) == set()  # an early one is no delay
    assert of_rival("asymmetric_friction", "hip", ("hip",)) == set()
    # with what is beside it, which is said of findings
    assert of_rival("coulomb_friction", "hip", ("hip",), finding("torque_offset", "hip")) == set()


def test_each_of_two_rivals_has_names_of_its_own():
    rivals = tuple(Rival(name, "hip", 0.3, "") for name in ("torque_ripple", "actuation_delay", "viscous_friction"))
    (found,) = with_alternatives(
        [replace(finding("actuation_lag", "hip"), rivals=rivals)], ("hip",), CATALOGUE, ("hip",)
    )
    assert [r.alternatives for r in found.rivals] == [
        (), ((Name("clock_offset", None),),), ((Name("gain_mismatch", "hip"),),)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("stated", "rival"),
    [
        (finding("clock_offset", None, offset=(-0.006, -0.004)), "actuation_delay"),
        (finding("gain_mismatch", "hip", kp_scale=(1.1, 1.3), kd_scale=(1.5, 1.6)), "torque_scale"),
    ],
)
def test_no_rival_is_called_the_same_as_the_finding_that_it_rivals(stated, rival):
    beside = replace(stated, rivals=(Rival(rival, "hip", 0.4, ""),))
    (found,) = with_alternatives([beside], ["hip"], CATALOGUE, ["hip"])[0].rivals
    assert (Name(stated.effect, stated.joint),) not in found.alternatives


def test_one_name_twice_does_not_add_up_to_another():
    twice = finding("coulomb_friction", "knee"), finding("coulomb_friction", "knee")
    assert names(*twice) == [set(), set()]


def test_what_has_no_identity_and_what_the_catalogue_does_not_know_stay_as_they_are():
    assert names(finding("backlash", "knee"), finding("an effect of your own", "knee")) == [set(), set()]


def test_every_identity_of_the_catalogue_is_found_from_its_parts():
    for effect in CATALOGUE:
        for others in effect.identical_to:
            parts = [finding(name, "hip", value=(1.0, 2.0)) for name in others]
            whole = (Name(effect.name, None if effect.whole_robot else "hip"),)
            assert all(whole in found for found in names(*parts, joints=("hip",)))


def test_it_is_said_on_the_terminal_on_the_page_and_in_the_file():
    sample = slider()
    pair = (Name("coulomb_friction", "carriage"), Name("torque_offset", "carriage"))
    stated = replace(sample.answer.findings[0], alternatives=(pair,))
    answer = replace(sample.answer, findings=(stated,))
    said = "Asymmetric friction, which here is the same as Coulomb friction with torque offset: no recording tells"
    assert said in " ".join(terminal_summary(answer).split())
    assert said in render(answer, (), ())
    assert answer.to_json()["findings"][0]["alternatives"] == [
        [{"effect": "coulomb_friction", "joint": "carriage"}, {"effect": "torque_offset", "joint": "carriage"}]
    ]
    assert Answer.from_json(answer.to_json()).findings == answer.findings


def test_of_a_rival_it_is_said_in_the_same_places():
    sample = slider()
    clock = (Name("clock_offset", None),)
    rival = Rival("actuation_delay", "carriage", 0.4, "chirp it", (clock,))
    answer = replace(sample.answer, findings=(replace(sample.answer.findings[0], rivals=(rival,)),))
    said = "Actuation delay, which here is the same as clock offset of the whole robot: no recording tells them apart."
    assert said in " ".join(terminal_summary(answer).split())
    assert said in render(answer, (), ())
    assert Answer.from_json(answer.to_json()).findings[0].rivals == (rival,)


def test_the_finding_that_it_rivals_is_no_partner_of_a_rival():
    gains = ((Name("gain_mismatch", "hip"),),)
    viscous = replace(finding("viscous_friction", "hip"), alternatives=gains)
    rival = Rival("torque_scale", "hip", 0.4, "", gains)
    (said,) = same_as(rival, Answer("explained", (), findings=(replace(viscous, rivals=(rival,)),)))
    assert said == "Torque scale, which here is the same as gain mismatch: no recording tells them apart."


def test_a_file_from_before_is_read_without_them():
    content = slider().answer.to_json()
    del content["findings"][0]["alternatives"]
    assert Answer.from_json(content).findings[0].alternatives == ()


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        (
            ("coulomb_friction", "torque_offset"),
            "which together with torque offset is the same as asymmetric",
        ),
        (("torque_offset", "coulomb_friction"), "which together with Coulomb friction is the same as asymmetric"),
    ],
)
def test_two_that_add_up_to_one_say_so_of_each_other(stated, said):
    found = with_alternatives([finding(name, "hip") for name in stated], ["hip"], CATALOGUE)
    assert said in same_as(found[0], Answer("explained", (), findings=found))[0]


def test_a_rival_goes_by_another_single_name_and_not_by_one_that_two_names_make():
    """Which takes values that a rival has not got; alone, one of the two would be another physics."""
    pair = frozenset({"joint_spring", "torque_offset"})
    both = type("Both", (CoulombFriction,), {"name": "both", "identical_to": (pair, frozenset({"viscous_friction"}))})()
    told = replace(finding("torque_ripple", "knee"), rivals=(Rival("both", "knee", 0.3, ""),))
    (said,) = with_alternatives([told], ("hip", "knee"), (*TORQUES, both))
    assert said.rivals[0].alternatives == ((Name("viscous_friction", "knee"),),)
