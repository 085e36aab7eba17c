"""The rope pulls robot and sled alike, at every step of the physics, as a serial simulation with the same law says."""

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.functional import rotations
from torchrl_athletic.robots import Handle, Terrain, b2z1, z1
from torchrl_athletic.testing import no_host_sync
from torchrl_athletic.training.captured import fuse_transforms
from torchrl_athletic.transforms import Decimation, InitialState, PDControl, SledRope, StartRanges

DT, SUBSTEPS = 0.005, 4
ROBOT = b2z1(tool=Handle())
POSE = torch.tensor(ROBOT.default_pose)
RETRACTED = POSE.clone()
RETRACTED[-7:] += torch.tensor([0.4, -1.0, -0.6, 0.3, 0.0, 0.0, 0.0])
"""The hand comes back by a foot or so, and to the side."""
STATE = ("sled_position", "sled_velocity", "sled_mass", "sled_friction", "rope_length", "rope_tension", "rope_force")
DRAWN = ("sled_mass", "sled_friction")
LIGHT = {"mass": (1.0, 4.0), "friction": (0.1, 0.3)}
"""Sleds that an arm alone can pull."""


def make_env(n=2, *, start=(), robot=ROBOT, substeps=SUBSTEPS, **told):
    base = TorqueEnv(robot, num_envs=n, every_step=SledRope.every_step)
    rope = SledRope(DT, **told)
    return TransformedEnv(base, Compose(rope, PDControl(robot.kp, robot.kd), Decimation(substeps), *start))


def play(env, steps, target=RETRACTED, shown=None):
    """What is shown, from the first on."""
    shown = env.reset() if shown is None else shown
    states = [shown]
    for _ in range(steps):
        shown = env.step(shown.clone().set("action", target.expand(*env.batch_size, -1)))["next"]
        states.append(shown)
    keys = env.full_observation_spec.keys(True, True)
    return torch.stack([state.select(*keys) for state in states], -1)


class Replica:
    """One robot and one sled, stepped by MuJoCo alone. The laws are written down again here."""

    def __init__(self, shown, every=1):
        self.every, self.count = every, 0  # of how many steps the force is held for
        self.model = ROBOT.model()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, self.model.key(ROBOT.keyframe).id)
        self.x, self.v = shown["sled_position"].double().numpy(), np.zeros(2)
        self.m, self.mu, self.length, self.height = (
            float(shown[key]) for key in ("sled_mass", "sled_friction", "rope_length", "sled_hook_height")
        )
        self.force = np.zeros(3)

    def grip(self):
        probe = mujoco.MjData(self.model)
        probe.qpos[:], probe.qvel[:] = self.data.qpos, self.data.qvel
        mujoco.mj_forward(self.model, probe)
        return probe.sensor("handle_position").data, probe.sensor("handle_linear_velocity").data

    def step(self, target):
        error = target.double().numpy() - self.data.qpos[7:]
        self.data.qfrc_applied[6:] = np.array(ROBOT.kp) * error - np.array(ROBOT.kd) * self.data.qvel[6:]
        self.data.xfrc_applied[self.model.body("handle").id, :3] = self.force
        mujoco.mj_step(self.model, self.data)
        self.v = self.v - self.force[:2] / self.m * DT
        speed, brake = np.linalg.norm(self.v), self.mu * 9.81 * DT
        self.v = np.zeros(2) if speed <= brake else self.v * (speed - brake) / speed
        self.x = self.x + self.v * DT
        self.count += 1
        if self.count % self.every == 0:
            place, velocity = self.grip()
            way = np.array([*self.x, self.height]) - place
            d = np.linalg.norm(way)
            rate = (np.array([*self.v, 0.0]) - velocity) @ way / d
            self.force = max(1000 * max(d - self.length, 0) ** 2 - rate**2, 0.0) * way / d


