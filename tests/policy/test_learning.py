"""A small LanSAR learns a task in which the command decides: to reach for the block that is named.

The blocks stand where they always stand: finding them anywhere takes more data and updates than a test has.
"""

import numpy as np
import torch

from .conftest import dataset_meta, small_config

COLOURS = ("red", "blue", "pink")
REACH = 0.012  # m, where the teacher closes the gripper


def start(rng):
    """Robot state (15) somewhere, and the environment state (24)."""
    state, environment = np.zeros(15), np.zeros(24)
    state[:3] = rng.uniform(-0.15, 0.15, 3)
    state[3:6] = [np.pi, 0, 1.5]
    state[14] = 1
    environment[6:].reshape(3, 6)[:, :3] = [[0.12, 0, -0.1], [-0.12, 0.05, 0], [0, -0.1, 0.1]]
    return state, environment


def block(environment, colour):
    return environment[6:].reshape(3, 6)[COLOURS.index(colour), :3]


def move(state, target):
    """A robot that goes where it is told."""
    state = state.copy()
    state[:6], state[14] = target[:6], target[6]
    return state


def teach(state, environment, colour):
    """Absolute action towards the named block, closing when there."""
    way = block(environment, colour) - state[:3]
    target = np.append(state[:3] + np.clip(way, -0.02, 0.02), state[3:6])
    return np.append(target, -1 if np.linalg.norm(way) < REACH else 1)


def record(root, episodes):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_lansar.policy.windows import ACTION_NAMES

    sizes = {"observation.state": 15, "observation.environment_state": 24, "action": 7}
    features = {k: {"dtype": "float32", "shape": (size,), "names": None} for k, size in sizes.items()}
    features["action"]["names"] = ACTION_NAMES["abs"]
    dataset = LeRobotDataset.create("test/reach", fps=30, features=features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for i in range(episodes):
        state, environment = start(rng)
        for _ in range(20):
            action = teach(state, environment, COLOURS[i % 3])
            values = (state, environment, action)
            frame = {k: v.astype(np.float32) for k, v in zip(sizes, values, strict=True)}
            dataset.add_frame({**frame, "task": f"reach for the {COLOURS[i % 3]} block"})
            action[:3] += rng.normal(
                0, 0.004, 3
            )  # what is done differs from what is recorded, as on the desk
            state = move(state, action)
        dataset.save_episode()
    dataset.finalize()


def test_the_policy_learns_to_reach_for_the_block_the_command_names(tmp_path):
    from lerobot_lansar.policy.modeling_lansar import LanSARPolicy
    from lerobot_lansar.policy.processor_lansar import make_lansar_pre_post_processors

    record(tmp_path / "data", 30)
    torch.manual_seed(0)
    config = small_config(
        hidden=64, context_layers=1, dropout=0.0, mlp_norm="layer", learning_rate=2e-3, window_start="mixed"
    )
    config.input_features, config.output_features = {}, {}
    policy = LanSARPolicy(config, dataset_meta=dataset_meta(tmp_path / "data")).train()
    preprocess, _ = make_lansar_pre_post_processors(config)
    optimizer = config.get_optimizer_preset().build(policy.parameters())
    schedule = config.get_scheduler_preset().build(optimizer, 150)
    empty = {"observation.state": torch.zeros(24, 15), "observation.environment_state": torch.zeros(24, 24)}
    generator = torch.Generator().manual_seed(0)
    for _ in range(150):
        index = torch.randint(30 * 20, (24,), generator=generator)
        tasks = [f"reach for the {COLOURS[int(i) // 20 % 3]} block" for i in index]
        loss, _ = policy.forward(preprocess({**empty, "index": index, "task": tasks}))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()

    rng = np.random.default_rng(1)
    colours = [COLOURS[i % 3] for i in range(12)]
    states, environments = map(list, zip(*(start(rng) for _ in colours), strict=True))
    for _ in range(30):
        batch = {
            "observation.state": torch.tensor(np.stack(states), dtype=torch.float32),
            "observation.environment_state": torch.tensor(np.stack(environments), dtype=torch.float32),
            "task": [f"reach for the {colour} block" for colour in colours],
        }
        actions = policy.select_action(preprocess(batch)).numpy()
        states = [move(state, action) for state, action in zip(states, actions, strict=True)]
    where = [[block(environment, colour) for colour in COLOURS] for environment in environments]
    distances = np.linalg.norm(np.array(where) - np.array(states)[:, None, :3], axis=-1)  # (12, colour)
    named = [COLOURS.index(colour) for colour in colours]
    assert np.median(distances[range(12), named]) < 0.04
    assert (distances.argmin(axis=1) == named).sum() >= 9
    assert sum(state[14] < 0 for state in states) >= 6  # and closed the gripper there
