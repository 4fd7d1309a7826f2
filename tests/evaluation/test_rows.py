"""Policies that predict several actions at once are reset in each environment where a command begins."""

from types import SimpleNamespace

import pytest
import torch
from random_policies import STEPS, random_policy

from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.clip.model import embedding_size
from lerobot_lansar.command import CommandError
from lerobot_lansar.evaluation.rows import ResetAtCommands
from lerobot_lansar.evaluation.stream import Episode
from lerobot_lansar.policy.configuration_lansar import LanSARConfig
from lerobot_lansar.policy.modeling_lansar import LanSARPolicy

T = 15


def observations(seed):
    """What one environment shows in T steps."""
    generator = torch.Generator().manual_seed(seed)
    return [(torch.randn(15, generator=generator), torch.randn(24, generator=generator)) for _ in range(T)]


def act(policy, environments, commands_begin, **more):
    """The actions of one batch, (T, B, 7).

    Args:
        policy: Random.
        environments: The seed of each.
        commands_begin: The steps at which each gets a new command, besides the first.
        more: Further entries of the batch, the same for all environments and steps.
    """
    streams = [SimpleNamespace(episode=Episode("open_drawer", seed), commands=1) for seed in environments]
    rows, seen = ResetAtCommands(policy, streams), [observations(seed) for seed in environments]
    rows.reset()
    taken = []
    for t in range(T):
        for stream, begins in zip(streams, commands_begin, strict=True):
            stream.commands += t in begins
        state, scene = (torch.stack([each[t][part] for each in seen]) for part in (0, 1))
        batch = {"observation.state": state, "observation.environment_state": scene, "task": ["go"] * len(seen)}
        batch |= {key: value.expand(len(seen), -1) for key, value in more.items()}
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


def lansar():
    torch.manual_seed(0)
    options = {"hidden": 96, "context_heads": 4, "decoder_layers": 2, "decoder_heads": 4, "use_images": False}
    return LanSARPolicy(LanSARConfig(device="cpu", clip=ClipConfig("lansar-desk", ""), **options)).eval()


SAID = {"observation.clip.command": torch.linspace(-1, 1, embedding_size("lansar-desk"))}


def test_lansar_forgets_in_the_environment_of_a_new_command_only():
    """Also when the new command has the same words, as when one episode ends and the next begins with it."""
    policy = lansar()
    without, with_one = (act(policy, [3, 4], [[], begins], **SAID) for begins in ([], [2]))
    assert torch.equal(with_one[:, 0], without[:, 0])
    assert (with_one[:, 1] != without[:, 1]).any(dim=1)[2]
    alone = act(policy, [4], [[2]], **SAID)
    assert torch.equal(alone[:, 0], with_one[:, 1]), "however many environments there are"


def test_lansar_recovers_from_numbers_that_are_not_finite_where_a_command_begins():
    policy = lansar()
    batch = {"observation.state": torch.full((4, 15), 1e30), "observation.environment_state": torch.zeros(4, 24)}
    batch |= {"task": ["go"] * 4, "observation.clip.command": SAID["observation.clip.command"].expand(4, -1)}
    assert policy.select_action(batch).isnan().any(), "the weights do not overflow: take a larger number"
    policy.reset_environments([2])
    batch["observation.state"] = torch.zeros(4, 15)
    assert policy.select_action(batch).isfinite().all(dim=1).tolist()[2]


def test_a_batch_that_cannot_be_divided_is_refused():
    streams = [SimpleNamespace(episode=Episode("open_drawer", seed), commands=1) for seed in (0, 1)]
    rows = ResetAtCommands(random_policy("act"), streams)
    with pytest.raises(CommandError, match=r"patches is \(6, 3\) for 2 environments.*--eval.batch_size=1"):
        rows.select_action({"observation.state": torch.zeros(2, 15), "patches": torch.zeros(6, 3)})
