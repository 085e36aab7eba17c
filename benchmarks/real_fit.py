"""The standard joints fitted to five real benches, beside least squares by hand and mujoco.sysid: errors kept aside.

    ATHLETIC_DATA=... python benchmarks/real_fit.py

Ten minutes on two cores. All are scored by one neutral replay: plain MuJoCo with its own actuators, in windows of half
a second from the measured state, over recordings that none of them fitted. The rivals minimise just that error.
mujoco.sysid needs ``pip install "mujoco[sysid]"`` and is left out without, as it is where the list has what it lacks.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import tyro
from mujoco import rollout
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from torchrl_athletic.diagnosis import Fit, fit
from torchrl_athletic.recordings import Recording, split_at_gaps
from torchrl_athletic.recordings.datasets import load_dataset

Array = NDArray[np.float64]

NAMES = ("frictionloss", "damping", "armature", "delay", "limit", "offset", "encoder", "scale", "kp", "kd")
SHORT = ("frictionloss", "damping", "armature", "limit")
"""What most people fit by hand."""
WINDOW = 0.5
"""[s]."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    cases: tuple[str, ...] = ("emps", "two_link_arm:measured", "two_link_arm", "unbalanced_disk", "pendulum", "xl330")
    """Data sets; ``:measured`` drives the simulation with the measured torque."""
    seed: int = 0
    output: Path = Path("benchmarks/results/real_fit.md")
    fits: Path | None = Path("out/real_fit")
    """Where the files of our fits go; None for none."""
    most: int = 100
    """Windows that a rival fits; more are thinned evenly."""


def main(cfg: Config) -> None:
    store = cfg.output.with_suffix(".json")
    rows = json.loads(store.read_text()) if store.exists() else {}
    for case in cfg.cases:
        rows[case] = run(case, cfg)
        store.parent.mkdir(parents=True, exist_ok=True)
        store.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n")
        cfg.output.write_text(table(rows))
        print(table({case: rows[case]}))


