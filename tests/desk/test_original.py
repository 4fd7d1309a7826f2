"""Agreement with recordings of the original simulator, on its own asset files."""

import gzip
import json
from pathlib import Path

import numpy as np
import pybullet as p
import pytest
from PIL import Image

from lerobot_lansar.calvin import BLOCK_ORDER, BLOCKS, COLORS, FURNITURE, TASKS, block_pose, wrap_angle
from lerobot_lansar.desk import SCENES, BlockState, Desk, Snapshot, completed_tasks

EXCEPTION = "slider_A"
"""The one recording of 68 that is not repeated bit for bit: from its 173rd frame on, pushing the slide, joints differ
by up to 0.008 rad. It depends on what was simulated before the reset: without our step that clears contacts it differs
from frame 177 on. What the original simulated, at random, before its first reset is not recorded."""

TOLERANCE = 2
"""Frames by which a task may be fulfilled earlier or later than in `dynamics`. That was recorded as the original runs,
without deterministic overlapping pairs, where motion in contact depends on the environment's seed."""

OTHER_OUTCOMES = {
    # The block moved 0.09993 m instead of 0.10005; the task asks for 0.1.
    ("eval_013", 107): {"push_red_block_right"},
    # A block rotated in passing, which no command asked for.
    ("eval_014", 219): {"rotate_pink_block_left"},
}


def red_blue_pink(scene: str) -> list[int]:
    """Columns that bring a recorded `scene_obs` into our order."""
    columns, order = list(range(24)), BLOCK_ORDER[scene]
    return [*columns[FURNITURE], *(i for color in COLORS for i in columns[block_pose(order.index(color))])]


RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "golden" / "dynamics"


@pytest.mark.parametrize("name", sorted(file.stem for file in RECORDINGS.glob("*.npz")) or ["absent"])
def test_trajectories_and_their_tasks_are_the_originals(golden, original_assets, name):
    recorded = np.load(golden / "dynamics" / f"{name}.npz")
    expected = np.load(golden / "dynamics_det" / f"{name}.npz")
    events = json.loads((golden / "events.json").read_text())[name]
    scene = str(recorded["scene"])[-1]
    columns = red_blue_pink(scene)
    with Desk(scene, original_assets, cameras=()) as desk:
        obs = [desk.reset(recorded["reset_robot_obs"], recorded["reset_scene_obs"][columns])]
        states = [desk.snapshot()]
        for action in recorded["actions"]:
            obs.append(desk.step(action, str(recorded["mode"])))
            states.append(desk.snapshot())
    bound = 0.01 if name == EXCEPTION else 0.0
    for key, row in (("robot_obs", slice(None)), ("scene_obs", columns)):
        difference = np.abs(np.array([o[key] for o in obs]) - expected[key][:, row])
        assert difference.max() <= bound
    for segment in events:
        if "segment" not in segment:
            continue
        start, first = segment["start"], {}
        for frame in range(start + 1, segment["end"] + 1):
            for task in completed_tasks(states[start], states[frame]):
                first.setdefault(task, frame)
        missing = set(segment["first_success"]) ^ set(first)
        assert missing <= OTHER_OUTCOMES.get((name, start), set())
        for task in first.keys() - missing:
            assert abs(first[task] - segment["first_success"][task]) <= TOLERANCE


@pytest.mark.parametrize("scene", SCENES)
def test_the_built_in_desk_has_the_originals_joints_and_extents(golden, scene):
    facts = json.loads((golden / "facts.json").read_text())["scenes"][scene]
    with Desk(scene, cameras=()) as desk:
        client, body = desk._client, desk._furniture.body
        for joint in range(p.getNumJoints(body, physicsClientId=client)):
            p.resetJointState(body, joint, 0, physicsClientId=client)
        p.performCollisionDetection(physicsClientId=client)
        for name, box in facts["aabb"].items():
            if name in desk._furniture.links:
                ours = p.getAABB(body, desk._furniture.links[name], physicsClientId=client)
                np.testing.assert_allclose(ours, box, atol=0.005, err_msg=name)
        for name, joint in facts["joints"].items():
            info = p.getJointInfo(body, joint["index"], physicsClientId=client)
            state = p.getLinkState(body, joint["index"], computeForwardKinematics=1, physicsClientId=client)
            axes = np.array(p.getMatrixFromQuaternion(state[5])).reshape(3, 3)
            assert info[1].decode() == name
            np.testing.assert_allclose(info[8:10], joint["limits"], atol=1e-6)
            np.testing.assert_allclose(state[4], joint["origin"], atol=1e-4)
            np.testing.assert_allclose(axes @ info[13], joint["axis_world"], atol=1e-4)


