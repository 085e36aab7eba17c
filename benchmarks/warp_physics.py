"""Does ``WarpPhysics`` simulate what ``BatchPhysics`` does, and how much of bare MuJoCo Warp is left behind it?

    python benchmarks/warp_physics.py                  # both tables, on a GPU: three minutes with compiled kernels
    python benchmarks/warp_physics.py --check          # every path of the back end, one by one, with what failed
    python benchmarks/warp_physics.py --check --device cpu --num-envs 4

The first run compiles some seventy kernels, which takes a minute or two. Agreement: the same robots from the same
states under the same torques on both back ends. Throughput: the library and a CUDA graph of bare ``mujoco_warp.step``
advance the same robots from the same states in turn (A B, B A, A B, ...); each pair gives one ratio of wall time.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_athletic.physics import BatchPhysics, CapacityError, Physics, WarpPhysics
from torchrl_athletic.robots import b2z1

DECIMATION = 4
"""Physics steps of a control step."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    check: bool = False
    """Try every path instead of measuring."""
    model: Path | None = None
    """MJCF of another robot than B2+Z1; its first keyframe is the start."""
    device: str = "cuda"
    """Device of WarpPhysics; ``cpu`` serves to try this script."""
    num_envs: int = 4096
    """Worlds."""
    cones: tuple[str, ...] = ("pyramidal", "elliptic")
    """Cones of friction; one row of throughput each."""
    iterations: int = 10
    """Most iterations of the solver; its line search gets twice as many."""
    nconmax: int | None = None
    """Contacts per world; None as estimated."""
    njmax: int | None = None
    """Constraint rows per world; None as estimated."""
    pairs: int = 10
    """Ratios per row."""
    control_steps: int = 50
    """Control steps of one measurement."""
    output: Path = Path("benchmarks/results/warp_physics.md")
    """Where the tables go."""


def main(cfg: Config) -> None:
    torch.set_num_threads(1)
    if cfg.check:
        sys.exit(check_all(cfg))
    sections = [*heading(cfg), *agreement(cfg), "", *throughput(cfg), ""]
    report = "\n".join(sections)
    print(report)
    cfg.output.parent.mkdir(parents=True, exist_ok=True)
    temporary = cfg.output.with_suffix(".part")
    temporary.write_text(report)
    os.replace(temporary, cfg.output)


# Agreement


def agreement(cfg: Config) -> list[str]:
    """Rows of the table: how far both back ends are apart after 0.005 to 0.5 s."""
    rows = [
        "## Agreement with BatchPhysics",
        "",
        "64 robots that have settled on their feet, given random joint velocities (0.5 rad/s) and held by a PD law "
        "computed from the state of BatchPhysics and applied to both. Float32 against float64. Differences over the "
        "robots: median, and what nine in ten stay under.",
        "",
        "| cones | time [s] | joint positions [rad] | joint velocities [rad/s] | bodies [m] |",
        "|---|---|---|---|---|",
    ]
    for cone in cfg.cones:
        model = robot(cfg, cone)
        num_envs = min(64, cfg.num_envs)
        reference = BatchPhysics(model, num_envs)
        warp = WarpPhysics(model, num_envs, device=cfg.device, nconmax=cfg.nconmax, njmax=cfg.njmax)
        home, _ = start(model, num_envs, speed=0.0)
        qpos, qvel = settled(reference, speed=0.5)
        for physics in (reference, warp):
            physics.data("xpos")
            physics.reset(qpos=qpos, qvel=qvel)
        done = 0
        for steps in (1, 4, 20, 100):
            for _ in range(steps - done):
                torque = hold(reference, home)
                for physics in (reference, warp):
                    physics.apply_torque(torque)
                    physics.step(refresh=True)
            done = steps
            apart = [
                difference(warp.joint_position, reference.joint_position),
                difference(warp.joint_velocity, reference.joint_velocity),
                difference(warp.data("xpos"), reference.data("xpos")),
            ]
            rows.append(f"| {cone} | {steps * reference.timestep:.3f} | {' | '.join(apart)} |")
        warp.check()
    return rows


