"""Motors and hobby servos on a pendulum or with a bare horn."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from benchmarks.real_robots.robots.robot import (
    LOOKED,
    UNSEEN,
    Robot,
    without_shapes,
)
from torchrl_athletic.recordings import Recording


def go1(data: Path) -> Robot:
    """Motor of a Go1 with an arm of 0.15 m and 0, 1, 2 or 3 kg at its end; 2 kg kept aside. 62 Hz.

    The logged speed is a seventh of the position's slope, and is left out.
    """
    paths = sorted((data / "bam/example_data/data_raw_go1").glob("*.json"))
    takes = [take for path in paths for take in _servo_takes(path)]
    return _loaded_pendulum(
        takes, arm_mass=0.078, length=0.15, kp=10.0, kv=0.3, limit=23.7, aside=2.0, looked_at=LOOKED
    )


def sts(data: Path, motor: str) -> Robot:
    """A hobby servo, STS3215 or the stronger STS3250, that swings 0.5 to 1.2 kg on 150 mm: 100 Hz, 120 logs of 6 s.

    Six firmware gains and five motions, the first of four repetitions each; 0.97 kg kept aside. A unit of the gain is
    turned into N m/rad by the duty per error, the resistance and the torque constant of the authors' configurations,
    at 12 V; the damping by the same constants is left out. Torques at a standstill are those on the servos' data
    sheets, 30 and 50 kg cm. Lost readings of -180 degrees, in one log of six, are bridged for all who fit alike.
    """
    folder, duty, resistance, stall = {
        "STS3215": ("STS_3215_12V_20250317", 0.16489, 1.0, 2.94),
        "STS3250": ("STS_3250", 0.16383, 1.2, 4.90),
    }[motor]
    stiffness = duty * 12.0 * 1.0787 / resistance
    first: dict[tuple[Any, ...], Path] = {}
    for path in sorted((data / "sysid/data/feetech" / folder / "raw").glob("*.json")):
        log = json.loads(path.read_text())
        if log["length"] == 0.15:
            first.setdefault((log["mass"], log["kp"], log["trajectory"]), path)
    takes = [take for path in first.values() for take in _servo_takes(path, stiffness)]
    return _loaded_pendulum(takes, 0.05, 0.15, 16 * stiffness, 0.0, stall, aside=0.969, looked_at="no")


def miuzei(data: Path) -> Robot:
    """A Miuzei hobby servo with a weight on an arm, position targets at 50 Hz: 1 to 3 s each, shorter takes left out.

    Of the distinct motions every fourth is kept aside with all its repetitions. Gains and limit are those of the
    authors' MJCF, without its filter of 0.1 s. Angles are logged in half turns.
    """
    home = data / "servo-sysid/src/sysid"
    spec = mujoco.MjSpec.from_string(without_shapes(home / "desc/robot.xml"))
    spec.delete(spec.actuators[0])
    servo = spec.add_actuator(name="servo", target="servo", trntype=mujoco.mjtTrn.mjTRN_JOINT, forcerange=(-2.7, 2.7))
    servo.set_to_position(kp=25.0, kv=5.0)
    spec.compile()
    motions: dict[tuple[float, ...], list[Recording]] = {}
    for k, row in enumerate(json.loads((home / "dataset/response.json").read_text())["data"]):
        if len(row["actions"]) >= 50:
            target, angle = (
                np.pi * np.array(row[name], dtype=np.float64)[:, None] for name in ("actions", "sensor_data")
            )
            take = Recording(
                0.02 * np.arange(len(angle), dtype=np.float64), ("servo",), angle, position_target=target,
                kp=np.array([25.0]), kd=np.array([5.0]), source=f"{k}_{row['type']}",
            )  # fmt: skip
            motions.setdefault(tuple(row["actions"]), []).append(take)
    groups: tuple[list[Recording], list[Recording]] = ([], [])
    for k, takes in enumerate(motions.values()):
        groups[k % 4 == 3].extend(takes)
    return Robot(spec.to_xml(), *groups, LOOKED)


def mx106(data: Path, motor: int) -> Robot:
    """Dynamixel MX-106 with a bare horn, steps and triangles at 100 Hz; sines and the third repeat are kept aside.

    Gains and limit are those that its owners fitted for their humanoid, without their friction, delay and backlash. The
    model has no rotor: a horn of 15 g is all that moves. One row in a hundred has no reading. Stamps are those of the
    commands; readings come 2 to 4 ms later.
    """
    xml = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
      <joint name="horn" axis="0 0 1"/><inertial pos="0 0 0" mass="0.015" diaginertia="2e-6 2e-6 2e-6"/>
      </body></worldbody><actuator><motor joint="horn" ctrlrange="-5.5 5.5"/></actuator></mujoco>"""
    home = data / f"Jandi_real2sim/data/raw/mode5/mode5_mx106_ID_{motor}/no_load"

    def take(kind: str, repeat: int) -> Recording:
        rows = np.genfromtxt(home / f"{kind}/repeat_{repeat}/telemetry.csv", delimiter=",", names=True)
        time, reading, target = (rows[name] for name in ("time_s", "q_present_rad", "q_cmd_rad"))
        read = np.isfinite(reading)
        position = np.interp(time, time[read], reading[read])
        return Recording(
            time, ("horn",), position[:, None], position_target=target[:, None], kp=np.array([6.0]),
            kd=np.array([0.6]), source=f"mx106_{motor}_{kind}_{repeat}",
        )  # fmt: skip

    fitted = [take(kind, repeat) for kind in ("step", "triangle") for repeat in (1, 2)]
    return Robot(xml, fitted, [take(kind, 3) for kind in ("step", "triangle", "sine")], UNSEEN)


