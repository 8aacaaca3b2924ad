"""Every code block of the README and the site runs, in the order of its page, in a folder of the page's own.

A block runs as it stands but for SMALLER and SIZES, which make it cheap. ELSEWHERE lists the lines of shell that
cannot run here. A Python block that cannot is below a comment `<!-- not run: REASON -->`; it is still compiled.
Pages with shell blocks run in the second part of .ci/run, all others by default.
"""

from __future__ import annotations

import functools
import pathlib
import re
import shlex
import shutil
import tomllib
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from bench.__main__ import main as bench
from by_hand import made
from paths import DATA, ROOT
from pmt_jax.config.methods import METHODS
from pmt_jax.errors import UsageError
from pmt_jax.render import gl
from pmt_jax.studies import table
from pmt_jax.training import final

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"(<!-- not run: \S.*? -->\n)?```(bash|python|toml)\n(.*?)```", re.DOTALL)
SLOW = {"multi_goal", "own_loop", "own_method", "voltage"}  # pages without shell blocks that compile for seconds

ELSEWHERE = {
    r"git clone|cd|python -m venv|source|pip install": "downloads; .ci/run makes environments and installs into them",
    r"pytest": "the first part of .ci/run",
    r"pre-commit": "writes into .git; tests/docs/test_docs.py compares its hooks with .ci/run",
    r"srun|case|.*--coordinator": "several hosts; tests/training/test_devices.py has several processes",
    r"nvidia-": "an NVIDIA GPU",
    r".*--loggers wandb": "wandb, which .[dev] does not have; tests/training/test_loggers.py runs it if it is there",
    r"python -m bench peers": "other programs, which a reader downloads; tests/bench has doubles of them",
    r"python -m bench publish": "replaces policies of the package; tests/policies/test_pretrained.py has a copy",
}


def _steps(found: re.Match[str]) -> str:
    """Few, and one number for most runs, which then share programs; but more for a run that goes on."""
    few = int(float(found[1])) // 100
    return f"--steps {few if 2048 < few <= 3000 else 2048}"


SMALLER: list[tuple[str, str | Callable[[re.Match[str]], str]]] = [
    (r"--steps ([\d.e]+)(?!\S)", _steps),
    (r"--(seeds|episodes|random) \d+", r"--\1 2"),
    (r"--(jobs|workers|devices) \d+", r"--\1 1"),
    (r"sweep ant_2x4", "sweep lane"),
    (r"train voltage_33 --steps \S+", "train voltage_33 --steps 512"),
    (r"--steps 0:150", "--steps 0:9"),
    (r"--steps 80:220:4", "--steps 80:88:4"),
    (r"--deterministic --size", "--deterministic --steps 0:9 --size"),
    (r"--method r4sg", "--method f4sg"),
    (r"train (paper/)?ant_2x4 --method f4sg", r"train \1ant_2x4"),
    # Where flags matter and not the robot, which README and train.md train.
    (r"train ant_2x4$", "train lane"),
    (r"train ant_2x4(.*) --(eval-interval|devices|workers)", r"train lane\1 --\2"),
    (r"train lane --cost-limit", "train lane --method mappo_l --cost-limit"),
    (r"train ant_2x4 (.*runs/ant$)", r"train lane \1"),
    (r"train paper/ant_2x4 (.*--out)", r"train lane \1"),
    (r"--init hub:ant_2x4/f4sg", "--init hub:ant_2x4/mappo"),
    (r"train velocity_ant_2x4", "train lane"),
    (r"eval runs/x --physics", "eval hub:ant_2x4/mappo_l --physics"),
    (r"method=mappo_l,f4sg,r4sg", "method=mappo"),
    (r"sweep study\.toml (.*--part)", r"sweep lane --set clip=0.1,0.2 --method mappo \1"),
    (r"\[64,64\],\[128,128\]", "[32,32]"),
    (r"bench run.*", 'bench run ant --quick --only "plain loop"'),
    (r"HEAD~5", "bench/results"),  # a checkout may be shallow
    (r'load_config\("lane", method="f4sg"\)', 'load_config("lane", steps=2000, num_envs=8)'),
    # Programs that no other command shares are of the method that compiles fastest.
    (r'load_config\("lane", (method="f4sg", )?(?!method)', 'load_config("lane", method="mappo", '),
    (r"train (docs/examples/my_env\.py) --method f4sg", r"train \1"),
    (r"split\(jax\.random\.key\(0\), 5\)", "split(jax.random.key(0), 2)"),  # as many seeds as on another page
    (r"random = \d+", "random = 2"),
    (r'"voltage_141"$', '"lane"'),
    (r"my/mapdn/folder", str(DATA / "mapdn_format_case33")),
]
BUDGET = {"steps": 2048, "seeds": 2, "num_envs": 16, "rollout_length": 32, "minibatches": 1, "epochs": 1}
BUDGET |= {"emotion_epochs": 1, "log_interval": 1}
_RUN = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in BUDGET.items())
# Given to a command that does not have them. One method, which compiles fastest, lets most runs share one program.
SIZES = {"train": f"--method mappo {_RUN}", "sweep": _RUN, "eval": "--episodes 2", "report": "--episodes 2"}

# The runs that a page speaks of and does not make.
GIVEN = {name: "pmt train lane --out runs/x" for name in ("evaluate", "render")}
GIVEN["export"] = "pmt train lane --out runs/lane"


