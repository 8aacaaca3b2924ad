"""What one would write without this library: a Python loop over C MuJoCo, random actions, no observations.

It takes a task's model as it is; our C engine skips MuJoCo's search for islands in it, which changes no bit and is
worth 6 % on the ant.
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import mujoco
import numpy as np

from envs.ant import corridor
from envs.hands import hand_over
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


TASKS: dict[str, Callable[[], Task]] = {
    **{f"velocity_{task}": functools.partial(_velocity, variant.robot) for task, variant in VARIANTS.items()},
    "ant_2x4": lambda: Task(corridor.model(), corridor.SUBSTEPS, _reset_ant, _ant_over),
    "hand_over_2x6": lambda: Task(hand_over.model(), hand_over.SUBSTEPS, _reset_hands, _hands_over),
}


def plain_loop(case: Case) -> Build:
    """As many loops at once as the case has threads; MuJoCo releases the interpreter lock while it steps."""
    task, threads = TASKS[case.task](), case.threads or usable_cpus()

    def loop(seed: int) -> None:
        model, data, rng = task.model, mujoco.MjData(task.model), np.random.default_rng(seed)
        low, high = model.actuator_ctrlrange.T
        task.reset(data, rng)
        for action in rng.uniform(low, high, (STEPS, model.nu)):
            data.ctrl[:] = action
            mujoco.mj_step(model, data, task.substeps)
            if task.over(model, data):
                mujoco.mj_resetData(model, data)
                task.reset(data, rng)

    def call() -> None:
        if threads == 1:
            loop(0)
        else:
            list(pool.map(loop, range(threads)))

    pool = ThreadPoolExecutor(threads)
    return lambda: Program(call, threads * STEPS, {"threads": threads})
