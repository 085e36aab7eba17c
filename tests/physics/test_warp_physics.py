"""What the protocol promises, asked of both back ends, and the agreement of the two.

MuJoCo Warp runs on its CPU device here. Its kernels take half a minute to compile the first time, so they all live in
this module and its tests of Warp count as slow.
"""

import importlib.util
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import torch
from physics.models import HOPPER, compiled

from torchrl_athletic.physics import BatchPhysics, CapacityError, Physics, WarpPhysics

N = 4
WARP = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("mujoco_warp") is None, reason="mujoco_warp is not installed"),
]
TOUCHING = HOPPER.replace("<gyro", '<touch site="sole"/><framelinvel objtype="body" objname="foot"/><gyro').replace(
    '<geom size="0.08"/>', '<geom size="0.08"/><site name="sole" size="0.1"/>'
)
CROWD = (
    "<mujoco><worldbody><geom type='plane' size='5 5 .1'/>"
    + "".join(f"<body pos='{x} 0 .1'><freejoint/><geom type='box' size='.1 .1 .1'/></body>" for x in range(3))
    + "</worldbody></mujoco>"
)


def make(backend: str, model: mujoco.MjModel, num_envs: int = N, **options) -> Physics:
    if backend == "batch":
        return BatchPhysics(model, num_envs, **options)
    return WarpPhysics(model, num_envs, device="cpu", **options)


def excite(physics: Physics, steps: int = 60, seed: int = 0, **options) -> None:
    """Apply torques that differ between envs and steps, and not between back ends."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        torque = torch.randn(physics.num_envs, len(physics.joint_names), generator=generator, dtype=torch.float64)
        physics.apply_torque(torque.to(physics.dtype))
        physics.step(**options)


def everything(physics: Physics) -> dict[str, torch.Tensor]:
    names = ("time", "qpos", "qvel", "qacc_warmstart", "sensordata", "xpos", "qacc", "cvel")
    return {name: physics.data(name).clone() for name in names}


@pytest.fixture(params=["batch", pytest.param("warp", marks=WARP)])
def backend(request):
    return request.param


def test_a_slider_under_constant_force_moves_as_the_integrator_must(backend):
    """Semi-implicit Euler: v_n = n a h and x_n = a h² n (n + 1) / 2."""
    physics = make(backend, compiled("slider"), 3)
    force = torch.tensor([[-8.0], [0.0], [2.0]], dtype=physics.dtype)
    physics.apply_torque(force)
    physics.step(nstep=50)
    acceleration, h, n = force / 4.0, 0.01, 50
    torch.testing.assert_close(physics.joint_velocity, n * acceleration * h)
    torch.testing.assert_close(physics.joint_position, acceleration * h**2 * n * (n + 1) / 2)
    torch.testing.assert_close(physics.time, torch.full_like(physics.time, n * h))


def test_a_wrench_pulls_and_twists_about_the_world_s_axes(backend):
    """Without gravity, from rest: one step gives the velocity h F / m, and the rate h T / I about a principal axis."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><option gravity='0 0 0'/><worldbody><body name='ball'><freejoint/>"
        "<geom size='.1' mass='2'/></body></worldbody></mujoco>"
    )
    physics = make(backend, model, 2)
    physics.apply_wrench("ball", force=[[1.0, 0, 0], [0, -2.0, 0]], torque=torch.tensor([0, 0, 0.03]))
    physics.step()
    h, inertia = model.opt.timestep, 0.4 * 2 * 0.1**2
    expected = torch.tensor([[0.5 * h, 0, 0, 0, 0, 0.03 / inertia * h], [0, -h, 0, 0, 0, 0.03 / inertia * h]])
    torch.testing.assert_close(physics.qvel, expected.to(physics.dtype))


