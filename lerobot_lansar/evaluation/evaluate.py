"""`lansar-eval`: LeRobot's evaluation on the desk in several processes; an interrupted one goes on where it stopped.

Each finished episode has a line in OUTPUT_DIR/episodes.jsonl. Episodes that have one are not played again.
"""

import json
import os
import shlex
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from filelock import FileLock, Timeout
from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins

from ..benchmark import EPISODES_FILE, LH_MTLC
from ..calvin import CHAIN_LENGTH
from ..clip.store import sha256
from ..command import CommandError, run_command
from ..envs.command_line import evaluated_policy
from ..jobs.executors import run_shards
from ..jobs.pool import usable_cores
from ..jobs.staging import end_submitted, refuse_submitted, submitted_jobs, write_atomically
from ..report.episodes import INFO_FILE, PLAN_FILE, WEIGHTS, read_lines
from ..report.episodes import Episode as Played
from .options import EvaluateConfig
from .stream import Episode
from .worker import evaluate_shard

_STATE = ".lansar-eval"
"""Hidden folder in OUTPUT_DIR: the lock, the mark of submitted jobs, their logs."""
_MAY_CHANGE = ("output_dir", "job_name", "workers", "executor", "slurm", "chains", "videos", "eval")
"""Options that decide no episode's result."""
_ENV_MAY_CHANGE = ("features", "features_map", "render_fps", "render_size")
"""Those of --env; the first two follow from the others."""


def evaluate(config: EvaluateConfig) -> Path:
    """Plays the missing episodes.

    What an episode's line says depends on the policy, the options and the seed, not on the number of workers or on
    interruptions.

    Returns:
        The output folder, with `episodes.jsonl`, `eval_config.json`, videos and, when all episodes are played,
        LeRobot's `eval_info.json`.

    Raises:
        ValueError, CommandError: An option is wrong, or the folder holds another evaluation.
        WorkerDied: A worker was killed.
    """
    config.check()
    config.desk.get_env_processors()  # compares the environment with the policy
    folder = config.folder
    state = folder / _STATE
    state.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(state / "lock", timeout=3):
            refuse_submitted(state, folder)
            return _evaluate(config)
    except Timeout:
        raise CommandError(f"another process is evaluating into {folder}: wait for it or stop it") from None


def _evaluate(config: EvaluateConfig) -> Path:
    folder, desk = config.folder, config.desk
    env_options = desk.gym_kwargs
    env_options["results_extra"] = {**env_options["results_extra"], "policy_reset": "command"}
    before = _earlier(config)
    if before:  # the same weights, although they may lie elsewhere by now
        env_options["results_extra"]["policy"] = before["policy"]
    episodes = planned(config)
    done = {episode.key for episode in read_lines(folder)}
    missing = [episode for episode in episodes if (episode.task, episode.seed) not in done]
    info = folder / INFO_FILE
    told = json.loads(info.read_text())["overall"]["n_episodes"] if info.exists() else 0
    if not missing and told == len(episodes):
        return folder
    info.unlink(missing_ok=True)  # of an evaluation with fewer or more episodes
    config.workers = min(config.workers or 1, max(1, len(missing)))
    executor = config.executor if missing else "local"
    described = _described(config)
    if before:
        kept = ("policy",) if missing else ("policy", "command", "hardware", "seconds")
        described |= {key: before[key] for key in kept}
    write_atomically(folder / PLAN_FILE, json.dumps(described, indent=2) + "\n")
    _make_paths_absolute(config, env_options)
    seconds = before.get("seconds", 0.0)  # None: a run was killed, or jobs played
    started, tally = time.time() - (seconds or 0.0), _Tally(config)
    try:
        with submitted_jobs(folder / _STATE, submitting=executor == "slurm"):
            complete = run_shards(
                (evaluate_shard, (config, env_options, missing)),
                config.workers if missing else 0,
                (write_eval_info, (config, started)),
                executor=executor,
                workers=config.workers,
                slurm=config.slurm,
                logging_dir=folder / _STATE / "jobs",
                progress=lambda: len(tally()),
                total=len(episodes),
                unit="chain" if list(desk.suites()) == [LH_MTLC] else "episode",
                desc="evaluating",
                status=lambda: _mean(tally(), desk.suites()),
            )
    finally:
        if executor != "slurm" and seconds is not None and missing:
            _note_seconds(folder, time.time() - started)
    if not complete:
        print(f"submitted; {folder / INFO_FILE} appears when the jobs are done")
    return folder


