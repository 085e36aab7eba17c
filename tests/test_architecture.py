"""The house keeps its order: who may know whom, what an import costs, what is packed, and that examples run."""

import ast
import doctest
import importlib
import importlib.util
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

import torchrl_athletic

ROOT = Path(__file__).parents[1]
PACKAGE = Path(torchrl_athletic.__file__).parent  # as installed

ROOMS = (  # a room may import only rooms above it
    "functional",
    "transforms",
    "losses",
    "networks",
    "testing",
    "robots",
    "physics",
    "envs",
    "recordings",
    "effects",
    "diagnosis",
    "identification",
    "training",
)
TENSORS = {"torch", "tensordict", "torchrl"}
LIBRARIES = {  # all that these rooms may import from other projects
    "functional": {"torch"},
    "transforms": TENSORS,
    "losses": TENSORS,
    "networks": TENSORS | {"numpy"},  # which keeps the shipped ones
    "testing": TENSORS | {"pytest"},
    "recordings": {"numpy", "scipy", "h5py", "mcap", "mcap_ros2", "pyarrow", "rosbags"},
}
MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))


def name_of(module: Path) -> str:
    """``effects/friction.py`` -> ``torchrl_athletic.effects.friction``."""
    return ".".join(("torchrl_athletic", *module.with_suffix("").parts)).removesuffix(".__init__")


