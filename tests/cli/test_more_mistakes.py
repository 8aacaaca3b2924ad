"""More than a hundred wrong invocations by hand: each gets one sentence and exit code 2, and changes nothing."""

from __future__ import annotations

import os
import pathlib
import shlex
import stat
import subprocess
import sys

import pytest

from by_hand import row, written
from paths import ROOT
from pmt_jax.errors import UsageError
from pmt_jax.files import writing
from pmt_jax.training import trainer

FILES = {
    "file": b"mine",
    "notrun/thesis.tex": b"mine",
    "binary.toml": b"\x00\xff\xfe",
    "nul.toml": b'task = "la\x00ne"',
    "cycle.toml": b'extends = "cycle.toml"',
    "list.toml": b'task = ["lane"]',
    "date.toml": b'task = "lane"\nseed = 2026-01-01',
    "nested.toml": b'task = "lane"\n[clip]\nx = 1',
    "twice.toml": b'task = "lane"\nclip = 0.1\nclip = 0.2',
    "method.toml": b'task = "lane"\nmethod = "ppo"',
    "both.toml": b'task = "lane"\nmethod = "f4sg"\n[method.macpo]\nclip = 0.1',
    "pairs.toml": b'task = "lane"\nenv = [1]',
    "empty_list.toml": b'extends = "lane"\n[[sweep]]\nset.clip = []',
    "draws.toml": b'extends = "lane"\n[[sweep]]\nrandom = -1',
    "no_task.toml": b"clip = 0.1",
    "empty.py": b"",
    "syntax.py": b"def (",
    "exits.py": b"raise SystemExit(0)",
}
MISTAKES = """
Train lane | unknown command 'Train'; did you mean 'train'?
-train lane | argument COMMAND: invalid choice: 'lane'
--version=3 | argument --version: ignored explicit argument '3'
--verbose train lane | unknown argument '--verbose'
train lane lane | unexpected word 'lane' (see pmt train --help)
train 'lane ' | unknown task 'lane '; did you mean 'lane'?
train LANE | unknown task 'LANE'; did you mean 'lane'?
train lane --method MAPPO_L | unknown method 'MAPPO_L'; did you mean 'mappo_l'?
train '' | unknown task ''
train . | unknown task '.'
train lane:Lane | unknown task 'lane:Lane'; did you mean 'lane'?
train hub:ant_2x4/r4sg | unknown task 'hub:ant_2x4/r4sg'
train ant_2x4.toml | there is no configuration file ant_2x4.toml
train file | file is not valid TOML
train binary.toml | binary.toml is not valid TOML
train nul.toml | nul.toml is not valid TOML
train cycle.toml | cycle.toml extends 'cycle.toml', which extends it in turn
train list.toml | unknown task '['lane']'
train date.toml | seed = datetime.date(2026, 1, 1) does not fit: expected a whole number
train nested.toml | clip = {'x': 1} does not fit: expected a number
train twice.toml | twice.toml is not valid TOML: Cannot overwrite a value
train method.toml | unknown method 'ppo'; did you mean 'ippo'?
train both.toml | both.toml: method = NAME and [method.NAME] tables exclude each other; keep the tables and choose
train pairs.toml | env = [1] does not fit: expected name=value
train missing.py:Env | there is no environment file
train empty.py | should hold one class with reset and step
train syntax.py | cannot be imported: SyntaxError: invalid syntax
train exits.py | cannot be imported: SystemExit: 0
train lane --method | argument --method: expected one argument
train lane --method= | unknown method ''
train lane --method MAPPO | unknown method 'MAPPO'
train lane --method mappo,happo | unknown method 'mappo,happo'; did you mean 'mappo'?
train lane --seeds 0 | seeds must be at least 1 and fit 32 bits, not 0
train lane --seeds 1e10 | seeds must be at least 1 and fit 32 bits, not 10000000000
train lane --seeds= | seeds = '' does not fit: expected a whole number
train lane --seed 1e30 | seed must lie between 0 and 2**31 - seeds
train lane --steps 1,000 | steps = '1,000' does not fit
train lane --steps 1k | steps = '1k' does not fit
train lane --steps 1e6.5 | steps = '1e6.5' does not fit
train lane --num-envs 7 --minibatches 3 | a batch of 175 steps cannot be cut into 3 equal minibatches; take a divisor
train lane --rollout-length 0 | rollout_length must be at least 1
train lane --epochs 0 | epochs must be at least 1
train lane --hidden 64,-1 | hidden must name at least one layer of at least one unit, not [64, -1]
train lane --hidden , | hidden = ',' does not fit: expected whole numbers
train lane --hidden 64x64 | hidden = '64x64' does not fit: expected whole numbers
train lane --hidden 1e9 | networks with hidden = [1000000000] needs at least
train lane --activation RELU | activation = 'RELU' does not fit: expected relu | tanh | elu
train lane --layer-norm 2 | layer_norm = '2' does not fit: expected true or false
train lane --actor-lr -1e-3 | actor_lr must be a number that is not negative and fits 32 bits, not -0.001
train lane --actor-lr -inf | actor_lr must be a number that is not negative and fits 32 bits, not -inf
train lane --max-grad-norm 0 | max_grad_norm must be a number above 0, or inf, not 0.0
train lane --gae-lambda 2 | gae_lambda must lie in [0, 1], not 2.0
train lane --clip 0 | clip must be a number above 0, not 0.0
train lane --cost-limit 1,2 | cost_limit has 2 numbers, but task 'lane' has 1 cost(s)
train lane --cost-limit 1e39 | cost_limit must be a cost per episode of at least 0 that fits 32 bits, not 1e+39
train lane --method f4sg_letter --gamma 1 | f4sg_letter judges costs by 1 - gamma times their value
train lane --cost-limit one | cost_limit = 'one' does not fit: expected a number, or one for each cost
train lane --lambda-max 0.1 | lambda_init = 2.0 lies above lambda_max = 0.1
train lane --method macpo --limit-lr 3 | limit_lr must lie in [0, 1], not 3.0
train lane --method macpo --kl-limit inf | kl_limit must be a number above 0, not inf
train lane --lambda-init 0 | a multiplier of 0 never moves
train lane --init ~nosuchuser/x | --init must be a path, but '~nosuchuser/x' begins with a home that is unknown
train lane --physics= | physics = '' does not fit: expected auto | fused | mjx
train lane --env num_agents | env = ['num_agents'] does not fit: expected name=value
train ant_2x4 --env physics=warp | 'physics' is no option of a task; set physics = ... (--physics)
train lane --env name=3 | 'name' is no option of a task; name the task itself
train lane --env =3 | task 'lane' has no option ''
train lane --env num_agents=0 | num_agents must be at least 1, not 0
train lane --env num_agents=true | num_agents must be a whole number, not True
train lane --env num_agents=100000 | needs at least 144,00
train lane --preset= | unknown preset ''
train lane --preset ../presets/smoke | unknown preset '../presets/smoke'
train --preset smoke | the following arguments are required: TASK|CONFIG
train lane --eval-episodes 0 --eval-interval 1 | eval_episodes must be at least 1
train lane --loggers csv,csvv | unknown logger 'csvv'; did you mean 'csv'?
train lane --devices 0 | --devices must be a whole number of at least 1, not '0'
train lane --process 0 | --processes belong together; --coordinator and --processes are missing
train lane --coordinator nowhere --process 0 --processes 2 | --coordinator must be HOST:PORT
train lane --process 3 --processes 2 --coordinator a:1 | --process must be from 0 to 1 with --processes 2, not 3
train lane --out /dev/null | /dev/null is a file, not a folder
train lane --out notrun/thesis.tex/x | cannot write into notrun/thesis.tex/x: Not a directory
train lane --out= | . already holds other files
train lane --out notrun --resume | there is no run to resume in notrun: it has no config.toml
train lane --profile file --out x | file: File exists
train lane --resum --out x | unknown argument '--resum'; did you mean '--resume'?
table x --trust | unknown argument '--trust'
train lane --no-cache=3 | argument --no-cache: ignored explicit argument '3'
sweep lane | the following arguments are required: --out
sweep lane --set =1 --out s | unknown setting ''
sweep lane --set out=a,b --out s | unknown setting 'out'
sweep lane --set clip=0.1 --set clip=0.2 --out s | --set names clip twice: give all its values at once
sweep lane --set hidden=[64,32 --out s | --set takes NAME=VALUE,VALUE,..., or with --random
sweep lane --set clip=0.1,0.2 --clip 0.3 --out s | clip varies and is given by itself; leave one of the two out
sweep lane --set method=happo,mappo --method macpo --out s | method varies and is given by itself
sweep lane --set env=num_agents=2,num_agents=3 --env num_agents=4 --out s | the option num_agents varies and is given by
sweep lane --set seed=0,1 --seeds 2 --out s | 'seed=0' and 'seed=1' would both train seed 1: with seeds = 2 their first
sweep lane --set cost_limit=1,[1,2] --out s | cost_limit has 2 numbers, but task 'lane' has 1 cost(s); give one number
sweep empty_list.toml --out s | clip varies over an empty list; give it at least one value
sweep draws.toml --out s | draws.toml: random must be a whole number of at least 1, not -1
sweep lane --random 0 --out s | --random must be a whole number of at least 1, not '0'
sweep lane --set clip=0.1,0.2 --out run | run holds a run, not a sweep; choose another --out
train no_task.toml | no_task.toml names no task; add extends = "TASK"
train run | run/config.toml, and this continues it: pmt train run/config.toml --out run --resume
sweep lane --set env=num_agents=2,agents=3 --out s | task 'lane' has no option 'agents'
sweep lane --set clip=0.1,0.2 --out file | cannot write into file: File exists; choose another --out
sweep lane --set clip=a:b --random 2 --out s | random draws need a range
sweep lane --set clip=0.1,0.2 --jobs 0 --out s | --jobs must be a whole number of at least 1, not '0'
sweep lane --set env=num_agents=x,y --out s | env = ['y'] does not fit
sweep lane --set clip=0.1,0.2 --seeds 0 --out s | seeds must be at least 1
sweep lane --set clip=0.1,0.2 --out s --resume | unknown argument '--resume': the same command without it continues
sweep lane --set clip=0.1,0.2 --out s --workers 2 | unknown argument '--workers': only pmt train has workers; --jobs N
reproduce table1 --workers=2 | unknown argument '--workers': only pmt train has workers; --jobs N trains N programs
sweep hub:ant_2x4/r4sg --set clip=0.1,0.2 --out s | unknown task 'hub:ant_2x4/r4sg'
eval | the following arguments are required: RUN|TASK
eval run run | unexpected word 'run' (see pmt eval --help)
eval file | file is not a run folder: it is a file
eval run/config.toml | run/config.toml is not a run folder: it is a file; name its folder, run
eval . | . is not a run folder: it holds
eval ant_2x4/f4sg | is a pretrained policy, not a run folder; name it hub:ant_2x4/f4sg
eval run | there is no finished checkpoint in run/checkpoints; train the run first
eval run --episodes 1e3 | --episodes must be a whole number of at least 1, not '1e3'
eval run --episodes 99999999999 | --episodes must be a whole number of at most 2147483647
eval run --policy zero | run is a run and no task: leave out --policy to evaluate it, or name a task
eval lane | lane is a task and no run: name a folder that pmt train wrote; a baseline, which voltage
eval none.py:Env | none.py:Env is a task and no run: name a folder
eval lane --policy random --physics mujoco | --physics belongs to a run; leave out --policy
eval voltage_33 --policy zero --env voltage=3 | task 'voltage_33' has no option 'voltage'
eval hub: | unknown policy 'hub:'
eval hub:../../etc/passwd | unknown policy 'hub:../../etc/passwd'
eval hub:ant_2x4/r4sg --physics gpu | physics = 'gpu' does not fit
export hub:ant_2x4/r4sg -o p --which best2 | unknown checkpoint 'best2'; did you mean 'best'?
export run -o file | there is no finished checkpoint in run/checkpoints
export run -o | argument -o/--out: expected one argument
render run -o x | cannot write x: its ending must be .mp4, .gif or .html
render run --fps 0 | --fps must be a whole number of at least 1, not '0'
render run --size 0x0 | --size must be a whole number of at least 32, not '0'
render run --size 99999x99999 | --size must be a whole number of at most 8192
render run --steps a:b | --steps must be a whole number of at least 0, not 'a'
render run --episode -1 | --episode must be a whole number of at least 0, not '-1'
plot file | file holds no run
plot notrun | notrun holds no run
plot run -o run | cannot write run: its ending must be .png, .svg or .pdf
plot run -o .png | cannot write .png: its ending must be .png, .svg or .pdf
plot run -o file/x.png | cannot write file/x.png: File exists
report run -o .html | cannot write .html: the ending of a report must be .html
report run -o file/x.html | cannot write file/x.html: file is a file, not a folder; choose another -o
render run -o file/x.html | cannot write file/x.html: file is a file, not a folder; choose another -o
eval run --save file/x.npz | cannot write file/x.npz: file is a file, not a folder; choose another --save
report broken | broken/metrics.jsonl: a row has step = "x", where a whole number belongs
table run --baseline nobody | no row is called 'nobody'
table run --test | --test compares with a baseline
table run -o notrun | cannot write notrun: Is a directory
table run -o '' | cannot write .: it is a folder; choose another -o
table run -o . | cannot write .: it is a folder
table run -o ./ | cannot write .: it is a folder
table run -o / | cannot write /: it is a folder
export hub:ant_2x4/r4sg -o / | cannot write into /: it is the root of all folders
table run --format pdf | unknown format 'pdf'
reproduce table4 | unknown table 'table4'; did you mean 'table3'?
reproduce table1 --budget huge | unknown budget 'huge'
reproduce table1 --format pdf | unknown format 'pdf'
reproduce table1 table2 | unexpected word 'table2'
hub ant | unexpected word 'ant'
doctor --fix | unknown argument '--fix'
envs lane switch | unexpected word 'switch'
envs syntax.py | cannot be imported: SyntaxError
"""


