"""A push of F for t changes the momentum by F t, and pushes come and go as announced."""

import mujoco
import pytest
import torch
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.robots import b2z1, from_mjcf
from torchrl_athletic.transforms import B2Z1_PUSHES, Decimation, ExternalPush, Push

FLOATING = """
<mujoco model="two"><option gravity="0 0 0" timestep="0.005" integrator="implicitfast"/><worldbody>
  <body name="base"><freejoint/><geom size="0.1" mass="3"/>
    <body name="tip" pos="0.3 0 0"><joint name="hinge" axis="0 1 0"/><geom size="0.05" mass="1"/></body></body>
</worldbody><actuator><motor joint="hinge" forcerange="-1 1"/></actuator></mujoco>"""
PUSHES = (Push(("base",), force=(4.0, 6.0), torque=(0.0, 0.0)), Push(("tip",), force=(1.0, 2.0), torque=(0.0, 0.1)))


def make_env(n: int = 3, first_row: int = 0, decimation: int = 1, seed: int = 0) -> TransformedEnv:
    push = ExternalPush(
        PUSHES, dt=0.005 * decimation, rest=(0.05, 0.1), duration=(0.05, 0.1), first_row=first_row, seed=seed
    )
    return TransformedEnv(TorqueEnv(from_mjcf(FLOATING), num_envs=n), Compose(Decimation(decimation), push))