def imports(source: str, package: str) -> Iterator[str]:
    """Every module that the source imports, wherever in it, as an absolute name with what is taken from it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            origin = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            yield from (f"{origin}.{alias.name}" for alias in node.names)


def imports_of(module: Path) -> Iterator[str]:
    name = name_of(module)
    package = name if module.name == "__init__.py" else name.rpartition(".")[0]
    return imports((PACKAGE / module).read_text(), package)


def breaches(room: str, imported: Iterator[str]) -> set[str]:
    """Imports that a module of the room may not have."""
    above = ROOMS[: ROOMS.index(room) + 1]
    allowed = LIBRARIES.get(room)
    found = set()
    for name in imported:
        top, _, rest = name.partition(".")
        if top == "torchrl_athletic":
            ours = rest.partition(".")[0]
            if ours in ROOMS and ours not in above:
                found.add(name)
        elif allowed is not None and top not in allowed | sys.stdlib_module_names:
            found.add(name)
    return found


@pytest.mark.parametrize(
    ("room", "source", "breach"),
    [
        ("effects", "from torchrl_athletic.diagnosis import diagnose", "torchrl_athletic.diagnosis.diagnose"),
        ("effects", "from ..diagnosis.gates import adequacy", "torchrl_athletic.diagnosis.gates.adequacy"),
        ("effects", "from torchrl_athletic import training", "torchrl_athletic.training"),
        ("transforms", "def f():\n    import mujoco.viewer", "mujoco.viewer"),
        ("functional", "from tensordict import TensorDict", "tensordict.TensorDict"),
    ],
)
def test_a_breach_of_the_order_is_seen(room, source, breach):
    assert breaches(room, imports(source, f"torchrl_athletic.{room}")) == {breach}


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_rooms_above_it_and_the_libraries_it_may(room):
    modules = [module for module in MODULES if module.parts[0] == room]
    assert modules
    found = {str(module): breach for module in modules if (breach := breaches(room, imports_of(module)))}
    assert not found


def test_every_folder_of_the_package_is_a_room():
    assert {module.parts[0] for module in MODULES if len(module.parts) > 1} == set(ROOMS)


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_a_module_says_what_it_is(module):
    assert (ast.get_docstring(ast.parse((PACKAGE / module).read_text())) or "").strip()


@pytest.mark.parametrize("room", ROOMS)
def test_what_a_room_offers_exists_and_what_it_takes_in_is_offered(room):
    module = importlib.import_module(f"torchrl_athletic.{room}")
    offered = getattr(module, "__all__", [])
    assert [name for name in offered if not hasattr(module, name)] == []
    assert len(set(offered)) == len(offered)
    tree = ast.parse(Path(module.__file__).read_text())
    taken = {
        alias.asname or alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert {name for name in taken if not name.startswith("_") and name != "annotations"} <= set(offered)


@pytest.mark.parametrize("module", [m for m in MODULES if ">>>" in (PACKAGE / m).read_text()], ids=str)
def test_examples_in_docstrings_do_what_they_show(module, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    failed, _ = doctest.testmod(importlib.import_module(name_of(module)), optionflags=options)
    assert failed == 0, capsys.readouterr().out


@pytest.mark.parametrize(
    ("imported", "absent"),
    [
        (["torchrl_athletic"], ["numpy", "torch", "mujoco", "matplotlib", "wandb", "pyarrow"]),
        (["torchrl_athletic.__main__"], ["numpy", "torch", "mujoco", "tyro"]),
        (["torchrl_athletic.recordings"], ["torch", "mujoco", "matplotlib", "h5py", "mcap", "pyarrow", "rosbags"]),
        ([f"torchrl_athletic.{room}" for room in ROOMS], ["matplotlib", "wandb", "mujoco_warp", "mcap", "rosbags"]),
    ],
    ids=["package", "command line", "recordings", "all rooms"],
)
def test_an_import_stays_light(imported, absent):
    code = f"import sys, {', '.join(imported)}; print([name for name in {absent!r} if name in sys.modules])"
    run = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("room", ["transforms", "losses"])
def test_the_link_at_the_root_leads_into_the_package(room):
    assert os.readlink(ROOT / room) == f"torchrl_athletic/{room}"


def test_tools_read_the_package_and_not_the_links():
    run = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--show-files"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    shown = {Path(line).relative_to(ROOT).parts[0] for line in run.stdout.split()}
    assert "torchrl_athletic" in shown
    assert shown.isdisjoint({"transforms", "losses"})
    assert str(ROOT / "torchrl_athletic/transforms/__init__.py") in run.stdout


@pytest.fixture(scope="module")
def packed(tmp_path_factory) -> tuple[set[str], set[str]]:
    """Names in the wheel and in the source distribution of this tree."""
    folder = tmp_path_factory.mktemp("packed")
    ignore = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "dist", "site", "out", "outputs")
    tree = shutil.copytree(ROOT, folder / "tree", symlinks=True, ignore=ignore)
    code = "from setuptools.build_meta import build_sdist, build_wheel; build_wheel('..'); build_sdist('..')"
    subprocess.run([sys.executable, "-c", code], cwd=tree, capture_output=True, check=True)
    [wheel], [source] = folder.glob("*.whl"), folder.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        in_wheel = archive.namelist()
    with tarfile.open(source) as archive:
        in_source = [name.partition("/")[2] for name in archive.getnames()]
    assert len(set(in_wheel)) == len(in_wheel)
    return set(in_wheel), set(in_source)


def test_packages_hold_every_file_of_the_rooms_once(packed):
    files = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "torchrl_athletic").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    for names in packed:
        assert files <= names
    assert {name.partition("/")[0] for name in packed[0]} == {"torchrl_athletic", *_metadata_folder(packed[0])}


def test_source_distribution_holds_no_second_copy_behind_the_links(packed):
    assert {name for name in packed[1] if name.startswith(("transforms", "losses"))} == set()


def _metadata_folder(names: set[str]) -> set[str]:
    return {top for name in names if (top := name.partition("/")[0]).endswith(".dist-info")}


@pytest.mark.parametrize("script", sorted((ROOT / "recipes").glob("*.py")), ids=lambda path: path.name)
def test_a_recipe_is_short_and_uses_what_is_public(script):
    source = script.read_text()
    assert len(source.splitlines()) < 120
    private = {name for name in imports(source, "") if name.startswith("torchrl_athletic") and "._" in name}
    assert private == set()
