"""The arm's actuation by name: what a recipe's ``--actuation`` means."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from torchrl.envs import Transform

from torchrl_athletic.envs.actuation_chain import actuation_chain, shipped_net
from torchrl_athletic.identification.simulator import Simulator
from torchrl_athletic.robots import Robot


def with_actuation(
    robot: Robot,
    actuation: str,
    *,
    delay: tuple[int, int] = (0, 0),
    arm_power: float | None = 300.0,
    substeps: int = 1,
    seed: int = 0,
    first_row: int = 0,
) -> tuple[Robot, list[Transform]]:
    """A robot as an identified simulator has it, and what stands between position targets and its motors.

    Args:
        robot: As nominal.
        actuation: ``"ideal"`` motors; ``"uan"``, ideal motors that the shipped actuator net corrects; or the folder of
            a :class:`Simulator`: CEM's, a diagnosis', with or without a net.
        delay: Least and greatest delay of actions [torques].
        arm_power: Greatest power of the arm [W]; None sets no limit.
        substeps: Physics steps that each torque is held for.
        seed: Of the delays.
        first_row: Number of the first row, for parts of a larger batch.

    Raises:
        FileNotFoundError: If it is neither of these names nor such a folder.
        ValueError: If what was identified does not fit the robot.

    Example:
        >>> from torchrl_athletic.robots import z1
        >>> [type(part).__name__ for part in with_actuation(z1(), "ideal")[1]]
        ['PowerClip', 'TorqueSpeedClip', 'PDControl', 'Decimation']
    """
    least, greatest = delay
    told: dict[str, Any] = {"max_delay": greatest, "min_delay": least, "seed": seed, "first_row": first_row}
    if actuation in ("ideal", "uan"):
        net = shipped_net("uan", robot) if actuation == "uan" else None
        return robot, actuation_chain(robot, net=net, arm_power=arm_power, **told)
    simulator = Simulator.load(actuation, robot)
    return simulator.robot, simulator.chain(arm_power=arm_power, substeps=substeps, **told)


def actuation_identity(actuation: str) -> str:
    """What tells one actuation from another: its name and, of a simulator's folder, a digest of what lies there.

    A run is gone on with in the simulator that it began in. One that was identified anew in the same folder is another.

    Example:
        >>> actuation_identity("ideal")
        'ideal'
    """
    files = [Path(actuation) / name for name in ("simulator.json", "corrected.json", "net.pt")]
    if actuation in ("ideal", "uan") or not files[0].exists():
        return actuation
    content = hashlib.sha256(b"".join(f.read_bytes() for f in files if f.exists()))
    return f"{actuation} ({content.hexdigest()[:12]})"
