"""What is measured: each bench is a list of cases, which take turns or run one after the other."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NamedTuple

from pmt_jax import METHODS
from pmt_jax.errors import UsageError
from pmt_jax.tasks import did_you_mean

Timed = Literal["plain loop", "environment", "training", "power flow"]
Kind = Timed | Literal["start", "checkpoint", "baseline", "certificate", "update"]
Settings = tuple[tuple[str, Any], ...]


@dataclasses.dataclass(frozen=True)
class Case:
    """One thing to measure. A field that is left out is in no row.

    Attributes:
      kind: a plain Python loop over C MuJoCo; the environment alone under random actions; the whole training loop;
        the start of `pmt train`; checkpoints; power flows; episodes of a policy that is not learned.
      task: an environment, or a network for power flows.
      what: which start, tool, policy, walls or rule.
      method, physics: of training and of the engine; the task's own if left out.
      seeds, num_envs: side by side; of power flows the batch, of a baseline or certificate its episodes.
      rollout_length: control steps of an environment between updates; alone, control steps in one call.
      devices: that share the environments and seeds; threads: plain loops at once, 0 for one on each of all CPUs.
      workers: worker processes that share the seeds of a training and the CPUs; cases with more than CPUs do not run.
      settings: other settings of the training; alone, other options of the environment.
    """

    kind: Kind
    task: str
    what: str = ""
    method: str = ""
    physics: str = ""
    seeds: int = 1
    num_envs: int = 1
    rollout_length: int = 0
    devices: int = 1
    threads: int = 0
    workers: int = 1
    settings: Settings = ()

    def about(self) -> dict[str, Any]:
        """The case as the beginning of its row."""
        said = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "settings"}
        defaults = {f.name: f.default for f in dataclasses.fields(self)}
        always = ("seeds", "num_envs", "rollout_length") if self.kind in ("environment", "training") else ()
        return {name: value for name, value in said.items() if name in always or value != defaults[name]}


class Program(NamedTuple):
    """What a case becomes when it is timed.

    Attributes:
      call: does its work once and waits until it is done; goes on from where it stopped.
      steps: environment steps, or power flows, of a call, of all seeds and environments together.
      facts: what is known before it runs, for its row.
    """

    call: Callable[[], Any]
    steps: int
    facts: dict[str, Any] = {}


Build = Callable[[], Program]  # compiles


@dataclasses.dataclass(frozen=True)
class Bench:
    """A list of cases, whose rows make one result. All programs are compiled first and take turns, so that other work
    on the machine hits all alike.

    Attributes:
      what: what is measured, with units.
      cases: in the order of the rows; quick: what a smoke runs instead, once.
      on: `gpu` and `gpus` are skipped if there is none, or only one, unless given by name. `either` runs where it is
        asked to. Results of GPUs are named after the device, too.
      gpu: of a bench for `either`, its cases on a GPU.
    """

    what: str
    cases: Sequence[Case]
    quick: Sequence[Case]
    on: Literal["cpu", "gpu", "gpus", "either"] = "cpu"
    gpu: Sequence[Case] = ()

    def chosen(self, on_cpu: bool, quick: bool) -> Sequence[Case]:
        """The cases for a CPU or a GPU, or those of a smoke."""
        return self.quick if quick else self.gpu if self.on == "either" and not on_cpu else self.cases


def _alone(task: str, sizes: Iterable[int], steps: int = 0, seeds: int = 1, **engine: Any) -> tuple[Case, ...]:
    """The environment alone; a call has 2,048 steps of all environments together unless `steps` is given."""
    return tuple(
        Case("environment", task, seeds=seeds, num_envs=n, rollout_length=steps or max(4, 2048 // n), **engine)
        for n in sizes
    )


def _walled(walls: str, **engine: Any) -> tuple[Case, ...]:
    return _alone("ant_2x4", (64,), what=walls, settings=(("walls", walls),), **engine)


def _training(task: str, method: str, seeds: int, num_envs: int, length: int, *more: Any, **engine: Any) -> Case:
    sizes = {"seeds": seeds, "num_envs": num_envs, "rollout_length": length}
    return Case("training", task, method=method, settings=more, **sizes, **engine)


def _plain(task: str) -> Case:
    return Case("plain loop", task)


def _in_workers(task: str, seeds: int, counts: Sequence[int]) -> tuple[Case, ...]:
    return tuple(dataclasses.replace(_training(task, "mappo_l", seeds, 64, 64), workers=count) for count in counts)


def _fits(task: str, num_envs: int, length: int, *ways: str) -> tuple[Case, ...]:
    """One step of the critic and of an actor, by XLA and by the learner's own code."""
    sizes = {"method": "mappo_l", "num_envs": num_envs, "rollout_length": length}
    return tuple(Case("update", task, f"{net} {way}", **sizes) for net in ("critic", "actor") for way in ways)