def test_state_tensors_are_the_simulation_itself_and_stay_the_same_object(backend):
    physics = make(backend, compiled("hopper"))
    held = {name: physics.data(name) for name in ("time", "qpos", "qvel", "ctrl", "qfrc_applied", "xfrc_applied")}
    held["qpos"][2, 0] = 7.0
    held["qvel"][2, 0] = 1.0
    physics.step()
    physics.reset([1])
    physics.step(refresh=True, envs=torch.tensor([True, False, True, True]))
    assert held["qpos"][2, 0] == pytest.approx(7.0 + 2 * 0.005, abs=1e-3)
    assert held["qpos"][[0, 1, 3], 0].abs().max() < 1e-3
    for name, tensor in held.items():
        assert tensor is physics.data(name) is getattr(physics, name)


def test_a_masked_reset_starts_some_envs_anew_and_leaves_the_others(backend):
    physics = make(backend, compiled("hopper"))
    start = everything(physics)
    physics.ctrl[:] = 0.3
    excite(physics, 30)
    physics.xfrc_applied[:] = 0.1
    before = everything(physics)
    mask = torch.tensor([True, False, True, False])
    physics.reset(mask)
    for name in ("time", "qpos", "qvel", "qacc_warmstart"):
        assert torch.equal(physics.data(name)[mask], start[name][mask]), name
        assert torch.equal(physics.data(name)[~mask], before[name][~mask]), name
    for name in ("ctrl", "qfrc_applied", "xfrc_applied"):
        assert not physics.data(name)[mask].any()
        assert physics.data(name)[~mask].any(1).all()
    torch.testing.assert_close(physics.data("xpos")[mask], start["xpos"][mask])
    assert physics.data("sensordata")[mask][:, -1].tolist() == [0.0, 0.0]  # the knee


def test_a_reset_to_a_keyframe_and_to_given_values(backend):
    physics = make(backend, compiled("hopper"))
    excite(physics, 5)
    physics.reset([3, 1], keyframe="crouch")
    assert physics.qpos[[1, 3], 8].tolist() == pytest.approx([-0.8] * 2)
    assert physics.qvel[[1, 3], 0].tolist() == pytest.approx([0.1] * 2)
    qvel = torch.arange(N * 8.0).view(N, 8)
    physics.reset(torch.tensor([False, True, True, False]), qpos=physics.model.key_qpos[0], qvel=qvel)
    torch.testing.assert_close(physics.qvel[1:3], qvel[1:3].to(physics.dtype))
    assert physics.qpos[:, 8].tolist()[1:3] == pytest.approx([-0.8] * 2)
    assert physics.qvel[3, 0] == pytest.approx(0.1)
    assert physics.data("sensordata")[2, -1] == pytest.approx(-0.8)


@pytest.mark.parametrize("refresh", [False, True])
def test_a_masked_step_leaves_the_other_envs_exactly_as_they_are(backend, refresh):
    physics, free = (make(backend, compiled("hopper")) for _ in range(2))
    for each in (physics, free):
        everything(each)
        excite(each, 25)
    before = everything(physics)
    mask = torch.tensor([False, True, False, True])
    physics.step(3, refresh=refresh, envs=mask)
    free.step(3, refresh=refresh)
    after, expected = everything(physics), everything(free)
    for name in before:
        assert torch.equal(after[name][~mask], before[name][~mask]), name
        assert torch.equal(after[name][mask], expected[name][mask]), name
        assert not torch.equal(after[name][mask], before[name][mask]), name


def test_a_refresh_shows_the_new_poses_and_velocities_and_changes_nothing_else(backend):
    model = mujoco.MjModel.from_xml_string(TOUCHING)
    refreshed, plain = (make(backend, model) for _ in range(2))
    for physics in (refreshed, plain):
        everything(physics)
        excite(physics, 40)
    refreshed.step(4, refresh=True)
    plain.step(4)
    shown, lagging = everything(refreshed), everything(plain)
    plain.forward()
    current = everything(plain)
    touch, accelerometer = 3, slice(0, 3)
    for name in ("qpos", "qvel", "time", "qacc_warmstart", "qacc"):
        assert torch.equal(shown[name], lagging[name]), name
    for name in ("xpos", "cvel"):
        torch.testing.assert_close(shown[name], current[name], msg=name)
        assert not torch.equal(shown[name], lagging[name])
    torch.testing.assert_close(shown["sensordata"][:, 4:], current["sensordata"][:, 4:])
    for late in (touch, accelerometer):
        assert torch.equal(shown["sensordata"][:, late], lagging["sensordata"][:, late])
    assert (shown["sensordata"][:, touch] > 0).any()


