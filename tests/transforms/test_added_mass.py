"""A weight is there from its phase on, as if the model had been compiled with it, and gone with the next episode."""

import importlib.util
from functools import partial

import mujoco
import numpy as np
import pytest
import torch
from torchrl.envs import Compose, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.functional.phase import Phase, PhaseSchedule
from torchrl_athletic.physics import WarpPhysics
from torchrl_athletic.robots import Dumbbell, b2z1, z1
from torchrl_athletic.testing import no_host_sync
from torchrl_athletic.training import control_step
from torchrl_athletic.training.captured import CapturedRollout, fuse_transforms
from torchrl_athletic.training.checkpoint import env_state, restore_env
from torchrl_athletic.transforms import (
    AddedMass,
    Decimation,
    DomainRandomization,
    PDControl,
    RandomizationRanges,
    TaskPhase,
)

ARM, ROBOT = z1(tool=Dumbbell()), b2z1(tool=Dumbbell(), cone="pyramidal")
EMPTY, BEGINS = 1e-3, 3
"""Mass of the hand without a load [kg]; action after which the second phase begins."""
CONSTANTS = ("body_subtreemass", "body_invweight0", "dof_invweight0")
MASSES_ONLY = RandomizationRanges(friction=None, restitution=None)
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
needs_warp = pytest.mark.skipif(importlib.util.find_spec("mujoco_warp") is None, reason="mujoco_warp is not installed")


def make_env(
    n=3,
    robot=ARM,
    first_row=0,
    stays=0.0,
    starts_late=0.0,
    randomization=None,
    randomized_first=True,
    physics=None,
    episode=1000,
    **load,
):
    """Actions are held for two steps of the physics."""
    phases = PhaseSchedule(
        (Phase("reach", 0.01 * BEGINS, leave_probability=1 - stays), Phase("lift", start_probability=starts_late))
    )
    load = AddedMass(first_row=first_row, **load)
    others = [] if randomization is None else [randomization]
    fields = sorted({field for part in (load, *others) for field in part.fields})
    physics = None if physics is None else physics(robot.model(), n, fields=fields, joint_names=robot.joint_names)
    chain = [PDControl(robot.kp, robot.kd), Decimation(2), *(others if randomized_first else [])]
    chain += [
        TaskPhase(phases, dt=0.01, first_row=first_row),
        load,
        *([] if randomized_first else others),
        StepCounter(episode),
    ]
    base = TorqueEnv(robot, physics, num_envs=n, fields=() if physics else fields)
    return TransformedEnv(base, Compose(*chain))


def act(env, shown, steps=1):
    """Hold the default pose."""
    pose = torch.tensor(env.base_env.robot.default_pose, device=env.device)
    for _ in range(steps):
        shown = env.step(shown.set("action", pose.expand(*env.batch_size, -1)))["next"]
    return shown


def held(env):
    """Mass of the dumbbell in each row."""
    physics = env.base_env.physics
    return physics.field("body_mass")[:, physics.model.body("dumbbell").id]


def compiled(env, row):
    """MuJoCo's own compilation of a robot that holds what a row holds; other links weigh what they do there."""
    robot = {"z1": z1, "b2z1": partial(b2z1, cone="pyramidal")}[env.base_env.robot.name]
    model, physics = robot(tool=Dumbbell(float(held(env)[row]))).model(), env.base_env.physics
    dumbbell = model.body("dumbbell").id
    for field in physics.fields:
        values = physics.field(field)[row].double().cpu().numpy()
        if field.startswith("body_"):
            values[dumbbell] = getattr(model, field)[dumbbell]
        getattr(model, field)[:] = values
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def step_alone(model, physics, row):
    """One step of a serial MuJoCo from a row's state."""
    data = mujoco.MjData(model)
    for name in ("qpos", "qvel", "qfrc_applied", "qacc_warmstart"):
        getattr(data, name)[:] = physics.data(name)[row].numpy()
    mujoco.mj_step(model, data)
    return data