def _scaled(task: str, num_envs: int, length: int, devices: Sequence[int]) -> tuple[Case, ...]:
    """One device; then per number D of devices D times the environments, D seeds, and what one device had."""
    cases = [_training(task, "mappo_l", 1, num_envs, length, what="one device")]
    for count in devices:
        for what, seeds, envs in (("weak, environments", 1, count * num_envs), ("weak, seeds", count, num_envs)):
            cases.append(_training(task, "mappo_l", seeds, envs, length, what=what, devices=count))
        cases.append(_training(task, "mappo_l", 1, num_envs, length, what="strong", devices=count))
    return tuple(cases)


# The ant's batch and networks, also on a task whose environment costs next to nothing: there the learner is alone.
_BATCH = (("epochs", 5), ("minibatches", 8), ("hidden", (128, 128)))
_GRU = ("recurrent", "gru")
_LIKE_THE_ANT = (*_BATCH, ("activation", "relu"), ("layer_norm", True))
_TOOLS = ("power-grid-model iterative_current", "power-grid-model newton_raphson")
_SINGLE_TOOLS = ("lightsim2grid", "lightsim2grid, solve only", "pandapower")
_OURS = ("ours f32", "ours f64")

# One task of each robot: what its motors are shared out as makes no difference to the speed.
ROBOTS = tuple(
    f"velocity_{name}"
    for name in ("ant_2x4", "half_cheetah_2x3", "hopper_3x1", "walker2d_2x3", "swimmer_2x1", "humanoid_9_8")
)

GOALS = tuple(f"multi_goal_{robot}_{level}" for robot in ("point", "ant") for level in range(3))