def settled(physics: Physics, speed: float) -> tuple[Tensor, Tensor]:
    """Standing, a second after the start pose, where feet touch or do not by a hair; with random joint velocities."""
    home, extra = start(physics.model, physics.num_envs, speed)
    physics.reset(qpos=home)
    for _ in range(200):
        physics.apply_torque(hold(physics, home))
        physics.step()
    return physics.qpos.float(), (physics.qvel + extra).float()


def hold(physics: Physics, qpos: Tensor) -> Tensor:
    """Torques of a PD law about the start pose. Shape (N, J)."""
    columns = physics.model.jnt_qposadr[[physics.model.joint(name).id for name in physics.joint_names]]
    return 150 * (qpos[:, columns] - physics.joint_position) - 4 * physics.joint_velocity


def difference(ours: Tensor, theirs: Tensor) -> str:
    apart = (ours.cpu().double() - theirs.cpu().double()).abs().flatten(1).amax(1)
    return f"{apart.median():.1e}, {apart.quantile(0.9):.1e}"


# Throughput


def throughput(cfg: Config) -> list[str]:
    """Rows of the table: time of a control step, and ratios to the bare graph."""
    rows = [
        "## Throughput",
        "",
        f"{cfg.num_envs} worlds, {DECIMATION} physics steps of 5 ms a call; solver iterations at most "
        f"{cfg.iterations}, line search {2 * cfg.iterations}. Robots fallen to the ground under constant random "
        f"torques, {cfg.control_steps} calls from the same states each time. Ratio: bare over ours, median (least to "
        f"greatest) of {cfg.pairs} interleaved pairs.",
        "",
        "| cones | nconmax, njmax | call | bare MuJoCo Warp graph [ms] | WarpPhysics [ms] | ratio |",
        "|---|---|---|---|---|---|",
    ]
    for cone in cfg.cones:
        model = robot(cfg, cone)
        physics = WarpPhysics(model, cfg.num_envs, device=cfg.device, nconmax=cfg.nconmax, njmax=cfg.njmax)
        physics.data("sensordata")
        fall(physics)
        states = {name: physics.data(name).clone() for name in ("time", "qpos", "qvel", "qacc_warmstart")}
        torque = physics.qfrc_applied.clone()
        bare, bare_states = bare_graph(physics, torque)
        everyone = torch.ones(cfg.num_envs, dtype=torch.bool, device=physics.device)
        unrolled = WarpPhysics(model, cfg.num_envs, cfg.device, nconmax=physics.nconmax, njmax=physics.njmax)
        unrolled.warp_model.opt.graph_conditional = False
        unrolled.qfrc_applied.copy_(torque)
        calls: dict[str, tuple[WarpPhysics, Callable[[], None]]] = {
            "step": (physics, partial(physics.step, DECIMATION)),
            "step, refreshed": (physics, partial(physics.step, DECIMATION, refresh=True)),
            "step, refreshed, of a mask": (physics, partial(physics.step, DECIMATION, refresh=True, envs=everyone)),
            "step, every iteration of the solver": (unrolled, partial(unrolled.step, DECIMATION)),
        }
        for name, (subject, call) in calls.items():
            ours: list[float] = []
            rival: list[float] = []
            for k in range(cfg.pairs + 1):  # the first pair warms up
                for mine in (k % 2 == 0, k % 2 == 1):
                    view = {field: subject.data(field) for field in states} if mine else bare_states
                    for field, value in states.items():
                        view[field].copy_(value)
                    (ours if mine else rival).append(seconds(call if mine else bare, cfg.control_steps))
            ratio = [theirs / own for own, theirs in zip(ours[1:], rival[1:], strict=True)]
            shown = f"{median(ratio):.3f} ({min(ratio):.3f} to {max(ratio):.3f})"
            capacity = f"{physics.nconmax}, {physics.njmax}"
            rows.append(
                f"| {cone} | {capacity} | {name} | {1e3 * median(rival[1:]):.2f} | {1e3 * median(ours[1:]):.2f} | "
                f"{shown} |"
            )
        physics.check()
        del physics, unrolled, calls, bare, bare_states, states
    return rows


