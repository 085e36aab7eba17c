"""Answers as a diagnosis would give them, small and synthetic, for every kind of verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from torchrl_athletic.diagnosis.result import (
    Answer,
    Estimate,
    Finding,
    Location,
    Overlay,
    RegimeMap,
    Rival,
    Score,
)

RATE = 250.0
WINDOW = 0.5


@dataclass(frozen=True)
class Sample:
    """What the report gets."""

    answer: Answer
    maps: tuple[RegimeMap, ...]
    overlays: tuple[Overlay, ...]
    model: mujoco.MjModel


SLIDER = """
<mujoco model="emps"><worldbody><body name="carriage"><joint name="carriage" type="slide" axis="1 0 0"/>
  <geom type="box" size=".06 .04 .03" mass="95"/></body></worldbody></mujoco>"""
ARM = """
<mujoco model="two_link_arm"><worldbody><body name="upper_arm"><joint name="shoulder" axis="0 -1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5"/>
  <body name="forearm" pos="0 0 -.3"><joint name="elbow" axis="0 -1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.25" size=".015" mass=".4"/></body></body></worldbody></mujoco>"""


def slider() -> Sample:
    """One slide with direction-dependent friction, and a flexibility that nothing in the catalogue explains."""
    answer = Answer(
        verdict="partly_explained",
        summary=(
            "The model lacks friction that depends on the direction of motion.",
            "On the take kept aside the error falls from 1.05 mm to 0.52 mm over 0.5 s; noise alone leaves 0.06 mm.",
        ),
        findings=(
            Finding(
                effect="asymmetric_friction",
                joint="carriage",
                probability=0.97,
                sentence="Friction on the carriage depends on direction: viscous friction is 166.7 N·s/m forwards and "
                "240.4 N·s/m backwards.",
                parameters={
                    "viscous_forward": Estimate(166.706, (163.2, 170.1), "N·s/m"),
                    "viscous_backward": Estimate(240.424, (236.1, 244.9), "N·s/m"),
                    "coulomb_forward": Estimate(20.144, (19.6, 20.7), "N"),
                    "coulomb_backward": Estimate(20.628, (20.1, 21.2), "N"),
                },
                regime="moving backwards above 0.05 m/s",
                rivals=(
                    Rival(
                        "torque_offset",
                        "carriage",
                        0.02,
                        "Hold the carriage at rest and raise the force slowly both ways: an offset shifts both "
                        "break-away forces, asymmetric friction does not depend on it.",
                    ),
                ),
                energy_share=0.78,
                grounds={
                    "share": 0.97,
                    "left": 0.21,
                    "excess": 4.1,
                    "scatter": 0.06,
                    "open": 0.22,
                    "energy": 0.78,
                    "terms": 1,
                    "strain": 2.0,
                },
            ),
        ),
        locations=(
            Location("carriage", "moving backwards", 0.61, (0.55, 0.67)),
            Location("carriage", "moving forwards", 0.27, (0.22, 0.33)),
            Location("carriage", "acceleration above 2 m/s²", 0.12, (0.04, 0.19)),
        ),
        fit={
            "train": Score(
                0.82e-3, 0.31e-3, 0.05e-3, 0.66, {"carriage": {"before": 0.82e-3, "after": 0.31e-3, "floor": 0.05e-3}}
            ),
            "heldout": Score(
                1.05e-3, 0.52e-3, 0.06e-3, 0.54, {"carriage": {"before": 1.05e-3, "after": 0.52e-3, "floor": 0.06e-3}}
            ),
        },
        unexplained_share=0.22,
        quality={
            "recordings": [
                {
                    "source": "emps.npz",
                    "rate": 1000.0,
                    "duration": 24.84,
                    "masked": {"standstill": 1312, "stroke end": 88},
                    "warnings": [],
                },
                {
                    "source": "emps_pulses.npz",
                    "rate": 1000.0,
                    "duration": 24.84,
                    "masked": {"standstill": 1290},
                    "warnings": ["force saturates at ±351 N in 0.4 % of the samples"],
                },
            ],
            "warnings": [],
            "units": {"carriage": "m"},
        },
        model="emps.xml",
        seed=0,
        remarks=("The pulses of emps_pulses.npz excite a flexibility near 27 Hz that no effect of the catalogue has.",),
    )
    rng = np.random.default_rng(0)

    def friction(v: np.ndarray) -> np.ndarray:
        return np.where(v > 0, 18.0, -18.5) * (np.abs(v) / 0.12)

    maps = tuple(
        _map(rng, "carriage", feature, unit, "N", low, high, shape, noise=2.4, leftover=0.12)
        for feature, unit, low, high, shape in (
            ("position", "m", 0.0, 0.246, lambda x: 2 * np.sin(20 * x)),
            ("speed", "m/s", -0.13, 0.13, friction),
            ("load", "N", -90.0, 90.0, lambda x: 0.08 * x),
            ("acceleration", "m/s²", -3.0, 3.0, lambda x: 1.2 * x),
            ("time", "s", 0.0, 24.8, lambda x: 0.5 + 0 * x),
        )
    )
    overlays = (
        _overlay(rng, "emps.npz", False, 24.8, ("carriage",), (0.12,), (0.82e-3,), (0.31e-3,), 2e-6),
        _overlay(rng, "emps_pulses.npz", True, 24.8, ("carriage",), (0.12,), (1.05e-3,), (0.52e-3,), 2e-6),
    )
    return Sample(answer, maps, overlays, mujoco.MjModel.from_xml_string(SLIDER))


def arm() -> Sample:
    """Two hinges, two findings, each with a rival."""
    answer = Answer(
        verdict="explained",
        summary=(
            "Two effects are missing: dry friction in the elbow and the rotor's inertia at the shoulder.",
            "Together they close 93 % of the gap on recordings kept aside.",
        ),
        findings=(
            Finding(
                "coulomb_friction",
                "elbow",
                0.98,
                "The elbow has dry friction of 0.078 N·m that the model does not have.",
                {"torque": Estimate(0.0783, (0.0741, 0.0826), "N·m")},
                "everywhere in motion",
                (
                    Rival(
                        "load_dependent_friction",
                        "elbow",
                        0.06,
                        "Repeat the sine with 0.5 kg at the hand: dry friction stays, load-dependent friction grows.",
                    ),
                ),
                0.71,
            ),
            Finding(
                "reflected_inertia",
                "shoulder",
                0.84,
                "The shoulder accelerates as if 2.76e-3 kg·m² of rotor inertia were added behind the gear.",
                {"inertia": Estimate(0.00276, (0.00251, 0.00302), "kg·m²")},
                "accelerations above 20 rad/s²",
                (
                    Rival(
                        "link_mass",
                        "forearm",
                        0.12,
                        "Record the arm stretched and folded: link mass changes the gravity torque, a rotor does not.",
                    ),
                    Rival(
                        "torque_scale",
                        "shoulder",
                        0.03,
                        "Hold three static poses: a torque scale is wrong at rest too, inertia only in acceleration.",
                    ),
                ),
                0.64,
            ),
        ),
        locations=(
            Location("elbow", "everywhere", 0.69, (0.62, 0.75)),
            Location("shoulder", "everywhere", 0.3, (0.25, 0.38)),
            Location("elbow", "below 2 rad/s", 0.58, (0.51, 0.65)),
            Location("shoulder", "accelerations above 20 rad/s²", 0.31, (0.25, 0.36)),
            Location("elbow", "accelerations above 20 rad/s²", 0.11, (0.07, 0.15)),
        ),
        fit={
            "train": Score(
                0.197,
                0.027,
                0.012,
                0.92,
                {
                    "shoulder": {"before": 0.080, "after": 0.018, "floor": 0.009},
                    "elbow": {"before": 0.267, "after": 0.034, "floor": 0.014},
                },
            ),
            "heldout": Score(
                0.217,
                0.027,
                0.013,
                0.93,
                {
                    "shoulder": {"before": 0.082, "after": 0.019, "floor": 0.009},
                    "elbow": {"before": 0.296, "after": 0.033, "floor": 0.016},
                },
            ),
        },
        unexplained_share=0.04,
        quality={
            "recordings": [
                {
                    "source": f"multisine_{i}.csv",
                    "rate": 499.8,
                    "duration": 10.0,
                    "masked": {"gap": 3 * i, "stall": 41},
                    "warnings": ["jitter of 0.6 ms (30 % of a sample)"] if i == 2 else [],
                }
                for i in range(1, 6)
            ],
            "warnings": ["The velocity of elbow lags its position by 2 ms; positions are used."],
        },
        model="two_link_arm.xml",
        seed=1,
    )
    rng = np.random.default_rng(1)
    shapes = {
        "elbow": (
            lambda v: -0.078 * np.tanh(v / 0.3),
            lambda x: 0.01 * np.sin(x),
            lambda x: 0.004 * x,
            lambda x: 2e-4 * x,
        ),
        "shoulder": (
            lambda v: -0.01 * np.tanh(v),
            lambda x: 0.02 * np.sin(x),
            lambda x: 0.01 * x,
            lambda x: 2.76e-3 * x,
        ),
    }
    maps = tuple(
        _map(rng, joint, feature, unit, "N·m", -high, high, shape, noise=0.02, leftover=0.08)
        for joint, row in shapes.items()
        for (feature, unit, high), shape in zip(
            (
                ("speed", "rad/s", 12.0),
                ("position", "rad", 3.0),
                ("load", "N·m", 2.0),
                ("acceleration", "rad/s²", 60.0),
            ),
            row,
            strict=True,
        )
    )
    joints = ("shoulder", "elbow")
    overlays = tuple(
        _overlay(rng, f"multisine_{i}.csv", i > 3, 10.0, joints, (0.9, 1.4), (0.082, 0.296), (0.019, 0.033), 5e-4)
        for i in range(1, 6)
    )
    return Sample(answer, maps, overlays, mujoco.MjModel.from_xml_string(ARM))


def nothing_missing() -> Sample:
    """A model that is right: everything lies within the noise."""
    s = arm()
    same = {joint: {"before": 0.0131, "after": 0.0131, "floor": 0.0127} for joint in ("shoulder", "elbow")}
    answer = replace(
        s.answer,
        verdict="nothing_missing",
        findings=(),
        locations=(),
        unexplained_share=0.0,
        summary=(
            "The model explains the recordings down to sensor noise: 13.1 mrad over 0.5 s, noise alone 12.7 mrad.",
        ),
        fit={split: Score(0.0131, 0.0131, 0.0127, 0.0, same) for split in ("train", "heldout")},
        quality={**s.answer.quality, "warnings": []},
    )
    rng = np.random.default_rng(2)
    maps = tuple(
        _map(rng, joint, "speed", "rad/s", "N·m", -12.0, 12.0, lambda x: 0 * x, noise=0.02, leftover=1.0)
        for joint in ("shoulder", "elbow")
    )
    overlays = (
        _overlay(
            rng, "multisine_4.csv", True, 10.0, ("shoulder", "elbow"), (0.9, 1.4), (0.013, 0.013), (0.013, 0.013), 5e-4
        ),
    )
    return Sample(answer, maps, overlays, s.model)


def unexplained() -> Sample:
    """A difference that no effect of the catalogue explains; the best partial match is not stated as the cause."""
    s = arm()
    score = Score(
        0.217,
        0.188,
        0.013,
        0.14,
        {
            "shoulder": {"before": 0.082, "after": 0.081, "floor": 0.009},
            "elbow": {"before": 0.296, "after": 0.253, "floor": 0.016},
        },
    )
    answer = replace(
        s.answer,
        verdict="unexplained",
        findings=(),
        fit={"train": score, "heldout": score},
        unexplained_share=0.83,
        summary=(
            "The elbow needs up to 0.08 N·m more than the model gives, and no effect of the catalogue explains why.",
        ),
        remarks=("The best partial match, hysteresis of the elbow, explains 17 % of the error: it is not the cause.",),
    )
    maps = tuple(replace(m, after=0.85 * m.before, after_band=0.85 * m.before_band) for m in s.maps)
    overlays = tuple(replace(o, after=o.measured + 0.87 * (o.before - o.measured)) for o in s.overlays)
    return Sample(answer, maps, overlays, s.model)


def partial() -> Sample:
    """A run stopped during the fit: no held-out score, no overlays yet."""
    s = arm()
    answer = replace(
        s.answer,
        complete=False,
        stage="simulate",
        verdict="partly_explained",
        unexplained_share=0.31,
        findings=(replace(s.answer.findings[0], probability=0.7, rivals=()),),
        fit={"train": s.answer.fit["train"]},
        summary=("So far, dry friction in the elbow explains most of the error.",),
    )
    return Sample(answer, s.maps[:4], (), s.model)


SAMPLES = {f.__name__: f for f in (slider, arm, nothing_missing, unexplained, partial)}


def _map(rng, joint, feature, unit, torque_unit, low, high, shape, noise, leftover) -> RegimeMap:
    centre = np.linspace(low, high, 25)[1:-1]
    width = 0.25 * noise * (1 + 1.5 * np.abs(np.linspace(-1, 1, 23)) ** 3)
    before = shape(centre) + 0.4 * width * rng.standard_normal(23)
    after = leftover * shape(centre) + 0.4 * width * rng.standard_normal(23)
    band = np.stack((-width, width), axis=1)
    return RegimeMap(
        joint, feature, unit, torque_unit, centre, before, before[:, None] + band, after, after[:, None] + band, noise
    )


def _overlay(rng, source, heldout, duration, joints, amplitude, rmse_before, rmse_after, noise) -> Overlay:
    time = np.arange(0, duration, 1 / RATE)
    phase = 2 * np.pi * rng.uniform(size=(3, len(joints)))
    tones = np.array([0.31, 0.83, 1.9])[:, None]
    share = np.array([0.6, 0.3, 0.1])[:, None]
    angle = 2 * np.pi * tones[:, None] * time[None, :, None] + phase[:, None]
    truth = (share[:, None] * np.sin(angle)).sum(0) * amplitude
    windows = (int(np.ceil(duration / WINDOW)), len(joints))
    push = rng.choice([-1, 1], windows) * rng.uniform(0.5, 1.5, windows)
    drift = ((time % WINDOW) / WINDOW)[:, None] ** 2 * np.repeat(push, int(WINDOW * RATE), axis=0)[: len(time)]
    drift /= np.sqrt((drift**2).mean(axis=0))
    measured = truth + noise * rng.standard_normal(truth.shape)
    return Overlay(
        source, heldout, time, tuple(joints), measured, truth + drift * rmse_before, truth + drift * rmse_after
    )
