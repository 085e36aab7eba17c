"""Where the pre-training's reward itself has the hand, by several readings of two terms that the paper leaves open.

    python benchmarks/reward_optimum.py

The paper prints a sum over key points "up to three", a third each, but speaks of four; and bare bars about the joints'
deviation from the default pose, which may be a sum of absolute values (as its table of the UAN says of such bars) or a
length. For goals of the command ranges, the joints and the base's height, roll and pitch are sought, by gradients from
many starts, at which tracking less deviation pays most, with all feet on level ground, at any height of the base. It
rolls and pitches by 0.4 rad at most each, by 0.12, or not at all. Nothing moves, nothing collides and no other term
counts. "Gain" is what the second half of the starts added to the reward: near 0 the search is done.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import torch
import tyro
from torch import Tensor
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[1]))

from benchmarks.by_case import commit
from torchrl_athletic.functional import rotations, streams
from torchrl_athletic.functional.commands import CommandName, command_ranges, goal_to_pose
from torchrl_athletic.functional.rewards import WBC_SCALES
from torchrl_athletic.recordings.whole_file import whole_file
from torchrl_athletic.robots import b2z1
from torchrl_athletic.robots.b2z1 import FOOT_RADIUS, LEGS

LENGTH = 0.3
"""Length of the key points' axes [m]."""
HEIGHT = (0.35, 0.68)
"""Least and greatest height of the base [m]."""
TILTS = {"by 0.4 rad at most": 0.4, "by 0.12 rad at most": 0.12, "not": 0.0}
"""Greatest roll and greatest pitch of the base [rad]."""
GROUND = (10.0, 2000.0)
"""Price of a foot off the ground, by its square, at first and at last [1/m²]: a base that must not lift a foot at all
would hardly be moved."""
Deviation = Callable[[Tensor], Tensor]
Chain = list[tuple[Tensor, Tensor, Tensor | None, int]]
"""From the base to a site: place, attitude, axis and number of each joint."""


@dataclass(frozen=True)
class Config:
    commands: CommandName = "box"
    """Goals of the hand, as of ``recipes/pretrain_wbc.py``."""
    goals: int = 100
    """How many."""
    starts: int = 64
    """Starts of the search for each goal."""
    steps: int = 400
    """Steps of each search."""
    seed: int = 0
    """Seed of goals and starts."""
    output: Path = Path("benchmarks/results/reward_optimum.md")


@dataclass(frozen=True)
class Reading:
    """What the two terms may mean."""

    words: str
    weight: float
    """Of each of the four key points."""
    deviation: Deviation


def total(change: Tensor) -> Tensor:
    """Sum of absolute values, rounded at 0 for the gradient."""
    return (change.square() + 1e-8).sqrt().sum(-1)


def length(change: Tensor) -> Tensor:
    """Length, rounded at 0 for the gradient."""
    return (change.square().sum(-1) + 1e-6).sqrt()


READINGS = (
    Reading("mean of four key points, sum of absolute deviations", 1 / 4, total),
    Reading("a third of each key point, sum of absolute deviations (ours)", 1 / 3, total),
    Reading("mean of four key points, length of the deviation", 1 / 4, length),
    Reading("a third of each key point, length of the deviation", 1 / 3, length),
)


class Body:
    """The robot's kinematics in torch: joint angles, base height, roll and pitch to hand and feet."""

    def __init__(self) -> None:
        robot = b2z1()
        self.model = robot.model()
        self.names = robot.joint_names
        self.pose = torch.tensor(robot.default_pose)
        self.limits = torch.tensor(robot.position_limit).T
        self.feet = [self._chain(f"{leg}_foot") for leg in LEGS]
        self.hand = self._chain("end_effector")

    def _chain(self, name: str) -> Chain:
        model, site = self.model, self.model.site(name)
        body = site.bodyid[0]
        links: Chain = [(torch.tensor(site.pos).float(), torch.tensor(site.quat).float(), None, -1)]
        while model.body_parentid[body] != 0:
            axis, number = None, -1
            if model.body_jntnum[body]:
                joint = model.joint(model.body_jntadr[body])
                axis, number = torch.tensor(joint.axis).float(), self.names.index(joint.name)
            place, attitude = (torch.tensor(value[body]).float() for value in (model.body_pos, model.body_quat))
            links.append((place, attitude, axis, number))
            body = model.body_parentid[body]
        return links[::-1]

    def place(self, chain: Chain, q: Tensor, base: Tensor) -> tuple[Tensor, Tensor]:
        """Position [m] and quaternion of a site. Joints (*B, J) and base (*B, 3) to (*B, 3) and (*B, 4)."""
        zero = torch.zeros_like(base[..., :1])
        position = torch.cat((zero, zero, base[..., :1]), -1)
        attitude = rotations.multiply(_turn(base[..., 2], (0.0, 1.0, 0.0)), _turn(base[..., 1], (1.0, 0.0, 0.0)))
        for offset, quaternion, axis, number in chain:
            position = position + rotations.rotate(attitude, offset.expand_as(position))
            attitude = rotations.multiply(attitude, quaternion.expand_as(attitude))
            if axis is not None:
                attitude = rotations.multiply(attitude, _turn(q[..., number], axis.tolist()))
        return position, attitude