def fall(physics: WarpPhysics) -> None:
    """A second under constant random torques, from the start pose."""
    qpos, qvel = start(physics.model, physics.num_envs, speed=1.0)
    physics.reset(qpos=qpos, qvel=qvel)
    generator = torch.Generator().manual_seed(2)
    physics.apply_torque(5 * torch.randn(physics.num_envs, len(physics.joint_names), generator=generator))
    for _ in range(50):
        physics.step(DECIMATION)


def bare_graph(physics: WarpPhysics, torque: Tensor) -> tuple[Callable[[], None], dict[str, Tensor]]:
    """MuJoCo Warp as its documentation uses it, with the library's capacities; also its state, to be written."""
    import mujoco_warp as mjw
    import warp as wp

    with wp.ScopedDevice(str(physics.device)):
        model = mjw.put_model(physics.model)
        data = mjw.make_data(physics.model, physics.num_envs, nconmax=physics.nconmax, njmax=physics.njmax)
        model.opt.warn_overflow = 0
        states = {name: wp.to_torch(getattr(data, name)) for name in ("time", "qpos", "qvel", "qacc_warmstart")}
        wp.to_torch(data.qfrc_applied).copy_(torque)

        def steps() -> None:
            for _ in range(DECIMATION):
                mjw.step(model, data)

        steps()
        if physics.device.type == "cpu":
            return steps, states
        synchronize()
        with wp.ScopedCapture() as capture:
            steps()

    synchronize()

    def replay(held: Any = (model, data)) -> None:  # the graph does not keep alive what it works on
        wp.capture_launch(capture.graph)

    return replay, states


def seconds(call: Callable[[], Any], repeats: int) -> float:
    """Wall time of one call."""
    synchronize()
    before = time.perf_counter()
    for _ in range(repeats):
        call()
    synchronize()
    return (time.perf_counter() - before) / repeats


def synchronize() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


# The robot


def robot(cfg: Config, cone: str = "pyramidal") -> mujoco.MjModel:
    model = b2z1().model() if cfg.model is None else mujoco.MjModel.from_xml_path(str(cfg.model))
    model.opt.cone = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}[cone]
    model.opt.iterations, model.opt.ls_iterations = cfg.iterations, 2 * cfg.iterations
    return model


def start(model: mujoco.MjModel, num_envs: int, speed: float) -> tuple[Tensor, Tensor]:
    """The first keyframe, with random velocities of the joints [rad/s]. Shapes (N, nq) and (N, nv)."""
    qpos = torch.from_numpy(model.key_qpos[0] if model.nkey else model.qpos0).repeat(num_envs, 1)
    qvel = torch.zeros(num_envs, model.nv, dtype=torch.float64)
    qvel[:, 6:] = speed * torch.randn(num_envs, model.nv - 6, generator=torch.Generator().manual_seed(1)).double()
    return qpos, qvel


# Every path, one by one

CHECKS: list[Callable[[Config, mujoco.MjModel], None]] = []


def checked(function: Callable[[Config, mujoco.MjModel], None]) -> Callable[[Config, mujoco.MjModel], None]:
    CHECKS.append(function)
    return function


def check_all(cfg: Config) -> int:
    """Returns how many failed."""
    print("\n".join(heading(cfg)[4:5]))
    model, failed = robot(cfg), []
    for function in CHECKS:
        began = time.perf_counter()
        try:
            function(cfg, model)
            synchronize()
            print(f"PASS {function.__name__} ({time.perf_counter() - began:.1f} s)", flush=True)
        except Exception:
            failed.append(function.__name__)
            print(f"FAIL {function.__name__}\n{traceback.format_exc()}", flush=True)
    print(f"{len(CHECKS) - len(failed)} of {len(CHECKS)} passed" + (f"; failed: {failed}" if failed else ""))
    return len(failed)


