"""What one would write without this library: Python loops over C MuJoCo, random actions, no observations.

Loops that run at once have a process each: threads of one process wait for Python's lock, and 16 of them kept 9 CPUs
busy. A loop takes a task's model as it is; our C engine skips MuJoCo's search for islands in it, which changes no bit
and is worth 6 % on the ant.
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import contextlib
import functools
import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import mujoco
import numpy as np

from envs.ant import corridor
from envs.hands import hand_over
from envs.multi_goal import LEVELS, models
from envs.multi_goal import VARIANTS as GOALS
from envs.physics import usable_cpus
from envs.velocity import VARIANTS, robots

from .cases import Build, Case, Program

STEPS = 500  # control steps of a call


class Task(NamedTuple):
    """What a plain loop needs of a task.

    Attributes:
      model: as the `mujoco` engine has it; substeps: physics steps in a control step.
      reset: puts MjData where an episode begins; over: does what follows the physics, says whether the episode ended.
    """

    model: mujoco.MjModel
    substeps: int
    reset: Callable[[mujoco.MjData, np.random.Generator], None]
    over: Callable[[mujoco.MjModel, mujoco.MjData], bool]


def _reset_ant(data: mujoco.MjData, rng: np.random.Generator) -> None:
    data.qpos += rng.uniform(-0.1, 0.1, len(data.qpos))
    data.qvel[:] = 0.1 * rng.normal(size=len(data.qvel))


def _ant_over(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    mujoco.mj_rnePostConstraint(model, data)
    upright = 1 - 2 * (data.xquat[1, 1] ** 2 + data.xquat[1, 2] ** 2)
    return not (0.2 <= data.qpos[2] <= 1.0 and upright >= -0.7)


def _reset_hands(data: mujoco.MjData, rng: np.random.Generator) -> None:
    joints = data.model.jnt_range[: hand_over.JOINTS]
    pose = joints[:, 0] + (joints[:, 1] - joints[:, 0]) * rng.uniform(-1, 1, hand_over.JOINTS)
    data.qpos[: hand_over.HINGES] = hand_over.RESET_SPREAD * np.tile(pose, hand_over.HANDS)


def _hands_over(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    return not data.qpos[hand_over.HINGES + 2] > hand_over.FALLEN


def _velocity(name: str) -> Task:
    """A robot of the velocity tasks; the humanoid's observation needs the forces after constraints, too."""
    robot = robots.ROBOTS[name]

    def reset(data: mujoco.MjData, rng: np.random.Generator) -> None:
        data.qpos += rng.uniform(-robot.noise, robot.noise, len(data.qpos))
        data.qvel[:] = robot.noise * rng.normal(size=len(data.qvel))

    def over(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
        if robot.sees_forces:
            mujoco.mj_rnePostConstraint(model, data)
        healthy: Any = robot.healthy  # of NumPy's arrays here
        return healthy is not None and not healthy(data.qpos, data.qvel)

    return Task(robots.model(name), robot.substeps, reset, over)


def _multi_goal(variant: str) -> Task:
    """Robots, and as many vases as the engine steps, anywhere on a grid; sensors need the forward pass."""
    name, number = GOALS[variant]
    kind, level = models.ROBOTS[name], LEVELS[number]
    vases = min(level.vases, 4)
    side = np.arange(-level.size + 0.25, level.size, 0.5)
    cells = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    starts = [*range(0, 2 * kind.nq, kind.nq), *range(2 * kind.nq, 2 * kind.nq + 7 * vases, 7)]

    def reset(data: mujoco.MjData, rng: np.random.Generator) -> None:
        for start, place in zip(starts, rng.permutation(cells), strict=False):
            data.qpos[start : start + 2] = place
        if name == "ant":
            for start in starts[:2]:
                data.qpos[start + 2] = 0.18
                data.qpos[start + 8 : start + 15 : 2] = np.array([1, -1, -1, 1]) * np.pi / 2

    def over(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
        mujoco.mj_forward(model, data)
        heights = data.qpos[2 : 2 * kind.nq : kind.nq]
        return kind.least_height is not None and bool((heights <= kind.least_height).any())

    return Task(models.model(name, 2, vases, level.size), models.SUBSTEPS, reset, over)


TASKS: dict[str, Callable[[], Task]] = {
    **{f"velocity_{task}": functools.partial(_velocity, variant.robot) for task, variant in VARIANTS.items()},
    **{f"multi_goal_{variant}": functools.partial(_multi_goal, variant) for variant in GOALS},
    "ant_2x4": lambda: Task(corridor.model(), corridor.SUBSTEPS, _reset_ant, _ant_over),
    "hand_over_2x6": lambda: Task(hand_over.model(), hand_over.SUBSTEPS, _reset_hands, _hands_over),
}


def plain_loop(case: Case) -> Build:
    """As many loops at once as the case has threads: one in this process, and one in each of its workers."""
    task, threads = TASKS[case.task](), case.threads or usable_cpus()

    def build() -> Program:
        workers = [_worker(case.task, seed) for seed in range(1, threads)]

        def call() -> None:
            for worker in workers:
                worker.send(None)
            _loop(task, 0)
            for worker in workers:
                worker.recv()

        for worker in workers:
            worker.recv()
        return Program(call, threads * STEPS, {"threads": threads})

    return build


def _loop(task: Task, seed: int) -> None:
    """STEPS control steps."""
    model, data, rng = task.model, mujoco.MjData(task.model), np.random.default_rng(seed)
    low, high = model.actuator_ctrlrange.T
    task.reset(data, rng)
    for action in rng.uniform(low, high, (STEPS, model.nu)):
        data.ctrl[:] = action
        mujoco.mj_step(model, data, task.substeps)
        if task.over(model, data):
            mujoco.mj_resetData(model, data)
            task.reset(data, rng)


def _worker(task: str, seed: int) -> Connection:
    """Starts a process that runs the loop whenever it is sent None; it answers None, also once it is ready."""
    context = multiprocessing.get_context("spawn")  # a fork would copy the locks of JAX's threads
    ours, theirs = context.Pipe()
    context.Process(target=_serve, args=(theirs, task, seed), daemon=True).start()
    theirs.close()  # the worker's end alone is left: where either process dies, the other one's reading ends
    return ours


def _serve(pipe: Connection, name: str, seed: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C ends the bench, and that its workers
    task = TASKS[name]()
    _loop(task, seed)
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            pipe.send(None)
            pipe.recv()
            _loop(task, seed)
