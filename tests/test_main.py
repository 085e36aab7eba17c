"""The console script picks the subcommand and hands its flags over."""

import sys
from dataclasses import dataclass
from importlib.metadata import entry_points
from types import ModuleType

import pytest

from torchrl_athletic.training import learn_remainder


@dataclass(frozen=True)
class Config:
    """Say what the model leaves out."""

    model: str = "demo"
    """Path of the MJCF."""
    uan: bool = False
    """Hand what is left to a net."""


@pytest.fixture
def received(monkeypatch):
    """Configs that reached a stand-in for the diagnosis, and what was to learn the remainder."""
    configs = []
    command = ModuleType("torchrl_athletic.diagnosis.command")
    command.Config, command.main = Config, lambda config, *learn: configs.append((config, *learn))
    monkeypatch.setitem(sys.modules, command.__name__, command)
    monkeypatch.setattr("torchrl_athletic.diagnosis.command", command, raising=False)
    return configs


def run(*args):
    [script] = entry_points(group="console_scripts", name="torchrl-athletic")
    script.load()(args)


def test_flags_reach_the_diagnosis(received):
    run("diagnose", "--model", "arm.xml")
    assert received == [(Config(model="arm.xml"),)]


def test_what_is_left_goes_to_a_net_where_that_is_asked(received):
    run("diagnose", "--uan")
    assert received == [(Config(uan=True), learn_remainder)]


def test_help_lists_the_subcommand_with_what_it_does(received, capsys):
    with pytest.raises(SystemExit, match="0"):
        run("--help")
    assert "diagnose" in (shown := capsys.readouterr().out)
    assert "Say what the model leaves out" in shown
    assert received == []


def test_an_unknown_subcommand_is_refused_by_naming_those_that_exist(received, capsys):
    with pytest.raises(SystemExit, match="2"):
        run("diagnoze")
    assert "diagnose" in capsys.readouterr().err
    assert received == []
