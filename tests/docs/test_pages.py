"""What holds for every page of the site: its length, and where its numbers come from."""

from __future__ import annotations

import pathlib
import re

import pytest

from bench import render
from places import ROOT

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
LONG = ("reference", "appendix")  # folders whose pages may be long
SHORT = [path for path in PAGES if path.parent.name not in LONG]
NUMBER = r"(?<![\w.,])(?<![\w.]-)(?:(?:\d[\d,]*\d|\d)(?:\.\d+)?|\.\d+)(?!\w)"  # its sign does not count

# Numbers that are no measurements: limits, horizons, settings, constants and known optima of the tasks, versions.
STATED = {
    "howto/compare.md": "95",
    "howto/evaluate.md": "95",
    "howto/export.md": "32",
    "howto/hosts.md": "64",
    "howto/pretrained.md": "95",
    "howto/render.md": "33",
    "howto/sweep.md": "32",
    "results/index.md": ".008 50 0.78 6.75",  # the lowest p that five seeds against five can have
    "results/limits.md": "10 3 60 95",
    "results/table1.md": "1,000 95",
    "results/table2.md": "2.5 75 256",
    "results/table3.md": "0.95 1.05 239 64",
    "start/first_run.md": "95",
    "start/install.md": "3.11 3.12 3.13",
    "methods/protection_motivation.md": "11 91",
    "tasks/ant.md": "0.05 0.01 1.4 20 50 60 100 134 150 600",
    "tasks/hand_over.md": "0.2 0.5 25 60 120 500 567",
    "tasks/toys.md": "0.3 16.36 18.85 24.561 95",
    "tasks/velocity.md": "0.0001 0.001 0.04891 0.2 0.4 0.5 0.78 0.9613 1.25 1.641 2.3 2.418 2.522 2.932 3.17 3.227",
    "tasks/voltage.md": "0.6 64 322 1547 2110.14300",
}


def page(path: pathlib.Path) -> str:
    return path.relative_to(DOCS).as_posix()


def value(number: str) -> float:
    return float(number.replace(",", ""))


def numbers(markdown: str) -> list[str]:
    """Those of prose and tables, without code and addresses."""
    prose = re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)|\$\$.*?\$\$|\$[^$\n]*\$", "", markdown, flags=re.DOTALL)
    prose = re.sub(r"\b(19|20)\d\d\b|Eq\. \d+((, | and | to )\d+)*", "", prose)  # years, numbers of equations
    return re.findall(NUMBER, re.sub(r"^ *\d+\. ", "", prose, flags=re.MULTILINE))


@pytest.mark.parametrize("path", SHORT, ids=page)
def test_a_page_is_short(path: pathlib.Path):
    assert len(render.BLOCK.sub("", path.read_text()).split()) <= 1500


@pytest.mark.parametrize("path", SHORT, ids=page)
def test_numbers_come_from_results(path: pathlib.Path):
    """Every number of a page stands in one of its blocks, perhaps with more digits, or is stated above.

    Outside of the results, whole numbers up to ten are counts of what the page lists.
    """
    text = path.read_text()
    made = {
        value(x) for block in render.BLOCK.finditer(text) for x in re.findall(r"\d[\d,]*(?:\.\d+)?|\.\d+", block[0])
    }
    made |= {value(x) for x in STATED.get(page(path), "").split()}
    made |= set() if path.parent.name == "results" else set(map(float, range(11)))
    found = numbers(render.BLOCK.sub("", text))
    typed = [x for x in found if all(round(y, len(x.partition(".")[2])) != value(x) for y in made)]
    assert not typed, f"{typed}: make a block of them, or say in STATED why not"


def test_what_is_stated_is_needed():
    for name, stated in STATED.items():
        assert set(stated.split()) <= set(numbers(render.BLOCK.sub("", (DOCS / name).read_text()))), name


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"])
def test_links_of_the_top_level(name: str):
    """mkdocs checks those of the site."""
    links = re.findall(r"\]\(([^)#\s]+)", (ROOT / name).read_text())
    assert all(link.startswith("http") or (ROOT / link).exists() for link in links)
