import mujoco
import numpy as np
import pytest
import torch
from physics.models import HOPPER, MODELS, Loop, compiled

from torchrl_athletic.physics import BatchPhysics, Physics, SimulationError

pytestmark = pytest.mark.usefixtures("every_cpu")
N = 5


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def hop(physics: BatchPhysics, steps: int = 60) -> torch.Tensor:
    """Where the envs end under torques that differ between envs and steps."""
    generator = torch.Generator().manual_seed(1)
    for _ in range(steps):
        physics.apply_torque(torch.randn(physics.num_envs, 2, generator=generator, dtype=torch.float64))
        physics.step()
    return physics.qpos.clone()


def assert_same(physics: BatchPhysics, loop: Loop, *fields: str) -> None:
    for field in fields:
        np.testing.assert_array_equal(physics.data(field).numpy(), loop.read(field), err_msg=field)


@pytest.mark.parametrize("num_threads", [1, 2])
@pytest.mark.parametrize("name", MODELS)
def test_steps_like_a_python_loop_to_the_last_bit(name, num_threads, rng):
    model = compiled(name)
    physics, loop = BatchPhysics(model, N, num_threads), Loop([model] * N)
    assert physics.batch.nthread == num_threads
    derived = ("sensordata", "xpos", "qacc", "qfrc_bias")
    for field in derived:
        physics.data(field)
    velocity = rng.normal(size=(N, model.nv))
    physics.qvel[:] = torch.from_numpy(velocity)
    loop.write("qvel", velocity)
    contacts = 0
    for _ in range(100):
        for field, size in (("ctrl", model.nu), ("qfrc_applied", model.nv)):
            value = rng.normal(size=(N, size))
            physics.data(field)[:] = torch.from_numpy(value)
            loop.write(field, value)
        physics.step()
        loop.step()
        assert_same(physics, loop, "qpos", "qvel", *derived)
        contacts += sum(data.ncon for data in loop.data)
    assert (contacts > 0) == (name == "hopper")
    assert physics.time.tolist() == [data.time for data in loop.data]
    assert len(np.unique(loop.read("qpos"), axis=0)) == N  # no two envs did the same


def test_goes_on_like_the_loop_after_a_masked_reset(rng):
    model = compiled("hopper")
    physics, loop = BatchPhysics(model, N), Loop([model] * N)

    def advance() -> None:
        for _ in range(40):
            torque = rng.normal(size=(N, 2))
            physics.apply_torque(torch.from_numpy(torque))
            loop.write("qfrc_applied", np.hstack((np.zeros((N, 6)), torque)))
            physics.step()
            loop.step()
        assert_same(physics, loop, "qpos", "qvel", "qacc_warmstart")

    advance()
    qpos = np.tile(model.qpos0, (N, 1)) + 0.01 * rng.normal(size=(N, model.nq))
    qvel = rng.normal(size=(N, model.nv))
    physics.reset(torch.tensor([False, True, False, True, False]), qpos=qpos, qvel=qvel)
    for i in (1, 3):
        mujoco.mj_resetData(model, loop.data[i])
        loop.data[i].qpos[:], loop.data[i].qvel[:] = qpos[i], qvel[i]
    advance()
    physics.reset([4, 2], keyframe="crouch")
    for i in (2, 4):
        mujoco.mj_resetDataKeyframe(model, loop.data[i], 0)
    advance()


def test_per_env_fields_equal_models_compiled_with_those_values(rng):
    """The compiler is the oracle: it knows which constants follow from which value, and how frames may be shortened."""
    base = mujoco.MjSpec.from_string(HOPPER).compile()
    models = []
    for i in range(N):
        spec = mujoco.MjSpec.from_string(HOPPER)
        foot = spec.body("foot")
        foot.mass, foot.ipos, foot.gravcomp = 0.5 + 0.1 * i, [0.01 * i, 0, 0], 0.1 * i
        knee = spec.joint("knee")
        knee.armature, knee.frictionloss = 0.02 * i, 0.3 * i
        spec.site("imu").pos = [0.02 * i, 0, 0]
        spec.option.gravity = [0.2 * i, 0, -9.81]
        models.append(spec.compile())
    fields = ("body_mass", "body_ipos", "body_gravcomp", "dof_armature", "dof_frictionloss", "site_pos", "opt.gravity")
    physics, loop = BatchPhysics(base, N, fields=fields), Loop(models)
    for name in fields:
        physics.set_field(name, np.stack([_of(model, name) for model in models]))
    physics.data("sensordata")
    for _ in range(80):
        torque = rng.normal(size=(N, 2))
        physics.apply_torque(torch.from_numpy(torque))
        loop.write("qfrc_applied", np.hstack((np.zeros((N, 6)), torque)))
        physics.step()
        loop.step()
        assert_same(physics, loop, "qpos", "qvel", "sensordata")


