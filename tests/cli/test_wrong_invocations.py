"""Whatever stands on the command line or in a file: it runs, or one sentence says why not. Nothing is compiled here."""

from __future__ import annotations

import dataclasses
import math
import pathlib
import tempfile

import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pmt_jax import load_config, tasks
from pmt_jax.cli import commands, main
from pmt_jax.config.settings import Config
from pmt_jax.errors import UsageError
from pmt_jax.policies import evaluate
from pmt_jax.studies import reproduce, sweep
from pmt_jax.training import trainer

COMMANDS = commands.make_parser()[1]
SETTINGS = [field.name for field in dataclasses.fields(Config)]
ODD = ("", " ", "-1", "0", "2.5", "nan", "inf", "-inf", "1e400", "1e30", "1e12", "4294967296", "9" * 400, "x" * 300)
ODD += (
    "none",
    "true",
    "[1,2",
    "=",
    "a=b=c",
    ",",
    "1,",
    "1,x",
    ":",
    "1:2:0",
    "640x",
    "0x10",
    "ü",
    "a b",
    "..",
    "/dev/null",
)
words = st.one_of(
    st.sampled_from(ODD),
    st.text(st.characters(min_codepoint=32, exclude_categories=("Cs",)), max_size=9),
    st.floats().map(str),
)
sources = st.sampled_from(
    ("lane", "paper/lane", "presets/smoke", "my_env.py", "none.toml", "hub:ant_2x4/none", "empty")
)


def build_task(task: str, policy: str, episodes: int, options: dict[str, object], save: object) -> dict[str, object]:
    """Builds the task of a baseline, and evaluates nothing."""
    tasks.make(task, **options)
    return {"cost_limit": 1.0, "episode_reward": (float(episodes), math.nan)}


@pytest.fixture(scope="module", autouse=True)
def nothing_trains():
    """What would need a compiled program does nothing, in an empty working directory."""
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        (pathlib.Path(folder) / "empty").mkdir()
        patch.chdir(folder)
        patch.setattr(trainer, "train", lambda *_, **__: 0)
        patch.setattr(sweep, "sweep", lambda *_, **__: 0)
        patch.setattr(reproduce, "reproduce", lambda *_, **__: 0)
        patch.setattr(evaluate, "evaluate_baseline", build_task)
        yield


@st.composite
def invocations(draw: st.DrawFn) -> list[str]:
    """A command, what it is about, and up to three of its flags with whatever behind them."""
    name = draw(st.sampled_from([name for name in COMMANDS if name not in ("doctor", "hub", "envs", "completion")]))
    flags = [a for a in COMMANDS[name]._actions if a.option_strings and a.dest != "help"]
    argv = [name, draw(st.one_of(sources, words))]
    for action in draw(st.lists(st.sampled_from(flags), max_size=3)):
        argv.append(action.option_strings[-1])
        argv += [] if action.nargs == 0 else [draw(words)]
    return argv


@settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(argv=invocations())
def test_a_command_line_runs_or_gets_one_sentence(argv: list[str], capsys: pytest.CaptureFixture[str]):
    capsys.readouterr()
    code = main(argv)
    _, err = capsys.readouterr()
    assert code in (0, 2), argv
    assert (err == "") == (code == 0)
    if code == 2:
        assert err.startswith("pmt: ") and len(err.rstrip("\n").splitlines()) == 1, argv


values = st.recursive(
    st.one_of(words, st.integers(), st.floats(), st.booleans()),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(words, inner, max_size=2)),
    max_leaves=4,
)
names = st.one_of(st.sampled_from([*SETTINGS, "extends", "about"]), words)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(table=st.dictionaries(names, values, max_size=3))
def test_a_file_is_read_or_gets_one_sentence(table: dict[str, object]):
    file = pathlib.Path("some.toml")
    file.write_text(tomli_w.dumps({"task": "lane", **table}))
    try:
        config = load_config(file)
    except UsageError as error:
        assert "\n" not in str(error)
    else:
        assert config == config.replace() or "nan" in repr(config)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(text=st.binary(max_size=30))
def test_a_file_of_any_bytes_is_read_or_gets_a_sentence(text: bytes):
    file = pathlib.Path("some.toml")
    file.write_bytes(text)
    assert main(["train", str(file)]) in (0, 2)


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        ("train lane --steps inf", "steps = 'inf' does not fit: expected a whole number"),
        ("train lane --steps 1e400", "steps = '1e400' does not fit: expected a whole number"),
        ("train lane --steps 1e30", "is more than 2**31 updates"),
        (f"train {'x' * 300}", "unknown task 'xxx"),
        (f"train {'x' * 300}.toml", "cannot read the configuration file"),
        ("train lane --num-envs 1e12", "num_envs must be at least 1 and fit 32 bits"),
        ("train lane --num-envs 1e9", "does not fit 32 bits; ask for a smaller batch"),
        ("train lane --lambda-init 1e38", "lambda_init = 1e+38 lies above lambda_max = 20.0"),
        ("train lane --actor-lr 1e39", "actor_lr must be a number that is not negative and fits 32 bits"),
        ("render none --episode 4294967296", "--episode must be a whole number of at most 2147483647"),
        ("render none --steps 3:1:0", "--steps must be FROM:TO or FROM:TO:EVERY, like 100:300:2, not '3:1:0'"),
        ("render none --steps 0:5:00", "--steps must be FROM:TO or FROM:TO:EVERY, like 100:300:2, not '0:5:00'"),
        ("render none --size 8x8", "--size must be a whole number of at least 32, not '8'"),
        ("eval none --env foo=1", "--env needs --policy: a run keeps its task"),
        ("eval voltage_33 --policy zero --which best", "--which belongs to a run; leave out --policy"),
        ("eval lane --policy zero --env num_agents=2.5", "num_agents must be a whole number, not 2.5"),
        ("eval voltage_33 --policy zero --env v_lower=abc", "v_lower must be a number, not 'abc'"),
        ("eval ant_2x4 --policy zero --env observation=3", "observation must be a text, not 3"),
        ("eval voltage_33 --policy zero --env data=7", "data must be a text or a Path"),
        (
            "sweep lane --set clip=, --out x",
            "--set takes NAME=VALUE,VALUE,...",
        ),
    ],
)
def test_what_once_ended_in_a_traceback(argv: str, says: str, cli):
    code, _, err = cli(*argv.split())
    assert code == 2 and says in err and err.count("\n") == 1