def test_per_env_fields_act_as_models_compiled_with_those_values(backend):
    """The compiler is the oracle: it knows which constants follow from which value."""
    models = []
    for i in range(N):
        spec = mujoco.MjSpec.from_string(HOPPER)
        spec.body("foot").mass, spec.body("foot").ipos = 0.5 + 0.1 * i, [0.01 * i, 0, 0]
        spec.joint("knee").armature, spec.joint("hip").frictionloss = 0.02 * i, 0.2 * i
        spec.option.gravity = [0.2 * i, 0, -9.81]
        models.append(spec.compile())
    fields = ("body_mass", "body_ipos", "dof_armature", "dof_frictionloss", "opt.gravity")
    physics = make(backend, mujoco.MjSpec.from_string(HOPPER).compile(), fields=fields)
    for name in fields:
        of = [model.opt.gravity if name == "opt.gravity" else getattr(model, name) for model in models]
        physics.set_field(name, np.stack(of))
    excite(physics)
    singles = [make(backend, model, 1) for model in models]
    generator = torch.Generator().manual_seed(0)
    for _ in range(60):
        torque = torch.randn(N, 2, generator=generator, dtype=torch.float64).to(physics.dtype)
        for i, single in enumerate(singles):
            single.apply_torque(torque[i : i + 1])
            single.step()
    expected = torch.cat([single.qpos for single in singles])
    torch.testing.assert_close(physics.qpos, expected, rtol=0, atol=2e-5)
    assert (expected.diff(dim=0).abs().amax(1) > 1e-3).all()


def test_a_field_is_set_for_the_envs_meant(backend):
    physics = make(backend, compiled("hopper"), fields=("dof_damping", "body_mass"))
    physics.set_field("body_mass", 2.0, envs=torch.tensor([False, True, False, False]))
    physics.set_field("dof_damping", torch.linspace(0, 1, N)[:, None].expand(N, 8), envs=[0, 3])
    assert physics.field("body_mass")[:, 3].tolist() == [0.5, 2.0, 0.5, 0.5]
    assert physics.field("dof_damping")[:, 7].tolist() == [0.0, 0.5, 0.5, 1.0]
    assert physics.field("dof_damping") is physics.field("dof_damping")


def test_several_fields_are_set_with_what_follows_from_them_computed_once(backend, monkeypatch):
    model = compiled("hopper")
    fields = ("body_mass", "body_inertia", "geom_friction")
    together, apart = (make(backend, model, fields=fields) for _ in range(2))
    computed = []
    of, name = (together.batch, "set_const") if backend == "batch" else (together, "_inertial")
    really = getattr(of, name)
    if backend == "batch":
        monkeypatch.setattr(together, "batch", Counted(of, computed))
    else:
        monkeypatch.setattr(together, name, lambda given: computed.append(1) or really(given))
    scale = torch.tensor([0.5, 1.0, 1.5, 2.0])
    values = {name: torch.as_tensor(getattr(model, name)) for name in fields}
    values = {name: value * scale.view(-1, *[1] * value.ndim) for name, value in values.items()}
    together.set_fields(values, envs=[0, 2, 3])
    assert len(computed) == 1
    for name, value in values.items():
        apart.set_field(name, value, envs=[0, 2, 3])
    for each in (together, apart):
        excite(each)
    torch.testing.assert_close(together.qpos, apart.qpos)
    assert together.field("body_mass")[:, 1].tolist() == pytest.approx([2.5, 5.0, 7.5, 10.0])


