"""A stream of episodes plays each exactly as it is played alone."""

import json

import numpy as np
import pytest

from lerobot_lansar.benchmark import EPISODES_FILE, LH_MTLC
from lerobot_lansar.envs import CalvinEnv
from lerobot_lansar.envs.vector import SerialVectorEnv
from lerobot_lansar.evaluation.stream import Episode, EpisodeStream

OPTIONS = {"cameras": (), "steps_per_command": 8, "render_fps": 10}
EPISODES = [("open_drawer", 3), (LH_MTLC, 0), ("turn_on_led", 5), ("open_drawer", 8), (LH_MTLC, 1007)]


def policy(agent_pos):
    """Relative actions (…, 7) that depend on the robot's state (…, 15) alone."""
    return np.sin(1000 * agent_pos[..., :7]).astype(np.float32)


def played_alone(task, seed):
    """The robot's states that the policy saw, (steps, 15)."""
    env = CalvinEnv(task, **OPTIONS)
    obs, _ = env.reset(seed=seed)
    seen, ended = [], False
    while not ended:
        seen.append(obs["agent_pos"])
        obs, _, ended, _, _ = env.step(policy(obs["agent_pos"]))
    env.close()
    return np.array(seen)


def played_as_streams(episodes, rows, folder):
    """The same of each episode, by task and seed; and what LeRobot's rollout may ask of the environment."""
    queue = iter(episodes)
    streams = [EpisodeStream(CalvinEnv(**OPTIONS), queue, folder, OPTIONS["render_fps"]) for _ in range(rows)]
    env = SerialVectorEnv([lambda stream=stream: stream for stream in streams])
    seen, commands = {}, []
    while not all(stream.is_over for stream in streams):  # as the worker calls LeRobot's rollout
        obs, _ = env.reset(seed=None, options={"lerobot_new_rollout": True})
        ended = np.zeros(rows, dtype=bool)
        for _ in range(env.call("_max_episode_steps")[0]):
            for row, stream in enumerate(streams):
                if stream.episode is not None:
                    assert env.call("task_description")[row]
                    seen.setdefault((stream.episode.task, stream.episode.seed), []).append(obs["agent_pos"][row])
            obs, _, terminated, _, _ = env.step(policy(obs["agent_pos"]))
            commands.append([stream.commands for stream in streams])
            ended |= terminated
            if ended.all():
                break
    env.close()
    return {key: np.array(states) for key, states in seen.items()}, np.array(commands)


@pytest.mark.parametrize("steps", [5, 999])
def test_every_episode_is_played_as_alone(tmp_path, steps, monkeypatch):
    """Also when several rollouts follow each other in the middle of episodes."""
    monkeypatch.setattr("lerobot_lansar.evaluation.stream.STEPS", steps)
    episodes = [Episode(task, seed) for task, seed in EPISODES]
    seen, commands = played_as_streams(episodes, 2, tmp_path)
    assert set(seen) == set(EPISODES)
    for task, seed in EPISODES:
        np.testing.assert_array_equal(seen[task, seed], played_alone(task, seed))
    assert commands[-1].sum() == len(EPISODES), "each began one command, which failed"
    lines = [json.loads(line) for line in (tmp_path / EPISODES_FILE).read_text().splitlines()]
    assert all(set(line["end"]) == {"robot_obs", "scene_obs"} for line in lines)
    assert {(line["chain"], line["seed"]) for line in lines} == {(None, 3), (0, 0), (None, 5), (None, 8), (7, 1007)}


def test_the_next_episode_begins_where_one_ends(tmp_path):
    seen, commands = played_as_streams([Episode("open_drawer", seed) for seed in range(5)], 2, tmp_path)
    assert [len(states) for states in seen.values()] == [8] * 5
    assert len(commands) == 24, "three episodes in one environment, two in the other, which then waits"
    assert commands[:8].tolist()[-1] == [2, 2]
    assert commands[-1].tolist() == [3, 2]


def test_an_action_that_is_not_finite_ends_its_episode_only(tmp_path):
    queue = iter([Episode("open_drawer", seed) for seed in (3, 4)])
    stream = EpisodeStream(CalvinEnv(**OPTIONS), queue, tmp_path, 30)
    stream.reset()
    with pytest.warns(UserWarning, match="episodes fail early"):
        obs, _, terminated, _, _ = stream.step(np.full(7, np.nan))
    assert (terminated, stream.episode.seed, stream.commands) == (False, 4, 2)
    np.testing.assert_array_equal(obs["agent_pos"], played_alone("open_drawer", 4)[0])
    while not stream.is_over:
        stream.step(policy(obs["agent_pos"]))
    stream.close()
    lines = [json.loads(line) for line in (tmp_path / EPISODES_FILE).read_text().splitlines()]
    assert [line["reason"] is None for line in lines] == [False, True]


def test_chosen_episodes_are_filmed(tmp_path):
    import av

    video = tmp_path / "videos" / "lh_mtlc_0" / "eval_episode_0.mp4"
    played_as_streams([Episode(LH_MTLC, 0, video), Episode(LH_MTLC, 1)], 1, tmp_path)
    assert [path.name for path in video.parent.iterdir()] == [video.name]
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.average_rate) == (200, 10)
        assert len(list(container.decode(stream))) == 4, (
            "of 9 pictures at 30 Hz, the first, every third after it and the last"
        )