def made(cfg: Config, model: mujoco.MjModel, **options: Any) -> WarpPhysics:
    physics = WarpPhysics(model, cfg.num_envs, device=cfg.device, **options)
    physics.data("sensordata")  # computed at first sight, which would tell a captured step from others
    return physics


def half(cfg: Config) -> Tensor:
    """Every other env. Bool, shape (N,), on the device."""
    return (torch.arange(cfg.num_envs) % 2 == 0).to(cfg.device)


def everything(physics: WarpPhysics) -> dict[str, Tensor]:
    names = ("time", "qpos", "qvel", "qacc_warmstart", "xpos", "cvel", "sensordata", "qacc")
    return {name: physics.data(name).clone() for name in names}


def random_torque(physics: WarpPhysics, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 5 * torch.randn(physics.num_envs, len(physics.joint_names), generator=generator).to(physics.device)


def same(ours: Tensor, theirs: Tensor, what: str, atol: float = 0.0) -> None:
    torch.testing.assert_close(ours, theirs, rtol=0, atol=atol, msg=lambda text: f"{what}: {text}")


@checked
def views_are_the_simulation(cfg: Config, model: mujoco.MjModel) -> None:
    physics = made(cfg, model)
    for name in ("qpos", "qvel", "ctrl", "qfrc_applied", "xfrc_applied", "time"):
        assert physics.data(name).data_ptr() == getattr(physics.warp_data, name).ptr, name
        assert physics.data(name) is getattr(physics, name), name
        assert physics.data(name).device == physics.device, name
    held = physics.qpos
    held[0, 2] = 3.0
    physics.step()
    assert physics.qpos is held
    assert 2.9 < float(held[0, 2]) < 3.1
    assert abs(float(physics.time[0]) - physics.timestep) < 1e-7


@checked
def a_graphed_step_is_the_steps_launched_one_by_one(cfg: Config, model: mujoco.MjModel) -> None:
    ours, theirs = made(cfg, model), made(cfg, model)
    for physics in (ours, theirs):
        physics.apply_torque(random_torque(physics, 0))
    ours.step(4)
    for _ in range(4):
        theirs.step()
    same(ours.time, theirs.time, "time", atol=1e-7)
    same(ours.qpos, theirs.qpos, "qpos", atol=1e-5)


@checked
def both_back_ends_go_the_same_way(cfg: Config, model: mujoco.MjModel) -> None:
    num_envs = min(cfg.num_envs, 64)
    ours, theirs = WarpPhysics(model, num_envs, device=cfg.device), BatchPhysics(model, num_envs)
    qpos, qvel = settled(theirs, speed=0.5)
    for physics in (ours, theirs):
        physics.data("xpos")
        physics.reset(qpos=qpos, qvel=qvel)
        physics.step(10, refresh=True)
    apart = (ours.qpos.cpu().double() - theirs.qpos).abs().amax(1)
    assert apart.median() < 1e-4, apart.median()
    far = (ours.data("xpos").cpu().double() - theirs.data("xpos")).abs().amax((1, 2))
    assert far.median() < 1e-4, far.median()


@checked
def a_masked_step_leaves_the_others(cfg: Config, model: mujoco.MjModel) -> None:
    physics, mask = made(cfg, model), half(cfg)
    physics.apply_torque(random_torque(physics, 1))
    everything(physics)
    physics.step(5)
    for refresh in (False, True):
        before = everything(physics)
        physics.step(2, refresh=refresh, envs=mask)
        after = everything(physics)
        for name in before:
            same(after[name][~mask], before[name][~mask], f"{name} of the others, refresh={refresh}")
            assert not torch.equal(after[name][mask], before[name][mask]), name
    physics.step(1, envs=~mask)  # the same graph with another mask
    assert torch.equal(physics.time[mask] > physics.time[~mask].max(), torch.ones_like(mask[mask]))


@checked
def a_masked_reset_starts_anew(cfg: Config, model: mujoco.MjModel) -> None:
    physics, mask = made(cfg, model), half(cfg)
    everything(physics)
    physics.ctrl.fill_(0.1)
    physics.apply_torque(random_torque(physics, 2))
    physics.step(5)
    before = everything(physics)
    qpos, qvel = (state.float().to(cfg.device) for state in start(model, cfg.num_envs, 1.0))
    physics.reset(mask, qpos=qpos, qvel=qvel)
    same(physics.qpos[mask], qpos[mask], "qpos")
    same(physics.qvel[mask], qvel[mask], "qvel")
    for name in ("time", "ctrl", "qfrc_applied", "qacc_warmstart"):
        assert not physics.data(name)[mask].any(), name
    for name in ("time", "qpos", "qvel", "qacc_warmstart"):
        same(physics.data(name)[~mask], before[name][~mask], name)
    heights = physics.data("xpos")[mask, 1, 2]
    same(heights, heights[:1].expand_as(heights), "heights after the reset", atol=1e-6)
    physics.reset([1], keyframe=0)
    same(physics.qpos[1].double().cpu(), torch.from_numpy(model.key_qpos[0]), "keyframe", atol=1e-6)


@checked
def a_refresh_shows_the_new_state(cfg: Config, model: mujoco.MjModel) -> None:
    physics = made(cfg, model)
    everything(physics)
    physics.apply_torque(random_torque(physics, 3))
    physics.step(10)
    physics.step(2, refresh=True)
    shown = everything(physics)
    physics.forward()
    current = everything(physics)
    early = np.setdiff1d(np.arange(model.nsensordata), physics._late.cpu().numpy())
    for name in ("xpos", "cvel"):
        same(shown[name], current[name], name, atol=1e-4)
    same(shown["sensordata"][:, early], current["sensordata"][:, early], "sensors", atol=1e-4)
    same(shown["qpos"], current["qpos"], "qpos")
    same(shown["qacc_warmstart"], current["qacc_warmstart"], "warm start")


@checked
def fields_differ_between_envs(cfg: Config, model: mujoco.MjModel) -> None:
    fields = ("body_mass", "dof_damping", "dof_frictionloss", "geom_friction", "opt.gravity")
    physics = made(cfg, model, fields=fields)
    body = model.nbody - 1
    mass = torch.as_tensor(model.body_mass).repeat(cfg.num_envs, 1)
    mass[:, body] += torch.linspace(0, 1, cfg.num_envs)
    physics.set_field("body_mass", mass)
    subtree = physics._warp.to_torch(physics.warp_model.body_subtreemass)[:, 0]
    same(subtree.cpu().double(), mass.sum(1), "mass of the whole", atol=1e-3)
    gravity = torch.zeros(cfg.num_envs, 3)
    gravity[0, 2] = 5.0
    physics.set_field("opt.gravity", gravity)
    mask = half(cfg)
    physics.set_field("dof_damping", 3.0, envs=mask)
    assert (physics.field("dof_damping")[mask] == 3.0).all()
    height = float(physics.qpos[0, 2])
    physics.qpos[:, 2] += 1.0
    physics.step(20)
    assert float(physics.qpos[0, 2]) > height + 1.005
    assert abs(float(physics.qpos[1, 2]) - height - 1.0) < 1e-3  # no gravity, no motion


def policy(physics: WarpPhysics) -> tuple[torch.nn.Module, Tensor]:
    torch.manual_seed(0)
    size = physics.joint_position.shape[1]
    net = torch.nn.Sequential(torch.nn.Linear(2 * size, 32), torch.nn.ELU(), torch.nn.Linear(32, size))
    return net.to(physics.device), torch.zeros(physics.num_envs, 2 * size, device=physics.device)


def control_step(physics: WarpPhysics, net: torch.nn.Module, observation: Tensor, done: Tensor) -> Tensor:
    """Policy, four physics steps with torques of their own, observation and masked reset: what an env does."""
    with torch.no_grad():
        target = net(observation)
        for k in range(DECIMATION):
            physics.apply_torque(20 * target - physics.joint_velocity)
            physics.step(refresh=k == DECIMATION - 1)
        physics.reset(done | physics.diverged)
        observation.copy_(torch.cat((physics.joint_position, physics.joint_velocity), 1))
        return physics.data("sensordata").sum(1) + physics.qpos[:, 2]


@checked
def policy_physics_and_reset_in_one_graph(cfg: Config, model: mujoco.MjModel) -> None:
    graphed, eager = made(cfg, model), made(cfg, model)
    results: list[list[Tensor]] = [[], []]
    for physics, found in zip((graphed, eager), results, strict=True):
        net, observation = policy(physics)
        done = torch.zeros(cfg.num_envs, dtype=torch.bool, device=physics.device)

        def call(p: WarpPhysics = physics, n: Any = net, o: Tensor = observation, d: Tensor = done) -> Tensor:
            return control_step(p, n, o, d)

        replay = physics.capture(call) if physics is graphed else call
        observation.zero_()  # the warm-up wrote to it
        assert float(physics.time.max()) == 0.0, "the capture moved the simulation"
        for k in range(6):
            done.copy_(half(cfg) if k == 3 else torch.zeros_like(done))
            found.append(replay().clone())
    assert graphed.time.unique().numel() == 2, graphed.time.unique()
    same(graphed.time, eager.time, "time", atol=1e-6)
    for k, (ours, theirs) in enumerate(zip(*results, strict=True)):
        apart = (ours - theirs).abs().median()
        assert apart < 1e-2, f"step {k}: {apart}"
    apart = (graphed.qpos - eager.qpos).abs().amax(1).median()
    assert apart < 1e-2, apart


@checked
def a_mask_is_read_at_each_replay(cfg: Config, model: mujoco.MjModel) -> None:
    physics = made(cfg, model, fields=("dof_damping", "body_mass"))
    mask, damping = torch.zeros_like(half(cfg)), torch.zeros(cfg.num_envs, model.nv, device=cfg.device)
    mass = physics.field("body_mass").clone()

    def work() -> None:
        physics.set_field("dof_damping", damping, envs=mask)
        physics.set_field("body_mass", mass, envs=mask)
        physics.step(2, envs=mask)

    replay = physics.capture(work)
    for k, chosen in enumerate((half(cfg), ~half(cfg), torch.ones_like(mask))):
        mask.copy_(chosen)
        damping.fill_(k + 1.0)
        mass[:, 1] += 1.0
        before, time_before = physics.field("dof_damping").clone(), physics.time.clone()
        replay()
        assert (physics.field("dof_damping")[chosen] == k + 1.0).all(), k
        assert torch.equal(physics.field("dof_damping")[~chosen], before[~chosen]), k
        same(physics.time - time_before, 2 * physics.timestep * chosen.float(), f"time {k}", atol=1e-6)
    subtree = physics._warp.to_torch(physics.warp_model.body_subtreemass)[:, 1]
    same(subtree, (physics.field("body_mass")[:, 1:]).sum(1), "subtree of the base", atol=1e-2)


@checked
def torch_s_own_capture_can_hold_the_physics(cfg: Config, model: mujoco.MjModel) -> None:
    if cfg.device == "cpu":
        return
    physics = made(cfg, model)
    physics.step(2)
    total = torch.zeros(cfg.num_envs, device=physics.device)
    total.add_(physics.qvel.square().sum(1)).zero_()  # loads the kernels
    stream, graph = torch.cuda.Stream(), torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"), physics.capturing():
        physics.step(2)
        total.add_(physics.qvel.square().sum(1))
    before = float(physics.time[0])
    for _ in range(3):
        graph.replay()
    synchronize()
    assert abs(float(physics.time[0]) - before - 6 * physics.timestep) < 1e-6
    assert (total > 0).all()


@checked
def another_stream_may_be_current(cfg: Config, model: mujoco.MjModel) -> None:
    if cfg.device == "cpu":
        return
    physics, stream = made(cfg, model), torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        physics.apply_torque(random_torque(physics, 4))
        physics.step(3)
        physics.reset(half(cfg))
        physics.step(3, refresh=True)
        ended = physics.time.clone()
    stream.synchronize()
    expected = torch.where(half(cfg), 3 * physics.timestep, 6 * physics.timestep)
    same(ended, expected.to(ended), "time", atol=1e-6)


@checked
def nothing_waits_for_the_device(cfg: Config, model: mujoco.MjModel) -> None:
    if cfg.device == "cpu":
        return
    physics, mask = made(cfg, model, fields=("dof_damping",)), half(cfg)
    torque, damping = random_torque(physics, 5), torch.ones(cfg.num_envs, model.nv, device=physics.device)

    def work() -> None:
        physics.apply_torque(torque)
        physics.apply_wrench(model.body(1).name, force=torch.ones(3, device=physics.device))
        physics.set_field("dof_damping", damping, envs=mask)
        physics.step(2, refresh=True, envs=mask)
        physics.step()
        physics.reset(mask | physics.diverged | physics.overflow)
        physics.forward()

    work()
    torch.cuda.set_sync_debug_mode("error")
    try:
        work()
    finally:
        torch.cuda.set_sync_debug_mode("default")


@checked
def lost_contacts_are_told(cfg: Config, model: mujoco.MjModel) -> None:
    roomy = made(cfg, model)
    roomy.reset(keyframe=0)
    roomy.step(40)
    roomy.check()
    tight = made(cfg, model, nconmax=1, njmax=24)
    tight.reset(keyframe=0)
    tight.step(40)
    assert bool(tight.overflow.any())
    try:
        tight.check()
    except CapacityError as error:
        print(f"     {error}")
    else:
        raise AssertionError("nothing was said")


@checked
def a_diverged_env_is_named_until_its_reset(cfg: Config, model: mujoco.MjModel) -> None:
    physics, healthy = made(cfg, model), made(cfg, model)
    physics.qfrc_applied[1, 7] = torch.nan
    physics.qvel[2, 0] = 1e11
    for each in (physics, healthy):
        each.step(4)
    physics.qvel[2] = 0.0
    physics.step(1)
    healthy.step(1)
    assert physics.diverged.nonzero().flatten().tolist() == [1, 2], physics.diverged.nonzero()
    others = torch.ones_like(physics.diverged)
    others[1:3] = False
    same(physics.qpos[others], healthy.qpos[others], "the others", atol=1e-4)
    physics.reset(physics.diverged)
    physics.step(4)
    assert not physics.diverged.any()
    assert physics.qpos.isfinite().all()


@checked
def a_rollout_records_the_steps(cfg: Config, model: mujoco.MjModel) -> None:
    physics = made(cfg, model)
    control = torch.stack([random_torque(physics, k) for k in range(5)], 1)
    path = physics.rollout(5, control, "torque", record=("qpos", "sensordata"))
    assert path["qpos"].shape == (cfg.num_envs, 5, model.nq)
    assert torch.equal(path["qpos"][:, -1], physics.qpos)
    assert not torch.equal(path["qpos"][:, 0], path["qpos"][:, 1])


@checked
def graphs_keep_their_memory_to_themselves(cfg: Config, model: mujoco.MjModel) -> None:
    """Temporaries after the physics stay where replays find them, and no later tensor gets their place."""
    if cfg.device == "cpu":
        return
    physics, eager = made(cfg, model), made(cfg, model)

    def work(p: WarpPhysics) -> Tensor:
        p.step(2)
        found = p.qpos.sum(1, keepdim=True).expand(-1, 4096).contiguous()
        for _ in range(4):
            found = found * 1.5 - found.mean(1, keepdim=True)
        p.apply_torque(found[:, : len(p.joint_names)].tanh())
        return found.sum(1)

    replay = physics.capture(lambda: work(physics))
    for _ in range(3):
        physics.capture(lambda: work(physics))  # empties torch's cache
    torch.cuda.empty_cache()
    others = []
    for _ in range(33):  # every stream that torch has
        with torch.cuda.stream(torch.cuda.Stream()):
            others.append(torch.zeros(2**24, device=physics.device))
    synchronize()
    for k in range(5):
        ours, theirs = replay().clone(), work(eager)
        synchronize()
        apart = (ours - theirs).abs().median() / theirs.abs().median()
        assert apart < 1e-3, f"step {k}: {apart}"
    assert not any(bool(other.any()) for other in others), "a replay wrote into another tensor"


@checked
def random_numbers_differ_between_replays(cfg: Config, model: mujoco.MjModel) -> None:
    """Drawn before the physics, and after it."""
    physics = made(cfg, model)
    for after in (False, True):
        drawn = torch.zeros(2, cfg.num_envs, device=physics.device)

        def work(after: bool = after, drawn: Tensor = drawn) -> None:
            if after:
                physics.step()
            drawn[0] = torch.rand(cfg.num_envs, device=physics.device)
            drawn[1].uniform_()
            physics.step()

        try:
            replay = physics.capture(work)
            seen = []
            for _ in range(3):
                replay()
                seen.append(drawn.clone())
        except RuntimeError as error:
            raise AssertionError(f"drawn {'after' if after else 'before'} the physics") from error
        assert not torch.equal(seen[1], seen[2]), f"after={after}"
        assert not torch.equal(seen[1][0], seen[1][1]), f"after={after}"


@checked
def replays_keep_their_memory(cfg: Config, model: mujoco.MjModel) -> None:
    if cfg.device == "cpu":
        return
    physics = made(cfg, model)
    net, observation = policy(physics)
    replay = physics.capture(lambda: control_step(physics, net, observation, physics.diverged))
    replay()
    physics.step(2)
    synchronize()
    before = torch.cuda.mem_get_info()[0]
    for _ in range(100):
        replay()
        physics.step(2)
    synchronize()
    lost = (before - torch.cuda.mem_get_info()[0]) / 2**20
    assert lost < 64, f"{lost:.0f} MiB"


@checked
def an_unknown_capture_is_refused(cfg: Config, model: mujoco.MjModel) -> None:
    if cfg.device == "cpu":
        return
    physics = made(cfg, model)
    physics.step()
    kept, refused = torch.zeros(1, device=physics.device).add_(0), ""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        kept.add_(1)
        try:
            physics.step()
        except RuntimeError as error:
            refused = str(error)
    assert "physics.capture(function)" in refused, refused
    graph.replay()
    physics.step()
    assert float(kept) == 1.0


# Words


def heading(cfg: Config) -> list[str]:
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return [
        "# WarpPhysics: agreement and throughput",
        "",
        f"    python {' '.join([Path(__file__).parent.name + '/' + Path(__file__).name, *sys.argv[1:]])}",
        "",
        f"Commit {commit or 'unknown'}; {gpu}, {os.cpu_count()} CPUs, {platform.system()}; Python "
        f"{platform.python_version()}, {', '.join(versions())}.",
        "",
    ]


def versions() -> Iterator[str]:
    from importlib.metadata import version

    for package in ("mujoco", "mujoco-warp", "warp-lang", "torch"):
        yield f"{package} {version(package)}"


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Config))
