"""The baselines of the paper: cross-entropy method, supervised actuator net, domain randomisation, online adaptation.

They explain a mismatch by numbers alone, which is what ``diagnosis`` is measured against.
"""

from torchrl_athletic.identification.simulator import Simulator, load_net

__all__ = ["Simulator", "load_net"]