class Counted:
    """A batch that notes how often constants were computed."""

    def __init__(self, batch, computed):
        self._batch, self._computed = batch, computed

    def set_const(self, ids):
        self._computed.append(1)
        return self._batch.set_const(ids)

    def __getattr__(self, name):
        return getattr(self._batch, name)


def test_what_floats_is_raised_with_all_that_hangs_on_it_and_nothing_else_changes(backend):
    model = mujoco.MjModel.from_xml_string(TOUCHING)
    raised, placed = (make(backend, model) for _ in range(2))
    names = ("xpos", "xipos", "geom_xpos", "site_xpos", "subtree_com", "sensordata", "xquat", "cvel")
    for each in (raised, placed):
        for name in names:
            each.data(name)
        excite(each, 5)
        each.forward()
    before = raised.data("xpos").clone()
    height = torch.tensor([[0.0], [0.1], [0.0], [0.4]]).to(raised.dtype)
    raised.raise_up(height)
    placed.qpos[:, 2:3] += height
    placed.forward()
    late = ~np.isin(np.arange(model.nsensordata), [0, 1, 2, 3])  # accelerometer and touch follow from forces
    for name in names:
        one, other = raised.data(name), placed.data(name)
        # Of the whole world's centre of mass, which nobody asks for, a part alone would rise.
        columns = torch.from_numpy(late) if name == "sensordata" else slice(1, None)
        torch.testing.assert_close(one[:, columns], other[:, columns], atol=1e-5, rtol=1e-5, msg=name)
    assert (raised.data("xpos") - before)[:, 1:, 2].mean(1).tolist() == pytest.approx([0.0, 0.1, 0.0, 0.4], abs=1e-5)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("mujoco_warp") is None, reason="mujoco_warp is not installed")
def test_a_graph_with_room_for_few_changes_serves_all_in_their_turn(monkeypatch):
    """What a recorded graph does, called as it is: two envs at once, of which three changed."""
    monkeypatch.setattr("torchrl_athletic.physics.warp_physics._AT_ONCE", 2)
    model = compiled("hopper")
    few, whole = (WarpPhysics(model, N, device="cpu", fields=("body_mass",)) for _ in range(2))
    mass = torch.as_tensor(model.body_mass).float() * torch.tensor([0.5, 1.5, 2.0, 3.0])[:, None]
    mask = torch.tensor([True, False, True, True])
    whole.set_fields({"body_mass": mass}, envs=mask)
    few.field("body_mass").copy_(whole.field("body_mass"))
    few._follow_few(mask)
    late = (few._constants["dof_invweight0"] != whole._constants["dof_invweight0"]).any(1)
    assert late.sum() == 1
    torch.testing.assert_close(few._constants["body_subtreemass"], whole._constants["body_subtreemass"])
    few._follow_few(torch.zeros(N, dtype=torch.bool))
    for name, value in whole._constants.items():
        torch.testing.assert_close(few._constants[name], value, msg=name)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("mujoco_warp") is None, reason="mujoco_warp is not installed")
def test_a_write_within_a_graph_lets_the_constants_of_the_changed_envs_follow_and_leaves_the_others(monkeypatch):
    model = compiled("hopper")
    graph, plain = (WarpPhysics(model, N, device="cpu", fields=("body_mass",)) for _ in range(2))
    mass = torch.as_tensor(model.body_mass).float() * torch.tensor([0.5, 1.5, 2.0, 3.0])[:, None]
    mask = torch.tensor([True, False, True, True])
    plain.set_fields({"body_mass": mass}, envs=mask)
    graph._constants["dof_invweight0"][1] = 7.0  # as of somebody else
    monkeypatch.setattr(graph, "_recording", lambda: True)
    graph.set_fields({"body_mass": mass}, envs=mask)
    assert (graph._constants["dof_invweight0"][1] == 7.0).all()
    for name, value in plain._constants.items():
        torch.testing.assert_close(graph._constants[name][mask], value[mask], msg=name)
    assert (plain._constants["dof_invweight0"][0] != plain._constants["dof_invweight0"][1]).any()