def test_robot_and_sled_do_what_a_serial_simulation_says():
    states = play(make_env(3, **LIGHT), 40)
    assert (states["rope_tension"].amax(1) > 10).all()
    assert ((states["sled_position"][:, -1] - states["sled_position"][:, 0]).norm(dim=-1) > 0.05).all()
    for row in states.unbind(0):
        replica, coarse = Replica(row[0]), Replica(row[0], every=SUBSTEPS)
        for number, shown in enumerate(row[1:].unbind(0)):
            for _ in range(SUBSTEPS):
                replica.step(RETRACTED)
                coarse.step(RETRACTED)
            at = f"step {number}"
            np.testing.assert_allclose(shown["rope_force"], replica.force, atol=0.02, err_msg=at)
            np.testing.assert_allclose(shown["sled_position"], replica.x, atol=1e-4, err_msg=at)
            np.testing.assert_allclose(shown["sled_velocity"], replica.v, atol=1e-3, err_msg=at)
            np.testing.assert_allclose(shown["joint_position"], replica.data.qpos[7:], atol=1e-4, err_msg=at)
            np.testing.assert_allclose(shown["base_position"], replica.data.qpos[:3], atol=1e-4, err_msg=at)
        assert np.abs(coarse.x - replica.x).max() > 1e-3  # a force held for an action would have been told apart


def test_each_step_of_the_physics_feels_the_force_of_the_state_before_it(monkeypatch):
    env = make_env(2, **LIGHT)
    physics, felt = env.base_env.physics, []
    handle, step = physics.model.body("handle").id, physics.step

    def watched(*args, **told):
        felt.append(physics.xfrc_applied[:, handle].clone())
        return step(*args, **told)

    monkeypatch.setattr(physics, "step", watched)
    states = play(env, 30)
    felt = torch.stack(felt, 1)
    assert (felt[..., 3:] == 0).all()
    torch.testing.assert_close(felt[:, ::SUBSTEPS, :3].float(), states["rope_force"][:, :-1])
    taut = (felt[:, 1:].norm(dim=-1) > 1) & (felt[:, :-1].norm(dim=-1) > 1)
    assert taut.sum() > 20
    assert (felt.diff(dim=1).norm(dim=-1)[taut] > 0).all()


def test_an_episode_begins_with_the_rope_just_taut_ahead_of_the_robot():
    turned = InitialState(StartRanges(base_position=(1.0, 1.0, 0.0)))
    shown = make_env(20, start=[turned], length=1.5).reset()
    ahead = shown["sled_position"] - shown["handle_position"][:, :2]
    torch.testing.assert_close(ahead.norm(dim=-1), torch.full((20,), 1.5))
    heading = torch.atan2(ahead[:, 1:], ahead[:, :1])
    torch.testing.assert_close(heading, rotations.yaw(shown["base_quaternion"]), atol=1e-5, rtol=0)
    assert heading.std() > 1
    drop = shown["handle_position"][:, 2:] - shown["sled_hook_height"]
    torch.testing.assert_close(shown["rope_length"], (drop.square() + 1.5**2).sqrt())
    assert (shown["rope_tension"] == 0).all()
    assert (shown["rope_force"] == 0).all()
    assert (shown["sled_velocity"] == 0).all()


def test_the_hook_is_over_the_ground_below_the_robot():
    robot = b2z1(tool=Handle(), terrain=Terrain(slope=0.1))
    spread = InitialState(StartRanges(base_position=(8.0, 8.0, 0.0)))
    shown = make_env(10, start=[spread], robot=robot, hook_height=0.3).reset()
    uphill = 0.1003 * shown["base_position"][:, :1]  # the tangent of the slope
    torch.testing.assert_close(shown["sled_hook_height"], 0.3 + uphill, atol=0.03, rtol=0)
    assert shown["sled_hook_height"].std() > 0.2


