"""Everything public is documented, and what the documentation shows is right. `test_blocks.py` runs its blocks."""

from __future__ import annotations

import argparse
import ast
import doctest
import functools
import importlib
import importlib.util
import json
import pathlib
import re
import shlex
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest

import pmt_jax
from bench import render
from paths import ROOT
from pmt_jax import tasks
from pmt_jax.cli import flags
from pmt_jax.cli.commands import make_parser
from pmt_jax.cli.parser import refuse_unknown
from pmt_jax.config.load import load_config
from pmt_jax.config.methods import METHODS
from pmt_jax.config.settings import FIELDS

MARKDOWN = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
MODULES = [*sorted((ROOT / "pmt_jax").rglob("*.py")), *sorted((ROOT / "envs").rglob("*.py"))]
# Examples that compile for several seconds; what they show is tested elsewhere too.
SLOW = {
    "pmt_jax.learning.learner",
    "envs.multi_goal.multi_goal",
    "envs.voltage.control",
    "envs.voltage.baselines",
    "envs.voltage.power_flow",
}


def pages(what: str) -> list[Any]:
    """The pages that have `what`."""
    return [pytest.param(x, id=str(x.relative_to(ROOT))) for x in MARKDOWN if what in x.read_text()]


def commands(path: pathlib.Path, program: str = "pmt") -> list[list[str]]:
    """The words after `program` of each such command in a page's shell blocks."""
    blocks = re.findall(r"```bash\n(.*?)```", path.read_text().replace("\\\n", " "), re.DOTALL)
    lines = re.sub(r"\$\(.*?\)", "", "\n".join(blocks)).splitlines()
    words = [shlex.split(part, comments=True) for line in lines for part in re.split(r"&&|[|;]", line)]
    return [each[each.index(program) + 1 :] for each in words if program in each]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    """Examples may write files and add methods; they find the repository's docs as a reader does."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").symlink_to(ROOT / "docs")
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


def test_the_version_is_in_one_place():
    """pmt_jax/__init__.py has it, and the changelog begins with it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" not in project["project"] and "version" in project["project"]["dynamic"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "pmt_jax.__version__"}
    assert not re.search(r"^version:", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    first = re.search(r"^## (\S+)( \(unreleased\))?$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert first and pmt_jax.__version__ == first[1] + (".dev0" if first[2] else "")


def test_hooks_are_the_checks_of_ci():
    """A commit runs the linters, types and import rules that .ci/run does, in its words."""
    hooks = re.findall(r"entry: ([^,}]+)", (ROOT / ".pre-commit-config.yaml").read_text())
    ci = (ROOT / ".ci" / "run").read_text()
    checks = re.search(r"^linters\(\) \{\n(.*?)\n\}$", ci, re.DOTALL | re.MULTILINE)
    assert checks and [line.strip().removesuffix(" .") for line in checks[1].splitlines()] == hooks


def test_modules_of_python_are_stable_as_the_page_says():
    """The names that the page on stability lists are those that the package exports."""
    page = (ROOT / "docs" / "design" / "stability.md").read_text()
    names = re.search(r"`from pmt_jax import \.\.\.`: ([^|]+)\|", page)
    assert names and re.findall(r"`(\w+)`", names[1]) == sorted(pmt_jax.__all__, key=str.lower)


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")
def test_the_tutorial(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    cells = json.loads((ROOT / "docs" / "tutorial.ipynb").read_text())["cells"]
    assert not any(cell.get("outputs") for cell in cells), "commit the notebook without outputs"
    namespace: dict[str, Any] = {}
    for number, cell in enumerate(cells):
        if cell["cell_type"] == "code":
            source = "".join(cell["source"]).replace("steps=60_000", "steps=6_000")
            exec(compile(source, f"tutorial.ipynb, cell {number}", "exec"), namespace)
    assert namespace["config"].steps == namespace["mine"].steps == 6_000
    dreaded, usual = (namespace[name]["cost_critic/explained_variance"] for name in ("dreaded", "metrics"))
    assert (dreaded != usual).any()  # another method, indeed
    said = capsys.readouterr().out
    assert "episode_reward" in said and "dread" in said and "cost of each agent [1. 0.]" in said


@pytest.mark.parametrize("path", pages("pmt "))
def test_commands_in_markdown(path: pathlib.Path):
    """Each command is one that the parser takes, with settings that its task takes."""
    for words in commands(path):
        parser, known = make_parser()
        refuse_unknown(words, known)
        arguments = parser.parse_all([word for word in words if word != "--help"])
        source = getattr(arguments, "source", "")
        if arguments.command == "train" and source.removeprefix("paper/") in tasks.names():
            load_config(source, preset=arguments.preset, **flags.given(arguments))


@pytest.mark.parametrize("path", pages("`pmt "))
def test_flags_in_sentences(path: pathlib.Path):
    """Commands within a sentence, which may have words to be replaced, are commands, and their flags are flags."""
    parser, known = make_parser()
    (commands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    sentences = re.sub(r"```.*?```", "", path.read_text(), flags=re.DOTALL)
    for command in re.findall(r"`pmt ([^`]+)`", sentences):
        words = shlex.split(command)
        assert words[0] in known, command
        flags = {flag for action in commands.choices[words[0]]._actions for flag in action.option_strings}
        used = {word.split("=")[0] for word in words if re.match("--?[a-z]", word)}
        assert used <= flags, (command, used - flags)


@pytest.mark.parametrize("path", pages("python -m "))
def test_modules_in_markdown(path: pathlib.Path):
    """Those of this repository can be found."""
    for words in commands(path, "python"):
        if words[0] == "-m" and words[1].split(".")[0] in ("bench", "docs", "pmt_jax"):
            assert importlib.util.find_spec(words[1]), words


@pytest.mark.parametrize("path", pages("```toml"))
def test_toml_in_markdown(path: pathlib.Path):
    for block in re.findall(r"```toml\n(.*?)```", path.read_text(), re.DOTALL):
        table = tomllib.loads(block)
        assert table.keys() - {"sweep", "extends", "env", "method"} <= FIELDS.keys()


# ---------------------------------------------------------------------------------------------------------------------
# What holds for every page of the site: its length, and where its numbers come from


DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
SHORT = [path for path in PAGES if path.parent.name != "reference"]  # which is looked up, not read
NOTES = [path for path in PAGES if path.parent.name == "appendix"]
MOST = 1500  # words of a page, tables included
RESULTS = [path for path in PAGES if path.parent.name == "results" or path.name == "README.md"]
DIGITS = r"(?:(?:\d[\d,]*\d|\d)(?:\.\d+)?|\.\d+)(?:e-?\d+)?"
NUMBER = rf"(?<![\w.,])(?<![\w.]-){DIGITS}(?!\w)"  # its sign does not count


def page(path: pathlib.Path) -> str:
    return path.relative_to(DOCS if path.is_relative_to(DOCS) else ROOT).as_posix()


def digits(number: str) -> int:
    """Decimals of a number."""
    return len(number.partition("e")[0].partition(".")[2]) - int(number.partition("e")[2] or 0)


def value(number: str) -> float:
    return float(number.replace(",", ""))


def numbers(markdown: str) -> list[str]:
    """Those of prose and tables, without code and addresses."""
    prose = re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)|\$\$.*?\$\$|\$[^$\n]*\$", "", markdown, flags=re.DOTALL)
    prose = re.sub(r"\b(19|20)\d\d(-\d\d-\d\d)?\b|Eq\. \d+((, | and | to )\d+)*", "", prose)  # dates, equations
    return re.findall(NUMBER, re.sub(r"^ *\d+\. ", "", prose, flags=re.MULTILINE))


def words(path: pathlib.Path) -> int:
    """With tables and without marks."""
    return len(re.sub(r"<!--.*?-->", "", path.read_text(), flags=re.DOTALL).split())


@pytest.mark.parametrize("path", SHORT, ids=page)
def test_a_page_is_short(path: pathlib.Path):
    assert words(path) <= MOST


def test_all_pages_together_are_short():
    assert sum(map(words, PAGES)) <= 45_000


@pytest.mark.parametrize("path", PAGES, ids=page)
def test_pages_use_no_words_that_a_reader_cannot_know(path: pathlib.Path):
    assert not re.findall(
        r"\b(?:leases?|candidates?|(?:second|third|fourth|fifth) round|form [a-j])\b", path.read_text()
    )


def made(text: str) -> set[float]:
    """The numbers that `bench render` fills into a page: those of its blocks, and those in its sentences."""
    filled = (found[3] for pattern in (render.BLOCK, render.NUMBER) for found in pattern.finditer(text))
    return {value(x) for each in filled for x in re.findall(DIGITS, each)}


def typed(markdown: str, known: set[float]) -> list[str]:
    """The numbers above ten that are not `known`, perhaps with more digits there. Below, they count things."""
    found = [x for x in numbers(markdown) if value(x) > 10 or value(x) % 1]
    return [x for x in found if all(round(y, digits(x)) != value(x) for y in known)]


def sections(text: str) -> list[str]:
    return re.split(r"^## ", render.BLOCK.sub("", text), flags=re.MULTILINE)


@pytest.mark.parametrize("path", RESULTS, ids=page)
def test_findings_come_from_results(path: pathlib.Path):
    """Bold sentences say what was found, so a command fills their numbers or they are in a table of the page."""
    text = path.read_text()
    findings = re.findall(r"\*\*(.+?)\*\*", render.NUMBER.sub(r"\3", render.BLOCK.sub("", text)), re.DOTALL)
    assert not typed(" ".join(findings), made(text)), "let `bench render` fill them (bench/tables/values.py)"


@pytest.mark.parametrize("begin", ["Why an emotion?", "Results", "Speed"])
def test_all_numbers_of_the_readmes_results_are_in_its_tables(begin: str):
    text = PAGES[0].read_text()
    (section,) = (section for section in sections(text) if section.startswith(begin))
    assert not typed(section.replace("95 % interval", "interval"), made(text))  # a level is no result


@pytest.mark.parametrize("path", NOTES, ids=page)
def test_notes_name_command_and_date(path: pathlib.Path):
    """A section with numbers that no block has ends with `*Measured DATE: COMMAND ...*`."""
    text = path.read_text()
    for section in sections(text):
        measured = re.search(r"^\*Measured \d{4}-\d\d-\d\d[^*]+`[^*]+\*$", section, re.MULTILINE)
        assert measured or not typed(section, made(text)), section


def test_a_wrong_number_in_a_finding_is_found():
    """Neither a table of the page nor a command has it."""
    known = made("<!-- bench: x2 -->\n| 47 of 50 |\n<!-- /bench -->\n<!-- bench: y:*:5 -->1,724<!-- /bench --> earned")
    assert known == {47, 50, 1724} and typed("48 of 50 keep 0.25, all 9 of 1,724", known) == ["48", "0.25"]


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"])
def test_links_of_the_top_level(name: str):
    """mkdocs checks those of the site."""
    links = re.findall(r"\]\(([^)#\s]+)", (ROOT / name).read_text())
    assert all(link.startswith("http") or (ROOT / link).exists() for link in links)
