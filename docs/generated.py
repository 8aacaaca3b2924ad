"""Pages of the site that mkdocs makes of the code when it builds: nothing of them is tracked, so nothing gets old.

mkdocs.yml names this file as its hook.
"""

from __future__ import annotations

import argparse
import dataclasses
import html
import json
import pathlib
import re
import sys
import tomllib
from collections.abc import Callable
from typing import Any

import griffe
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from pmt_jax import formats, tasks
from pmt_jax.cli.commands import make_parser
from pmt_jax.cli.flags import describe
from pmt_jax.config.fields import GROUPS
from pmt_jax.config.settings import HYPER_FIELDS, Config
from pmt_jax.studies import plot
from pmt_jax.training.metrics import METRICS

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
DOCS = pathlib.Path(__file__).parent
ROOT = DOCS.parent


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The repository is that of pyproject.toml; its folder is importable, as `bench` is not installed."""
    sys.path.insert(0, str(ROOT))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    if repository := project.get("urls", {}).get("Repository"):
        config.repo_url, config.repo_name, config.edit_uri = repository, project["name"], "edit/main/docs/"
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that are made."""
    for path, make in PAGES.items():
        files.append(File.generated(config, path, content=make()))
    return files


def on_page_content(content: str, **_: object) -> str:
    """Formulas as MathML, which browsers draw without a script."""

    def formula(found: re.Match[str]) -> str:
        return convert(html.unescape(found[3]), display="block" if found[2] == "[" else "inline")

    return FORMULA.sub(formula, content)


class SeveralNames(griffe.Extension):
    """Gives each name of an entry like `terminated, truncated: [T, B] bool` in a docstring an entry of its own."""

    ENTRY = re.compile(r"^( +)(\w+(?:, \w+)+): (.*(?:\n\1 +\S.*)*)$", re.MULTILINE)

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Changes the docstring before it is parsed."""
        if obj.docstring:
            obj.docstring.value = self.ENTRY.sub(
                lambda found: "\n".join(f"{found[1]}{name}: {found[3]}" for name in found[2].split(", ")),
                obj.docstring.value,
            )


def settings() -> str:
    """Every setting, from the metadata of its field."""
    lines = ["# Settings", "", "Every setting is a flag of `pmt train` and a line of a TOML file. Traced settings may"]
    lines += ["differ within one program, so a sweep over them compiles once. Any other change compiles a new program."]
    fields = [field for field in dataclasses.fields(Config) if field.name != "task"]
    for group, meaning in GROUPS.items():
        rows = []
        for field in fields:
            if field.metadata["group"] == group:
                values, default = describe(field, Config())
                bound = field.metadata["bound"]
                values += f"; must {bound.words}" if bound else ""
                traced = "yes" if field.name in HYPER_FIELDS else ""
                rows.append([f"`{field.name}`", field.metadata["help"], values, default and f"`{default}`", traced])
        lines += ["", f"## {group.capitalize()}", "", f"{meaning.capitalize()}.", ""]
        lines += [formats.markdown(["setting", "meaning", "values", "default", "traced"], rows)]
    return "\n".join(lines)


def metrics() -> str:
    """Every column of metrics.jsonl with its unit."""
    sums = {"sum": "; summed over the row"}
    rows = [[f"`{name}`", m.unit, m.definition + sums.get(m.reduction, "")] for name, m in METRICS.items()]
    return f"""# Metrics

The columns of `metrics.jsonl`. A row is `log_interval` updates of one seed. A value is the mean over the updates of its
row, unless its meaning says otherwise. A mean over episodes weighs each episode of the row the same.

* `info/NAME` is a metric of the task's own.
* `episode_cost`, `true_episode_cost`, `lambda` and `cost_excess` have parts. `NAME/0` is of the first cost, mean over
  agents, where a task has several. `NAME/agent_0` is of the first agent, and `NAME/agent_0/cost_0` of its first cost,
  where agents do not share costs ([how the limit is judged](run_folder.md#within-the-limit)).
* `eval/NAME` is the mean of NAME over the episodes of an evaluation with mean actions, and `eval/NAME/ci95` is the
  half-width of its 95 % interval. Both are null in rows without an evaluation.

{formats.markdown(["metric", "unit", "meaning"], rows)}
"""


def commands() -> str:
    """The help of every command; that of `train` without its settings, which have a page of their own."""
    parser, parsers = make_parser()
    parts = ["# Command line", "`pmt COMMAND --help` prints the same in a terminal.", "## pmt", _help(parser)]
    for name, command in parsers.items():
        if name in ("train", "sweep"):
            parts += [f"## pmt {name}", _help(command), "Every [setting](settings.md) is a flag, too."]
        else:
            parts += [f"## pmt {name}", _help(command)]
    return "\n\n".join(parts)


def _help(parser: argparse.ArgumentParser) -> str:
    for group in parser._action_groups:
        group._group_actions = [a for a in group._group_actions if not a.dest.startswith("set_")]
    parser._action_groups = [group for group in parser._action_groups if group._group_actions]
    parser.formatter_class = lambda prog: argparse.HelpFormatter(prog, width=100)
    return f"```text\n{parser.format_help().strip()}\n```"


def all_tasks() -> str:
    """What agents of every task observe, the motors that they move, and the options of the task."""
    from bench.tables import pages

    parts = ["# All tasks", "What each agent observes and moves. [Tasks](../tasks/index.md) says what they are about."]
    parts += [pages.as_tasks("all"), "`observation` and `state` count entries: of one agent's observation, and of what"]
    parts[-1] += " central critics see. `action entries` counts those of one agent. `steps` is the time limit."
    for name in tasks.names():
        parts += [f"## {name} {{#{name}}}"]
        shown = {"Observation": "observation", "Global state": "state", "Actions": "actions", "Options": "options"}
        for title, kind in shown.items():
            parts += [f"{title}:", pages.KINDS[kind](name)]
    return "\n\n".join(parts)


def pretrained() -> str:
    """The policies of the package with their evaluations, as `python -m bench publish` measured them."""
    from bench import records
    from bench.tables import speed

    table = speed.TABLES["hub"](records.load())
    head = (
        "Reward and cost of mean actions; [use a pretrained policy](../howto/pretrained.md) says what the columns mean."
    )
    return f"# Pretrained policies\n\n{head}\n\n{table}\n"


def tutorial() -> str:
    """The notebook docs/tutorial.ipynb as a page."""
    cells = json.loads((DOCS / "tutorial.ipynb").read_text())["cells"]
    forms = {"markdown": "{}", "code": "```python\n{}\n```"}
    text = "\n\n".join(forms[cell["cell_type"]].format("".join(cell["source"])) for cell in cells)
    return text.replace("](examples/", "](../examples/")


def from_the_top(name: str) -> Callable[[], str]:
    """A file of the repository's top level as a page, whose links are relative to its folder."""
    return lambda: re.sub(r"\]\(docs/", "](../", (ROOT / name).read_text())


def palette() -> str:
    """The colours of the figures for the style sheet of the site."""
    lines = [f"  --{name.replace('_', '-')}: {colour};" for name, colour in plot.METHOD_COLOURS.items()]
    return "\n".join([":root {", *lines, "}", ""])


PAGES: dict[str, Callable[[], str]] = {
    "start/tutorial.md": tutorial,
    "reference/settings.md": settings,
    "reference/metrics.md": metrics,
    "reference/commands.md": commands,
    "reference/tasks.md": all_tasks,
    "reference/pretrained.md": pretrained,
    "design/contributing.md": from_the_top("CONTRIBUTING.md"),
    "palette.css": palette,
}
