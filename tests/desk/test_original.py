"""Agreement with recordings of the original simulator, on its own asset files."""

import gzip
import json

import numpy as np
import pytest
from PIL import Image

from lerobot_lansar.desk import COLORS, SCENES, TASKS, BlockState, Desk, Snapshot, completed_tasks

TRAJECTORIES = [
    "button_A", "drawer_C", "eval_000", "eval_022", "lift_red_A", "lift_red_B", "place_red_slider_D", "rand_A_rel_hi",
    "rand_B_abs_hi", "rotate_blue_D", "slider_C", "stack_red_D", "switch_B",
]  # fmt: skip


def red_blue_pink(scene: str) -> list[int]:
    """Columns of a recorded scene_obs in our order."""
    order = list(SCENES[scene].blocks)
    return list(range(6)) + [6 + 6 * order.index(c) + i for c in COLORS for i in range(6)]


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_trajectories_equal_the_original_bit_for_bit(golden, original_assets, name):
    recorded = np.load(golden / "dynamics" / f"{name}.npz")
    expected = np.load(golden / "dynamics_det" / f"{name}.npz")
    scene = str(recorded["scene"])[-1]
    columns = red_blue_pink(scene)
    with Desk(scene, original_assets, cameras=()) as desk:
        obs = [desk.reset(recorded["reset_robot_obs"], recorded["reset_scene_obs"][columns])]
        obs += [desk.step(action, str(recorded["mode"])) for action in recorded["actions"]]
    np.testing.assert_array_equal([o["robot_obs"] for o in obs], expected["robot_obs"])
    np.testing.assert_array_equal([o["scene_obs"] for o in obs], expected["scene_obs"][:, columns])


def _snapshot(info: dict) -> Snapshot:
    names = {info["robot"]["uid"]: "robot", info["table"]["uid"]: "desk"}
    names |= {block["uid"]: name.split("_")[1] for name, block in info["blocks"].items()}
    links = {index: name for name, index in info["table"]["links"].items()}

    def touch(contact):
        name = names.get(contact[0], "plane")
        return name, links[contact[1]] if name == "desk" else ""

    blocks = {
        name.split("_")[1]: BlockState(
            np.array(block["pos"]),
            np.array(block["orn"]),
            np.array(block["lin_vel"]),
            np.array(block["ang_vel"]),
            frozenset(touch(contact) for contact in block["contacts"]),
        )
        for name, block in info["blocks"].items()
    }
    touched = frozenset(
        names.get(contact[0] if isinstance(contact, list) else contact, "plane")
        for contact in info["robot"]["contacts"]
    )
    doors, lights = info["doors"], info["lights"]
    return Snapshot(
        doors["base__slide"],
        doors["base__drawer"],
        bool(lights["lightbulb"]),
        bool(lights["led"]),
        blocks,
        touched,
    )


def test_oracle_answers_every_recorded_pair_as_the_original_did(golden):
    with gzip.open(golden / "oracle_frames.jsonl.gz", "rt") as file:
        frames = {(f["traj"], f["frame"]): _snapshot(f["info"]) for f in map(json.loads, file)}
    seen = set()
    for line in (golden / "oracle.jsonl").read_text().splitlines():
        pair = json.loads(line)
        start, end = (frames[pair["traj"], pair[key]] for key in ("start", "end"))
        assert completed_tasks(start, end) == set(pair["tasks"]), pair
        seen |= set(pair["tasks"])
    assert seen == set(TASKS), "the recordings no longer cover every task"


def test_tasks_are_calvins_in_calvins_order(golden):
    assert list(TASKS) == [task["task"] for task in json.loads((golden / "tasks.json").read_text())]


@pytest.mark.parametrize("tag", ["A_1_on", "B_0_off", "C_1_off", "D_0_on"])
def test_pictures_equal_the_originals(golden, original_assets, tag):
    states = json.loads((golden / "images" / "states.json").read_text())
    state = next(s for s in states if s["tag"] == tag)
    scene_obs = np.array(state["reset_scene_obs"])[red_blue_pink(tag[0])]
    with Desk(tag[0], original_assets) as desk:
        obs = desk.reset(state["reset_robot_obs"], scene_obs)
    for camera in ("static", "gripper"):
        expected = np.asarray(Image.open(golden / "images" / f"{tag}_{camera}.png").convert("RGB")).astype(
            int
        )
        assert np.abs(obs[f"rgb_{camera}"] - expected).mean() < 0.02, camera