def test_masses_and_frictions_fill_their_ranges_and_differ_from_episode_to_episode():
    env = make_env(300)
    first, second = env.reset(), env.reset()
    for key, (low, high) in zip(DRAWN, ((20.0, 180.0), (0.1, 0.2)), strict=True):
        assert low <= first[key].min() < low + 0.05 * (high - low)
        assert high >= first[key].max() > high - 0.05 * (high - low)
        assert not torch.equal(first[key], second[key])
    drawn = torch.cat([first[key] for key in DRAWN], -1)
    assert torch.corrcoef(drawn.T)[0, 1].abs() < 0.15


def test_a_robot_that_stands_leaves_the_sled_where_it_is():
    with_sled = play(make_env(1), 50, POSE)
    assert torch.equal(with_sled["sled_position"], with_sled["sled_position"][:, :1].expand(-1, 51, -1))
    assert (with_sled["sled_velocity"] == 0).all()
    assert with_sled["rope_tension"].max() < 5  # it settles by 4 cm
    free = TransformedEnv(TorqueEnv(ROBOT), Compose(PDControl(ROBOT.kp, ROBOT.kd), Decimation(SUBSTEPS)))
    alone = play(free, 50, POSE)
    torch.testing.assert_close(with_sled["base_position"], alone["base_position"], atol=2e-3, rtol=0)


def test_a_partial_reset_renews_its_rows_only_and_their_force_is_gone():
    env = make_env(3, **LIGHT)
    reached = play(env, 6)[:, -1]
    env.step(reached.clone().set("action", RETRACTED.expand(3, -1)))
    acting = env.base_env.physics.xfrc_applied[:, env.base_env.physics.model.body("handle").id, :3]
    assert (acting.norm(dim=-1) > 1).all()
    starts = torch.tensor([[True], [False], [True]])
    before = reached.clone()
    again = env.reset(reached.clone().set("_reset", starts))
    assert (acting.norm(dim=-1) > 0).tolist() == [False, True, False]
    for key in (*STATE, "sled_hook_height"):
        assert torch.equal(again[key][1], before[key][1]), key
    for key in DRAWN:
        assert (again[key] != before[key])[starts].all(), key
    assert (again["rope_tension"] == 0).squeeze(-1).tolist() == [True, False, True]
    following = env.step(again.clone().set("action", RETRACTED.expand(3, -1)))["next"]
    assert torch.equal(following["sled_position"][::2], again["sled_position"][::2])


def test_a_row_alone_is_the_row_of_the_batch():
    batch, alone = make_env(3, **LIGHT), make_env(1, first_row=2, **LIGHT)
    many, one = play(batch, 20), play(alone, 20)
    starts = torch.tensor([[False], [False], [True]])
    later = play(batch, 20, shown=batch.reset(many[:, -1].clone().set("_reset", starts)).exclude("_reset"))
    many, one = torch.cat((many, later), -1), torch.cat((one, play(alone, 20)), -1)
    assert one["rope_tension"].max() > 1
    for key in (*STATE, "joint_position"):
        assert torch.equal(many[key][2], one[key][0]), key


def test_compiled_it_pulls_as_it_does_uncompiled():
    plain, compiled = make_env(2, **LIGHT), make_env(2, **LIGHT)
    fuse_transforms(compiled, backend="aot_eager")
    ours, theirs = play(plain, 25), play(compiled, 25)
    assert ours["rope_tension"].max() > 1
    for key in STATE:
        torch.testing.assert_close(theirs[key], ours[key], atol=1e-3, rtol=1e-3)


def test_nothing_in_it_waits_for_a_gpu():
    env = make_env(3, **LIGHT)
    reached, rope = play(env, 5)[:, -1], env.transform[0]
    following = reached.clone()
    starting = reached.clone().set("_reset", torch.tensor([[True], [False], [True]]))
    with no_host_sync():
        rope._inv_call(reached)
        rope._step(reached, following)
        rope._reset(starting, following)
    assert (following["rope_tension"] == 0).squeeze(-1).tolist() == [True, False, True]


