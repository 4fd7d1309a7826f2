"""CALVIN's long-horizon benchmark (LH-MTLC), frozen: 1000 chains of five tasks from 192 initial states of scene D.

chains.json           the chains, in the benchmark's order
initial_states.json   the robot's initial state and the scene's 192
"""

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np

LH_MTLC = "lh_mtlc"
"""The benchmark's name among the environment's tasks."""

EPISODES_FILE = "episodes.jsonl"
"""File in an evaluation's results folder: the environment adds a line per finished episode, the report reads them."""


@dataclass(frozen=True)
class Chain:
    """One evaluation chain.

    Attributes:
        tasks: Names of the five tasks, in the order in which they are commanded.
        robot_obs: (15,) initial robot state.
        scene_obs: (24,) initial scene state, blocks in red, blue, pink order.
    """

    tasks: tuple[str, ...]
    robot_obs: np.ndarray
    scene_obs: np.ndarray


@cache
def load_chains() -> tuple[Chain, ...]:
    """The 1000 chains in the benchmark's order."""
    folder = resources.files(__package__)
    states = json.loads((folder / "initial_states.json").read_text())
    robot_obs = np.array(states["robot_obs"])
    scene_obs = {json.dumps(entry["initial_condition"]): np.array(entry["scene_obs"]) for entry in states["conditions"]}
    return tuple(
        Chain(tuple(chain["tasks"]), robot_obs, scene_obs[json.dumps(chain["initial_condition"])])
        for chain in json.loads((folder / "chains.json").read_text())
    )