def test_each_gets_its_sentence(tmp_path: pathlib.Path, cli, monkeypatch: pytest.MonkeyPatch):
    for name, content in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    written(tmp_path / "run", [row(10, 0, 1.0, episode_cost=1.0, violation_rate=0.0)])
    written(tmp_path / "broken", ['{"step": "x"}\n'])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(trainer, "compile_run", lambda *_: pytest.fail("trains"))
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    wrong = []
    for line in MISTAKES.strip().splitlines():
        words, says = line.split(" | ", 1)
        code, out, err = cli(*shlex.split(words))
        if code != 2 or out or says not in err or not err.startswith("pmt: ") or err.count("\n") != 1:
            wrong.append((words, code, out, err))
        changed = {
            path
            for path in tmp_path.rglob("*")
            if path not in before or path.is_file() and path.read_bytes() != before[path]
        }
        if changed:
            wrong.append((words, "changed", changed))
    assert not wrong


@pytest.mark.parametrize(("argv", "code"), [("envs", 0), ("nothing", 2)])
def test_closed_output_is_silence(argv: str, code: int):
    command = f"{shlex.quote(sys.executable)} -m pmt_jax {argv}"
    silent = subprocess.run(["bash", "-c", f"{command} >&- 2>/dev/null"], cwd=ROOT, capture_output=True)
    muted = subprocess.run(["bash", "-c", f"{command} 2>&- >&-"], cwd=ROOT, capture_output=True)
    assert (silent.returncode, muted.returncode) == (code, code)


