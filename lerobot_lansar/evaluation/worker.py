"""One process of `lansar-eval`: LeRobot's `rollout` over its share of the episodes."""

import logging
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stderr, redirect_stdout

import torch
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.device_utils import get_safe_torch_device
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed

from ..envs import CalvinEnv
from ..envs.vector import SerialVectorEnv
from ..jobs.pool import usable_cores
from ..report.episodes import read_lines
from .loading import load_policy
from .options import EvaluateConfig
from .rows import ResetAtCommands
from .stream import Episode, EpisodeStream

LOGS = "logs"
"""Folder in `--output_dir` for what LeRobot prints in each worker."""


def evaluate_shard(config: EvaluateConfig, env_options: dict, episodes: Sequence[Episode], shard: int) -> None:
    """Plays every `workers`-th of the episodes from number `shard` on, but those that have a line by now.

    Args:
        config: The command's options.
        env_options: Arguments of `CalvinEnv`.
        episodes: All that were missing when the command began.
        shard: The worker's number.
    """
    assert config.workers is not None
    done = {episode.key for episode in read_lines(config.folder)}
    mine = [episode for episode in episodes[shard :: config.workers] if (episode.task, episode.seed) not in done]
    if not mine:
        return
    log = config.folder / LOGS / f"worker_{shard}.log"
    log.parent.mkdir(exist_ok=True)
    with open(log, "w") as file, redirect_stdout(file), redirect_stderr(file):
        _evaluate(config, env_options, mine)


def _evaluate(config: EvaluateConfig, env_options: dict, episodes: list[Episode]) -> None:
    assert config.policy is not None
    assert config.workers is not None
    register_third_party_plugins()
    logging.getLogger().setLevel(logging.WARNING)
    device = get_safe_torch_device(str(config.policy.device))
    if config.executor == "local":
        threads = max(1, usable_cores() // config.workers)
        torch.set_num_threads(min(torch.get_num_threads(), threads))
    torch.backends.cudnn.benchmark = True
    torch.backends.cuda.matmul.allow_tf32 = True
    set_seed(config.seed)
    policy, processors = load_policy(config.policy, config.desk, config.rename_map)
    queue = iter(episodes)
    streams = [
        EpisodeStream(CalvinEnv(**env_options), queue, config.folder, config.desk.render_fps)
        for _ in range(min(config.eval.batch_size, len(episodes)))
    ]
    env = SerialVectorEnv([lambda stream=stream: stream for stream in streams])  # type: ignore[misc]
    precision = torch.autocast(device.type) if config.policy.use_amp else nullcontext()
    try:
        with torch.no_grad(), precision:
            resetting = ResetAtCommands(policy, streams)
            while not all(stream.is_over for stream in streams):
                rollout(env, resetting, *processors)  # type: ignore[arg-type]
    finally:
        env.close()