def run(case: str, cfg: Config) -> dict[str, Any]:
    """Fit one bench in every way, and score each on what was kept aside."""
    name, _, drive = case.partition(":")
    data = load_dataset(name)
    recordings, heldout = (
        [r.driven_by_measured_torque() if drive else r for r in group] for group in (data.recordings, data.heldout)
    )
    model = mujoco.MjModel.from_xml_string(data.model)
    begin = time.monotonic()
    ours = fit(data.model, recordings, heldout, seed=cfg.seed, output=cfg.fits and cfg.fits / case.replace(":", "_"))
    seconds = {"ours": time.monotonic() - begin}
    train, held = (Replay(model, group) for group in (recordings, heldout))
    thinned = train.thinned(cfg.most)
    points = {"given": train.nominal(), "ours": of_fit(ours, train)}
    for rival, names in (("by hand, 4 numbers", SHORT), ("by hand, the same list", NAMES)):
        begin = time.monotonic()
        points[rival] = by_hand(thinned, [n for n in names if n in train.movable])
        seconds[rival] = time.monotonic() - begin
    begin = time.monotonic()
    sysid = by_sysid(thinned)
    if sysid is not None:
        points["mujoco.sysid"] = sysid
        seconds["mujoco.sysid"] = time.monotonic() - begin
    errors = {who: {"train": _rmse(train, x), "heldout": _rmse(held, x)} for who, x in points.items()}
    return {
        "errors": {who: {k: v[0] for k, v in e.items()} for who, e in errors.items()},
        "medians": {who: {k: v[1] for k, v in e.items()} for who, e in errors.items()},
        "parameters": {who: np.round(x, 9).tolist() for who, x in points.items()},
        "unit": "m" if name == "emps" else "rad",
        "seconds": {who: round(s, 1) for who, s in seconds.items()},
        "remarks": list(ours.remarks),
        "commit": _commit(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


def _rmse(replay: Replay, x: Array) -> tuple[list[float], list[float]]:
    """Root mean square over all windows, and of the median window, of each joint."""
    square = replay.mean_square(x)
    return np.sqrt(square.mean(0)).tolist(), np.sqrt(np.median(square, axis=0)).tolist()


class Replay:
    """Plain MuJoCo: every joint's own actuator takes the logged command; parameters are (10, J), as :data:`NAMES`."""

    def __init__(self, model: mujoco.MjModel, recordings: Sequence[Recording]) -> None:
        self.given, self.names = model, recordings[0].joint_names
        self.joint = [model.joint(n).id for n in self.names]
        self.dof, self.qpos = model.jnt_dofadr[self.joint], model.jnt_qposadr[self.joint]
        self.actuator = [int(np.flatnonzero(model.actuator_trnid[:, 0] == j)[0]) for j in self.joint]
        self.windows = [w for r in recordings for w in self._cut(r)]
        self.targets = any(r.position_target is not None for r in recordings)
        damped = {float(r.kd[0]) if r.kd is not None else 0.0 for r in recordings}
        drive = ("kp", "kd") if len(damped) > 1 else ("kp",)
        self.movable = (*NAMES[:7], *(drive if self.targets else ("scale",)))

    def _cut(self, recording: Recording) -> list[dict[str, Any]]:
        """Windows of half a second, back to back, with states from a smoothed log."""
        out = []
        for r in split_at_gaps(recording):
            period = 1.0 / r.rate
            substeps = int(np.ceil(period / self.given.opt.timestep - 1e-3))
            grid = r.time[0] + period * np.arange(int((r.time[-1] - r.time[0]) / period + 1e-6) + 1)
            q = np.stack([np.interp(grid, r.time, c) for c in r.position.T], -1)
            size = max(5, 2 * round(0.01 / period) + 1)
            smooth = savgol_filter(q, size, 3, axis=0)
            v = savgol_filter(q, size, 3, deriv=1, delta=period, axis=0)
            if r.velocity is not None and period < 0.02:
                v = savgol_filter(np.stack([np.interp(grid, r.time, c) for c in r.velocity.T], -1), size, 3, axis=0)
            length = round(WINDOW / period)
            integral = np.vstack([np.zeros(len(self.names)), np.cumsum(np.diff(r.time)[:, None] * r.command[:-1], 0)])
            for first in range(0, len(grid) - length, length):
                edges = grid[first] + period / substeps * np.arange(length * substeps + 1)
                out.append(
                    {
                        "q": smooth[first],
                        "v": v[first],
                        "measured": q[first + 1 : first + length + 1],
                        "step": period / substeps,
                        "substeps": substeps,
                        "edges": edges,
                        "stamps": r.time,
                        "integral": integral,
                        "gains": None if r.position_target is None else (r.kp, r.kd),
                    }
                )
        return out

    def thinned(self, most: int) -> Replay:
        """A copy with fewer windows."""
        other = object.__new__(Replay)
        other.__dict__.update(self.__dict__)
        chosen = np.linspace(0, len(self.windows) - 1, min(most, len(self.windows))).astype(int)
        other.windows = [self.windows[k] for k in chosen]
        return other

    def nominal(self) -> Array:
        """The given model's parameters. Shape (10, J)."""
        m, one = self.given, np.ones(len(self.dof))
        damping = m.dof_damping.reshape(m.nv, -1)[self.dof, 0]
        given = (m.dof_frictionloss[self.dof], damping, m.dof_armature[self.dof])
        limit = m.actuator_forcerange[self.actuator, 1]
        return np.stack([*given, 0 * one, limit, 0 * one, 0 * one, one, one, one])

    def model(self, x: Array, window: dict[str, Any]) -> mujoco.MjModel:
        """A model with the parameters in it, for one window's step and gains."""
        friction, damping, armature, _, limit, offset, _, scale, kp, kd = x
        m = self.given.__copy__()
        m.opt.timestep = window["step"]
        m.dof_frictionloss[self.dof], m.dof_armature[self.dof] = friction, armature
        m.dof_damping.reshape(m.nv, -1)[self.dof, 0] = damping
        a = self.actuator
        m.actuator_ctrllimited[a] = 0
        m.actuator_biastype[a] = mujoco.mjtBias.mjBIAS_AFFINE
        m.actuator_biasprm[a, 0] = offset
        m.actuator_gainprm[a, 0] = scale
        if window["gains"] is not None:
            m.actuator_gainprm[a, 0] = kp * window["gains"][0]
            m.actuator_biasprm[a, 1] = -kp * window["gains"][0]
            m.actuator_biasprm[a, 2] = -kd * window["gains"][1]
        m.actuator_forcelimited[a] = 1
        m.actuator_forcerange[a] = np.stack([-limit, limit], -1)
        return m

    def errors(self, x: Array) -> list[Array]:
        """Predicted less measured positions of every window. Shapes (length, J)."""
        models: list[mujoco.MjModel] = []
        states: list[Array] = []
        controls: list[Array] = []
        rows_of: dict[Any, list[int]] = {}
        built: dict[Any, mujoco.MjModel] = {}
        encoder = x[NAMES.index("encoder")]
        for w in self.windows:
            gains = None if w["gains"] is None else (*w["gains"][0], *w["gains"][1])
            key = (w["step"], gains, len(w["edges"]))
            rows_of.setdefault(key, []).append(len(models))
            if key not in built:
                built[key] = self.model(x, w)
            models.append(built[key])
            state = np.zeros(1 + self.given.nq + self.given.nv)
            state[1 + self.qpos], state[1 + self.given.nq + self.dof] = w["q"] - encoder, w["v"]
            states.append(state)
            late = w["edges"][:, None] - x[NAMES.index("delay")]
            columns = [np.interp(late[:, j], w["stamps"], w["integral"][:, j]) for j in range(len(self.dof))]
            control = np.zeros((len(late) - 1, self.given.nu))
            control[:, self.actuator] = np.diff(np.stack(columns, -1), axis=0) / w["step"]
            controls.append(control)
        out: list[Array] = [np.zeros(0)] * len(models)
        for rows in rows_of.values():
            data = [mujoco.MjData(models[rows[0]]) for _ in range(os.cpu_count() or 1)]
            path, _ = rollout.rollout(
                models[rows[0]], data, np.stack([states[k] for k in rows]), np.stack([controls[k] for k in rows])
            )
            for k, states_of in zip(rows, path, strict=True):
                w = self.windows[k]
                read = states_of[w["substeps"] - 1 :: w["substeps"], 1 + self.qpos] + encoder
                out[k] = np.nan_to_num(read - w["measured"], nan=10.0, posinf=10.0, neginf=-10.0)
        return out

    def mean_square(self, x: Array) -> Array:
        """Mean square of the error in each window. Shape (W, J)."""
        return np.stack([(e**2).mean(0) for e in self.errors(x)])

    def residual(self, x: Array) -> Array:
        """Whose sum of squares is that of the windows' mean squares."""
        return np.concatenate([(e / np.sqrt(len(e))).ravel() for e in self.errors(x)])


def bounds(replay: Replay) -> tuple[Array, Array, Array]:
    """Wide ones, and a size of each number. Shapes (10, J)."""
    x = replay.nominal()
    limit = x[4]
    one = np.ones_like(limit)
    low = np.stack([0 * one, 0 * one, 0 * one, 0 * one, 0.01 * limit, -limit, -0.5 * one, *[0.05 * one] * 3])
    high = np.stack([limit, 20 * limit, 100 * one, 0.2 * one, limit, limit, 0.5 * one, *[20 * one] * 3])
    size = np.stack([0.02 * limit, 0.02 * limit, 0.01 * one, 0.005 * one, 0.1 * limit, 0.02 * limit, 0.02 * one,
                     *[0.1 * one] * 3])  # fmt: skip
    mass = np.zeros((replay.given.nv, replay.given.nv))
    data = mujoco.MjData(replay.given)
    mujoco.mj_forward(replay.given, data)
    mujoco.mj_fullM(replay.given, data, mass)
    inertia = np.diag(mass)[replay.dof]
    high[2], size[2] = 100 * inertia, 0.1 * inertia
    return low, high, size


def by_hand(replay: Replay, names: Sequence[str]) -> Array:
    """``scipy.optimize.least_squares`` from a sensible guess, as one would write it in an afternoon."""
    low, high, size = bounds(replay)
    x = replay.nominal()
    rows = [NAMES.index(n) for n in names]
    guess = x.copy()
    guess[:3] = np.maximum(guess[:3], 0.3 * size[:3])
    if "limit" in names:  # just below what was asked for, or no slope would show it
        guess[4] = np.minimum(x[4], 0.9 * _asked(replay))

    def residual(z: Array) -> Array:
        y = x.copy()
        y[rows] = z.reshape(len(rows), -1) * size[rows]
        return replay.residual(y)

    begin = np.clip(guess[rows], low[rows] + 1e-6 * size[rows], high[rows] - 1e-6 * size[rows])
    found = least_squares(
        residual, (begin / size[rows]).ravel(), bounds=((low / size)[rows].ravel(), (high / size)[rows].ravel()),
        diff_step=np.full(begin.size, 1e-3), x_scale="jac", max_nfev=40, xtol=1e-4, ftol=1e-4,
    )  # fmt: skip
    x[rows] = found.x.reshape(len(rows), -1) * size[rows]
    return x


def _asked(replay: Replay) -> Array:
    """Largest torque that was asked for."""
    most = np.zeros(len(replay.dof))
    for w in replay.windows:
        command = np.diff(w["integral"], axis=0) / np.diff(w["stamps"])[:, None]
        if w["gains"] is not None:
            command = w["gains"][0] * (command - w["measured"].mean(0))
        most = np.maximum(most, np.abs(command).max(0))
    return most


def by_sysid(replay: Replay) -> Array | None:
    """mujoco.sysid with friction, damping, rotor, scale and offset, one model for all windows; None if it cannot.

    Delays and limits by parameter, logs with several gains or rates are beyond its one model.
    """
    sysid = import_module("mujoco.sysid")
    alike = {(w["step"], len(w["edges"]), w["gains"] is None) for w in replay.windows}
    if not hasattr(sysid, "ParameterDict") or len(alike) > 1 or replay.targets:
        return None
    low, high, size = bounds(replay)
    x, rows = replay.nominal(), [NAMES.index(n) for n in ("frictionloss", "damping", "armature", "offset", "scale")]
    params = sysid.ParameterDict()
    for k in rows:
        begin = np.clip(x[k], low[k] + 0.3 * size[k] * (k < 3), high[k])
        params.add(sysid.Parameter(NAMES[k], begin, low[k], high[k]))
    window = replay.windows[0]

    def build(p: Any, spec: Any = None) -> mujoco.MjModel:
        y = x.copy()
        for k in rows:
            y[k] = np.ravel(p[NAMES[k]].value)
        return replay.model(y, window)

    model = replay.model(x, window)
    mapping = sysid.TimeSeries.compute_all_state_mappings(model)[0]
    trajectories = []
    for w in replay.windows:
        late = np.stack([np.interp(w["edges"], w["stamps"], c) for c in w["integral"].T], -1)
        control = np.zeros((len(late), model.nu))
        control[:-1, replay.actuator] = np.diff(late, axis=0) / w["step"]
        control[-1] = control[-2]
        time = w["step"] * np.arange(len(late))
        state = np.zeros(1 + model.nq + model.nv)
        state[1 + replay.qpos], state[1 + model.nq + replay.dof] = w["q"], w["v"]
        read = np.zeros((len(w["measured"]) + 1, model.nq))
        read[:, replay.qpos] = np.vstack([w["q"], w["measured"]])
        trajectories.append(
            sysid.SystemTrajectory(
                model,
                sysid.TimeSeries.from_control_names(time, control, model),
                sysid.TimeSeries(time[:: w["substeps"]], read, mapping),
                state,
                None,
            )
        )
    residual = _sysid_residual(sysid, params, build, trajectories)
    found, _ = sysid.optimize(params, residual, optimizer="mujoco", verbose=False, max_iters=15, x_scale="jac")
    for k in rows:
        x[k] = np.ravel(found[NAMES[k]].value)
    return x


def _sysid_residual(sysid: Any, params: Any, build: Callable[..., Any], trajectories: Sequence[Any]) -> Any:
    def residual(z: Array, p: Any, **options: Any) -> Any:
        return [sysid.model_residual(z, p, build, t, **options)[0] for t in trajectories], [], []

    return residual


def of_fit(fitted: Fit, replay: Replay) -> Array:
    """Our parameters as the neutral replay takes them. Shape (10, J)."""
    x = replay.nominal()
    row = {"coulomb_friction": 0, "viscous_friction": 1, "reflected_inertia": 2, "actuation_delay": 3,
           "torque_saturation": 4, "torque_offset": 5, "encoder_offset": 6, "torque_scale": 7}  # fmt: skip
    gains = {"kp_scale": 8, "kd_scale": 9}
    for p in fitted.parameters:
        x[gains[p.name] if p.effect == "gain_mismatch" else row[p.effect], replay.names.index(p.joint)] = p.value
    x[4] = np.minimum(x[4] * x[7], replay.nominal()[4])  # the limit comes before the scale
    return x


def table(rows: dict[str, dict[str, Any]]) -> str:
    """The results as Markdown."""
    rivals = list(dict.fromkeys(who for r in rows.values() for who in r["errors"]))
    lines = [
        "Made by `python benchmarks/real_fit.py`. RMSE over 0.5 s windows of recordings kept aside, by one neutral "
        "replay, joint by joint; in brackets that of the median window. The machine was shared: times are upper "
        "bounds.",
        "",
        "| data set | " + " | ".join(rivals) + " | ours / best rival | time: ours, rivals | commit |",
        "|---" * (len(rivals) + 4) + "|",
    ]
    for case, r in rows.items():
        cells = [_cell(r, who) for who in rivals]
        pooled = {who: float(np.sqrt(np.mean(np.square(e["heldout"])))) for who, e in r["errors"].items()}
        best = min(e for who, e in pooled.items() if who not in ("given", "ours"))
        times = ", ".join(f"{s:.0f} s" for s in r["seconds"].values())
        lines.append(f"| {case} | {' | '.join(cells)} | {pooled['ours'] / best:.2f} | {times} | {r['commit']} |")
    remarks = [f"- {case}: {text}" for case, r in rows.items() for text in r["remarks"]]
    return "\n".join([*lines, "", *remarks]).rstrip() + "\n"


def _cell(r: dict[str, Any], who: str) -> str:
    if who not in r["errors"]:
        return ""
    scale, unit = (1e3, "mm" if r["unit"] == "m" else "mrad")
    e, m = (" / ".join(f"{scale * v:.3g}" for v in r[k][who]["heldout"]) for k in ("errors", "medians"))
    return f"{e} ({m}) {unit}"


def _commit() -> str:
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return done.stdout.strip() or os.environ.get("COMMIT", "unknown")


if __name__ == "__main__":
    main(tyro.cli(Config))
