"""The catalogue of physics that a model may lack.

One file per family; every effect knows its parameters with units and bounds, its fingerprint in the torque domain, how
to enter a simulation, its sentence, and the experiment that separates it from its rivals.
"""

from torchrl_athletic.effects.control import GainMismatch
from torchrl_athletic.effects.effect import Effect, Fingerprint, Parameter
from torchrl_athletic.effects.friction import AsymmetricFriction, CoulombFriction, ViscousFriction
from torchrl_athletic.effects.inertia import LinkCom, LinkInertia, LinkMass, ReflectedInertia
from torchrl_athletic.effects.nuisance import ClockShift, LinkComShift
from torchrl_athletic.effects.plant import Plant
from torchrl_athletic.effects.sensing import EncoderOffset
from torchrl_athletic.effects.signals import JointAddress, Signals, project_recording
from torchrl_athletic.effects.timing import ActuationDelay, ActuationLag
from torchrl_athletic.effects.torque import TorqueOffset, TorqueScale

CATALOGUE: tuple[Effect, ...] = (
    CoulombFriction(),
    ViscousFriction(),
    AsymmetricFriction(),
    ReflectedInertia(),
    LinkMass(),
    LinkCom(),
    ActuationDelay(),
    ActuationLag(),
    TorqueScale(),
    TorqueOffset(),
    EncoderOffset(),
    GainMismatch(),
)
"""Every effect that a diagnosis considers unless told otherwise."""

__all__ = [
    "CATALOGUE",
    "ActuationDelay",
    "ActuationLag",
    "AsymmetricFriction",
    "ClockShift",
    "CoulombFriction",
    "Effect",
    "EncoderOffset",
    "Fingerprint",
    "GainMismatch",
    "JointAddress",
    "LinkCom",
    "LinkComShift",
    "LinkInertia",
    "LinkMass",
    "Parameter",
    "Plant",
    "ReflectedInertia",
    "Signals",
    "TorqueOffset",
    "TorqueScale",
    "ViscousFriction",
    "project_recording",
]
