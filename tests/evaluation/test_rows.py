"""Policies that predict several actions at once are reset in each environment where a command begins."""

from types import SimpleNamespace

import pytest
import torch
from random_policies import STEPS, random_policy

from lerobot_lansar.evaluation.rows import ResetAtCommands
from lerobot_lansar.evaluation.stream import Episode

T = 15


def observations(seed):
    """What one environment shows in T steps."""
    generator = torch.Generator().manual_seed(seed)
    return [(torch.randn(15, generator=generator), torch.randn(24, generator=generator)) for _ in range(T)]


def act(policy, environments, commands_begin):
    """The actions of one batch, (T, B, 7).

    Args:
        policy: Random.
        environments: The seed of each.
        commands_begin: The steps at which each gets a new command, besides the first.
    """
    streams = [SimpleNamespace(episode=Episode("open_drawer", seed), commands=1) for seed in environments]
    rows, seen = ResetAtCommands(policy, streams), [observations(seed) for seed in environments]
    rows.reset()
    taken = []
    for t in range(T):
        for stream, begins in zip(streams, commands_begin, strict=True):
            stream.commands += t in begins
        state, scene = (torch.stack([each[t][part] for each in seen]) for part in (0, 1))
        batch = {"observation.state": state, "observation.environment_state": scene, "task": [""] * len(seen)}
        taken.append(rows.select_action(batch))
    return torch.stack(taken)


@pytest.mark.parametrize("kind", list(STEPS))
def test_a_new_command_ends_the_plan_of_its_own_environment_only(kind):
    policy = random_policy(kind)
    without, with_one = (act(policy, [3, 4], [[], begins]) for begins in ([], [2]))
    assert torch.equal(with_one[:, 0], without[:, 0])
    differs = (with_one[:, 1] != without[:, 1]).any(dim=1)
    assert differs.tolist() == [False] * 2 + [True] * (T - 2)


@pytest.mark.parametrize("kind", list(STEPS))
def test_what_an_environment_does_depends_on_its_own_episode_alone(kind):
    """Also where a policy draws random numbers, and after other episodes."""
    policy = random_policy(kind)
    together = act(policy, [3, 4, 5], [[2], [], [4, 9]])
    torch.manual_seed(7)
    assert torch.equal(act(policy, [5, 3], [[4, 9], [2]]), together[:, [2, 0]])


def test_act_plans_anew_as_after_a_reset():
    policy = random_policy("act")
    taken = act(policy, [3], [[2]])
    policy.reset()
    for t, (state, scene) in enumerate(observations(3)):
        if t == 2:
            policy.reset()
        batch = {"observation.state": state[None], "observation.environment_state": scene[None]}
        assert torch.equal(policy.select_action(batch), taken[t])


def test_temporal_ensembles_are_not_shared():
    policy = random_policy("act", n_action_steps=1, temporal_ensemble_coeff=0.01)
    assert torch.equal(act(policy, [3, 4], [[], [5]])[:, 0], act(policy, [3], [[]])[:, 0])


def test_the_copies_share_their_weights():
    policy = random_policy("act")
    streams = [SimpleNamespace(episode=Episode("open_drawer", seed), commands=1) for seed in (0, 1)]
    rows = ResetAtCommands(policy, streams)
    copies = [each._policy for each in rows._copies]
    for name, parameter in policy.named_parameters():
        assert all(dict(each.named_parameters())[name] is parameter for each in copies)
