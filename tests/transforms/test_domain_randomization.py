"""Each episode has another robot on other ground, and nothing is lost on the way to the physics."""

from dataclasses import replace

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.robots import Bucket, Dumbbell, b2z1, z1
from torchrl_athletic.robots.scene import GROUND_SOLREF
from torchrl_athletic.transforms import DomainRandomization, PDControl, RandomizationRanges

ROBOT = b2z1()
MASS = float(ROBOT.model().body_mass.sum())


def make_env(n: int = 4, first_row: int = 0, **kwargs) -> TransformedEnv:
    randomization = DomainRandomization(first_row=first_row, **kwargs)
    env = TorqueEnv(ROBOT, num_envs=n, fields=randomization.fields)
    return TransformedEnv(env, Compose(PDControl(ROBOT.kp, ROBOT.kd), randomization))


def test_specs_hold():
    check_env_specs(make_env(2))


def test_what_is_drawn_fills_its_range_and_stays_within():
    env = make_env(64)
    td, ranges, physics = env.reset(), RandomizationRanges(), env.base_env.physics
    floor = physics.model.geom("floor").id
    friction = physics.field("geom_friction")[:, floor, 0]
    nominal = torch.tensor(physics.model.body_mass)
    bodies = nominal > 0
    drawn = {
        "friction": friction,
        "mass_scale": (physics.field("body_mass") / nominal)[:, bodies],
        "com_offset": (physics.field("body_ipos") - torch.tensor(physics.model.body_ipos))[:, bodies],
        "stiffness_scale": td["kp_scale"][:, :12],
        "damping_scale": td["kd_scale"][:, :12],
        "torque_limit_scale": td["torque_limit_scale"][:, :12],
    }
    for name, value in drawn.items():
        low, high = getattr(ranges, name)
        assert low - 1e-6 <= value.min() < low + 0.1 * (high - low), name
        assert high + 1e-6 >= value.max() > high - 0.1 * (high - low), name
        assert value.mean().item() == pytest.approx((low + high) / 2, abs=0.15 * (high - low)), name
    for key in ("kp_scale", "kd_scale", "torque_limit_scale"):
        assert (td[key][:, 12:] == 1).all()  # the arm's drives are a net's business
    assert (td["randomization"].abs() <= 1).all()


def test_a_heavier_link_has_its_inertia_in_proportion_and_the_whole_weighs_the_sum():
    env = make_env(16)
    env.reset()
    physics = env.base_env.physics
    scale = physics.field("body_mass")[:, 1:] / torch.tensor(physics.model.body_mass)[1:]
    inertia = physics.field("body_inertia")[:, 1:] / torch.tensor(physics.model.body_inertia)[1:]
    torch.testing.assert_close(inertia, scale.unsqueeze(-1).expand_as(inertia))
    total = physics.field("body_mass").sum(-1)
    assert 0.6 * MASS < total.min() < 0.95 * MASS < 1.05 * MASS < total.max() < 1.4 * MASS
    physics.qpos[:, 2] += 1.0  # in free fall gravity is all there is: weight is the mass that the physics believes in
    physics.forward()
    weight = physics.data("qfrc_bias")[:, 2]
    torch.testing.assert_close(weight, 9.81 * total, rtol=1e-6, atol=0)


def test_restitution_softens_the_damping_of_the_ground_alone():
    env = make_env(8)
    env.reset()
    physics = env.base_env.physics
    floor, solref = physics.model.geom("floor").id, physics.field("geom_solref")
    damping = solref[:, floor, 1]
    assert (0.25 < damping).all()
    assert (damping <= 2).all()
    torch.testing.assert_close(
        solref[:, floor].prod(-1), torch.full((8,), GROUND_SOLREF[0], dtype=torch.float64), rtol=1e-5, atol=0
    )
    others = [geom for geom in range(physics.model.ngeom) if geom != floor]
    assert (solref[:, others] == torch.tensor(physics.model.geom_solref)[others]).all()