def _of(model: mujoco.MjModel, name: str) -> np.ndarray:
    return getattr(model.opt, name.removeprefix("opt.")) if name.startswith("opt.") else getattr(model, name)


def test_wrenches_act_at_the_centre_of_mass_in_world_axes(rng):
    model = compiled("hopper")
    physics, loop = BatchPhysics(model, N), Loop([model] * N)
    force, torque = rng.normal(size=(2, N, 3))
    physics.apply_wrench("base", force, torque)
    physics.apply_wrench("foot", force=[3.0, 0.0, 0.0])
    base, foot = model.body("base").id, model.body("foot").id
    for i, data in enumerate(loop.data):
        data.xfrc_applied[base] = [*force[i], *torque[i]]
        data.xfrc_applied[foot, 0] = 3.0
    for _ in range(50):
        physics.step()
        loop.step()
    assert_same(physics, loop, "qpos", "qvel")


def test_a_slider_under_constant_force_moves_as_the_integrator_must():
    """Semi-implicit Euler: v_n = n a h and x_n = a h² n (n + 1) / 2."""
    physics = BatchPhysics(compiled("slider"), 3)
    force = torch.tensor([[-8.0], [0.0], [2.0]], dtype=torch.float64)
    physics.apply_torque(force)
    physics.step(nstep=200)
    acceleration, h, n = force / 4.0, 0.01, 200
    torch.testing.assert_close(physics.joint_velocity, n * acceleration * h)
    torch.testing.assert_close(physics.joint_position, acceleration * h**2 * n * (n + 1) / 2)


def test_a_frictionless_pendulum_keeps_its_energy():
    physics = BatchPhysics(compiled("pendulum"), 4)
    physics.reset(qpos=[[0.5], [1.5], [3.0], [-2.0]], qvel=[[0.0], [1.0], [-2.0], [6.0]])
    path = physics.rollout(5000)
    q, v = path["qpos"][..., 0], path["qvel"][..., 0]
    energy = 0.5 * (0.1 + 2 * 0.5**2) * v**2 - 2 * 9.81 * 0.5 * torch.cos(q)
    torch.testing.assert_close(energy, energy[:, :1].expand_as(energy), rtol=0, atol=1e-6)
    assert (q.amax(1) - q.amin(1) > 0.9).all()  # it did swing


def test_envs_do_not_know_of_each_other():
    def run(disturb: bool) -> torch.Tensor:
        physics = BatchPhysics(compiled("hopper"), N, num_threads=2, fields=("body_mass", "dof_damping"))
        if disturb:
            physics.reset([3], keyframe="crouch")
            physics.set_field("body_mass", 2.0, envs=[3])
            physics.set_field("dof_damping", 3.0, envs=torch.arange(N) == 3)
            physics.xfrc_applied[3, 1] = 4.0
        return hop(physics)

    plain, disturbed = run(False), run(True)
    same = (plain == disturbed).all(1)
    assert same.tolist() == [True, True, True, False, True]


def test_state_tensors_are_the_simulation_itself():
    physics = BatchPhysics(compiled("hopper"), N)
    for name in ("time", "qpos", "qvel", "ctrl", "qfrc_applied", "xfrc_applied", "qacc_warmstart"):
        tensor = physics.data(name)
        assert tensor.data_ptr() == physics.batch.bind(name).ctypes.data
        assert tensor.dtype == torch.float64
    held = physics.qpos
    held[2, 0] = 7.0
    physics.qvel.numpy()[2, 0] = 1.0
    physics.step()
    assert held is physics.qpos
    assert physics.batch.get_data(2).qpos[0] == held[2, 0] == pytest.approx(7.0 + 0.005, abs=1e-4)
    assert held[[0, 1, 3, 4], 0].abs().max() < 1e-3


