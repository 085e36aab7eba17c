"""Find out why a MuJoCo simulation and a real robot disagree, correct it, train in the corrected one."""

__version__ = "0.1.0"