def _make_paths_absolute(config: EvaluateConfig, env_options: dict[str, Any]) -> None:
    """For jobs, which may run in another working directory."""
    config.output_dir = config.folder
    for name in ("assets", "annotations"):
        if env_options[name] is not None:
            env_options[name] = str(Path(env_options[name]).resolve())
            setattr(config.desk, name, env_options[name])
    assert config.policy is not None
    path = Path(str(config.policy.pretrained_path))
    if path.is_dir():
        config.policy.pretrained_path = path.resolve()


def planned(config: EvaluateConfig) -> list[Episode]:
    """All episodes of an evaluation, with the seeds and names of videos that LeRobot gives them."""
    assert config.seed is not None
    found = []
    for suite, tasks in config.desk.suites().items():
        for number, task in enumerate(tasks):
            videos = config.folder / "videos" / f"{suite}_{number}"
            for k in range(config.eval.n_episodes):
                video = videos / f"eval_episode_{k}.mp4" if k < config.videos else None
                found.append(Episode(task, config.seed + k, video))
    return found


def _counted(config: EvaluateConfig) -> list[Played]:
    """The planned episodes that have a line; an earlier run may have played more."""
    wanted = {(episode.task, episode.seed) for episode in planned(config)}
    return [episode for episode in read_lines(config.folder) if episode.key in wanted]


class _Tally:
    """What `_counted` returns, read again only when the file has grown: the progress bar asks twice a second."""

    def __init__(self, config: EvaluateConfig) -> None:
        self._config, self._size = config, -1
        self._episodes: list[Played] = []

    def __call__(self) -> list[Played]:
        file = self._config.folder / EPISODES_FILE
        size = file.stat().st_size if file.exists() else 0
        if size != self._size:
            self._size, self._episodes = size, _counted(self._config)
        return self._episodes


def _mean(episodes: list[Played], suites: dict[str, tuple[str, ...]]) -> str:
    if not episodes:
        return ""
    mean = float(np.mean([episode.successes for episode in episodes]))
    if LH_MTLC not in suites:
        return f"success {100 * mean:.1f} %"
    return f"average length {mean:.2f}" if len(suites) == 1 else f"{mean:.2f} commands an episode"


def _earlier(config: EvaluateConfig) -> dict[str, Any]:
    """What earlier runs of this evaluation left in its folder, empty if there were none.

    Raises:
        CommandError: The folder is that of another evaluation.
    """
    file = config.folder / PLAN_FILE
    if file.exists() and read_lines(config.folder):
        before: dict[str, Any] = json.loads(file.read_text())
        others = ", ".join(_differences(before["request"], _request(config)))
        if others:
            raise CommandError(
                f"{config.folder} holds another evaluation, which differs in {others}: give another --output_dir, or "
                f"repeat its options ({file})"
            )
        return before
    if not file.exists() and any((config.folder / name).exists() for name in (EPISODES_FILE, INFO_FILE)):
        raise CommandError(f"{config.folder} holds another evaluation: give another --output_dir")
    return {}


def _described(config: EvaluateConfig) -> dict[str, Any]:
    """This evaluation, for the next run and for `lansar-report`. How long it takes is not known yet."""
    local = config.executor == "local"
    where = f"{usable_cores()} CPU cores" if local else f"{config.workers} jobs of {config.executor}"
    return {
        "policy": evaluated_policy(),
        "seed": config.seed,
        "n_episodes": config.eval.n_episodes,
        "suites": config.desk.suites(),
        "command": shlex.join(["lansar-eval", *sys.argv[1:]]),
        "hardware": f"{where}, policy on {config.policy and config.policy.device}",
        "seconds": None,
        "version": version("lerobot_policy_lansar"),
        "request": _request(config),
    }


def _note_seconds(folder: Path, seconds: float) -> None:
    file = folder / PLAN_FILE
    described = json.loads(file.read_text()) | {"seconds": round(seconds, 1)}
    write_atomically(file, json.dumps(described, indent=2) + "\n")


