"""Every command that the pages show is understood by what it starts."""

import importlib.util
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType

import pytest
import tyro

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
SHOWN = r"^(?:.*&& |\w+=\S+ )?python ((?:recipes|benchmarks)/\w+\.py)([^\n|$]*)$"
SUBCOMMANDS = ("recipes/diagnose.py",)  # its flags are held against the pages by tests/test_readme.py


def shown() -> list[tuple[str, str]]:
    """File and arguments of each command in a shell block."""
    blocks = [b for page in PAGES for b in re.findall(r"^```bash\n(.*?)^```", page.read_text("utf-8"), re.S | re.M)]
    found = dict.fromkeys(match for block in blocks for match in re.findall(SHOWN, block, re.M))
    return [(file, arguments) for file, arguments in found if file not in SUBCOMMANDS]


def load(file: str) -> ModuleType:
    name = file.removesuffix(".py").replace("/", "_")
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, ROOT / file)
        assert spec
        assert spec.loader
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


def test_the_pages_show_how_to_identify_and_to_compare():
    files = {Path(file).stem for file, _ in shown()}
    assert files >= {"collect_recordings", "identify", "train_uan", "compare_identification", "throw_arm"}


@pytest.mark.parametrize(("file", "arguments"), shown(), ids=lambda words: words.partition(" #")[0].strip())
def test_a_command_is_understood(file, arguments):
    words = shlex.split(arguments, comments=True)
    cfg = tyro.cli(load(file).Config, args=words)  # refuses flags and values that it does not know
    given = re.findall(r"--([\w-]+)", arguments)
    assert all(hasattr(cfg, flag.partition(".")[0].replace("-", "_")) for flag in given if not flag.startswith("no-"))


def test_a_flag_that_does_not_exist_is_refused(capsys):
    with pytest.raises(SystemExit):
        tyro.cli(load("recipes/train_uan.py").Config, args=["--minute", "3"])
    assert "--minute" in capsys.readouterr().err