def assert_compiled_alike(env):
    """Each row is a robot compiled with what it holds: the same forces, accelerations and constants."""
    physics = env.base_env.physics
    models = [compiled(env, row) for row in range(physics.num_envs)]
    expected = [step_alone(model, physics, row) for row, model in enumerate(models)]
    looked_at = ("qpos", "qvel", "qacc", "qfrc_bias", "qfrc_constraint")
    for name in looked_at:
        physics.data(name)
    before = physics.qpos.clone()
    physics.step()
    for row, data in enumerate(expected):
        for name in looked_at:
            np.testing.assert_allclose(physics.data(name)[row], getattr(data, name), rtol=1e-9, atol=1e-9, err_msg=name)
    assert not torch.equal(physics.qpos, before)


def test_specs_hold():
    check_env_specs(make_env(2))
    check_env_specs(make_env(2, randomization=DomainRandomization(MASSES_ONLY, joints="arm")))


def test_masses_fill_their_range_and_stay_with_the_episode():
    env = make_env(256, mass=(2.0, 6.0))
    first = env.reset()
    load = first["load_mass"]
    assert 2.0 <= load.min() < 2.1 < 5.9 < load.max() < 6.0
    assert load.mean().item() == pytest.approx(4.0, abs=0.3)
    assert torch.equal(act(env, first, 5)["load_mass"], load)
    assert not torch.equal(env.reset()["load_mass"], load)


def test_it_is_taken_up_with_the_phase_and_by_the_rows_that_are_in_it():
    env = make_env(32, stays=0.5)
    shown = env.reset()
    for k in range(6):
        carried = torch.where(shown["task_phase_index"] == 1, shown["load_mass"], 0.0)
        assert torch.equal(shown["added_mass"], carried)
        assert torch.equal(held(env), carried[:, 0].double().clamp(min=EMPTY)), k
        assert bool((carried > 0).any()) == (k >= BEGINS)
        shown = act(env, shown)
    assert 5 < (shown["added_mass"] > 0).sum() < 27


def test_what_was_taken_up_is_carried_through_the_phases_that_follow():
    phases, load = PhaseSchedule((Phase("reach", 0.01), Phase("lift", 0.01), Phase("hold"))), AddedMass(mass=(2.0, 2.0))
    chain = Compose(PDControl(ARM.kp, ARM.kd), Decimation(2), TaskPhase(phases, dt=0.01), load)
    env = TransformedEnv(TorqueEnv(ARM, fields=load.fields), chain)
    shown = env.reset()
    for number, mass in ((0, EMPTY), (1, 2.0), (2, 2.0), (2, 2.0)):
        assert (shown["task_phase_index"].item(), held(env).item()) == (number, mass)
        shown = act(env, shown)


def test_the_first_physics_step_of_the_phase_feels_the_whole_weight():
    """The arm holds still; what it holds is suddenly heavier: by m g at the lever, and so it falls away."""
    env = make_env(2, mass=(4.0, 4.0))
    physics = env.base_env.physics
    shown = act(env, env.reset(), BEGINS - 1)
    physics.data("qfrc_bias")
    shown = act(env, shown)
    before = physics.data("qfrc_bias").clone()  # of the last physics step, whose state hardly differs
    lever = shown["end_effector_position"][0, 0] - physics.data("xpos")[0, 2, 0]
    physics.step()
    more = physics.data("qfrc_bias")[0, 1] - before[0, 1]
    assert more.item() == pytest.approx(-4.0 * 9.81 * lever.item(), rel=0.02)


@pytest.mark.parametrize("robot", [ARM, ROBOT], ids=["z1", "b2z1"])
def test_a_row_is_a_robot_compiled_with_its_load(robot):
    env = make_env(4, robot, stays=0.5)
    shown = act(env, env.reset(), BEGINS - 1)
    assert_compiled_alike(env)
    shown = act(env, shown)
    assert 0 < (shown["added_mass"] > 0).sum() < 4
    assert_compiled_alike(env)