def test_only_rows_that_start_draw_anew():
    env = make_env(3)
    td = env.reset()
    names = ("body_mass", "body_ipos", "geom_friction")
    before = {name: env.base_env.physics.field(name).clone() for name in names}
    again = env.reset(td.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    for name in names:
        changed = (env.base_env.physics.field(name) != before[name]).flatten(1).any(1)
        assert changed.tolist() == [False, True, False]
    for key in ("kp_scale", "randomization"):
        assert (again[key] != td[key]).any(-1).tolist() == [False, True, False]


def test_all_that_changes_is_written_at_once_and_for_rows_that_start_alone():
    """A GPU works the constants out anew with each writing."""
    env = make_env(3)
    td = env.reset()
    physics, written = env.base_env.physics, []
    physics.set_fields = lambda values, envs=None: written.append((set(values), envs.tolist()))
    physics.set_field = None
    env.reset(td.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    assert written == [(set(env.transform[-1].fields), [False, True, False])]


def test_a_ground_whose_friction_would_be_mixed_is_refused():
    def build():
        spec = ROBOT.build()
        spec.geom("floor").priority = 0
        return spec

    weak = replace(ROBOT, build=build)
    env = TransformedEnv(TorqueEnv(weak, num_envs=1, fields=DomainRandomization().fields), DomainRandomization())
    with pytest.raises(ValueError, match=r"ground 'floor' has priority 0.*priority=.1."):
        env.reset()


def test_what_never_touches_the_ground_may_have_any_priority():
    def build():
        spec = ROBOT.build()
        spec.worldbody.add_geom(name="wall", size=[0.1, 0, 0], pos=[9, 0, 1], priority=5)
        hip = spec.geom("FR_hip")
        hip.priority, hip.contype, hip.conaffinity = 5, 2, 2
        return spec

    env = TransformedEnv(
        TorqueEnv(replace(ROBOT, build=build), num_envs=1, fields=DomainRandomization().fields), DomainRandomization()
    )
    assert env.reset()["randomization"].isfinite().all()


def test_once_means_once():
    env = make_env(2, every_episode=False)
    first = env.reset()
    mass = env.base_env.physics.field("body_mass").clone()
    second = env.reset()
    assert torch.equal(first["randomization"], second["randomization"])
    assert torch.equal(env.base_env.physics.field("body_mass"), mass)


def test_a_row_alone_is_the_row_of_the_batch_to_the_last_bit():
    batch, alone = make_env(3), make_env(1, first_row=2)
    action = torch.tensor(ROBOT.default_pose).repeat(3, 1)
    one, two = batch.reset(), alone.reset()
    for k in range(6):
        if k == 3:
            one = batch.reset(one.set("_reset", torch.tensor([[False], [False], [True]])))
            two = alone.reset()
        one, two = batch.step(one.set("action", action))["next"], alone.step(two.set("action", action[:1]))["next"]
        for key in ("joint_position", "joint_velocity", "kd_scale", "randomization"):
            assert torch.equal(one[key][2], two[key][0]), (k, key)
    for name in batch.base_env.physics.fields:
        assert torch.equal(batch.base_env.physics.field(name)[2], alone.base_env.physics.field(name)[0])


def test_undeclared_fields_and_unknown_groups_are_refused():
    env = TransformedEnv(TorqueEnv(ROBOT, num_envs=2, fields=["body_mass"]), DomainRandomization())
    with pytest.raises(ValueError, match=r"share \['geom_friction'.*fields=randomization.fields"):
        env.reset()
    drives = RandomizationRanges(friction=None, restitution=None, mass_scale=None, com_offset=None)
    assert DomainRandomization(drives).fields == ()
    env = TransformedEnv(TorqueEnv(z1(), num_envs=2), DomainRandomization(drives))
    with pytest.raises(ValueError, match=r"no group of joints 'leg'"):
        env.reset()
    with pytest.raises(ValueError, match=r"friction is \(2.0, 1.0\)"):
        RandomizationRanges(friction=(2.0, 1.0))
    with pytest.raises(ValueError, match="would never end"):
        RandomizationRanges(restitution=(0.0, 1.0))


def test_joints_of_the_group_differ_in_what_their_gears_and_rotors_resist_with():
    between = {"joint_friction_scale": (0.5, 3.5), "joint_damping_scale": (0.3, 2.0), "armature_scale": (0.4, 2.4)}
    others = dict.fromkeys(("friction", "restitution", "mass_scale", "com_offset", "stiffness_scale"))
    randomization = DomainRandomization(RandomizationRanges(**others, **between), joints="arm")
    env = TransformedEnv(TorqueEnv(z1(), num_envs=64, fields=randomization.fields), randomization)
    drawn = env.reset()["randomization"]
    physics, names = env.base_env.physics, ("dof_frictionloss", "dof_damping", "dof_armature")
    for k, (field, (low, high)) in enumerate(zip(names, between.values(), strict=True)):
        scale = (
            physics.field(field).reshape(64, 7, -1)[..., 0]
            / torch.tensor(getattr(physics.model, field)).reshape(7, -1)[:, 0]
        )
        assert (scale[:, 6] == 1).all()  # the gripper's
        expected = low + (high - low) * (drawn[:, 12 + 6 * k : 18 + 6 * k] + 1) / 2
        torch.testing.assert_close(scale[:, :6].float(), expected)
        assert low <= scale[:, :6].min() < low + 0.1 * (high - low)
        assert high >= scale[:, :6].max() > high - 0.1 * (high - low)


def test_a_joint_with_more_friction_turns_less():
    only = dict.fromkeys(("friction", "restitution", "mass_scale", "com_offset", "stiffness_scale", "damping_scale"))
    ranges = RandomizationRanges(**only, torque_limit_scale=None, joint_friction_scale=(0.2, 5.0))
    randomization = DomainRandomization(ranges, joints=[0])
    env = TransformedEnv(TorqueEnv(z1(), num_envs=16, fields=randomization.fields), randomization)
    shown = env.reset()
    drawn = shown["randomization"][:, 0]
    for _ in range(20):
        shown = env.step(shown.set("torque", torch.tensor([6.0, 0, 0, 0, 0, 0, 0]).expand(16, 7)))["next"]
    turned = shown["joint_position"][:, 0]
    order = drawn.argsort()
    assert (turned[order].diff() <= 1e-6).all()
    assert turned[order][0] > turned[order][-1] + 0.01


@pytest.mark.parametrize(
    ("robot", "load"),
    [(b2z1(tool=Bucket()), "ball"), (b2z1(tool=Dumbbell(5.0)), "dumbbell"), (b2z1(payload=8.0), "payload")],
    ids=["bucket", "dumbbell", "payload"],
)
def test_tools_and_loads_are_no_part_of_the_robot_that_differs(robot, load):
    randomization = DomainRandomization()
    env = TransformedEnv(TorqueEnv(robot, num_envs=4, fields=randomization.fields), randomization)
    env.reset()
    physics = env.base_env.physics
    mass, body = physics.field("body_mass"), physics.model.body(load).id
    assert mass[:, body].tolist() == pytest.approx([float(physics.model.body_mass[body])] * 4)
    assert len(mass[:, physics.model.body("base").id].unique()) == 4


def test_two_of_them_for_legs_and_arm_multiply_their_scales():
    legs = DomainRandomization(seed=1)
    both = _only(stiffness_scale=(2.0, 2.0), joint_friction_scale=(0.5, 2.0))
    arm = DomainRandomization(both, joints=list(range(6, 18)), drawn_key="of_the_arm", seed=2)
    env = TransformedEnv(TorqueEnv(ROBOT, num_envs=3, fields=(*legs.fields, *arm.fields)), Compose(legs, arm))
    check_env_specs(env)
    td = env.reset()
    alone = TransformedEnv(TorqueEnv(ROBOT, num_envs=3, fields=legs.fields), DomainRandomization(seed=1))
    check_env_specs(alone)
    first = alone.reset()["kp_scale"]
    expected = first.clone()
    expected[:, 6:18] *= 2.0
    torch.testing.assert_close(td["kp_scale"], expected)
    again = env.reset(td.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    assert torch.equal(again["kp_scale"][[0, 2]], td["kp_scale"][[0, 2]])
    assert (again["kp_scale"][1, 12:18] == 2.0).all()


def test_two_of_them_that_would_undo_each_other_or_share_a_name_are_refused():
    def env_of(*transforms):
        fields = sorted({field for transform in transforms for field in transform.fields})
        return TransformedEnv(TorqueEnv(ROBOT, num_envs=2, fields=fields), Compose(*transforms))

    with pytest.raises(ValueError, match=r"shows 'randomization' already.*Give this one a drawn_key"):
        env_of(DomainRandomization(), DomainRandomization(_only(stiffness_scale=(1.0, 2.0)))).reset()
    with pytest.raises(ValueError, match=r"two DomainRandomization write \['body_mass', 'body_inertia'\]"):
        env_of(DomainRandomization(), DomainRandomization(_only(mass_scale=(1.0, 2.0)), drawn_key="more")).reset()


def _only(**ranges):
    return RandomizationRanges(**(dict.fromkeys(vars(RandomizationRanges())) | ranges))


def test_every_quantity_of_every_joint_and_link_is_drawn_for_itself():
    """And shown to the critic as it was drawn, in the order of the ranges."""
    env = make_env(200)
    td, physics = env.reset(), env.base_env.physics
    drawn, ranges = td["randomization"], RandomizationRanges()
    floor, legs = physics.model.geom("floor").id, slice(0, 12)
    links = torch.tensor(physics.model.body_mass) > 0
    scale = physics.field("body_mass")[:, links] / torch.tensor(physics.model.body_mass)[links]
    shift = (physics.field("body_ipos") - torch.tensor(physics.model.body_ipos))[:, links].flatten(1)
    found = {
        "friction": physics.field("geom_friction")[:, floor, :1],
        "restitution": None,
        "stiffness_scale": td["kp_scale"][:, legs],
        "damping_scale": td["kd_scale"][:, legs],
        "torque_limit_scale": td["torque_limit_scale"][:, legs],
        "mass_scale": scale,
        "com_offset": shift,
    }
    first = 0
    for name, value in found.items():
        unit = drawn[:, first : first + (1 if value is None else value.shape[1])]
        first += unit.shape[1]
        if value is not None:
            low, high = getattr(ranges, name)
            torch.testing.assert_close(value.float(), low + (high - low) * (unit + 1) / 2, rtol=1e-4, atol=1e-5)
    assert first == drawn.shape[1]
    softness = -physics.field("geom_solref")[:, floor, 1].float()  # falls as the restitution rises
    order = drawn[:, 1].argsort()
    assert (softness[order].diff() >= 0).all()
    assert (torch.corrcoef(drawn[:, :40].T) - torch.eye(40)).abs().max() < 0.35


def test_ground_and_links_may_be_named():
    some = {"bodies": ["link03"], "ground": ["FR_foot"]}
    ranges = _only(friction=(2.0, 3.0), mass_scale=(1.1, 1.5))
    env = make_env(3, ranges=ranges, **some)
    env.reset()
    physics = env.base_env.physics
    for field, at in (
        ("geom_friction", physics.model.geom("FR_foot").id),
        ("body_mass", physics.model.body("link03").id),
    ):
        value, given = physics.field(field), torch.tensor(getattr(physics.model, field))
        changed = (value != given).flatten(2).any(-1) if value.ndim > 2 else value != given
        assert changed.nonzero().tolist() == [[row, at] for row in range(3)]


def test_ranges_are_those_of_the_paper_s_table():
    """Fey et al. 2025, appendix A. What it does not name does not differ."""
    paper = {
        "friction": (0.5, 4.0), "restitution": (0.0, 0.5), "stiffness_scale": (0.9, 1.1), "damping_scale": (0.5, 1.5),
        "torque_limit_scale": (0.9, 1.1), "mass_scale": (0.5, 1.5), "com_offset": (-0.02, 0.02),
    }  # fmt: skip
    assert {name: between for name, between in vars(RandomizationRanges()).items() if between is not None} == paper


def test_joints_that_are_named_by_number_differ_and_no_others() -> None:
    randomization = DomainRandomization(_only(joint_friction_scale=(2.0, 3.0)), joints=[2, 4])
    env = TransformedEnv(TorqueEnv(z1(), num_envs=3, fields=randomization.fields), randomization)
    env.reset()
    physics = env.base_env.physics
    changed = physics.field("dof_frictionloss") != torch.tensor(physics.model.dof_frictionloss)
    assert changed.nonzero().tolist() == [[row, joint] for row in range(3) for joint in (2, 4)]


def test_ground_may_bounce_differently_and_grip_alike() -> None:
    env = make_env(4, ranges=_only(restitution=(0.0, 0.5)))
    env.reset()
    physics = env.base_env.physics
    assert len(physics.field("geom_solref")[:, physics.model.geom("floor").id, 1].unique()) == 4


def test_a_walking_robot_s_joints_change_and_its_base_does_not():
    """The base's six degrees of freedom stand before the joints'."""
    alone = dict.fromkeys(vars(RandomizationRanges())) | {"armature_scale": (2.0, 2.0)}
    env = make_env(2, ranges=RandomizationRanges(**alone), joints="leg")
    env.reset()
    physics = env.base_env.physics
    given = torch.tensor(physics.model.dof_armature)
    expected = given.clone()
    expected[6:18] *= 2.0
    torch.testing.assert_close(physics.field("dof_armature"), expected.expand(2, -1).to(physics.dtype))
