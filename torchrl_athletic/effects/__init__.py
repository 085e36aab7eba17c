"""The catalogue of physics that a model may lack.

One file per family; every effect knows its parameters with units and bounds, its fingerprint in the torque domain, how
to enter a simulation, its sentence, and the experiment that separates it from its rivals.
"""

from torchrl_athletic.effects.change import Disturbance, ThermalDrift
from torchrl_athletic.effects.control import GainMismatch
from torchrl_athletic.effects.coupling import CoupledDrive
from torchrl_athletic.effects.effect import Effect, Fingerprint, Parameter
from torchrl_athletic.effects.elastic import JointSpring, JointStop
from torchrl_athletic.effects.friction import (
    AsymmetricFriction,
    CoulombFriction,
    LoadDependentFriction,
    StribeckFriction,
    ViscousFriction,
)
from torchrl_athletic.effects.gravity import GravityTilt
from torchrl_athletic.effects.inertia import LinkCom, LinkInertia, LinkMass, ReflectedInertia
from torchrl_athletic.effects.nuisance import BaseClockShift, ClockShift, LinkComShift
from torchrl_athletic.effects.payload import OffsetPayload, Payload
from torchrl_athletic.effects.plant import Law, Now, Plant, Start
from torchrl_athletic.effects.presliding import Hysteresis
from torchrl_athletic.effects.sensing import ClockOffset, EncoderOffset, EncoderScale
from torchrl_athletic.effects.signals import JointAddress, Signals, project_recording
from torchrl_athletic.effects.timing import ActuationDelay, ActuationLag
from torchrl_athletic.effects.torque import (
    SpeedTorqueLimit,
    TorqueOffset,
    TorqueRipple,
    TorqueSaturation,
    TorqueScale,
)
from torchrl_athletic.effects.transmission import Backlash, Compliance

CATALOGUE: tuple[Effect, ...] = (
    CoulombFriction(),
    ViscousFriction(),
    StribeckFriction(),
    LoadDependentFriction(),
    AsymmetricFriction(),
    Hysteresis(),
    Backlash(),
    Compliance(),
    CoupledDrive(),
    ReflectedInertia(),
    LinkMass(),
    LinkCom(),
    Payload(),
    OffsetPayload(),
    GravityTilt(),
    ActuationDelay(),
    ActuationLag(),
    TorqueScale(),
    TorqueOffset(),
    TorqueSaturation(),
    SpeedTorqueLimit(),
    TorqueRipple(),
    JointSpring(),
    JointStop(),
    EncoderOffset(),
    EncoderScale(),
    ClockOffset(),
    GainMismatch(),
    ThermalDrift(),
    Disturbance(),
)
"""Every effect that a diagnosis considers unless told otherwise."""

TRIMS: tuple[Effect, ...] = (
    LinkMass(),
    LinkComShift(),
    LinkInertia(),
    EncoderOffset(),
    ClockShift(),
    BaseClockShift(),
)
"""What every model and every log is a little wrong in: adjusted within its tolerance beside the findings."""
FIT_TRIMS: tuple[Effect, ...] = (*TRIMS, TorqueScale())
"""What the fit of a combination adjusts beside it: the trims, and the torque scale."""

__all__ = [
    "CATALOGUE",
    "FIT_TRIMS",
    "TRIMS",
    "ActuationDelay",
    "ActuationLag",
    "AsymmetricFriction",
    "Backlash",
    "BaseClockShift",
    "ClockOffset",
    "ClockShift",
    "Compliance",
    "CoulombFriction",
    "CoupledDrive",
    "Disturbance",
    "Effect",
    "EncoderOffset",
    "EncoderScale",
    "Fingerprint",
    "GainMismatch",
    "GravityTilt",
    "Hysteresis",
    "JointAddress",
    "JointSpring",
    "JointStop",
    "Law",
    "LinkCom",
    "LinkComShift",
    "LinkInertia",
    "LinkMass",
    "LoadDependentFriction",
    "Now",
    "OffsetPayload",
    "Parameter",
    "Payload",
    "Plant",
    "ReflectedInertia",
    "Signals",
    "SpeedTorqueLimit",
    "Start",
    "StribeckFriction",
    "ThermalDrift",
    "TorqueOffset",
    "TorqueRipple",
    "TorqueSaturation",
    "TorqueScale",
    "ViscousFriction",
    "project_recording",
]