def test_a_pipe_is_written_and_never_replaced(tmp_path: pathlib.Path):
    """As /dev/stdout and /dev/full are."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    both = os.open(pipe, os.O_RDWR)
    with writing(pipe) as place:
        place.write_text("table")
    assert os.read(both, 9) == b"table" and stat.S_ISFIFO(pipe.stat().st_mode)
    os.close(both)
    with (
        pytest.raises(UsageError, match="cannot write /dev/full: No space left on device; choose another --save"),
        writing(pathlib.Path("/dev/full"), "--save") as place,
    ):
        assert place == pathlib.Path("/dev/full")
        raise OSError(28, "No space left on device")


def test_a_link_behind_o_stays_one(tmp_path: pathlib.Path):
    out, link = tmp_path / "page" / "x.html", tmp_path / "link.html"
    link.symlink_to(out)
    for text in ("first", "second"):
        with writing(link) as partial:
            partial.write_text(text)
        assert link.is_symlink() and out.read_text() == text


def test_a_file_behind_o_is_whole_or_the_old_one(tmp_path: pathlib.Path):
    out = tmp_path / "table.md"
    out.write_text("old")
    with pytest.raises(KeyboardInterrupt), writing(out) as partial:
        partial.write_text("half")
        raise KeyboardInterrupt
    assert out.read_text() == "old" and [path.name for path in tmp_path.iterdir()] == ["table.md"]
