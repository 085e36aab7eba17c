"""What named physics leaves is learnt from the fitted takes, and scored where the diagnosis scores."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from diagnosis.plants import pendulum, record, smooth_torque
from torch import nn

from torchrl_athletic.diagnosis import Diagnosis, diagnose
from torchrl_athletic.diagnosis.report.shares import energy_shares
from torchrl_athletic.effects import CATALOGUE
from torchrl_athletic.identification.simulator import load_net
from torchrl_athletic.training.remainder import driven_robot, learn_remainder, scored

ONLY_VISCOUS = tuple(e for e in CATALOGUE if e.name == "viscous_friction")


class Brake(nn.Module):
    """A net that knows: a torque against the newest velocity error's opposite, ``damping`` times it."""

    def __init__(self, damping: float) -> None:
        super().__init__()
        self.damping = damping

    def forward(self, errors: torch.Tensor) -> torch.Tensor:
        return self.damping * errors[..., -1:]  # the velocity error is minus the velocity


def takes(kinds, **joint) -> list:
    true = pendulum(joint=" ".join(f'{key}="{value}"' for key, value in {"damping": 0.05, **joint}.items()))
    return [record(true, smooth_torque(4.0, 1.5, seed=k), noise=1e-4, seed=k) for k in kinds]


@pytest.fixture(scope="module")
def damped() -> Diagnosis:
    """Nothing can be named: the catalogue is empty, and the pendulum is damped four times as much as the model says."""
    found = diagnose(pendulum(), takes([0, 1], damping=0.2), takes([2], damping=0.2), catalogue=())
    return replace(found, corrected=found.nominal)  # without what was adjusted within tolerances


def test_a_net_that_does_nothing_scores_as_the_named_physics(damped):
    robot = driven_robot(damped.xml, damped.recordings)
    score = scored(damped, Brake(0.0), robot, "heldout", damped.heldout)
    given = damped.answer.fit["heldout"].before
    assert score.before == pytest.approx(given, rel=1e-6)
    assert score.after == pytest.approx(given, rel=1e-6)


def test_a_net_that_knows_the_missing_damping_closes_the_gap_and_one_of_the_other_sign_opens_it(damped):
    robot = driven_robot(damped.xml, damped.recordings)
    right, wrong = (scored(damped, Brake(b), robot, "heldout", damped.heldout) for b in (0.15, -0.15))
    assert right.after < 0.1 * right.before
    assert wrong.after > 1.5 * wrong.before


def test_it_looks_back_through_what_was_measured_before_the_window(damped):
    class Oldest(nn.Module):
        def forward(self, errors: torch.Tensor) -> torch.Tensor:
            return 0.15 * errors[..., 20:21]  # twenty steps ago

    robot = driven_robot(damped.xml, damped.recordings)
    late = scored(damped, Oldest(), robot, "heldout", damped.heldout)
    assert late.after < 0.3 * late.before  # 40 ms late, and still a brake, from the window's first step on


def test_a_net_is_taught_written_and_its_share_is_told(damped, tmp_path):
    found = learn_remainder(damped, tmp_path, minutes=1.0, iterations=25, rows=8, progress=False)
    fit = found.answer.fit
    assert fit["heldout_uan"].after < 0.6 * fit["heldout"].after
    content = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert {"train_uan", "heldout_uan"} <= content["fit"].keys()
    assert energy_shares(found.answer, "heldout")["uan"] > 0.3
    assert "A UAN on the remainder takes another" in found.answer.remarks[-1]
    again = scored(damped, load_net(tmp_path / "uan.pt"), driven_robot(damped.xml, damped.recordings), "heldout",
                   damped.heldout)  # fmt: skip
    assert again.after == pytest.approx(fit["heldout_uan"].after, rel=1e-6)


def test_a_diagnosis_without_recordings_is_refused(damped):
    with pytest.raises(ValueError, match="hand over what diagnose"):
        learn_remainder(replace(damped, recordings=()))


def test_takes_of_several_gains_are_refused(damped):
    servo = [replace(r, torque_command=None, position_target=r.position, kp=np.array([k]), kd=np.array([1.0]))
             for r, k in zip(damped.recordings, (10.0, 20.0), strict=True)]  # fmt: skip
    with pytest.raises(ValueError, match="several gains"):
        driven_robot(damped.xml, servo)
    robot = driven_robot(damped.xml, servo[:1])
    assert (robot.kp, robot.kd) == ((10.0,), (1.0,))