def test_specs_hold():
    check_env_specs(make_env())


@pytest.mark.parametrize(
    ("base", "advice"),
    [
        (lambda: TorqueEnv(b2z1()), r"b2z1\(tool=Handle\(\)\)"),
        (lambda: TorqueEnv(ROBOT), r"every_step=SledRope\.every_step"),
        (lambda: TorqueEnv(z1(tool=Handle()), every_step=SledRope.every_step), "floating base"),
    ],
)
def test_an_environment_that_cannot_hold_a_rope_is_refused(base, advice):
    env = TransformedEnv(base(), SledRope(DT))
    with pytest.raises(ValueError, match=advice):
        env.reset()


@pytest.mark.parametrize(
    ("wrong", "advice"),
    [
        ({"dt": 0.0}, "more than 0"),
        ({"mass": (0.0, 10.0)}, "both more than 0"),
        ({"mass": (30.0, 20.0)}, "no sled weighs that"),
        ({"friction": (-0.1, 0.2)}, "neither below 0"),
        ({"length": 0.0}, "below the hand"),
        ({"stiffness": 0.0}, "make no rope"),
    ],
)
def test_a_sled_that_cannot_be_is_refused(wrong, advice):
    with pytest.raises(ValueError, match=advice):
        SledRope(**{"dt": DT, **wrong})


def test_a_rope_of_one_s_own_is_as_stiff_and_damps_as_much_as_it_is_told():
    rope = SledRope(DT, stiffness=300.0, damping=50.0)
    still = {"sled_position": torch.zeros(1, 2), "sled_velocity": torch.zeros(1, 2), "rope_force": torch.zeros(1, 3)}
    numbers = {"sled_mass": 5.0, "sled_friction": 0.1, "sled_hook_height": 0.0, "rope_length": 1.0, "rope_tension": 0.0}
    before = TensorDict({**still, **{key: torch.tensor([[value]]) for key, value in numbers.items()}}, [1])
    grip = {"handle_position": [[-2.0, 0.0, 0.0]], "handle_linear_velocity": [[-0.5, 0.0, 0.0]]}
    after = TensorDict({key: torch.tensor(value) for key, value in grip.items()}, [1])
    rope.advance(before, after)
    assert after["rope_tension"].item() == pytest.approx(300.0 - 50.0 * 0.25)


def test_a_sled_on_ice_and_a_rope_that_does_not_damp_are_none_that_cannot_be():
    rope = SledRope(DT, friction=(0.0, 0.0), damping=0.0)
    assert (rope.friction, rope.damping) == ((0.0, 0.0), 0.0)


def test_a_hand_that_moves_is_held_less_whether_it_goes_or_comes_and_towards_the_sled():
    rope = SledRope(DT, stiffness=100.0, damping=20.0)
    one = torch.ones(3, 1)
    values = (torch.tensor([[2.0, 0.0]] * 3), torch.zeros(3, 2), 50 * one, one, 0 * one, 2 * one, 0 * one)
    before = TensorDict(dict(zip(rope.out_keys, (*values, torch.zeros(3, 3)), strict=True)), batch_size=[3])
    after = TensorDict(
        handle_position=torch.tensor([[-0.3, 0.0, 0.0]] * 3),
        handle_linear_velocity=torch.tensor([[-0.5, 0.0, 0.0], [0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]),
        batch_size=[3],
    )
    rope.advance(before, after)
    away, still, back = after["rope_tension"].flatten().tolist()
    assert still > away > 0
    assert away == pytest.approx(back)
    torch.testing.assert_close(after["rope_force"], after["rope_tension"] * torch.tensor([1.0, 0.0, 0.0]))
    for name in ("sled_mass", "sled_friction", "sled_hook_height", "rope_length"):
        assert torch.equal(after[name], before[name])