def test_constants_are_those_of_a_fresh_compilation():
    """They are not shown by the physics, so a robot with them left as they were stands beside."""
    env = make_env(1, ROBOT, mass=(9.0, 9.0))
    act(env, env.reset(), BEGINS)
    right, stale = compiled(env, 0), ROBOT.model()
    for name in ("body_mass", "body_inertia"):
        getattr(stale, name)[:] = getattr(right, name)
    for name in CONSTANTS:
        assert not np.allclose(getattr(right, name), getattr(stale, name), rtol=1e-3), name
    physics, apart = env.base_env.physics, {}
    for label, model in (("right", right), ("stale", stale)):
        apart[label] = np.abs(step_alone(model, physics, 0).qvel)
    physics.step()
    found = np.abs(physics.qvel[0].numpy())
    np.testing.assert_allclose(found, apart["right"], rtol=1e-9, atol=1e-9)
    assert not np.allclose(found, apart["stale"], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("randomized_first", [True, False])
def test_beside_a_randomised_robot_neither_undoes_the_other(randomized_first):
    randomization = DomainRandomization(joints="leg", seed=4)
    env = make_env(4, ROBOT, stays=0.5, randomization=randomization, randomized_first=randomized_first)
    alone = TransformedEnv(
        TorqueEnv(ROBOT, num_envs=4, fields=randomization.fields), DomainRandomization(joints="leg", seed=4)
    )
    physics, links = env.base_env.physics, [body for body in range(1, ROBOT.model().nbody)]
    links.remove(ROBOT.model().body("dumbbell").id)
    some = torch.tensor([[True], [False], [True], [False]])

    def assert_robots_are_those_of(expected):
        for field in ("body_mass", "body_inertia", "body_ipos"):
            assert torch.equal(physics.field(field)[:, links], expected.field(field)[:, links]), field

    shown, bare = env.reset(), alone.reset()
    assert_robots_are_those_of(alone.base_env.physics)
    assert held(env).tolist() == [EMPTY] * 4
    assert_compiled_alike(env)
    shown = act(env, shown, BEGINS + 1)
    carries = shown["added_mass"][:, 0] > 0
    assert 0 < carries.sum() < 4
    assert_robots_are_those_of(alone.base_env.physics)
    assert_compiled_alike(env)
    shown = env.reset(shown.set("_reset", some))
    alone.reset(bare.set("_reset", some))
    assert_robots_are_those_of(alone.base_env.physics)
    loaded = carries & ~some[:, 0]
    assert torch.equal(held(env) > EMPTY, loaded)
    assert_compiled_alike(env)


def test_an_episode_starts_light_and_the_others_keep_their_load():
    env = make_env(3)
    shown = act(env, env.reset(), BEGINS + 1)
    before = shown.clone()
    some = torch.tensor([[False], [True], [False]])
    shown = env.reset(shown.set("_reset", some))
    assert shown["added_mass"].flatten().tolist() == [
        before["added_mass"][0].item(),
        0.0,
        before["added_mass"][2].item(),
    ]
    assert (shown["load_mass"] != before["load_mass"]).flatten().tolist() == [False, True, False]
    assert torch.equal(held(env), shown["added_mass"][:, 0].double().clamp(min=EMPTY))
    shown = act(env, shown.exclude("_reset"), BEGINS)
    assert torch.equal(shown["added_mass"], shown["load_mass"])
    assert torch.equal(held(env), shown["load_mass"][:, 0].double())


def test_an_episode_that_starts_in_the_phase_starts_with_its_load():
    env = make_env(16, starts_late=0.5)
    shown = env.reset()
    late = shown["task_phase_index"][:, 0] == 1
    assert 2 < late.sum() < 14
    assert torch.equal(held(env) > EMPTY, late)


def test_what_else_the_simulation_holds_stays_as_it_is():
    env, light = make_env(3), make_env(3, mass=(0.0, 0.0))
    one, two = act(env, env.reset(), BEGINS), act(light, light.reset(), BEGINS)
    for key in ("joint_position", "joint_velocity", "end_effector_position"):
        assert torch.equal(one[key], two[key])
    for name in ("qpos", "qvel", "time", "qacc_warmstart", "xpos", "sensordata"):
        ours, others = env.base_env.physics.data(name), light.base_env.physics.data(name)
        torch.testing.assert_close(ours, others, rtol=0, atol=1e-12, msg=name)  # cvel refers to a centre of mass
    assert not torch.equal(act(env, one)["joint_velocity"], act(light, two)["joint_velocity"])


def test_a_row_alone_is_the_row_of_the_batch_to_the_last_bit():
    batch, alone = make_env(3, stays=0.5), make_env(1, first_row=2, stays=0.5)
    one, two = batch.reset(), alone.reset()
    for k in range(10):
        if k == 6:
            one = batch.reset(one.set("_reset", torch.tensor([[False], [False], [True]]))).exclude("_reset")
            two = alone.reset()
        one, two = act(batch, one), act(alone, two)
        for key in ("joint_position", "joint_velocity", "added_mass", "load_mass"):
            assert torch.equal(one[key][2], two[key][0]), (k, key)


def test_a_resumed_run_goes_on_with_its_loads():
    env, twin = make_env(4, stays=0.5), make_env(4, stays=0.5)
    shown = act(env, env.reset(), BEGINS + 1)
    current = restore_env(twin, shown.clone(), env_state(env))
    assert torch.equal(held(twin), held(env))
    assert 0 < (held(env) > EMPTY).sum() < 4
    assert_compiled_alike(twin)
    restore_env(twin, current, env_state(env))
    for _ in range(4):
        shown, current = act(env, shown), act(twin, current)
        torch.testing.assert_close(current["joint_velocity"], shown["joint_velocity"], rtol=0, atol=0)
        assert torch.equal(current["added_mass"], shown["added_mass"])


def test_what_cannot_be_is_refused_with_a_way_out():
    with pytest.raises(ValueError, match=r"mass is \(2.0, 1.0\) kg.*least, greatest"):
        AddedMass(mass=(2.0, 1.0))
    with pytest.raises(ValueError, match=r"empty_mass is 0.0 kg.*Give a little"):
        AddedMass(empty_mass=0.0)
    with pytest.raises(ValueError, match=r"no body 'kettlebell'; it has .*'dumbbell'.*Dumbbell\(\)"):
        make_env(body="kettlebell").reset()
    phases = TaskPhase(PhaseSchedule((Phase("only"),)), dt=0.01)
    shared = TransformedEnv(TorqueEnv(ARM, fields=["body_mass"]), Compose(phases, AddedMass()))
    with pytest.raises(ValueError, match=r"share \['body_inertia'\].*fields=load.fields"):
        shared.reset()
    with pytest.raises(ValueError, match=r"'task_phase_index', which nothing before it shows.*Put TaskPhase"):
        TransformedEnv(TorqueEnv(ARM, fields=AddedMass.fields), AddedMass()).reset()
    loads = AddedMass(), AddedMass(mass_key="another", load_key="another_load", seed=1)
    twice = TransformedEnv(TorqueEnv(ARM, fields=AddedMass.fields), Compose(phases.clone(), *loads))
    with pytest.raises(ValueError, match=r"two AddedMass write \['body_mass', 'body_inertia'\] of the same"):
        twice.rollout(1)
    weightless = TorqueEnv(ARM, fields=AddedMass.fields)
    with pytest.raises(ValueError, match=r"body 'world' weighs 0.0 kg.*Give it some mass"):
        TransformedEnv(
            weightless, Compose(TaskPhase(PhaseSchedule((Phase("only"),)), dt=0.01), AddedMass("world"))
        ).reset()


@pytest.mark.parametrize("randomized_first", [True, False])
def test_a_body_whose_mass_is_randomised_too_is_refused(randomized_first):
    randomization = DomainRandomization(MASSES_ONLY, joints="arm", bodies=["link06", "dumbbell"])
    with pytest.raises(ValueError, match=r"write \['body_mass', 'body_inertia'\] of the same bodies.*other bodies"):
        make_env(randomization=randomization, randomized_first=randomized_first).reset()


@pytest.mark.slow
@needs_warp
@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("randomized", [False, True])
def test_a_simulation_for_gpus_holds_the_same_robots(recorded, randomized):
    """Also by the way that a recorded step takes to the constants."""
    randomization = DomainRandomization(joints="leg") if randomized else None
    on_gpu = partial(WarpPhysics, device="cpu")
    env = make_env(4, ROBOT, stays=0.5, physics=on_gpu, randomization=randomization)
    shown = env.reset()
    env.base_env.physics._recording = lambda: recorded
    assert_constants_follow(env)
    shown = act(env, shown, BEGINS + 1)
    assert torch.equal(held(env), shown["added_mass"][:, 0].clamp(min=EMPTY))
    assert 0 < (held(env) > EMPTY).sum() < 4
    assert_constants_follow(env)
    env.reset(shown.set("_reset", torch.tensor([[True], [False], [True], [False]])))
    assert_constants_follow(env)


def assert_constants_follow(env):
    physics, rows = env.base_env.physics, range(env.batch_size[0])
    for name in CONSTANTS:
        found = physics._expanded(name).cpu().numpy()
        expected = np.array([getattr(compiled(env, row), name) for row in rows])
        np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-6, err_msg=name)


