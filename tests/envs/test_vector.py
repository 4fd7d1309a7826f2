"""Vector environments: finished episodes freeze, workers come and go."""

import gymnasium as gym
import numpy as np
import pytest
from lerobot.envs.utils import close_envs

from lerobot_lansar.envs.vector import ForkedVectorEnv, SerialVectorEnv


class Counting(gym.Env):
    """Its episodes take `length` steps; it counts what it is asked to do."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, length):
        self.length, self.resets, self.steps = length, 0, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets, self.now = self.resets + 1, 0
        return np.array([float(seed or 0)]), {}

    def step(self, action):
        self.steps, self.now = self.steps + 1, self.now + 1
        return np.array([100.0 + self.now]), 1.0, self.now == self.length, False, {"is_success": True}

    def render(self):
        return np.zeros((2, 2, 3), np.uint8)


MAKERS = [lambda length=length: Counting(length) for length in (2, 5)]
CLASSES = pytest.mark.parametrize("kind", [SerialVectorEnv, ForkedVectorEnv])


def roll(env, **arguments):
    """Steps a batch until every episode has ended, as LeRobot does; what each step returned."""
    env.reset(**arguments)
    done, results = np.zeros(2, bool), []
    while not done.all():
        results.append(env.step(np.zeros((2, 1), np.float32)))
        done |= results[-1][2]
    return results


@CLASSES
def test_finished_episodes_repeat_their_end_without_reward_and_without_simulation(kind):
    env = kind(MAKERS)
    results = roll(env, seed=[7, 8])
    observations, rewards = (np.array([result[i] for result in results]) for i in (0, 1))
    assert observations[:, 0, 0].tolist() == [101, 102, 102, 102, 102]
    assert observations[:, 1, 0].tolist() == [101, 102, 103, 104, 105]
    assert rewards.tolist() == [[1, 1], [1, 1], [0, 1], [0, 1], [0, 1]]
    assert env.call("steps") == (2, 5)
    assert env.call("resets") == (1, 1)
    env.close()


@CLASSES
@pytest.mark.parametrize("arguments", [{"seed": [1, 2]}, {"options": {"lerobot_new_rollout": True}}, {}])
def test_every_reset_of_the_batch_starts_new_episodes(kind, arguments):
    env = kind(MAKERS)
    for _ in range(3):
        assert len(roll(env, **arguments)) == 5
    assert env.call("resets") == (3, 3)
    assert env.call("steps") == (6, 15)
    env.close()


def test_workers_start_at_first_use_and_again_after_closing():
    env = ForkedVectorEnv(MAKERS)
    assert env._workers is None
    assert env.num_envs == 2
    assert env.observation_space.shape == (2, 1)
    assert env.single_action_space.shape == (1,)
    assert env.unwrapped.metadata["render_fps"] == 30
    assert env.get_attr("length") == (2, 5)
    close_envs({"suite": {0: env}})
    assert env._workers is None
    assert np.shape(env.call("render")) == (2, 2, 2, 3)
    env.close()
    env.close()
