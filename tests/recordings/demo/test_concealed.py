"""The demo keeps its secret, and has every kind of it."""

import json

import mujoco
import numpy as np
import pytest

from torchrl_athletic.recordings import write_recording
from torchrl_athletic.recordings.demo import CONCEALED, PARAMETERS, Demo, concealed, concealed_demo, two_link_arm


@pytest.fixture(scope="module")
def demos() -> list[Demo]:
    return [concealed_demo(seed, duration=1.0) for seed in (0, 1, 5, 8, 11)]


def test_same_seed_same_demo(demos):
    again = concealed_demo(5, duration=1.0)
    assert again.secret == demos[2].secret
    for one, other in zip(demos[2].recordings + demos[2].heldout, again.recordings + again.heldout, strict=True):
        np.testing.assert_array_equal(one.position, other.position)


def test_every_effect_is_hidden_at_either_joint_sooner_or_later(monkeypatch):
    monkeypatch.setattr(concealed, "make_recordings", lambda *_: [])
    secrets = [concealed_demo(seed).secret for seed in range(200)]
    joints = ("shoulder", "elbow")
    assert {(secret.name, secret.joint) for secret in secrets} == {(name, j) for name in CONCEALED for j in joints}
    assert len({tuple(secret.parameters.values()) for secret in secrets}) == len(secrets)


def test_nothing_but_the_motion_gives_the_secret_away(demos, tmp_path):
    for demo in demos:
        assert demo.model_xml == two_link_arm().model_xml
        told = [(r.source, json.dumps(dict(r.metadata))) for r in demo.recordings + demo.heldout]
        assert told == [(r.source, json.dumps(dict(r.metadata))) for r in demos[0].recordings + demos[0].heldout]
        assert not any(name in text for name in PARAMETERS for pair in told for text in pair)
    write_recording(demos[0].recordings[0], tmp_path / "take.npz")
    content = (tmp_path / "take.npz").read_bytes()
    assert demos[0].secret.name.encode() not in content


def test_held_out_takes_are_of_another_kind(demos):
    kinds = [{r.metadata["excitation"] for r in takes} for takes in (demos[0].recordings, demos[0].heldout)]
    assert kinds[0].isdisjoint(kinds[1])
    assert all(r.rate == pytest.approx(200.0) for r in demos[0].recordings + demos[0].heldout)


def test_the_model_knows_the_joints_of_the_takes(demos):
    model = mujoco.MjModel.from_xml_string(demos[0].model_xml)
    assert tuple(model.joint(i).name for i in range(model.njnt)) == demos[0].recordings[0].joint_names