@pytest.mark.parametrize("name", ["qpos", "qvel", "ctrl", "qfrc_applied", "xfrc_applied", "time"])
def test_state_cannot_be_replaced_by_mistake(name):
    physics = BatchPhysics(compiled("hopper"), N)
    with pytest.raises(AttributeError, match=name):
        setattr(physics, name, torch.zeros_like(physics.data(name)))


def test_derived_fields_are_current_at_first_sight_and_lag_one_step_unless_refreshed():
    physics = BatchPhysics(compiled("hopper"), N)
    hop(physics)
    knee = slice(-1, None)  # of qpos, and its sensor
    assert torch.equal(physics.data("sensordata")[:, knee], physics.qpos[:, knee])
    before = physics.qpos[:, knee].clone()
    physics.step()
    assert torch.equal(physics.data("sensordata")[:, knee], before)
    physics.step(nstep=3, refresh=True)
    assert torch.equal(physics.data("sensordata")[:, knee], physics.qpos[:, knee])
    physics.reset([1], keyframe="crouch")
    assert physics.data("sensordata")[1, -1] == -0.8


def test_a_sensor_that_reads_contacts_is_refreshed_too():
    xml = HOPPER.replace("<gyro", '<jointlimitpos joint="knee"/><gyro').replace('damping="0.5"/>', 'range="-9 9"/>')
    physics = BatchPhysics(mujoco.MjModel.from_xml_string(xml), 1)
    physics.data("sensordata")
    physics.reset(qvel=[0.0] * 7 + [-60.0])
    seen = []
    for _ in range(10):
        physics.step(refresh=True)
        seen.append(physics.data("sensordata")[0, 3].item())
        assert seen[-1] == pytest.approx(min(np.deg2rad(9) + physics.qpos[0, 8].item(), 0))
    assert min(seen) < 0


def test_looking_changes_nothing():
    blind, looking = BatchPhysics(compiled("hopper"), N), BatchPhysics(compiled("hopper"), N)
    for physics in (blind, looking):
        hop(physics)
    for name in ("xpos", "qacc", "sensordata"):
        looking.data(name)
    looking.forward()
    looking.forward([0, 2])
    np.testing.assert_array_equal(looking.batch.state, blind.batch.state)
    assert torch.equal(hop(looking), hop(blind))


def test_a_field_reaches_the_model_that_is_simulated():
    physics = BatchPhysics(compiled("hopper"), N, fields=("dof_damping", "body_mass"))
    physics.set_field("dof_damping", np.linspace(0, 1, N)[:, None] * np.ones(8))
    physics.set_field("body_mass", 0.7, envs=[1])
    physics.field("dof_damping")[4, 7] = 0.25
    seen = [physics.batch.get_model(i) for i in range(N)]
    assert [model.dof_damping[6] for model in seen] == [0, 0.25, 0.5, 0.75, 1.0]
    assert seen[4].dof_damping[7] == 0.25
    assert [model.body("foot").mass.item() for model in seen] == [0.5, 0.7, 0.5, 0.5, 0.5]
    assert seen[1].body("foot").subtreemass.item() == 0.7  # a constant that follows
    assert physics.model.body("foot").mass.item() == 0.5


def test_python_numbers_keep_their_digits():
    physics = BatchPhysics(compiled("slider"), 2, fields=("dof_damping",))
    physics.set_field("dof_damping", [[0.1], [0.2]])
    physics.reset(qpos=[0.3])
    assert physics.field("dof_damping").tolist() == [[0.1], [0.2]]
    assert physics.qpos.tolist() == [[0.3], [0.3]]


@pytest.mark.parametrize(
    ("fields", "name", "value", "message"),
    [
        ((), "dof_damping", 1.0, r"fields=\['dof_damping'\]"),
        (("geom_condim",), "geom_condim", 3.5, "holds 3 where 3.5 was written: it is stored as torch.int32"),
        (("jnt_range",), "jnt_range", 0.5, r"jnt_range\[0\] would be ignored.* Give it a range"),
        (("actuator_forcerange",), "actuator_forcerange", [-1.0, 1.0], "actuator_forcelimited.* is 0"),
        (("dof_damping",), "dof_damping", np.ones((2, 8)), r"shape \(2, 8\), needed is \(5, 8\)"),
    ],
)
def test_a_write_that_would_be_lost_is_refused(fields, name, value, message):
    physics = BatchPhysics(compiled("hopper"), N, fields=fields)
    with pytest.raises(ValueError, match=message):
        physics.set_field(name, value)


