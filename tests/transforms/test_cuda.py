"""What changes the model, pushes the robot and bends its torques does on a GPU what it does on the CPU."""

import pytest
import torch

from torchrl_athletic.envs import NO_DISTURBANCES, actuation_chain, whole_body_env
from torchrl_athletic.robots import b2z1
from torchrl_athletic.training import control_step
from torchrl_athletic.training.captured import CapturedRollout
from torchrl_athletic.transforms import B2Z1_PUSHES, CorrectedActuation, DomainRandomization, ExternalPush

NUM_ENVS, STEPS = 16, 7
EPISODE = 3
"""Policy steps: the rows draw anew twice on the way."""
ROBOT = b2z1(cone="pyramidal")
DRAWN = ("randomization", "kp_scale", "kd_scale", "torque_limit_scale", "push", "push_on", "push_steps_left")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
DEVICES = ["cpu", pytest.param("cuda", marks=needs_gpu)]


def found():
    """Findings of a late, slow and weak shoulder whose encoder is off."""
    values = {
        "actuation_delay": {"delay": 0.012},
        "actuation_lag": {"time_constant": 0.006},
        "torque_scale": {"scale": 0.9},
        "encoder_offset": {"offset": 0.01},
    }
    effects = [
        {"effect": name, "joint": "joint2", "parameters": {key: {"value": value} for key, value in of.items()}}
        for name, of in values.items()
    ]
    return {"schema": "torchrl_athletic/corrected/1", "joint_names": ["joint2"], "effects": effects, "trims": []}


def make_env(device):
    timestep = ROBOT.model().opt.timestep
    actuation = CorrectedActuation(
        found(), timestep=timestep, joint_names=ROBOT.joint_names, torque_limit=ROBOT.torque_limit
    )
    push = ExternalPush(B2Z1_PUSHES, dt=4 * timestep, rest=(0.0, 0.04), duration=(0.02, 0.06))
    randomization = DomainRandomization()
    return whole_body_env(
        ROBOT,
        num_envs=NUM_ENVS,
        device=device,
        chain=[actuation, *actuation_chain(ROBOT)],
        disturbances=NO_DISTURBANCES,
        extra=(randomization, push),
        max_steps=EPISODE,
    )


def swing(device):
    """A policy that is a function of the time. Its actions are on the device before a graph is recorded."""
    still = torch.zeros(len(ROBOT.joint_names), device=device)

    def policy(tensordict):
        return tensordict.set("action", still + 0.3 * torch.sin(tensordict["step_count"].float() + 1))

    return policy


@torch.no_grad()
def play(device):
    env, policy = make_env(device), swing(device)
    shown, steps = env.reset(), []
    for _ in range(STEPS):
        step, shown = control_step(env, policy, shown)
        steps.append(step.clone().cpu())
    return env, steps


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_all_of_it_stays_finite(device):
    _, steps = play(device)
    for number, step in enumerate(steps):
        for key in step.keys(True, True):
            assert step.get(key).isfinite().all(), (number, key)
    assert any(step["next", "push_on"].any() for step in steps), "nobody was pushed"
    masses = [step["randomization"] for step in steps]
    assert not torch.equal(masses[0], masses[-1]), "no episode drew anew"


@pytest.mark.slow
@needs_gpu
def test_the_same_streams_draw_the_same_robots_and_pushes():
    (on_cpu, ours), (on_gpu, theirs) = play("cpu"), play("cuda")
    for step, other in zip(ours, theirs, strict=True):
        for key in DRAWN:
            torch.testing.assert_close(other[key], step[key], rtol=1e-5, atol=1e-5, msg=lambda m, k=key: f"{k}: {m}")
    for field in on_cpu.base_env.physics.fields:
        written = on_gpu.base_env.physics.field(field).cpu().double()
        torch.testing.assert_close(written, on_cpu.base_env.physics.field(field).double(), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@needs_gpu
def test_robots_move_alike_until_their_contacts_part_them():
    (_, ours), (_, theirs) = play("cpu"), play("cuda")
    for key, within in (("joint_position", 1e-3), ("applied_torque", 1.0), ("base_position", 1e-3)):
        apart = (theirs[0]["next", key] - ours[0]["next", key]).abs().median()
        assert apart < within, (key, apart)


@pytest.mark.slow
@needs_gpu
def test_one_graph_holds_it_and_draws_what_the_steps_draw():
    _, steps = play("cuda")
    batch = CapturedRollout(make_env("cuda"), swing("cuda"), STEPS, fuse=False)().cpu()
    for key in batch.keys(True, True):
        assert batch.get(key).isfinite().all(), key
    for number, step in enumerate(steps):
        torch.testing.assert_close(batch["randomization"][:, number], step["randomization"])
