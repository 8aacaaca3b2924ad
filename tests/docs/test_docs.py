"""Everything public is documented, and what the documentation shows runs.

A Python block of a Markdown file that cannot run here (an hour, data of the reader's) stands below a comment that says
why: `<!-- not run: REASON -->`. Such a block is still compiled.
"""

from __future__ import annotations

import ast
import doctest
import functools
import importlib
import json
import pathlib
import re
from collections.abc import Iterator
from typing import Any

import pytest

import pmt_jax
from places import ROOT
from pmt_jax.config.methods import METHODS

MARKDOWN = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
MODULES = [*sorted((ROOT / "pmt_jax").rglob("*.py")), *sorted((ROOT / "envs").rglob("*.py"))]
BLOCK = re.compile(r"(<!-- not run: \S.*? -->\n)?```python\n(.*?)```", re.DOTALL)
# Examples that compile for several seconds; what they show is tested elsewhere too.
SLOW = {"pmt_jax.learning.learner", "envs.voltage.control", "envs.voltage.baselines", "envs.voltage.power_flow"}


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    """Examples may write files and add methods."""
    monkeypatch.chdir(tmp_path)
    before = dict(METHODS)
    yield
    METHODS.clear()
    METHODS.update(before)


def name(path: pathlib.Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def public(body: list[ast.stmt], prefix: str = "") -> Iterator[tuple[str, ast.FunctionDef | ast.ClassDef]]:
    """Public classes, their public methods, and public functions."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public(node.body, f"{prefix}{node.name}.")


@functools.cache
def contracts() -> set[str]:
    """The methods that a Protocol of ours documents for all who keep it."""
    trees = [ast.parse(path.read_text()) for path in MODULES]
    classes = [node for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)]
    protocols = [c for c in classes if any(isinstance(b, ast.Name) and b.id == "Protocol" for b in c.bases)]
    return {m.name for c in protocols for m in c.body if isinstance(m, ast.FunctionDef) and ast.get_docstring(m)}


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_everything_public_is_documented(path: pathlib.Path):
    tree, promised = ast.parse(path.read_text()), contracts()
    bare = [
        what
        for what, node in public(tree.body)
        if not ast.get_docstring(node) and not ("." in what and what.split(".")[-1] in promised)
    ]
    assert ast.get_docstring(tree) and not bare


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=name(path), marks=[pytest.mark.full] if name(path) in SLOW else [])
        for path in MODULES
        if ">>> " in path.read_text()
    ],
)
def test_examples_in_docstrings(path: pathlib.Path):
    result = doctest.testmod(importlib.import_module(name(path)))
    assert result.attempted and not result.failed


@pytest.mark.parametrize("path", MARKDOWN, ids=lambda path: path.name)
def test_python_in_markdown(path: pathlib.Path):
    """A file's blocks run in order, in one namespace."""
    text = path.read_text()
    blocks = list(BLOCK.finditer(text))
    assert len(blocks) == text.count("```python")
    namespace: dict[str, object] = {}
    for block in blocks:
        line = text[: block.start(2)].count("\n")
        program = compile("\n" * line + block[2], path, "exec")
        if not block[1]:
            exec(program, namespace)


def test_the_citation_is_of_this_version():
    assert f"\nversion: {pmt_jax.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f'\nversion = "{pmt_jax.__version__}"\n' in (ROOT / "pyproject.toml").read_text()


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")
def test_the_tutorial(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    monkeypatch.chdir(ROOT / "docs")
    cells = json.loads(pathlib.Path("tutorial.ipynb").read_text())["cells"]
    assert not any(cell.get("outputs") for cell in cells), "commit the notebook without outputs"
    namespace: dict[str, Any] = {}
    for number, cell in enumerate(cells):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"tutorial.ipynb, cell {number}", "exec"), namespace)
    assert not (namespace["dreaded"]["lambda"] == namespace["metrics"]["lambda"]).all()  # another method, indeed
    said = capsys.readouterr().out
    assert "episode_reward" in said and "dread" in said and "tilt" in said