def test_a_gpu_need_not_wait():
    """For a step or a reset; the physics itself is another test's business."""
    env = make_env(3)
    shown = act(env, env.reset(), BEGINS - 1)
    load = env.transform[-2]
    physics = env.base_env.physics
    written = []
    physics.set_fields = lambda values, envs=None: written.append((values, envs))
    following = act(env, shown.clone())
    start = following.clone().set("_reset", torch.tensor([[True], [False], [False]]))
    with no_host_sync():
        load._step(shown, following)
        load._reset(start, following)
    assert written[-2][1].tolist() == [True, True, True]
    assert written[-1][1].tolist() == [True, False, False]


@pytest.mark.slow
def test_among_compiled_transforms_it_does_the_same():
    def env_of():
        randomization = DomainRandomization(MASSES_ONLY, joints="arm")
        return make_env(4, stays=0.5, randomization=randomization, episode=BEGINS + 3)

    compiled, plain = env_of(), env_of()
    fuse_transforms(compiled, backend="aot_eager")
    pose, loaded = torch.tensor(ARM.default_pose), 0
    ours, theirs = compiled.reset(), plain.reset()
    for _ in range(2 * BEGINS + 5):
        (_, ours), (_, theirs) = (
            control_step(env, lambda shown: shown.set("action", pose.expand(4, -1)), shown)
            for env, shown in ((compiled, ours), (plain, theirs))
        )
        torch.testing.assert_close(ours["joint_velocity"], theirs["joint_velocity"])
        assert torch.equal(held(compiled), held(plain))
        loaded += int((held(plain) > EMPTY).sum())
    assert loaded > 5


