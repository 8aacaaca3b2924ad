"""Finds actions that throw the egg from hand to hand, free of cost and without learning, and draws what they do.

Cross-entropy search (Rubinstein, 1999) over open-loop actions on MuJoCo's C engine: targets of groups of motors at a
few moments, straight lines between. A wide search comes first, a narrow one around what it found second. A candidate is
judged by its mean return over a few starts with their own poses, places and goals.

    python -m docs.figures.hand_over             draws docs/hand_over.png of the actions in bench/results
    python -m docs.figures.hand_over --search    searches for new ones first, and stores them there
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.image
import mujoco
import numpy as np

from envs.hands.hand_over import HORIZON, HandOver

ROOT = pathlib.Path(__file__).parents[2]
STORED = ROOT / "bench" / "results" / "hand_over_catch.json"

MOMENTS = (0, 6, 12, 18, 24, 32, 44)  # control steps at which the targets are free; held after the last
SMALLEST = 0.03  # standard deviation that the search keeps, in units of the action
CANDIDATES, STARTS, FRESH = 256, 3, 64  # in each round; what they are judged on; what the result is tried on besides
GUIDE = 30.0  # a metre nearer to the goal, at the nearest, counts this much return while searching
# What is searched over, for each hand: both wrist motors, spread, curl at the knuckle, curl of the middle joint, palm
# (LFJ4) and the thumb's first four; the fingers move alike.
MOTORS = (0, 1, (2, 5, 8, 12), (3, 6, 9, 13), (4, 7, 10, 14), 11, 15, 16, 17, 18, 19)
COSTLY, FREE = 4, 0.1


@dataclasses.dataclass(frozen=True)
class Stage:
    """rounds; first standard deviation of the targets; share of candidates that the next are drawn around."""

    rounds: int
    deviation: float
    elite: float


STAGES = (Stage(15, 0.6, 0.1), Stage(30, 0.25, 0.04))


def plan(targets: np.ndarray) -> np.ndarray:
    """Actions [..., 75, 40] from targets [..., moments, 2, groups of motors]; the costly one is cut to what is free."""
    times = np.arange(HORIZON)
    after = np.clip(np.searchsorted(MOMENTS, times, side="right"), 1, len(MOMENTS) - 1)
    first, last = np.array(MOMENTS)[after - 1], np.array(MOMENTS)[after]
    share = np.clip((times - first) / (last - first), 0.0, 1.0)[:, None, None]
    moved = (1 - share) * targets[..., after - 1, :, :] + share * targets[..., after, :, :]
    actions = np.zeros((*moved.shape[:-1], 20), np.float32)
    for group, motors in enumerate(MOTORS):
        actions[..., motors] = moved[..., group, None] if isinstance(motors, tuple) else moved[..., group]
    actions = np.clip(actions, -1.0, 1.0)
    actions[..., 0, COSTLY] = np.clip(actions[..., 0, COSTLY], -FREE, FREE)
    return actions.reshape(*actions.shape[:-2], 40)


def episodes(env: HandOver, actions: jax.Array, keys: jax.Array) -> dict[str, jax.Array]:
    """Each plan [P, 75, 40] from each start [S]: reward, cost and distance [75, P, S] and qpos [75, P, S, 55].

    After the object fell, reward and cost are 0.
    """

    def one(state: Any, action: jax.Array) -> Any:
        return env.step(state, action.reshape(env.spec.num_agents, env.spec.action_dim))

    step = jax.vmap(jax.vmap(one, (0, None)))

    def advance(carry: Any, action: jax.Array) -> Any:
        state, going = carry
        after = step(state, action)
        seen = {
            "reward": after.reward * going,
            "cost": after.cost[..., 0, 0] * going,
            "distance": after.info["distance"],
            "qpos": after.carry.physics.qpos,
        }
        return (after, going & ~after.terminated), seen

    starts = jax.vmap(env.reset)(keys)
    state = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(actions), *x.shape)), starts)
    going = jnp.ones((len(actions), len(keys)), bool)
    return jax.lax.scan(advance, (state, going), jnp.moveaxis(actions, 1, 0))[1]


def search(env: HandOver, keys: jax.Array) -> np.ndarray:
    """The best targets [moments, 2, groups] that the search came across, judged on the starts of `keys`."""

    @jax.jit
    def judged(actions: jax.Array) -> tuple[jax.Array, jax.Array]:
        seen = episodes(env, actions, keys)
        earned = seen["reward"].sum(0).mean(-1)
        return earned, earned - GUIDE * seen["distance"].min(0).mean(-1)

    best = np.zeros((len(MOMENTS), 2, len(MOTORS)))
    for stage in STAGES:
        rng, mean, best_score = np.random.default_rng(0), best, -np.inf
        std = np.full_like(mean, stage.deviation)
        for i in range(stage.rounds):
            drawn = np.clip(mean + std * rng.normal(size=(CANDIDATES, *mean.shape)), -1.0, 1.0)
            drawn[0], drawn[1] = mean, best
            earned, score = map(np.asarray, judged(plan(drawn)))
            elite = drawn[np.argsort(score)[-int(stage.elite * CANDIDATES) :]]
            if score.max() > best_score:
                best, best_score = drawn[score.argmax()], score.max()
            mean = 0.2 * mean + 0.8 * elite.mean(0)
            std = np.maximum(0.2 * std + 0.8 * elite.std(0), SMALLEST)
            print(f"round {i}: return {earned[score.argmax()]:.2f} best, {np.median(earned):.2f} median", flush=True)
    return best


def starts(seed: int, count: int) -> jax.Array:
    return jax.random.split(jax.random.key(seed), count)


def report(env: HandOver, targets: np.ndarray) -> dict[str, Any]:
    """The actions and what they earn, from the starts of the search and from others."""
    actions = np.round(plan(targets).astype(np.float64), 3)
    tried = jax.jit(lambda keys: episodes(env, jnp.asarray(actions, jnp.float32)[None], keys))

    def figures(keys: jax.Array) -> dict[str, Any]:
        seen = {name: np.asarray(x[:, 0]) for name, x in tried(keys).items()}
        returns = seen["reward"].sum(0)
        return {
            "returns": [round(float(x), 2) for x in returns[:8]],
            "mean_return": round(float(returns.mean()), 2),
            "mean_cost": float(seen["cost"].sum(0).mean()),
            "mean_last_distance_m": round(float(seen["distance"][-1].mean()), 4),
            "dropped": int((seen["reward"][-1] == 0).sum()),
            "starts": len(keys),
        }

    return {
        "task": env.spec.name,
        "engine": env.engine,
        "searched": figures(starts(0, STARTS)),
        "fresh": figures(starts(1, FRESH)),
        "actions": actions.tolist(),
    }


# ---------------------------------------------------------------------------------------------------------------------
# The picture


def picture(env: HandOver, actions: np.ndarray) -> np.ndarray:
    """Six views [H, W, 3]: what the actions [75, 40] do from the first start of the search, and a step that costs."""
    costly = np.zeros_like(actions)
    costly[:, COSTLY] = 1.0
    views = [*views_of(env, actions, (0, 14, 18, 22, 70)), *views_of(env, costly, (25,))]
    return np.concatenate([np.concatenate(views[:3], axis=1), np.concatenate(views[3:], axis=1)])


def views_of(env: HandOver, actions: np.ndarray, moments: tuple[int, ...]) -> list[np.ndarray]:
    """The scene before each of some control steps."""
    state, step = env.reset(starts(0, STARTS)[0]), jax.jit(env.step)
    data, views = mujoco.MjData(env.model), []
    with mujoco.Renderer(env.model, 360, 640) as renderer:
        for t in range(max(moments) + 1):
            if t in moments:
                raw = {name: np.asarray(x) for name, x in env.raw(state).items()}
                data.qpos[:] = raw["qpos"]
                mujoco.mj_forward(env.model, data)
                renderer.update_scene(data, "side")
                env.decorate(renderer.scene, raw, float(state.cost[0, 0]))
                views.append(np.pad(renderer.render()[2:-2, 2:-2], ((2, 2), (2, 2), (0, 0)), constant_values=255))
            state = step(state, jnp.asarray(actions[t], jnp.float32).reshape(2, 20))
    return views


def main() -> None:
    """Searches, if asked, and draws; that needs OpenGL, without a screen MUJOCO_GL=egl or osmesa."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--search", action="store_true")
    env = HandOver("2x6", physics="mujoco")
    if parser.parse_args().search:
        found = report(env, search(env, starts(0, STARTS)))
        print({name: x for name, x in found.items() if name != "actions"})
        STORED.write_text(json.dumps(found) + "\n")
    actions = np.array(json.loads(STORED.read_text())["actions"])
    matplotlib.image.imsave(ROOT / "docs" / "hand_over.png", picture(env, actions))


if __name__ == "__main__":
    main()