def _turn(angle: Tensor, axis: list[float] | tuple[float, ...]) -> Tensor:
    half = angle.unsqueeze(-1) / 2
    return torch.cat((half.cos(), half.sin() * torch.tensor(axis)), -1)


def keypoints(position: Tensor, attitude: Tensor) -> Tensor:
    return rotations.keypoints(position, rotations.matrix(attitude), LENGTH)


@dataclass(frozen=True)
class Optimum:
    """At what pays most, goal by goal."""

    attitude: Tensor
    """Error [rad]. Shape (G,)."""
    keypoints: Tensor
    """Mean distance of the four [m]. Shape (G,)."""
    reward: Tensor
    """Of the two terms, less what feet off the ground cost. Shape (G,)."""
    tilt: Tensor
    """Of the base, roll and pitch [rad]. Shape (G, 2)."""
    gain: float
    """What the second half of the starts added to the mean reward."""


def best(reading: Reading, kind: str, cfg: Config, tilt: float = 0.4) -> Optimum:
    """Search for all goals at once, with a base that rolls and pitches by so much at most [rad]."""
    low, high = torch.tensor([[HEIGHT[0], -tilt, -tilt], [HEIGHT[1], tilt, tilt]])
    body, ranges = Body(), command_ranges(kind)
    drawn, _ = ranges.draw(streams.stream(cfg.seed, torch.arange(cfg.goals)))
    pose = goal_to_pose(drawn, torch.tensor(ranges.shoulder))
    above = torch.tensor([0.0, 0.0, ranges.frame_height])
    goal = keypoints(pose[:, :3] + above, pose[:, 3:]).repeat(cfg.starts, 1, 1)
    generator = torch.Generator().manual_seed(cfg.seed)
    rows = cfg.goals * cfg.starts
    shaken = 0.4 * torch.randn(rows, len(body.names), generator=generator)
    shaken[: cfg.goals] = 0.0
    shaken[:, [k for k, name in enumerate(body.names) if name[:2] in LEGS]] *= 0.25
    q = (body.pose + shaken).clamp(*body.limits).requires_grad_()
    base = torch.tensor([0.55, 0.0, 0.0]).repeat(rows, 1).requires_grad_()
    search = torch.optim.Adam([q, base], lr=0.03)

    def paid(share: float) -> tuple[Tensor, Tensor]:
        way = keypoints(*body.place(body.hand, q, base)) - goal
        near = torch.exp(-2 * (way.square().sum(-1) + 1e-10).sqrt()).sum(-1)
        lifted = torch.stack([body.place(foot, q, base)[0][..., 2] - FOOT_RADIUS for foot in body.feet], -1)
        price = WBC_SCALES["joint_deviation"] * reading.deviation(q - body.pose)
        reward = WBC_SCALES["ee_pose_tracking"] * reading.weight * near + price
        ground = GROUND[0] * (GROUND[1] / GROUND[0]) ** share
        return reward - ground * lifted.square().sum(-1), way

    for step in tqdm(range(cfg.steps), desc=f"{kind}, {tilt:g} rad, {reading.words}", leave=False):
        search.param_groups[0]["lr"] = 0.03 * (1 - step / cfg.steps) + 1e-4
        search.zero_grad()
        (-paid(step / cfg.steps)[0].sum()).backward()
        search.step()
        with torch.no_grad():
            q.copy_(q.clamp(*body.limits))
            base.copy_(base.clamp(low, high))
    with torch.no_grad():
        reward, way = paid(1.0)
        by_start = reward.view(cfg.starts, cfg.goals)
        most, chosen = by_start.max(0)
        row = chosen * cfg.goals + torch.arange(cfg.goals)
        way = way[row]
        turned = (way[:, 1:] - way[:, :1]).flatten(1).norm(dim=-1) / (LENGTH * 8**0.5)
        half = by_start[: max(1, cfg.starts // 2)].amax(0)
        attitude, gain = 2 * turned.clamp(max=1).asin(), float((most - half).mean())
        return Optimum(attitude, way.norm(dim=-1).mean(-1), most, base[row, 1:].clone(), gain)


def main(cfg: Config) -> None:
    torch.set_num_threads(1)
    figures = ("attitude, mean [rad]", "95 %", "median", "over 0.15 rad", "key points [cm]", "gain")
    head = ("reading", "the base rolls and pitches", "tilts, in the mean [rad]", *figures)
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for reading, (words, tilt) in product(READINGS, TILTS.items()):
        found = best(reading, cfg.commands, cfg, tilt)
        attitude = found.attitude
        cells = [
            reading.words,
            words,
            f"{float(found.tilt.norm(dim=-1).mean()):.2f}",
            f"{float(attitude.mean()):.3f}",
            f"± {1.96 * float(attitude.std()) / cfg.goals**0.5:.3f}",
            f"{float(attitude.median()):.3f}",
            f"{float((attitude > 0.15).float().mean()):.0%}",
            f"{100 * float(found.keypoints.mean()):.1f}",
            f"{found.gain:.4f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    flag = "" if cfg.commands == "box" else f" --commands {cfg.commands}"
    told = f"`python benchmarks/reward_optimum.py{flag}`, {cfg.goals} goals, {cfg.starts} starts, commit {commit()}."
    title = f"Where the reward has the hand, goals `{cfg.commands}`:"
    with whole_file(cfg.output) as part:
        part.write_text("\n".join([title, "", *lines, "", told, ""]), encoding="utf-8")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
