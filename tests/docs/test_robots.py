"""The page of robots says what the robots hold, and shows pictures that exist."""

import importlib.util
import re
from pathlib import Path

import pytest

from torchrl_athletic.robots import Bucket, b2z1
from torchrl_athletic.robots.arm import BRACES

DOCS = Path(__file__).parents[2] / "docs"
JOINTS = (DOCS / "generated/robots_joints.md").read_text(encoding="utf-8")
PAGE = (DOCS / "robots.md").read_text(encoding="utf-8").replace('--8<-- "docs/generated/robots_joints.md"\n', JOINTS)


@pytest.fixture(scope="module")
def writer():
    spec = importlib.util.spec_from_file_location("robots_page", DOCS / "robots.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_table_of_joints_is_the_robots(writer):
    assert JOINTS in PAGE
    assert writer.joint_table(b2z1()) == JOINTS, "run python docs/robots.py"
    assert PAGE.count("`joint") == len(b2z1().joint_groups["arm"]) + 2  # and twice in the text


def test_every_picture_is_drawn_and_shown(writer):
    shown = set(re.findall(r"\(images/(robots_\w+\.png)\)", PAGE))
    assert shown == {f"robots_{name}.png" for name in writer.PICTURES}
    assert all((DOCS / "images" / name).stat().st_size > 10_000 for name in shown)


def test_every_sensor_is_explained():
    explained = set(re.findall(r"`(\w+)`", PAGE[PAGE.index("## Sensors") : PAGE.index("## Contacts")]))
    assert set(b2z1(tool=Bucket()).sensors) <= explained


def test_the_reinforcement_weighs_what_the_page_says():
    assert f"{sum(brace.mass for braces in BRACES.values() for brace in braces):.3f} kg on links" in PAGE
