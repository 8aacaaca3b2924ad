"""What holds for every page of the site: its length, and where its numbers come from."""

from __future__ import annotations

import pathlib
import re

import pytest

from bench import render
from paths import ROOT

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
    assert not typed(section, made(text))


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
