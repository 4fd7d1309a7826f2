"""Small LanSARs learn: a made-up task in which the command decides, and recorded demonstrations of the desk."""

import json

import draccus
import numpy as np
import pytest
import torch
import yaml

from lerobot_lansar.calvin import COLORS, continuous_euler
from lerobot_lansar.clip.config import ClipConfig

from .conftest import CONFIGS, dataset_meta, small_config

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
    return environment[6:].reshape(3, 6)[COLORS.index(colour), :3]


def move(state, target):
    """The robot state after an action that is carried out exactly."""
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

    from lerobot_lansar.calvin import ACTION_NAMES

    sizes = {"observation.state": 15, "observation.environment_state": 24, "action": 7}
    features = {k: {"dtype": "float32", "shape": (size,), "names": None} for k, size in sizes.items()}
    features["action"]["names"] = ACTION_NAMES["abs"]
    dataset = LeRobotDataset.create("test/reach", fps=30, features=features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for i in range(episodes):
        state, environment = start(rng)
        for _ in range(20):
            action = teach(state, environment, COLORS[i % 3])
            values = (state, environment, action)
            frame = {k: v.astype(np.float32) for k, v in zip(sizes, values, strict=True)}
            dataset.add_frame({**frame, "task": f"reach for the {COLORS[i % 3]} block"})
            action[:3] += rng.normal(0, 0.004, 3)  # what is done differs from what is recorded, as on the desk
            state = move(state, action)
        dataset.save_episode()
    dataset.finalize()


def train(policy, preprocess, tasks, updates, batch_size):
    """What lerobot-train does, in this process; `tasks` are the commands of all frames. Returns the losses."""
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    schedule = policy.config.get_scheduler_preset().build(optimizer, updates)
    empty = {
        "observation.state": torch.zeros(batch_size, 15),
        "observation.environment_state": torch.zeros(batch_size, 24),
    }
    generator = torch.Generator().manual_seed(0)
    losses = []
    for _ in range(updates):
        index = torch.randint(len(tasks), (batch_size,), generator=generator)
        loss, _ = policy.forward(preprocess({**empty, "index": index, "task": [tasks[int(i)] for i in index]}))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10)
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        losses.append(loss.item())
    return losses


def test_the_policy_learns_to_reach_for_the_block_the_command_names(tmp_path):
    """The blocks stand where they always stand: finding them anywhere takes more than a test has."""
    from lerobot_lansar.policy.modeling_lansar import LanSARPolicy
    from lerobot_lansar.policy.processor_lansar import make_lansar_pre_post_processors

    record(tmp_path / "data", 30)
    torch.manual_seed(0)
    config = small_config(
        hidden=64,
        context_layers=1,
        dropout=0.0,
        mlp_norm="layer",
        learning_rate=2e-3,
        window_start="mixed",
        clip=ClipConfig("lansar-desk", "v1"),
    )
    config.input_features, config.output_features = {}, {}
    policy = LanSARPolicy(config, dataset_meta=dataset_meta(tmp_path / "data")).train()
    preprocess, _ = make_lansar_pre_post_processors(config)
    tasks = [f"reach for the {COLORS[i // 20 % 3]} block" for i in range(30 * 20)]
    train(policy, preprocess, tasks, updates=150, batch_size=24)

    rng = np.random.default_rng(1)
    colours = [COLORS[i % 3] for i in range(12)]
    states, environments = map(list, zip(*(start(rng) for _ in colours), strict=True))
    for _ in range(30):
        batch = {
            "observation.state": torch.tensor(np.stack(states), dtype=torch.float32),
            "observation.environment_state": torch.tensor(np.stack(environments), dtype=torch.float32),
            "task": [f"reach for the {colour} block" for colour in colours],
        }
        actions = policy.select_action(preprocess(batch)).numpy()
        states = [move(state, action) for state, action in zip(states, actions, strict=True)]
    where = [[block(environment, colour) for colour in COLORS] for environment in environments]
    distances = np.linalg.norm(np.array(where) - np.array(states)[:, None, :3], axis=-1)  # (12, colour)
    named = [COLORS.index(colour) for colour in colours]
    assert np.median(distances[range(12), named]) < 0.04
    assert (distances.argmin(axis=1) == named).sum() >= 9
    assert sum(state[14] < 0 for state in states) >= 6  # and closed the gripper there


@pytest.mark.slow
def test_the_recommended_preset_fits_32_demonstrations_and_repeats_them(tmp_path):
    """400 updates on 32 recorded demonstrations of two tasks; then from the same starts on the desk."""
    from dataset_convert.convert import ConvertConfig, convert
    from lerobot_lansar.demos.record import RecordConfig, record
    from lerobot_lansar.desk import Desk, is_fulfilled
    from lerobot_lansar.policy.configuration_lansar import LanSARConfig
    from lerobot_lansar.policy.modeling_lansar import LanSARPolicy
    from lerobot_lansar.policy.processor_lansar import make_lansar_pre_post_processors

    folder = record(
        RecordConfig(
            tmp_path / "desk",
            tasks=["turn_on_led", "close_drawer"],
            episodes=32,
            validation_episodes=1,
            cameras=[],
            variety=0.0,
            seed=5,
        )
    )
    root = convert(
        ConvertConfig(root=folder, split="training", repo_id="test/desk", output_dir=tmp_path / "data", images="none")
    )
    options = yaml.safe_load((CONFIGS / "lansar.yaml").read_text())["policy"]
    options.pop("type")
    config = draccus.decode(LanSARConfig, options | {"clip": {"model": "lansar-desk", "pretrained": ""}})
    config.input_features, config.output_features = {}, {}
    torch.manual_seed(0)
    policy = LanSARPolicy(config, dataset_meta=dataset_meta(root)).train()
    preprocess, _ = make_lansar_pre_post_processors(config)
    episodes = json.loads((root / "meta" / "calvin_source.json").read_text())["windows"]
    tasks = [e["sentence"] for e in episodes for _ in range(e["end"] - e["start"])]
    losses = train(policy, preprocess, tasks, updates=400, batch_size=64)
    assert np.mean(losses[:20]) > 1
    assert np.mean(losses[-50:]) < 0.35

    fulfilled = 0
    with Desk("D", cameras=()) as desk:
        for episode in episodes:
            first = np.load(folder / "training" / f"episode_{episode['start']:07d}.npz")
            obs = desk.reset(first["robot_obs"], first["scene_obs"])
            begun = desk.snapshot()
            policy.reset()
            for _ in range(180):
                state = obs["robot_obs"].copy()
                state[3:6] = continuous_euler(state[3:6])
                seen = {
                    "observation.state": torch.tensor(state[None], dtype=torch.float32),
                    "observation.environment_state": torch.tensor(obs["scene_obs"][None], dtype=torch.float32),
                    "task": [episode["sentence"]],
                }
                obs = desk.step(policy.eval().select_action(preprocess(seen))[0].numpy(), "abs")
                if is_fulfilled(episode["task"], begun, desk.snapshot()):
                    fulfilled += 1
                    break
    assert fulfilled >= 29