@pytest.mark.parametrize(
    ("fields", "name", "value", "message"),
    [
        ((), "dof_damping", 1.0, r"fields=\['dof_damping'\]"),
        (("jnt_range",), "jnt_range", 0.5, r"jnt_range\[0\] would be ignored.* Give it a range"),
        (("dof_damping",), "dof_damping", np.ones((2, 8)), r"shape \(2, 8\), needed is \(4, 8\)"),
    ],
)
def test_a_write_that_would_be_lost_is_refused(backend, fields, name, value, message):
    with pytest.raises(ValueError, match=message):
        make(backend, compiled("hopper"), fields=fields).set_field(name, value)


def test_an_unknown_field_is_refused_with_a_hint(backend):
    with pytest.raises(ValueError, match="did you mean 'dof_damping'"):
        make(backend, compiled("arm"), fields=("dof_dampin",))


def test_a_diverged_env_is_named_until_it_is_reset_and_harms_no_other(backend, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log where it stands
    physics, healthy = (make(backend, compiled("hopper")) for _ in range(2))
    assert not physics.diverged.any()
    for each in (physics, healthy):
        excite(each, 20)
    physics.qfrc_applied[1, 3] = torch.nan
    physics.qvel[3, 0] = 1e11
    physics.step()
    healthy.step()
    physics.qvel[3] = 0.0  # back to where it looks healthy
    physics.qfrc_applied[1] = 0.0
    physics.step()
    healthy.step()
    assert physics.diverged.tolist() == [False, True, False, True]
    assert torch.equal(physics.qpos[[0, 2]], healthy.qpos[[0, 2]])
    physics.reset([1])
    assert physics.diverged.tolist() == [False, False, False, True]
    physics.step(20)
    assert physics.qpos[1].isfinite().all()
    assert not physics.diverged[1]


def test_torques_go_to_the_joints_named_in_their_order(backend):
    swapped, plain = (
        make(backend, compiled("arm"), 2, joint_names=names) for names in (("shoulder", "elbow"), ("elbow", "shoulder"))
    )
    torque = torch.tensor([[0.5, -0.2], [1.0, 0.3]], dtype=swapped.dtype)
    swapped.apply_torque(torque)
    plain.apply_torque(torque.flip(1))
    for physics in (swapped, plain):
        physics.step(50)
    assert torch.equal(swapped.qpos, plain.qpos)
    assert torch.equal(swapped.joint_position, plain.joint_position.flip(1))
    assert (swapped.qpos.abs() > 1e-3).all()


@pytest.mark.parametrize("into", ["torque", "ctrl", "xfrc_applied"])
def test_a_rollout_is_the_steps_one_by_one(backend, into):
    one, many = (make(backend, compiled("hopper")) for _ in range(2))
    target = one.joint_velocity if into == "torque" else one.data(into)
    control = torch.randn(N, 15, *target.shape[1:], generator=torch.Generator().manual_seed(3)).to(one.dtype)
    path = many.rollout(15, control, into, record=["qpos", "sensordata"])
    for k in range(15):
        if into == "torque":
            one.apply_torque(control[:, k])
        else:
            one.data(into)[:] = control[:, k]
        one.step()
        assert torch.equal(path["qpos"][:, k], one.qpos)
    assert path["sensordata"].shape == (N, 15, 7)


def test_a_captured_function_does_what_the_function_does(backend):
    """Where there is nothing to record, it is the function."""
    physics, eager = (make(backend, compiled("hopper")) for _ in range(2))

    def control(of: Physics) -> torch.Tensor:
        of.apply_torque(-5 * of.joint_position - of.joint_velocity)
        of.step(2, refresh=True)
        return of.qpos

    replay = physics.capture(lambda: control(physics))
    for _ in range(5):
        returned = replay()
        control(eager)
    assert torch.equal(returned, eager.qpos)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: p.apply_torque(torch.zeros(N, 3)), r"shape \(4, 3\), needed is \(4, 2\)"),
        (lambda p: p.reset(torch.tensor([True])), r"mask of envs has shape \(1,\), needed is one bool per env, \(4,\)"),
        (lambda p: p.step(envs=[7]), r"envs \[7\] must be among 0 to 3"),
        (lambda p: p.rollout(10, torch.zeros(N, 9, 2)), r"needed is \(4, 10, 2\)"),
        (lambda p: p.rollout(10, torch.zeros(N, 10, 2), "qpos"), "cannot go into 'qpos'; known are"),
        (lambda p: p.data("cfrc_ext"), "Read a sensor"),
    ],
)
def test_what_makes_no_sense_is_refused(backend, call, message):
    with pytest.raises(ValueError, match=message):
        call(make(backend, compiled("hopper")))