def _servo_takes(path: Path, stiffness: float = 1.0) -> list[Recording]:
    """A log of bam's format, parted where the motor is let go.

    Args:
        path: Of a log.
        stiffness: Of one unit of its gain [N m/rad].
    """
    log = json.loads(path.read_text())
    rows: list[Mapping[str, Any]] = log["entries"]
    on = np.array([row["torque_enable"] for row in rows])
    takes = []
    for driven in (True, False):
        part = [row for row, o in zip(rows, on, strict=True) if o == driven]
        if len(part) < 100:
            continue
        time, position, target = (
            np.array([float(row[k]) for row in part]) for k in ("timestamp", "position", "goal_position")
        )
        lost = np.abs(np.abs(position) - np.pi) < 0.002  # a reading of nothing, where the arm cannot be
        recording = Recording(
            time, ("motor",), np.interp(time, time[~lost], position[~lost])[:, None], position_target=target[:, None],
            kp=np.array([log["kp"] * stiffness * driven]), kd=np.array([log.get("damping", 0.0) * driven]),
            metadata={"payload_kg": log["mass"]}, source=f"{path.stem}_{'driven' if driven else 'released'}",
        )  # fmt: skip
        takes.append(recording)
    return takes


def _loaded_pendulum(
    takes: Sequence[Recording],
    arm_mass: float,
    length: float,
    kp: float,
    kv: float,
    limit: float,
    *,
    aside: float,
    looked_at: str,
) -> Robot:
    """A motor that swings an arm with a payload at its end, of which one is kept aside.

    Args:
        takes: What was recorded.
        arm_mass: Of the arm alone [kg].
        length: Of the arm [m].
        kp: Of recordings that have no gain [N m/rad].
        kv: As well [N m s/rad].
        limit: Of the torque [N m].
        aside: Payload [kg].
        looked_at: As of :class:`Robot`.
    """

    def pendulum(payload: float) -> str:
        """The payload is a body of its own, so that what a fit says of the arm's mass is said of the arm."""
        about = arm_mass / 12 * length**2
        end = f'<body pos="0 0 {-length}"><inertial pos="0 0 0" mass="{payload}" diaginertia="1e-9 1e-9 1e-9"/></body>'
        return f"""<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
          <joint name="motor" axis="0 1 0"/><site name="end" pos="0 0 {-length}"/>
          <inertial pos="0 0 {-length / 2}" mass="{arm_mass}" diaginertia="{about} {about} {0.01 * about}"/>
          {end if payload else ""}</body></worldbody>
          <actuator><position joint="motor" kp="{kp}" kv="{kv}" forcerange="-{limit} {limit}"/></actuator></mujoco>"""

    def model_of(recording: Recording) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_string(pendulum(float(recording.metadata["payload_kg"])))

    fitted, held = ([t for t in takes if (t.metadata["payload_kg"] == aside) == out] for out in (False, True))
    return Robot(pendulum(0.0), fitted, held, looked_at, model_of=model_of)