@pytest.mark.slow
@needs_gpu
@pytest.mark.parametrize("fuse", [False, True])
def test_one_graph_holds_it(fuse):
    randomization = DomainRandomization(joints="leg")
    physics = partial(WarpPhysics, device="cuda")
    env = make_env(16, ROBOT, stays=0.5, physics=physics, randomization=randomization, episode=BEGINS + 3)
    pose = torch.tensor(ROBOT.default_pose, device="cuda")
    batch = CapturedRollout(env, lambda shown: shown.set("action", pose.expand(16, -1)), 4 * BEGINS, fuse=fuse)().cpu()
    carried = torch.where(batch["task_phase_index"] == 1, batch["load_mass"], 0.0)
    torch.testing.assert_close(batch["added_mass"], carried)
    assert len(batch["load_mass"][0].unique()) == 2
    last = batch["next"][:, -1]
    on = torch.where(last["task_phase_index"] == 1, last["load_mass"], 0.0)[:, 0]
    alive = ~last["done"][:, 0]
    torch.testing.assert_close(held(env).cpu()[alive], on.clamp(min=EMPTY)[alive])
    assert_constants_follow(env)


def test_the_phase_and_the_mass_of_an_empty_hand_may_be_others():
    phases = PhaseSchedule((Phase("reach", 0.01), Phase("wait", 0.01), Phase("lift")))
    load = AddedMass(mass=(2.0, 2.0), phase=2, empty_mass=0.5)
    chain = Compose(PDControl(ARM.kp, ARM.kd), Decimation(2), TaskPhase(phases, dt=0.01), load)
    env = TransformedEnv(TorqueEnv(ARM, fields=load.fields), chain)
    shown = env.reset()
    for mass in (0.5, 0.5, 2.0):
        assert held(env).item() == mass
        shown = act(env, shown)
