"""Options of the wrong type or out of range: one sentence, whichever door they come through."""

from __future__ import annotations

import dataclasses

import pytest

import envs
from envs.base import EnvSpec
from envs.errors import TaskError, typed
from envs.voltage.control import VoltageControl


@pytest.mark.parametrize(
    ("task", "options", "says"),
    [
        ("lane", {"num_agents": 2.5}, "num_agents must be a whole number, not 2.5"),
        ("lane", {"num_agents": True}, "num_agents must be a whole number, not True"),
        ("lane", {"num_agents": 0}, "num_agents must be at least 1, not 0"),
        ("ant_2x4", {"threads": "two"}, "threads must be a whole number or none, not 'two'"),
        ("ant_2x4", {"walls": 3}, "walls must be a text, not 3"),
        ("hand_over_2x6", {"full_hand": 1}, "full_hand must be true or false, not 1"),
        ("voltage_33", {"v_lower": "abc"}, "v_lower must be a number, not 'abc'"),
        ("voltage_33", {"v_upper": float("nan")}, "v_upper must be a number, not nan"),
        ("voltage_33", {"v_lower": 1.2}, "v_lower must be below v_upper, but 1.2 is not below 1.05"),
        ("voltage_33", {"data": 3}, "data must be a text or a Path or a Profiles, not 3"),
        ("voltage_33", {"history": 0}, "history must be at least 1, not 0"),
    ],
)
def test_options_that_cannot_be(task, options, says):
    with pytest.raises(TaskError) as error:
        envs.make(task, **options)
    assert says in str(error.value)


def test_constructors_check_too_and_take_whole_numbers_for_numbers():
    with pytest.raises(TaskError, match="q_weight must be a number"):
        VoltageControl(q_weight="a lot")

    class Task:
        @typed
        def __init__(self, share: float, *, blocks: str | tuple[str, ...] = ()) -> None:
            self.share = share

    assert Task(1).share == 1 and Task(share=0.5, blocks=("a",)).share == 0.5
    with pytest.raises(
        TaskError, match=r"blocks must be a text or a tuple \(\[a, b\] on a command line\), not \['a'\]"
    ):
        Task(1, blocks=["a"])


@pytest.mark.parametrize("name", ["", "a/b", "..", "../a", ".a", "a..b", "a b", "<b>", "a\nb", "a\\b", "$HOME", None])
def test_a_spec_refuses_names_that_are_no_folders(name):
    with pytest.raises(TaskError, match="spec.name names folders"):
        dataclasses.replace(envs.make("lane").spec, name=name)
    assert isinstance(dataclasses.replace(envs.make("lane").spec, name="my-env_2.1+x"), EnvSpec)


def test_a_spec_takes_one_limit_or_one_for_each_cost():
    spec = dataclasses.replace(envs.make("lane").spec, num_costs=2)
    assert dataclasses.replace(spec, cost_limit=(1.0, 2)).cost_limit == (1.0, 2)
    for wrong in ((1.0,), (1.0, -1.0), float("nan"), "1", (1.0, "2")):
        with pytest.raises(TaskError, match="spec.cost_limit must be a number of at least 0, or a tuple of 2"):
            dataclasses.replace(spec, cost_limit=wrong)
