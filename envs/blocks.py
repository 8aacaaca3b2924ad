"""What the entries of observations, states and actions are: names, sizes and units, which the task pages print."""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import mujoco


class Block(NamedTuple):
    """Consecutive entries of one kind.

    Attributes:
      name: of the block; size: its entries; unit: of each, '-' if it has none.
      meaning: the rest of a sentence that begins with the name.
    """

    name: str
    size: int
    unit: str = "-"
    meaning: str = ""


Blocks = tuple[Block, ...]


def length(blocks: Blocks) -> int:
    """How many entries the blocks have together."""
    return sum(block.size for block in blocks)


def slices(blocks: Blocks) -> dict[str, slice]:
    """Where each block lies, by its name."""
    ends = [length(blocks[: number + 1]) for number in range(len(blocks))]
    return {block.name: slice(end - block.size, end) for block, end in zip(blocks, ends, strict=True)}


def agent_index(num_agents: int) -> Block:
    """The one-hot index that ends many observations."""
    return Block("agent index", num_agents, "-", "one-hot")


def joints(model: mujoco.MjModel, unseen: int) -> Blocks:
    """qpos without its first `unseen` entries, then qvel; the root is a free joint or three planar ones."""
    import mujoco

    names = [model.joint(number).name for number in range(model.njnt)]
    if model.nq > model.nv:  # a free joint, whose quaternion has one entry more than its spin
        root = 1
        places = [Block("torso height", 1, "m"), Block("torso orientation", 4, "-", "quaternion, w first")]
        speeds = [Block("torso velocity", 3, "m/s", "world frame")]
        speeds += [Block("torso spin", 3, "rad/s", "the torso's own frame")]
    else:
        root = 3
        places, speeds = [], []
        for name, kind, axis in zip(names[:root], model.jnt_type, model.jnt_axis, strict=False):
            unit, how = ("rad", "about") if kind == mujoco.mjtJoint.mjJNT_HINGE else ("m", "along")
            meaning = f"{how} {'xyz'[abs(axis).argmax()]}"
            places.append(Block(name, 1, unit, meaning))
            speeds.append(Block(f"{name} velocity", 1, f"{unit}/s", meaning))
        places = places[unseen:]
    hinges = names[root:]
    angles = Block("joint angles", len(hinges), "rad", ", ".join(hinges))
    return (*places, angles, *speeds, Block("joint velocities", len(hinges), "rad/s", "in the same order"))


def motors(model: mujoco.MjModel) -> list[str]:
    """The joints that the actuators drive, by actuator."""
    return [model.joint(int(joint)).name for joint in model.actuator_trnid[:, 0]]
