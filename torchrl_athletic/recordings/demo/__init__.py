"""Simulated robots that hide known physics, recorded as real ones are.

Closed-form rigid bodies, an integrator with exact sticking and slipping, and sensors with noise: an independent
witness for the diagnosis, which shares no line with the catalogue of effects nor with MuJoCo.
"""

from torchrl_athletic.recordings.demo.concealed import CONCEALED, Demo, concealed_demo
from torchrl_athletic.recordings.demo.effect import PARAMETERS, HiddenEffect, Machine, machine_with, random_effect
from torchrl_athletic.recordings.demo.robot import Link, Robot, pendulum, slider, two_link_arm
from torchrl_athletic.recordings.demo.simulation import simulate
from torchrl_athletic.recordings.demo.takes import Sensors, excitation_for, make_recordings

__all__ = [
    "CONCEALED",
    "PARAMETERS",
    "Demo",
    "HiddenEffect",
    "Link",
    "Machine",
    "Robot",
    "Sensors",
    "concealed_demo",
    "excitation_for",
    "machine_with",
    "make_recordings",
    "pendulum",
    "random_effect",
    "simulate",
    "slider",
    "two_link_arm",
]
