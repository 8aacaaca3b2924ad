"""A flag for every setting, in groups, with the defaults of the task that is asked about."""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

from ..config import load
from ..config.fields import GROUPS
from ..config.load import expectation, load_config
from ..config.methods import METHODS
from ..config.settings import FIELDS, Config
from ..errors import UsageError
from .parser import EVERYTHING, HELP, path

_METAVARS = {int: "N", float: "X"}
_FIRST = ("method", "steps", "seeds", "seed", "num_envs", "rollout_length", "hidden", "actor_lr", "cost_limit")
_FIRST += ("cost_margin", "physics", "env")  # what most people set, and `--help` without `all` shows
_PREFIX = "set_"  # of the names under which argparse keeps settings


def add_settings(parser: argparse.ArgumentParser) -> dict[str, argparse._ArgumentGroup]:
    """A flag for every field of Config, --preset, and --help; returns the groups, for more flags that belong there.

    The parser is made with add_help=False.
    """
    groups = {name: parser.add_argument_group(name, meaning) for name, meaning in GROUPS.items()}
    parser.add_argument(
        *HELP,
        action=_Help,
        help="shows what most people set, or with `--help all` everything; after a TASK with the task's own defaults",
    )
    presets = "; ".join(f"{name}: {about}" for name, about in load.presets().items())
    groups["common"].add_argument(
        "--preset", default="default", metavar="WORD", help=f"settings laid over the task's own ({presets})"
    )
    for field in dataclasses.fields(Config):
        if field.name == "task":  # it is the positional argument
            continue
        kind = FIELDS[field.name]
        metavar = "NAME=VALUE" if field.name == "env" else _METAVARS.get(kind, "WORD")
        action = "append" if field.name == "env" else "store"
        flag = f"--{field.name.replace('_', '-')}"
        groups[field.metadata["group"]].add_argument(flag, dest=_PREFIX + field.name, metavar=metavar, action=action)
    return groups


def given(arguments: argparse.Namespace) -> dict[str, Any]:
    """The settings that the command line names."""
    pairs = vars(arguments).items()
    found = {name.removeprefix(_PREFIX): x for name, x in pairs if name.startswith(_PREFIX) and x is not None}
    if found.get("init"):
        try:
            found["init"] = str(path(found["init"]))
        except argparse.ArgumentTypeError as error:
            raise UsageError(f"--init {error}") from None
    return found


class _Help(argparse.Action):
    """--help, or --help all, which reads the settings of the task and the flags before it when it is reached."""

    def __init__(self, **options: Any) -> None:
        super().__init__(nargs="?", metavar="all", **options)

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option_string: Any = None
    ) -> None:
        """Prints the help and ends."""
        source = namespace.source
        known = source and not (hasattr(namespace, "vary") and source.endswith(".toml"))  # a file may hold a sweep
        config = load_config(source, preset=namespace.preset, **given(namespace)) if known else Config()
        if known:
            parser.description = f"{parser.description} Defaults are those of {source}."
        fields = {field.name: field for field in dataclasses.fields(Config)}
        for action in parser._actions:
            if action.dest.startswith(_PREFIX):
                action.help = _help(fields[action.dest.removeprefix(_PREFIX)], config)
        if values != EVERYTHING:
            _hide_most(parser)
        parser.print_help()
        parser.exit()


def _hide_most(parser: argparse.ArgumentParser) -> None:
    """Leaves the settings of `_FIRST` in the help, and of the groups those that then have any."""
    for action in parser._actions:
        if action.dest.startswith(_PREFIX) and action.dest.removeprefix(_PREFIX) not in _FIRST:
            action.help = argparse.SUPPRESS
    shown = [group for group in parser._action_groups if any(x.help != argparse.SUPPRESS for x in group._group_actions)]
    parser._action_groups = shown
    parser.epilog = f"{sum(x.help == argparse.SUPPRESS for x in parser._actions)} more settings: --help {EVERYTHING}"


def describe(field: dataclasses.Field[Any], config: Config) -> tuple[str, str]:
    """Which values a setting takes, in words, and the one that it has in `config`, as one would type it."""
    words = " | ".join([*METHODS, "my_methods.py:NAME"]) if field.name == "method" else expectation(FIELDS[field.name])
    return words, _shown(getattr(config, field.name))


def _help(field: dataclasses.Field[Any], config: Config) -> str:
    words, default = describe(field, config)
    shown = f"default {default}" if FIELDS[field.name] in _METAVARS else f"{words}; default {default}"
    return f"{field.metadata['help']} [{shown}]".replace("%", "%%")


def _shown(value: Any) -> str:
    """A setting's value as one would type it."""
    if isinstance(value, tuple):
        return ",".join(f"{x[0]}={x[1]}" if isinstance(x, tuple) else str(x) for x in value) or "none"
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)
