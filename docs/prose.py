"""The linter of prose: proselint's checks, those of docs/prose.toml, and the length of sentences.

python -m docs.prose                checks pages, help texts, and the words of docstrings; exit code 1 on findings
python -m docs.prose FILE.md ...    checks some pages
"""

from __future__ import annotations

import ast
import dataclasses
import json
import pathlib
import re
import sys
import tomllib
from collections.abc import Iterator

from proselint import config
from proselint.checks import __register__ as checks
from proselint.registry import CheckRegistry
from proselint.tools import LintFile

from pmt_jax.cli.commands import make_parser
from pmt_jax.config.settings import Config
from pmt_jax.training.metrics import METRICS

ROOT = pathlib.Path(__file__).parent.parent
RULES = tomllib.loads((ROOT / "docs" / "prose.toml").read_text())
NO_PROSE = (
    r"^<!-- bench: \S+ -->\n.*?^<!-- /bench -->$",  # made tables
    r"^ *```.*?^ *```$",
    r"\$\$.*?\$\$",
    r"\$[^$\n]+\$",
    r"<!--.*?-->",
    r"\]\([^)]*\)",
    r'"[^"\n]*"',  # quoted, as the examples of CONTRIBUTING.md
)


def prose(markdown: str) -> str:
    """The text without what is no prose; lines keep their numbers."""
    for pattern in NO_PROSE:
        markdown = re.sub(pattern, lambda found: "\n" * found[0].count("\n"), markdown, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"^#.*$", r"\g<0>.", re.sub(r"`[^`\n]*(?:\n[^`\n]+)?`", "CODE", markdown), flags=re.MULTILINE)


def findings(name: str, text: str) -> Iterator[str]:
    """What to change in a text, a line each."""
    # Ours stand first, too: proselint takes the first entry that fits a check.
    enabled = RULES["proselint"] | config.DEFAULT["checks"] | RULES["proselint"]
    for found in LintFile(name, text).lint({"max_errors": 1000, "checks": enabled}):
        yield f"{name}:{found.pos[0]}: {found.check_result.message}"
    yield from wording(name, text)
    for paragraph in re.finditer(r"(?:^(?!\s*(?:[|#]|$)).+\n?)+", text, re.MULTILINE):
        for item in re.split(r"^\s*(?:[*-]|\d+\.) ", paragraph[0], flags=re.MULTILINE):
            for sentence in re.split(r"(?<=[.?!:;])[\s*]+", item):
                if len(sentence.split()) > RULES["sentences"]["most_words"]:
                    where = _line(text, paragraph.start())
                    yield f"{name}:{where}: a sentence of {len(sentence.split())} words: {sentence[:60]!r}"


def wording(name: str, text: str) -> Iterator[str]:
    """The words of a text that docs/prose.toml replaces, a line each."""
    in_one_line = text.replace("\n", " ")
    for pattern, instead in RULES["instead"].items():
        for found in re.finditer(rf"\b(?:{pattern})\b", in_one_line, re.IGNORECASE):
            yield f"{name}:{_line(text, found.start())}: '{found[0]}'; write: {instead}"


def docstrings() -> Iterator[tuple[str, str]]:
    """Names and docstrings of the code."""
    for path in [*(ROOT / "pmt_jax").rglob("*.py"), *(ROOT / "envs").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                yield f"{path.relative_to(ROOT)} ({getattr(node, 'name', 'module')})", ast.get_docstring(node) or ""


def _line(text: str, position: int) -> int:
    return text.count("\n", 0, position) + 1


def texts(files: list[str]) -> Iterator[tuple[str, str]]:
    """Names and prose of the files; of all pages and of the command line's help if none is named."""
    pages = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
    pages += sorted((ROOT / "docs").rglob("*.md"))
    for path in map(pathlib.Path, files) if files else pages:
        yield path.resolve().relative_to(ROOT).as_posix(), prose(path.read_text())
    if not files:
        cells = json.loads((ROOT / "docs" / "tutorial.ipynb").read_text())["cells"]
        yield "tutorial", prose("\n\n".join("".join(x["source"]) for x in cells if x["cell_type"] == "markdown"))
        yield "settings", ".\n\n".join(field.metadata["help"] for field in dataclasses.fields(Config)[1:])
        yield "metrics", ".\n\n".join(metric.definition for metric in METRICS.values())
        for command, parser in make_parser()[1].items():
            words = [parser.description, *(action.help for action in parser._actions)]
            yield f"pmt {command} --help", ".\n\n".join(filter(None, words))


def main(files: list[str]) -> int:
    """Prints what to change; 1 if there is anything."""
    CheckRegistry().register_many(checks)
    found = [line for name, text in texts(files) for line in findings(name, text)]
    found += [line for name, text in docstrings() for line in wording(name, text)] if not files else []
    print("\n".join(found) or "no findings")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