def test_limits_work_where_the_model_has_them_or_switches_them_on():
    arm = BatchPhysics(compiled("arm"), 2, fields=("jnt_range",))
    limits = torch.from_numpy(arm.model.jnt_range).repeat(2, 1, 1)
    limits[1, 1] = torch.tensor([-0.1, 0.1])
    arm.set_field("jnt_range", limits)
    arm.apply_torque(torch.tensor([[5.0, 0.0]] * 2))  # elbow first, as its actuator
    arm.step(nstep=500)
    assert arm.qpos[0, 1] > 0.5
    assert arm.qpos[1, 1] < 0.2
    switched = BatchPhysics(compiled("arm"), 2, fields=("jnt_range", "jnt_limited"))
    switched.set_field("jnt_limited", 1)
    switched.set_field("jnt_range", [-0.1, 0.1])


def test_an_unknown_field_is_refused_with_a_hint():
    with pytest.raises(ValueError, match="did you mean 'dof_damping'"):
        BatchPhysics(compiled("arm"), N, fields=("dof_dampin",))


def test_a_diverged_env_is_named_although_mujoco_restarts_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log where it stands
    physics = BatchPhysics(compiled("hopper"), N)
    assert not physics.diverged.any()
    torque = torch.zeros(N, 2, dtype=torch.float64)
    torque[1] = torch.nan
    physics.apply_torque(torque)
    physics.qvel[3, 0] = 1e11
    physics.step()
    assert physics.qpos.isfinite().all()  # looks healthy
    assert physics.diverged.tolist() == [False, True, False, True, False]
    physics.reset([1])
    physics.step()
    assert physics.diverged.tolist() == [False, False, False, True, False]
    physics.qpos[4, 0] = torch.nan
    assert physics.diverged.tolist() == [False, False, False, True, True]


def test_an_error_of_mujoco_names_its_envs_and_spares_the_others():
    physics = BatchPhysics(compiled("hopper"), N, fields=("opt.integrator",))
    physics.field("opt.integrator")[[1, 3]] = 99
    with pytest.raises(SimulationError, match="invalid integrator") as caught:
        physics.step()
    assert caught.value.ids.tolist() == [1, 3]
    assert (physics.time > 0).tolist() == [True, False, True, False, True]


def test_reset_touches_the_chosen_envs_alone():
    physics = BatchPhysics(compiled("hopper"), N)
    before = hop(physics)
    physics.reset(torch.zeros(N, dtype=torch.bool))
    physics.reset([])
    assert torch.equal(physics.qpos, before)
    rows = torch.full((N, 9), torch.nan)
    rows[4], rows[0] = torch.arange(9), -torch.arange(9.0)
    physics.reset([4, 0], qpos=rows, qvel=torch.ones(8))
    assert torch.equal(physics.qpos[[4, 0]], rows[[4, 0]].double())
    assert torch.equal(physics.qpos[1:4], before[1:4])
    assert (physics.qvel[[0, 4]] == 1).all()
    assert (physics.time == 0).tolist() == [True, False, False, False, True]
    assert (physics.qfrc_applied != 0).any(1).tolist() == [False, True, True, True, False]


@pytest.mark.parametrize(
    ("envs", "message"),
    [([True, False], r"one bool per env, \(5,\)"), ([0, 5], "among 0 to 4"), ([-1], "among 0 to 4")],
)
def test_envs_that_do_not_exist_are_refused(envs, message):
    physics = BatchPhysics(compiled("arm"), N, fields=("dof_damping",))
    for call in (physics.reset, physics.forward, lambda envs: physics.set_field("dof_damping", 9.0, envs)):
        with pytest.raises(ValueError, match=message):
            call(envs)
    assert (physics.field("dof_damping") != 9.0).all()


def test_torques_go_to_the_named_joints_in_their_order():
    model = compiled("hopper")
    torque = torch.tensor([[1.0, 2.0]] * N, requires_grad=True)
    physics = BatchPhysics(model, N, joint_names=("knee", "hip"))
    physics.qfrc_applied[:, 0] = 5.0
    physics.apply_torque(torque)
    assert physics.qfrc_applied[0].tolist() == [5.0, 0, 0, 0, 0, 0, 2.0, 1.0]
    assert not physics.qfrc_applied.requires_grad
    hop(physics)
    assert torch.equal(physics.joint_position, physics.qpos[:, [8, 7]])
    assert torch.equal(physics.joint_velocity, physics.qvel[:, [7, 6]])
    with pytest.raises(ValueError, match=r"torque has shape \(5, 1\), needed is \(5, 2\).*knee"):
        physics.apply_torque(torque[:, :1])


