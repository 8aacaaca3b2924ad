"""What holds for every page of the site: its length, and where its numbers come from."""

from __future__ import annotations

import pathlib
import re

import pytest

from bench import render
from places import ROOT

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
LONG = ("reference", "appendix")  # folders whose pages may be long
SHORT = [path for path in PAGES if path.parent.name not in LONG]
NOTES = [path for path in PAGES if path.parent.name == "appendix" and path.name != "preregistration.md"]
TYPED = [path for path in PAGES if path.parent.name != "appendix"]
DIGITS = r"(?:(?:\d[\d,]*\d|\d)(?:\.\d+)?|\.\d+)(?:e-?\d+)?"
NUMBER = rf"(?<![\w.,])(?<![\w.]-){DIGITS}(?!\w)"  # its sign does not count

# Numbers of pages that no block has, and what they are: none is a measurement.
STATED: dict[str, dict[str, str]] = {
    "README.md": {"versions of Python": "3.11 3.13", "band": "0.95 1.05", "bound of a test": "5e-5"},
    "appendix/benchmarks.md": {"exit code": "130", "unit": "1e9", "day": "11", "version": "0.14"},
    "howto/compare.md": {"level of intervals": "95"},
    "howto/evaluate.md": {"level of intervals": "95"},
    "howto/export.md": {"bits": "32"},
    "howto/pretrained.md": {"level of intervals": "95"},
    "howto/render.md": {"name of a feeder": "33"},
    "howto/resume.md": {"a constant of the code": "1e8"},
    "howto/sweep.md": {"bits": "32"},
    "methods/macpo.md": {"a limit, and seeds of limits_macpo_recovery_h200.json": "0.2 17"},
    "methods/mappo_l.md": {"setting of the published code": "1e-7"},
    "methods/protection_motivation.md": {"volumes of journals": "11 91"},
    "reference/run_folder.md": {"exit codes": "129 130 143"},
    "results/index.md": {
        "lowest p that five seeds against five can have, and a level": ".008 .05",
        "settings": "0.5 0.78 6.75",
        "steps, millions": "9.1 8.3",
        "the paper's steps, millions": "50",
    },
    "results/limits.md": {
        "limits and margins": "10 25",
        "seeds": "3 107 600 609 700 719 740 759 60 80 40 26 127 130",
        "seeds that the study asked for": "15",
        "seeds of limits_shorter_steps_h100.json": "17",
        "seeds and a reward of limits_less_noise_h100.json": "19 3,139",
        "seeds of limits_pid_h200.json and limits_unclipped_h200.json": "14 12",
        "month": "11",
        "reward of the control in limits_unclipped_h200.json, and p of rewards beside it": "4,960 .005",
        "rounded rewards and a p of limits_4x2_h200.json": "3,000 2,000 .121",
        "rewards that the study asked for": "4,563 4,501",
        "steps of MACPO, millions, and a half-life": "5.6 6.6 0.3e6",
        "means of limits_macpo_4x2_h200.json and of the paper": "2,388 1,468",
        "rates": "432,000 454,000 225,000",
        "updates": "60 300",
        "level of intervals": "95",
        "Wilson's interval of 18 of 20, percent": "70 97",
        "half-life": "2e5",
        "buses": "33",
    },
    "howto/limits.md": {
        "limits": "0.2",
        "seeds of limits_macpo_recovery_h200.json": "17 20",
        "seeds of limits_shorter_steps_h100.json": "18",
    },
    "howto/hosts.md": {"XLA's patience, seconds": "40"},
    "results/scaling.md": {
        "cores of a machine": "32",
        "quotients and products of the table's numbers": "8.9 19,064 35,568",
        "an update on two cores, seconds": "1.09 1.11 1.17",
        "slowest and fastest turns in the stored results": "3,600 11,633 24,651 29,312",
    },
    "results/speed.md": {
        "launches, rounded": "500",
        "integration steps of 512 and of 2,048 ants at 0fa7cc4, milliseconds": "1.91 2.28",
    },
    "results/velocity.md": {
        "running at the thresholds, standing still": "3,522 3,227 2,932 49 1,961 2,641 3,418 5,725 5,000",
        "a threshold, m/s": "0.58",
        "steps of an earlier run, millions": "6.9 5.6",
        "costs and multipliers of the stored curves": "75 104 673 917 1.4 5.1",
        "the humanoid after 5.6 million steps in another run": "458 500",
        "steps until a fall": "30 110 239 499",
        "means of costs beyond the limit; a cost in the stored table": "2.1 3.1 59 92 2.6 4.9 13.1 28.7",
        "steps of an episode, level of intervals": "1,000 95",
        "cells, and seeds": "56 24 25 29 30 42 50",
        "standard deviations of actions, and an excess of speed": "0.02",
        "hoppers of earlier runs": "1,515 1,774 484 0.05 1,911 1,878 1,532",
    },
    "results/velocity_tight.md": {
        "seeds": "20 24 25 30 47 50 100 119",
        "level of intervals": "95",
        "steps of one cost": "5,000",
        "multipliers of the stored curves": "12.6 13.5",
        "probabilities that a seed of one method has less than one of the other": "0.98 0.86 0.97 0.94",
    },
    "results/study.md": {
        "thinnings": "32",
        "updates": "60",
        "first seeds": "800 840",
        "a setting": "0.0045",
        "p of pairs of fear_probe_ten_million_h200.json, not corrected": ".022 .011 .024",
        "multipliers of the stored curves of the study and its rounds": "2.96 1.11",
    },
    "results/study_fourth.md": {
        "two seeds and the median in the stored runs": "71 88 53",
        "medians of 80 seeds in the stored runs": "52.8 53.2",
        "steps, millions": "3.7",
        "version of jax": "0.11",
    },
    "results/study_sixth.md": {
        "the limit": "2.5",
        "F4SG at p = 1, in the fourth round's table": "15.1",
        "a multiplier of its curves": "0.98",
    },
    "results/table1.md": {
        "horizon": "1,000",
        "level of intervals": "95",
        "larger sample of MAPPO-Lagrangian, in the results' table": "4,526",
        "month": "11",
        "degrees": "60",
        "a wall-clock time, minutes and seconds": "24 16",
        "rates": "85,000 104,000 50,000 68,000 42,000 45,000",
        "steps of runs that were ended, millions": "7.0 8.5 3.7 7.1",
    },
    "results/table2.md": {"limit": "2.5", "level": ".05", "horizon": "75", "settings": "256 1e-3"},
    "results/table3.md": {
        "band": "0.95 1.05",
        "horizon": "239",
        "episodes": "64",
        "updates": "15",
        "the mean of five policies": "2.5",
        "costs of the rule and the dispatch in the baselines' table": "8.05 7.70",
        "a test of two rows of same_days_voltage_33_h200.json": ".028",
    },
    "start/first_run.md": {"level of intervals": "95"},
    "start/install.md": {"versions of Python": "3.11 3.12 3.13"},
    "tasks/ant.md": {
        "seconds and newton metres": "0.05 0.01 50 150",
        "lengths in metres": "1.4 20 60 100 600",
        "degrees": "134",
        "bound of a test": "5e-5",
    },
    "tasks/hand_over.md": {
        "formulas of reward, cost and end": "0.2 0.5",
        "centimetres": "25",
        "parts of a second": "60 120",
        "densities": "500 567",
    },
    "tasks/toys.md": {"formula": "0.3", "optima in closed form": "16.36 18.85 24.561", "level of intervals": "95"},
    "tasks/velocity.md": {
        "coefficients of the rewards": "0.0001 0.001 0.5 1.25",
        "thresholds": "0.04891 0.9613 1.641 2.418 2.522 2.932 3.227",
        "bounds of actions and heights": "0.2 0.4",
        "the original package's rates, from the issue that asked for the tasks": "1,100 5,500",
        "versions of MuJoCo": "2.3 3.17",
        "bounds of tests": "2e-5 1e-3 1e-4",
    },
    "tasks/voltage.md": {
        "bound of actions": "0.6",
        "bits, episodes": "64",
        "bits": "32",
        "bounds of tests": "1e-7 1e-5",
        "names of a network, a standard and a paper": "322 1547 2110.14300",
    },
}


