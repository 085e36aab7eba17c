"""The README and the pages of the documentation say what is true."""

import ast
import doctest
import importlib
import re
import runpy
import sys
import textwrap
import tomllib
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
RUNNABLE = ["README.md", "docs/recordings.md", "docs/composition.md", "docs/losses.md"]  # others need files or minutes


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.S | re.M)


def source_of(block: str) -> str:
    """Python code, whether it is shown as a session, as a part of a class, or as it is."""
    session = "".join(example.source for example in doctest.DocTestParser().get_examples(block))
    return session or textwrap.dedent(block)


def commands(text: str) -> list[str]:
    """Lines of the shell blocks without their comments."""
    return [
        command
        for block in blocks(text, "bash")
        for line in block.splitlines()
        if (command := line.partition("  #")[0])
    ]


def test_first_commands_of_the_readme_install_and_run_then_install_and_test():
    run, test = commands(README)[:2]
    assert run == "pip install . && python recipes/diagnose.py"
    assert test == 'pip install ".[tests]" && pytest'


def test_ci_runs_these_two_commands_as_they_stand():
    assert [line for line in (ROOT / ".ci/run").read_text().splitlines() if line in commands(README)] == commands(
        README
    )[:2]


def test_first_screen_holds_two_sentences_the_picture_and_the_commands():
    above = README[: README.index("```bash")]
    promise = above.split("\n\n")[1]
    assert len(re.findall(r"\.(?=\s|$)", promise)) == 2
    assert "![" in above
    assert README[: README.index("pytest")].count("\n") < 40


def having(pattern: str) -> pytest.MarkDecorator:
    """Run a test on each page that holds the pattern."""
    paths = [path for path in PAGES if re.search(pattern, path.read_text(), re.M)]
    return pytest.mark.parametrize("path", paths, ids=lambda path: path.relative_to(ROOT).as_posix())


@having(r"\]\(")
def test_links_lead_to_files_that_exist(path):
    targets = [target.partition("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text())]
    ours = [target for target in targets if target and "://" not in target]
    assert [target for target in ours if not (path.parent / target).is_file()] == []


@having(r"^\|-")
def test_a_table_s_rows_follow_its_header_at_once(path):
    """A blank line after the rule ends the table, and what follows is shown as raw text."""
    lines = path.read_text(encoding="utf-8").splitlines()
    rules = [k for k, line in enumerate(lines) if re.fullmatch(r"\|(\s*:?-+:?\s*\|)+", line)]
    assert all(lines[k + 1].startswith("|") for k in rules)


def test_pictures_are_pictures():
    for picture in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README):
        assert (ROOT / picture).read_bytes().startswith(b"\x89PNG")


@having(r"pip install [^\n]*\[")
def test_extras_that_are_named_exist(path):
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {extra for group in re.findall(r'"\.\[([\w,]+)\]"', path.read_text()) for extra in group.split(",")}
    assert named <= set(extras)


@having("^```python")
def test_names_that_are_imported_exist(path):
    for block in blocks(path.read_text(), "python"):
        for node in ast.walk(ast.parse(source_of(block))):
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(node.module)
                assert [alias.name for alias in node.names if not hasattr(module, alias.name)] == []


@pytest.mark.parametrize("name", RUNNABLE)
def test_code_on_a_page_prints_the_output_shown(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / name).read_text()
    scope: dict[str, object] = {}
    for code in blocks(text, "python"):
        exec(compile(code, name, "exec"), scope)
    printed = capsys.readouterr().out
    assert printed
    assert printed in blocks(text, "text")


@pytest.fixture(scope="module")
def flags() -> set[str]:
    """Flags of the recipe, which is run here: another process would import all libraries again."""
    recipe = str(ROOT / "recipes/diagnose.py")
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as told:
        patch.setattr(sys, "argv", [recipe, "--help"])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(recipe, run_name="__main__")
    assert ended.value.code == 0
    return set(re.findall(r"--[\w-]+", told.getvalue()))


@having(r"diagnose\b.* --|^\| `--")
def test_flags_of_the_recipe_exist(path, flags):
    shown = {
        flag for line in commands(path.read_text()) if "diagnose" in line for flag in re.findall(r"--[\w-]+", line)
    }
    listed = set(re.findall(r"^\| `(--[\w-]+)` \|", path.read_text(), re.M))
    assert shown | listed <= flags