def momentum(env: TransformedEnv) -> torch.Tensor:
    """Momentum of all bodies [kg m/s]. Shape (N, 3)."""
    physics, rows = env.base_env.physics, []
    for qpos, qvel in zip(physics.qpos.numpy(), physics.qvel.numpy(), strict=True):
        data = mujoco.MjData(physics.model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(physics.model, data)
        mujoco.mj_subtreeVel(physics.model, data)
        rows.append(torch.tensor(physics.model.body_mass.sum() * data.subtree_linvel[0]))
    return torch.stack(rows)


def still(env: TransformedEnv, td):
    return td.set("torque", torch.zeros(*env.batch_size, 1))


@pytest.mark.parametrize("decimation", [1, 4])
def test_momentum_changes_by_force_times_time(decimation):
    env = make_env(decimation=decimation)
    td, impulse = env.reset(), torch.zeros(3, 3, dtype=torch.float64)
    for _ in range(60):
        impulse += td["push"][..., :3].sum(1).double() * 0.005 * decimation
        td = env.step(still(env, td))["next"]
    assert (impulse.norm(dim=-1) > 0.05).all()
    torch.testing.assert_close(momentum(env), impulse, atol=1e-3, rtol=5e-3)  # the integrator's own, as it turns


def test_pushes_hit_one_body_at_a_time_with_their_size_and_last_as_long_as_they_should():
    env = make_env(200)
    td, shown = env.reset(), []
    assert (td["push"] == 0).all()
    for _ in range(150):
        td = env.step(still(env, td))["next"]
        shown.append(td["push"])
    push = torch.stack(shown, 1)  # (N, T, bodies, 6)
    force = push[..., :3].norm(dim=-1)
    acting = force > 0
    assert not acting.all(-1).any()
    for body, (low, high) in enumerate(((4.0, 6.0), (1.0, 2.0))):
        sizes = force[..., body][acting[..., body]]
        assert low - 1e-4 <= sizes.min() < low + 0.1 * (high - low)
        assert high + 1e-4 >= sizes.max() > high - 0.1 * (high - low)
    share = acting.float().mean((0, 1))
    assert share.sum() == pytest.approx(0.5, abs=0.05)  # rests and pushes last alike
    assert share[0] == pytest.approx(share[1].item(), abs=0.05)
    on = acting.any(-1)
    runs = [len(run) for row in on for run in "".join("1" if x else " " for x in row[:140]).split()[:-1]]
    assert (min(runs), max(runs)) == (10, 20)
    assert push[..., :3][acting].mean(0).abs().max() < 0.4


def test_how_hard_a_push_is_has_nothing_to_do_with_where_it_hits():
    pushes = [Push(("left", "right"), force=(0.0, 10.0), torque=(0.0, 1.0))]
    push = ExternalPush(pushes, dt=0.005)._wrench(torch.rand(4000, 8, generator=torch.Generator().manual_seed(0)))
    force, torque = push[..., :3].norm(dim=-1), push[..., 3:].norm(dim=-1)
    left, right = (force[:, body][force[:, body] > 0].mean() for body in range(2))
    assert left == pytest.approx(right.item(), rel=0.1)
    assert torch.corrcoef(torch.stack((force.sum(-1), torque.sum(-1))))[0, 1].abs() < 0.1


def test_where_a_push_turns_a_body_has_nothing_to_do_with_where_it_shoves_it():
    """The cosine between two directions drawn apart lies evenly between -1 and 1."""
    push = ExternalPush([Push(("base",), (1.0, 1.0), (1.0, 1.0))], dt=0.005, rest=(0.0, 0.01), duration=(1.0, 1.0))
    env = TransformedEnv(TorqueEnv(from_mjcf(FLOATING), num_envs=1000), push)
    td = env.reset()
    for _ in range(3):
        td = env.step(still(env, td))["next"]
    force, torque = td["push"][:, 0].split(3, -1)
    cosine = (force * torque).sum(-1)
    assert (force.norm(dim=-1) > 0.99).all()
    assert cosine.mean().item() == pytest.approx(0.0, abs=0.1)
    assert cosine.abs().mean().item() == pytest.approx(0.5, abs=0.05)


def test_an_episode_may_start_just_before_a_push():
    """It starts anywhere within a rest, so that a policy cannot count on a quiet beginning."""
    left = make_env(400).reset()["push_steps_left"]
    assert (left.min(), left.max()) == (1, 20)
    assert left.float().mean() == pytest.approx(10, abs=1)


def test_a_reset_ends_the_push_of_its_rows_only():
    env = make_env(2)
    td = env.reset()
    while not (td["push_on"].all()):
        td = env.step(still(env, td))["next"]
    env.step(still(env, td))
    acting = env.base_env.physics.xfrc_applied
    assert (acting.abs().sum((1, 2)) > 0).all()
    again = env.reset(td.clone().set("_reset", torch.tensor([[True], [False]])))
    assert (acting[0] == 0).all()
    assert (again["push"][0] == 0).all()
    assert torch.equal(again["push"][1], td["push"][1])
    env.step(still(env, again))
    assert (acting[0] == 0).all()
    assert (acting[1] != 0).any()
    torch.testing.assert_close(acting[1, 1:], again["push"][1].double(), atol=1e-5, rtol=1e-5)  # once, not twice


def test_a_row_alone_is_the_row_of_the_batch():
    batch, alone = make_env(3), make_env(1, first_row=2)
    one, two = batch.reset(), alone.reset()
    for k in range(80):
        if k == 40:
            one = batch.reset(one.set("_reset", torch.tensor([[False], [False], [True]])))
            two = alone.reset()
        one, two = batch.step(still(batch, one))["next"], alone.step(still(alone, two))["next"]
        for key in ("push", "push_steps_left", "joint_position", "base_position"):
            assert torch.equal(one[key][2], two[key][0]), (k, key)


def test_specs_hold_on_the_robot_it_is_for():
    check_env_specs(make_env())
    check_env_specs(TransformedEnv(TorqueEnv(b2z1(), num_envs=2), ExternalPush(B2Z1_PUSHES, dt=0.005)))


def test_unknown_bodies_and_impossible_times_are_refused():
    env = TransformedEnv(TorqueEnv(from_mjcf(FLOATING)), ExternalPush([Push(("tail",))], dt=0.005))
    with pytest.raises(ValueError, match=r"no body 'tail'; it has \['world', 'base', 'tip'\].*Disturbances\(pushes="):
        env.reset()
    with pytest.raises(ValueError, match="make no pushes"):
        ExternalPush(PUSHES, dt=0.0)
    with pytest.raises(ValueError, match="a magnitude"):
        Push(("base",), force=(-1.0, 1.0))


def test_pushes_add_to_what_others_put_on_a_body_and_take_back_their_own_alone():
    env = make_env(3)
    two = ExternalPush(PUSHES, dt=0.005, rest=(0.02, 0.05), duration=(0.05, 0.1), push_key="shove", seed=9)
    env.append_transform(two)
    td = env.reset()
    physics = env.base_env.physics
    other = torch.tensor([0.3, -0.2, 0.1, 0.0, 0.01, 0.0], dtype=torch.float64)
    body = physics.model.body("base").id
    physics.xfrc_applied[:, body] += other
    both = 0
    for _ in range(80):
        pushes = td["push"].double() + td["shove"].double()
        both += int(((td["push"] != 0).any((1, 2)) & (td["shove"] != 0).any((1, 2))).sum())
        td = env.step(still(env, td))["next"]
        expected = pushes[:, 0] + other
        torch.testing.assert_close(physics.xfrc_applied[:, body], expected, atol=1e-5, rtol=1e-5)
    assert both > 10


def test_a_reset_ends_the_pushes_of_all_who_push_one_body():
    env = make_env(2)
    env.append_transform(
        ExternalPush(PUSHES, dt=0.005, rest=(0.03, 0.06), duration=(0.3, 0.4), push_key="shove", seed=9)
    )
    td = env.reset()
    while not (td["push_on"] & td["shove_on"]).all():
        td = env.step(still(env, td))["next"]
    env.step(still(env, td))
    acting = env.base_env.physics.xfrc_applied
    both = (td["push"] + td["shove"]).double()
    torch.testing.assert_close(acting[:, 1:], both, atol=1e-5, rtol=1e-5)
    again = env.reset(td.clone().set("_reset", torch.tensor([[True], [False]])))
    assert (again["push"][0] == 0).all()
    assert (again["shove"][0] == 0).all()
    for _ in range(3):  # taken back once, not with the sign turned at the next step
        assert (acting[0] == 0).all()
        assert (acting[1] != 0).any()
        env.step(still(env, again))


def test_forces_and_torques_are_within_their_own_sizes_on_the_bodies_of_their_group():
    pushes = [Push(("c", "a"), force=(4.0, 5.0), torque=(2.0, 3.0)), Push(("b",), force=(8.0, 9.0), torque=(6.0, 7.0))]
    push = ExternalPush(pushes, dt=0.005)
    assert push.bodies == ("c", "a", "b")
    wrench = push._wrench(torch.rand(500, 8, generator=torch.Generator().manual_seed(0)))
    for first, sizes in ((0, ((4, 5), (4, 5), (8, 9))), (3, ((2, 3), (2, 3), (6, 7)))):
        size = wrench[..., first : first + 3].norm(dim=-1)
        for body, (low, high) in enumerate(sizes):
            hit = size[:, body][size[:, body] > 0]
            assert low - 1e-5 <= hit.min() < low + 0.1
            assert high - 0.1 < hit.max() <= high + 1e-5


def test_bodies_are_found_by_their_names_in_the_order_of_the_groups():
    env = TransformedEnv(TorqueEnv(from_mjcf(FLOATING)), ExternalPush([Push(("tip",)), Push(("base",))], dt=0.005))
    td = env.reset()
    tip, base = torch.tensor([1.0, 0, 0, 0, 0, 0]), torch.tensor([0.0, 2, 0, 0, 0, 0])
    env.step(still(env, td.set("push", torch.stack((tip, base))[None])))
    model, acting = env.base_env.physics.model, env.base_env.physics.xfrc_applied[0].float()
    assert torch.equal(acting[model.body("tip").id], tip)
    assert torch.equal(acting[model.body("base").id], base)


def test_a_rest_and_a_push_take_two_to_six_seconds_and_up_to_half_of_one():
    push = ExternalPush(PUSHES, dt=0.02)
    assert (push.rest, push.duration) == ((2.0, 6.0), (0.05, 0.5))
    ends = torch.tensor([[0.0], [1.0]])
    assert push._steps(ends, push.rest).flatten().tolist() == [100, 300]
    assert push._steps(ends, (0.0, 0.05)).flatten().tolist() == [1, 2]


def test_the_robot_is_pushed_by_up_to_a_third_of_its_weight_and_less_further_out():
    robot = b2z1()
    weight = 9.81 * robot.model().body_mass.sum()
    most = [(push.force[1], push.torque[1]) for push in B2Z1_PUSHES]
    assert most[0][0] == pytest.approx(weight / 3, rel=0.1)
    assert most == sorted(most, reverse=True)
    assert {(push.force[0], push.torque[0]) for push in B2Z1_PUSHES} == {(0.0, 0.0)}
    assert [len(push.bodies) for push in B2Z1_PUSHES] == [1, 4, 4, 1]


def test_groups_are_equally_likely_and_so_are_the_bodies_of_a_group():
    """Whatever their number, so that the one base is pushed as often as all of the feet together."""
    groups = [
        tuple(f"{group}{body}" for body in range(size)) for group, size in (("a", 1), ("b", 3), ("c", 2), ("d", 1))
    ]
    push = ExternalPush([Push(bodies, force=(1.0, 1.0)) for bodies in groups], dt=0.02)
    unit = torch.rand(20_000, 8, generator=torch.Generator().manual_seed(0))
    hit = (push._wrench(unit)[..., :3] != 0).any(-1)
    assert (hit.sum(-1) == 1).all()
    expected = [1 / 4 / len(bodies) for bodies in groups for _ in bodies]
    assert hit.float().mean(0).tolist() == pytest.approx(expected, abs=0.01)