BENCHES = {
    "ant": Bench(
        "ant: control steps/s of the environment alone per engine and size, next to plain loops",
        (
            _plain("ant_2x4"),
            *_alone("ant_2x4", (64, 256), physics="fused"),
            *_alone("ant_2x4", (64, 256), physics="mujoco"),
            *_alone("ant_2x4", (64,), physics="mjx"),
        ),
        (_plain("ant_2x4"), *_alone("ant_2x4", (16,), physics="mujoco")),
        on="either",
        gpu=(
            *_alone("ant_2x4", (2048, 16_384), 100, physics="fused"),
            *_alone("ant_2x4", (2048, 16_384), 100, physics="warp"),
            *_alone("ant_2x4", (384,), 100, seeds=20, physics="fused"),
            _plain("ant_2x4"),
        ),
    ),
    "workstation": Bench(
        "ant: control steps/s of plain loops, the environment and training, one seed, and 8 and 16 in worker processes",
        (
            _plain("ant_2x4"),
            *_alone("ant_2x4", (64, 256), physics="mujoco"),
            *(_training("ant_2x4", "mappo_l", 1, 256, 32, devices=count) for count in (1, 2, 4)),
            _training("ant_2x4", "mappo_l", 1, 64, 64),
            *_in_workers("ant_2x4", 8, (1, 2, 4, 8)),
            *_in_workers("ant_2x4", 16, (1, 4, 8, 16)),
        ),
        (_plain("ant_2x4"), *_in_workers("ant_2x4", 2, (1, 2))),
    ),
    "walls": Bench(
        "ant: control steps/s of the environment alone, with walls that are drawn and with solid ones",
        tuple(
            case
            for engine in ("fused", "mujoco")
            for walls in ("reference", "solid")
            for case in _walled(walls, physics=engine)
        ),
        _walled("solid", physics="mujoco"),
    ),
    "hands": Bench(
        "hands: control steps/s per engine next to plain loops; CPU-seconds to compile",
        (
            _plain("hand_over_2x6"),
            *_alone("hand_over_2x6", (64, 256), physics="mujoco"),
            *_alone("hand_over_2x6", (64, 256), physics="mjx"),
        ),
        (_plain("hand_over_2x6"), *_alone("hand_over_2x6", (64,), physics="mujoco")),
    ),
    "robots": Bench(
        "velocity tasks: control steps/s of each robot alone per engine, on a CPU next to plain loops",
        tuple(
            case
            for task in ROBOTS
            for case in (
                _plain(task),
                *_alone(task, (256,), physics="fused"),
                *_alone(task, (256,), physics="mujoco"),
            )
        ),
        (_plain("velocity_hopper_3x1"), *_alone("velocity_hopper_3x1", (64,), physics="mujoco")),
        on="either",
        gpu=tuple(
            case
            for engine in ("fused", "warp")
            for task in ROBOTS
            for case in _alone(task, (16_384,), 50, physics=engine)
        ),
    ),
    "multi_goal": Bench(
        "MultiGoal tasks: control steps/s of the environment alone next to plain loops with the forward pass",
        tuple(
            case
            for task in GOALS
            for case in (
                _plain(task),
                *_alone(task, (64, 256), physics="fused"),
                *_alone(task, (64, 256), physics="mujoco"),
            )
        ),
        (_plain("multi_goal_point_1"), *_alone("multi_goal_point_1", (64,), physics="mujoco")),
        on="either",
        gpu=tuple(case for task in GOALS for case in _alone(task, (2048,), 100, physics="fused")),
    ),
    "methods": Bench(
        "every method: seconds to compile and per update, steps/s of the whole training loop",
        (
            *(_training("ant_2x4", method, 1, 64, 64, *_BATCH) for method in METHODS),
            _training("ant_2x4", "mappo_l", 1, 64, 64, *_BATCH, _GRU, what="gru"),
        ),
        tuple(_training("switch", method, 1, 64, 64, *_LIKE_THE_ANT) for method in ("mappo_l", "r4sg")),
    ),
    "update": Bench(
        "one gradient step of a network: seconds by part, by XLA and by the learner's C++ code",
        (*_fits("ant_2x4", 64, 64, "xla", "fused"), *_fits("ant_2x4", 256, 64, "xla", "fused")),
        _fits("lane", 16, 16, "xla"),
    ),
    "update_gpu": Bench(
        "GPU: one gradient step of a network: seconds and kernels by part",
        (*_fits("ant_2x4", 2048, 8, "xla", "fused"), *_fits("ant_2x4", 384, 32, "xla", "fused")),
        _fits("lane", 16, 16, "xla"),
        on="gpu",
    ),
    "grid": Bench(
        "power flows/s next to other tools; environment steps/s in a scan and with a call a step",
        (
            *(
                Case("power flow", network, what, num_envs=batch)
                for network in ("case33", "case141")
                for batch, tools in ((1024, (*_OURS, *_TOOLS)), (1, (*_OURS, *_SINGLE_TOOLS)))
                for what in tools
            ),
            *(case for task in ("voltage_33", "voltage_141") for n in (60, 1) for case in _alone(task, (256,), n)),
        ),
        (Case("power flow", "case33", "ours f32", num_envs=1024), *_alone("voltage_33", (256,), 60)),
    ),
    "baselines": Bench(
        "grids: what policies reach that are not learned, over 64 episodes",
        tuple(
            Case("baseline", task, what, num_envs=64)
            for task in ("voltage_33", "voltage_141")
            for what in ("zero", "random", "droop", "opf")
        ),
        (Case("baseline", "voltage_33", "zero", num_envs=2),),
    ),
    "certificate": Bench(
        "grids: in which steps of these 64 episodes any reactive power at all keeps every bus in the band",
        tuple(Case("certificate", task, num_envs=64) for task in ("voltage_33", "voltage_141")),
        (Case("certificate", "voltage_33", num_envs=2),),
    ),
    "checkpoint": Bench(
        "seconds to save and load a run of the method with the most networks; MB; share of training's wall time",
        (Case("checkpoint", "ant_2x4", method="mixed", num_envs=256),),
        (Case("checkpoint", "lane", method="mixed", num_envs=16),),
    ),
    "start": Bench(
        "seconds from `pmt train ant_2x4` to its first update, with empty caches and with those of the first start",
        tuple(Case("start", "ant_2x4", what, method="mappo_l") for what in ("empty cache", "second start")),
        (Case("start", "lane", "empty cache", method="mappo_l"),),
        on="either",
        gpu=tuple(
            Case("start", "ant_2x4", what, method="mappo_l", num_envs=2048, rollout_length=8)
            for what in ("empty cache", "second start")
        ),
    ),
    "loop": Bench(
        "ant: environment steps/s of the whole training loop per engine and size",
        tuple(
            _training("ant_2x4", "mappo_l", 1, n, 64, physics=engine)
            for engine in ("fused", "mujoco")
            for n in (64, 256)
        ),
        tuple(_training("switch", "mappo_l", seeds, 16, 25) for seeds in (1, 2)),
        on="either",
        gpu=(
            _training("ant_2x4", "mappo_l", 1, 2048, 8, physics="fused"),
            *(_training("ant_2x4", "mappo_l", seeds, 384, 32, physics="fused") for seeds in (5, 20)),
            _training("ant_2x4", "macpo", 20, 384, 32, physics="fused"),
            _training("ant_2x4", "mappo_l", 1, 2048, 8, physics="warp"),
        ),
    ),
    "engines": Bench(
        "GPU: environment steps/s of hands and grids per engine and size",
        (
            *_alone("hand_over_2x6", (4096, 16_384), 100, physics="warp"),
            *_alone("hand_over_2x6", (4096,), 20, physics="mjx"),
            *(case for task in ("voltage_33", "voltage_141") for case in _alone(task, (4096, 65_536), 240)),
        ),
        _alone("voltage_33", (64,), 60),
        on="gpu",
    ),
    "scaling": Bench(
        "GPUs: environment steps/s of the whole training loop over 1, 2, 4 ... devices, and the efficiency",
        (*_scaled("ant_2x4", 4096, 8, (2, 4, 8)), *_scaled("voltage_33", 4096, 60, (2, 4, 8))),
        _scaled("switch", 8, 25, (2,)),
        on="gpus",
    ),
}


def chosen(names: Sequence[str]) -> list[str]:
    """The benches by these names, in the order of BENCHES; all if there is no name.

    Raises:
      UsageError: there is none by that name.
    """
    for name in names:
        if name not in BENCHES:
            raise UsageError(f"unknown bench '{name}'{did_you_mean(name, BENCHES)}")
    return [name for name in BENCHES if not names or name in names]