@pytest.mark.parametrize("scene", SCENES)
def test_blocks_come_to_rest_as_high_on_the_built_in_desk_as_on_the_original(original_assets, scene):
    areas, drawer_x = SCENES[scene].areas, SCENES[scene].drawer_x
    cabinet = np.mean(areas["slider_left"].x)
    beside = np.mean(areas["slider_right"].x)
    poses = [
        [x, y, z, 0, 0, 1.57] for x, y, z in ((cabinet, 0.09, 0.464), (beside, 0.09, 0.464), (drawer_x, -0.28, 0.37))
    ]
    heights = []
    for assets in (None, original_assets):
        with Desk(scene, assets, cameras=()) as desk:
            obs = desk.reset(None, [0, 0.22, 0, 0, 0, 0, *np.ravel(poses)])
            for _ in range(60):
                obs = desk.step([*obs["robot_obs"][:6], 1], "abs")
            heights.append(obs["scene_obs"][BLOCKS].reshape(3, 6)[:, 2])
    np.testing.assert_allclose(*heights, atol=1e-4)


def test_all_initial_states_are_reached(golden, original_assets):
    states = np.load(golden / "initial_states.npz")
    with Desk("D", original_assets, cameras=()) as desk:
        for robot_obs, scene_obs in zip(states["robot_obs"], states["scene_obs"], strict=True):
            obs = desk.reset(robot_obs, scene_obs)
            np.testing.assert_allclose(obs["robot_obs"][7:14], robot_obs[7:14], atol=2e-3)
            np.testing.assert_allclose(obs["scene_obs"][FURNITURE], scene_obs[FURNITURE], atol=2e-3)
            blocks, asked = (state[BLOCKS].reshape(3, 6) for state in (obs["scene_obs"], scene_obs))
            np.testing.assert_allclose(blocks[:, :3], asked[:, :3], atol=2e-3)
            # one simulation step tilts a block by up to 3e-3 rad
            assert np.abs(wrap_angle(blocks[:, 3:] - asked[:, 3:])).max() < 5e-3


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


TAGS = [f"{scene}_{state}" for scene in "ABCD" for state in ("0_on", "0_off", "1_on", "1_off")]


@pytest.mark.parametrize("renderer", ["pybullet_tiny", "tiny"])
@pytest.mark.parametrize("tag", TAGS)
def test_pictures_equal_the_originals(golden, original_assets, tag, renderer):
    states = json.loads((golden / "images" / "states.json").read_text())
    state = next(s for s in states if s["tag"] == tag)
    scene_obs = np.array(state["reset_scene_obs"])[red_blue_pink(tag[0])]
    depths = np.load(golden / "images" / "images.npz")
    with Desk(tag[0], original_assets, renderer=renderer, depth=True) as desk:
        obs = desk.reset(state["reset_robot_obs"], scene_obs)
    for camera in ("static", "gripper"):
        picture = Image.open(golden / "images" / f"{tag}_{camera}.png").convert("RGB")
        assert np.abs(obs[f"rgb_{camera}"] - np.asarray(picture).astype(int)).mean() < 0.02, camera
        difference = np.abs(obs[f"depth_{camera}"] - depths[f"{tag}_depth_{camera}"])
        # a pixel on an edge may show what is behind it
        assert (difference > 1e-3).mean() < 1e-3, camera