def page(path: pathlib.Path) -> str:
    return path.relative_to(DOCS if path.is_relative_to(DOCS) else ROOT).as_posix()


def stated(path: pathlib.Path) -> list[str]:
    return " ".join(STATED.get(page(path), {}).values()).split()


def digits(number: str) -> int:
    """Decimals of a number."""
    return len(number.partition("e")[0].partition(".")[2]) - int(number.partition("e")[2] or 0)


def value(number: str) -> float:
    return float(number.replace(",", ""))


def numbers(markdown: str) -> list[str]:
    """Those of prose and tables, without code and addresses."""
    prose = re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)|\$\$.*?\$\$|\$[^$\n]*\$", "", markdown, flags=re.DOTALL)
    prose = re.sub(r"\b(19|20)\d\d\b|Eq\. \d+((, | and | to )\d+)*", "", prose)  # years, numbers of equations
    return re.findall(NUMBER, re.sub(r"^ *\d+\. ", "", prose, flags=re.MULTILINE))


@pytest.mark.parametrize("path", SHORT, ids=page)
def test_a_page_is_short(path: pathlib.Path):
    most = 900 if path.parent == ROOT else 1500
    assert len(render.BLOCK.sub("", path.read_text()).split()) <= most


def typed(path: pathlib.Path) -> list[list[str]]:
    """The numbers of each section of a page that are in none of its blocks, perhaps with more digits there, nor stated.

    Outside of the results, whole numbers up to ten are counts of what the page lists.
    """
    text = path.read_text()
    made = {value(x) for block in render.BLOCK.finditer(text) for x in re.findall(DIGITS, block[0])}
    made |= set(map(value, stated(path)))
    made |= set() if path.parent.name == "results" else set(map(float, range(11)))
    return [
        [x for x in numbers(section) if all(round(y, digits(x)) != value(x) for y in made)]
        for section in sections(text)
    ]


def sections(text: str) -> list[str]:
    return re.split(r"^## ", render.BLOCK.sub("", text), flags=re.MULTILINE)


@pytest.mark.parametrize("path", TYPED, ids=page)
def test_numbers_come_from_results(path: pathlib.Path):
    found = sum(typed(path), [])
    assert not found, f"{found}: make a block of them, or say in STATED what they are"


@pytest.mark.parametrize("path", NOTES, ids=page)
def test_notes_name_command_and_date(path: pathlib.Path):
    """A section with numbers that no block has ends with `*Measured DATE: COMMAND ...*`."""
    for found, section in zip(typed(path), sections(path.read_text()), strict=True):
        assert not found or re.search(r"^\*Measured \d{4}-\d\d-\d\d[^*]+`[^*]+\*$", section, re.MULTILINE), section


def test_what_is_stated_is_needed():
    for path in TYPED + NOTES:
        assert set(stated(path)) <= set(numbers(render.BLOCK.sub("", path.read_text()))), page(path)
    assert STATED.keys() <= set(map(page, TYPED + NOTES))


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"])
def test_links_of_the_top_level(name: str):
    """mkdocs checks those of the site."""
    links = re.findall(r"\]\(([^)#\s]+)", (ROOT / name).read_text())
    assert all(link.startswith("http") or (ROOT / link).exists() for link in links)