def _request(config: EvaluateConfig) -> dict[str, Any]:
    """What decides the results: options, and the content of files that they name."""
    options = {key: value for key, value in draccus.encode(config).items() if key not in _MAY_CHANGE}
    options["env"] = {key: value for key, value in options["env"].items() if key not in _ENV_MAY_CHANGE}
    assert config.policy is not None
    files = sorted(Path(str(config.policy.pretrained_path)).glob("*.safetensors"))
    options[WEIGHTS] = {file.name: sha256(file) for file in files}
    options["policy"] |= {"pretrained_path": None if files else evaluated_policy()}  # a folder is known by its weights
    if config.desk.annotations is not None:
        options["env"]["annotations"] = sha256(Path(config.desk.annotations))
    return json.loads(json.dumps(options))


def _differences(one: Any, other: Any, name: str = "") -> list[str]:
    """Names of the options in which two requests differ."""
    if isinstance(one, dict) and isinstance(other, dict) and not name.startswith("weights"):
        keys = [*one, *(key for key in other if key not in one)]
        sub = (_differences(one.get(k), other.get(k), f"{name}.{k}" if name else k) for k in keys)
        return [difference for found in sub for difference in found]
    return [] if one == other else [name if " " in name else f"--{name}"]


def write_eval_info(config: EvaluateConfig, started: float, _: int = 0) -> None:
    """Writes `eval_info.json` as LeRobot does, from the lines.

    Args:
        config: The command's options.
        started: When the evaluation began, earlier runs included, in seconds since the epoch.
    """
    played = {episode.key: episode for episode in _counted(config)}
    per_task: list[dict[str, Any]] = []
    groups = {}
    for suite, tasks in config.desk.suites().items():
        for number, task in enumerate(tasks):
            mine = [episode for episode in planned(config) if episode.task == task]
            successes = [played[task, episode.seed].successes for episode in mine]
            all_of_them = CHAIN_LENGTH if task == LH_MTLC else 1
            metrics = {
                "sum_rewards": [float(count) for count in successes],
                "max_rewards": [float(count > 0) for count in successes],
                "successes": [count == all_of_them for count in successes],
                "video_paths": [str(e.video) for e in mine if e.video is not None and e.video.is_file()],
                "predicted_video_paths": [],
            }
            per_task.append({"task_group": suite, "task_id": number, "metrics": metrics})
        groups[suite] = _aggregated([entry["metrics"] for entry in per_task if entry["task_group"] == suite])
    overall = _aggregated([entry["metrics"] for entry in per_task])
    seconds = time.time() - started
    overall |= {"eval_s": seconds, "eval_ep_s": seconds / overall["n_episodes"]}
    info = {"per_task": per_task, "per_group": groups, "overall": overall}
    write_atomically(config.folder / INFO_FILE, json.dumps(info, indent=2) + "\n")
    end_submitted(config.folder / _STATE)


def _aggregated(metrics: list[dict[str, Any]]) -> dict[str, Any]:
    rewards, largest, successes, videos = (
        [value for each in metrics for value in each[key]]
        for key in ("sum_rewards", "max_rewards", "successes", "video_paths")
    )
    return {
        "avg_sum_reward": float(np.mean(rewards)),
        "avg_max_reward": float(np.mean(largest)),
        "pc_success": 100 * float(np.mean(successes)),
        "n_episodes": len(rewards),
        "video_paths": videos,
        "predicted_video_paths": [],
    }


@parser.wrap()
def run(config: EvaluateConfig) -> None:
    """Evaluates and says what to do next."""
    folder = evaluate(config)
    early = sum(episode.reason is not None for episode in _counted(config))
    if early:
        print(f"{early} episodes ended early: `reason` in {os.path.relpath(folder / EPISODES_FILE)} says why")
    print(f"lansar-report --eval_dir={os.path.relpath(folder)} makes the tables")


def main() -> int:
    """Entry point of `lansar-eval`."""
    register_third_party_plugins()
    return run_command("lansar-eval", run, resumable=True)


if __name__ == "__main__":
    # jobs on other machines import these functions by their module's real name, which is not __main__
    from lerobot_lansar.evaluation.evaluate import main as run_main

    sys.exit(run_main())