def test_joints_are_those_of_the_actuators_in_their_order():
    assert BatchPhysics(compiled("arm"), 1).joint_names == ("elbow", "shoulder")
    assert BatchPhysics(compiled("hopper"), 1).joint_names == ("hip", "knee")
    assert BatchPhysics(compiled("pendulum"), 1).joint_names == ("hinge",)
    nameless = mujoco.MjModel.from_xml_string(MODELS["pendulum"].replace('name="hinge"', ""))
    assert BatchPhysics(nameless, 1).joint_names == ()


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("ankle",), r"no hinge or slide 'ankle'; it has \['hip', 'knee'\]"),
        (("float",), "'float'"),
        (("hip",) * 2, "once"),
    ],
)
def test_joints_that_cannot_be_driven_are_refused(names, message):
    with pytest.raises(ValueError, match=message):
        BatchPhysics(compiled("hopper"), N, joint_names=names)


@pytest.mark.parametrize(
    ("name", "joint_names", "into"),
    [
        ("hopper", None, "torque"),
        ("arm", ("shoulder", "elbow"), "torque"),
        ("arm", ("elbow", "shoulder"), "torque"),
        ("arm", ("elbow",), "torque"),
        ("hopper", None, "ctrl"),
        ("hopper", None, "qfrc_applied"),
        ("hopper", None, "xfrc_applied"),
    ],
)
def test_a_rollout_is_the_steps_one_by_one(name, joint_names, into, rng):
    steps = 40
    one, many = (BatchPhysics(compiled(name), N, joint_names=joint_names) for _ in range(2))
    for physics in (one, many):
        physics.qfrc_applied[:, 0] = 0.5  # stays, unless the rollout writes it
    target = one.joint_velocity if into == "torque" else one.data(into)
    control = torch.from_numpy(rng.normal(size=(N, steps, *target.shape[1:])))
    record = [field for field in ("qpos", "qvel", "qacc", "sensordata") if one.data(field).numel()]
    path = many.rollout(steps, control, into, record)
    for k in range(steps):
        if into == "torque":
            one.apply_torque(control[:, k])
        else:
            one.data(into)[:] = control[:, k]
        one.step()
        for field in record:
            assert torch.equal(path[field][:, k], one.data(field)), (field, k)
    np.testing.assert_array_equal(many.batch.state, one.batch.state)


def test_a_rollout_that_diverges_repeats_its_last_record_and_says_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    physics = BatchPhysics(compiled("hopper"), 2)
    torque = torch.zeros(2, 10, 2, dtype=torch.float64)
    torque[1, 4:] = torch.inf
    path = physics.rollout(10, torque, "torque")["qpos"]
    assert physics.diverged.tolist() == [False, True]
    assert torch.equal(path[1, 5:], path[1, 4:5].expand(5, -1))
    assert not torch.equal(path[0, 5], path[0, 4])


@pytest.mark.parametrize(
    ("shape", "into", "message"),
    [
        ((10, N, 2), "torque", r"needed is \(5, 10, 2\)"),
        ((N, 10, 1), "ctrl", r"needed is \(5, 10, 2\)"),
        ((N, 10, 2), "qpos", "cannot go into 'qpos'; known are"),
    ],
)
def test_a_rollout_of_the_wrong_shape_is_refused(shape, into, message):
    with pytest.raises(ValueError, match=message):
        BatchPhysics(compiled("hopper"), N).rollout(10, torch.zeros(shape), into)


def test_what_a_step_does_not_compute_is_not_shown():
    physics = BatchPhysics(compiled("hopper"), N)
    for call in (physics.data, lambda name: physics.rollout(1, record=[name])):
        with pytest.raises(ValueError, match="Read a sensor"):
            call("cfrc_ext")


def test_offers_all_that_the_protocol_asks_for():
    physics = BatchPhysics(compiled("hopper"), N)
    assert isinstance(physics, Physics)
    promised = {name for name in vars(Physics) if not name.startswith("_")}
    assert promised <= set(vars(BatchPhysics)) | set(vars(physics))
    assert physics.timestep == 0.005