def commands(block: str) -> Iterator[str]:
    """The commands of a shell block, each in one line and without comments and assignments."""
    for line in re.sub(r"\$\(.*?\)", "", block.replace("\\\n", " ")).splitlines():
        for part in line.split("&&"):
            words = shlex.split(part, comments=True)
            while words and re.match(r"\w+=", words[0]):
                words.pop(0)
            if words:
                yield shlex.join(words)


def smaller(text: str) -> str:
    for pattern, instead in SMALLER:
        text = re.sub(pattern, instead, text, flags=re.MULTILINE)
    return text


@functools.cache
def has_opengl() -> bool:
    try:
        return bool(gl.choose())
    except UsageError:
        return False


def words_of(command: str) -> list[str]:
    """A command that costs little; names with * are those that are there. Without OpenGL, films become pages."""
    words = shlex.split(smaller(command))
    if words[1] == "render" and not has_opengl():
        words = [re.sub(r"\.gif$", ".html", word) for word in words]
    sizes = iter(SIZES.get(words[1], "").split())
    words += [word for pair in zip(sizes, sizes, strict=True) if pair[0] not in words for word in pair]
    return [
        found for word in words for found in (sorted(map(str, pathlib.Path().glob(word))) if "*" in word else [word])
    ]


def small_paper(folder: pathlib.Path) -> dict[str, Any]:
    """The paper's tables, each with one method on a toy: tests/studies/test_sweep.py trains a whole table."""
    paper = tomllib.loads((ROOT / "pmt_jax" / "studies" / "paper.toml").read_text())
    for each in paper["tables"].values():
        each.update(methods=["mappo"], baseline="mappo", tasks=["lane"])
        each.pop("budgets", None)  # the small ones below are for all tables
    lines = ['extends = "lane"', *(f"{name} = {value}" for name, value in BUDGET.items())]
    (folder / "lane.toml").write_text("\n".join(lines))
    return paper | {"budgets": dict.fromkeys(paper["budgets"], {"source": f"{folder}/{{task}}.toml"})}


@pytest.fixture
def folder(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[pathlib.Path]:
    """A folder in which a reader may stand: what runs may write there, and may add methods."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))  # policy/numpy_policy.py is imported
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # `bench` is not installed and starts processes
    shutil.copytree(ROOT / "docs" / "examples", tmp_path / "docs" / "examples")
    (tmp_path / "bench" / "sweeps").mkdir(parents=True)
    (tmp_path / "bench" / "results").symlink_to(ROOT / "bench" / "results")
    for path in (ROOT / "bench" / "sweeps").glob("*.toml"):
        (tmp_path / "bench" / "sweeps" / path.name).write_text(smaller(path.read_text()))
    monkeypatch.setattr(table, "paper", lambda: small_paper(tmp_path))
    monkeypatch.setattr(final, "EPISODES", 2)
    methods = dict(METHODS)
    yield tmp_path
    METHODS.clear()
    METHODS.update(methods)


def pages() -> list[Any]:
    found = [path for path in PAGES if BLOCK.search(path.read_text())]
    late = [path for path in found if "```bash" in path.read_text() or path.stem in SLOW]
    name = {path: path.relative_to(ROOT).with_suffix("").as_posix() for path in found}
    return [pytest.param(path, id=name[path], marks=[pytest.mark.full] if path in late else []) for path in found]


@pytest.mark.timeout(1800)  # a page has many commands, and a machine may be loaded
@pytest.mark.parametrize("path", pages())
@pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")
def test_blocks_run(path: pathlib.Path, folder: pathlib.Path, cli: Any):
    text, namespace, ran = path.read_text(), {}, set()
    blocks = list(BLOCK.finditer(text))
    assert len(blocks) == len(re.findall(r"^```(?:bash|python|toml)", text, re.MULTILINE))

    def run(command: str) -> None:
        if any(re.match(pattern, command) for pattern in ELSEWHERE):
            return
        words = words_of(command)
        if tuple(words) in ran:
            return
        ran.add(tuple(words))
        if words[0] == "pmt":
            code, _, err = cli(*words[1:])
            assert code == 0, f"{shlex.join(words)}: {err}"
        else:
            assert words[:3] == ["python", "-m", "bench"], f"{command}: how does this run?"
            assert bench(words[3:]) == 0, command

    for method in ("happo", "f4sg", "mappo_l") if path.stem == "compare" else ():
        made(folder / "runs" / method, "lane", method, {0: [17.0, 0.9], 1: [18.0, 1.1]})
    if path.stem in GIVEN:
        run(GIVEN[path.stem])
    for block in blocks:
        if block[2] == "toml":
            (folder / "my_settings.toml").write_text(block[3])
        elif block[2] == "python":
            program = compile("\n" * text[: block.start(3)].count("\n") + smaller(block[3]), path, "exec")
            if not block[1]:
                exec(program, namespace)
        else:
            for command in commands(block[3]):
                run(command)


def test_nothing_is_left_out_in_vain():
    blocks = [block[3] for path in PAGES for block in BLOCK.finditer(path.read_text()) if block[2] == "bash"]
    found = [command for block in blocks for command in commands(block)]
    assert all(any(re.match(pattern, command) for command in found) for pattern in ELSEWHERE)