def test_lost_contacts_are_told(backend):
    """Three boxes on the ground need twelve contacts, and a thousand bytes or two contacts are too little."""
    model = CROWD.replace("<worldbody>", "<size memory='18K'/><worldbody>") if backend == "batch" else CROWD
    options = {} if backend == "batch" else {"nconmax": 2, "njmax": 16}
    physics = make(backend, mujoco.MjModel.from_xml_string(model), 2, **options)
    physics.step(20)
    with pytest.raises(CapacityError, match="memory=" if backend == "batch" else "nconmax=2.*half as large again"):
        physics.check()


def test_nothing_is_lost_with_the_room_that_is_set_aside_by_default(backend):
    physics = make(backend, mujoco.MjModel.from_xml_string(CROWD), 2)
    physics.qvel[1] = 1.0
    for _ in range(10):
        physics.step(10)
        physics.check()
    assert (physics.qpos[0, 2::7] > 0.098).all()


def test_offers_all_that_the_protocol_asks_for(backend):
    physics = make(backend, compiled("hopper"))
    assert isinstance(physics, Physics)
    promised = {name for name in vars(Physics) if not name.startswith("_")}
    assert promised <= set(vars(type(physics))) | set(vars(physics))
    assert physics.timestep == pytest.approx(0.005)


def agreement(name: str, steps: int = 80) -> dict[str, float]:
    """Largest difference between both back ends after a short rollout from the same random velocities."""
    model = compiled(name)
    rng = np.random.default_rng(4)
    qvel = 0.5 * rng.normal(size=(N, model.nv))
    ends = []
    for backend in ("batch", "warp"):
        physics = make(backend, model)
        for field in ("xpos", "sensordata"):
            physics.data(field)
        physics.reset(qvel=qvel)
        excite(physics, steps, refresh=True)
        ends.append({field: physics.data(field).double().clone() for field in ("qpos", "qvel", "xpos", "sensordata")})
    return {field: (ends[0][field] - ends[1][field]).abs().amax().item() for field in ends[0] if ends[0][field].numel()}


@pytest.mark.slow
@WARP[1]
@pytest.mark.parametrize("name", ["pendulum", "arm", "hopper"])
def test_both_back_ends_go_the_same_way(name):
    """Float32 against float64. The hopper falls, lands and is driven, all within the 0.4 s."""
    difference = agreement(name)
    assert difference["qpos"] < 1e-4
    assert difference["qvel"] < 2e-3
    assert difference["xpos"] < 1e-4


@WARP[1]
def test_an_import_of_the_physics_leaves_warp_alone():
    code = "import sys, torchrl_athletic.physics; print([m for m in ('warp', 'mujoco_warp') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_without_warp_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(ImportError, match=r"pip install torchrl-athletic\[warp\]"):
        WarpPhysics(compiled("arm"), 1)


@WARP[1]
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_the_other_back_end_is_named():
    with pytest.raises(RuntimeError, match="Take BatchPhysics"):
        WarpPhysics(compiled("arm"), 1)


@WARP[1]
def test_a_model_that_falls_asleep_is_refused():
    model = compiled("hopper")
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP.value
    with pytest.raises(NotImplementedError, match="sleeping bodies"):
        WarpPhysics(model, 1, device="cpu")
