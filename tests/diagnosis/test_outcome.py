"""Which gains were logged, which commands, and which recordings are drawn."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_athletic.diagnosis.outcome import OVERLAYS, Diagnosis, logged_gains
from torchrl_athletic.recordings import Recording

STILL = np.zeros((50, 2))


def take(kp=(30.0, 20.0), kd=(3.0, 2.0), source="a.npz", **changes) -> Recording:
    time = np.arange(50) / 100
    return Recording(
        time, ("hip", "knee"), STILL, position_target=STILL, kp=np.array(kp), kd=np.array(kd), source=source, **changes
    )


def torques() -> Recording:
    return replace(take(), position_target=None, torque_command=STILL, kp=None, kd=None)


@pytest.mark.parametrize(
    ("takes", "alike"),
    [
        ([], False),
        ([take()], True),
        ([take(), take()], True),
        ([take(), take(kp=(30.0, 21.0))], False),
        ([take(), take(kd=(3.0, 2.1))], False),
        ([take(), torques()], False),
        ([torques(), take()], False),
    ],
)
def test_gains_are_known_where_all_takes_have_the_same(takes, alike):
    assert logged_gains(takes) == ({"hip": (30.0, 3.0), "knee": (20.0, 2.0)} if alike else None)


@pytest.mark.parametrize(
    ("takes", "commands"),
    [((), None), ((take(),), "targets"), ((torques(),), "torques"), ((take(), torques()), None)],
)
def test_commands_are_of_one_kind_or_none(takes, commands):
    assert Diagnosis(None, None, None, "", recordings=takes)._commands == commands


def test_of_each_kind_some_recordings_are_drawn_with_the_given_and_the_corrected_model():
    given, corrected = (SimpleNamespace(rollout=lambda r, by=by: r.position + by) for by in (1.0, 2.0))
    takes, aside = (tuple(take(source=f"{kind}{k}") for k in range(OVERLAYS + 1)) for kind in ("fitted", "aside"))
    drawn = Diagnosis(None, given, corrected, "", recordings=takes, heldout=aside[:1]).overlays
    assert [(d.recording, d.heldout) for d in drawn] == [
        ("aside0", True),
        *((f"fitted{k}", False) for k in range(OVERLAYS)),
    ]
    for d in drawn:
        assert (d.measured == 0).all()
        assert (d.before == 1).all()
        assert (d.after == 2).all()
