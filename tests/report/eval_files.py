"""Writes the files of evaluations, for tests."""

import json

from lerobot_lansar.benchmark import EPISODES_FILE, load_chains


def write_eval(folder, *groups):
    """Writes an eval_info.json of (task group, sums of rewards) pairs as lerobot-eval does."""
    folder.mkdir(parents=True, exist_ok=True)
    per_task = [
        {
            "task_group": group,
            "task_id": i,
            "metrics": {"sum_rewards": sums, "successes": [s >= 5 for s in sums]},
        }
        for i, (group, sums) in enumerate(groups)
    ]
    (folder / "eval_info.json").write_text(json.dumps({"per_task": per_task, "per_group": {}, "overall": {}}))
    return folder


def write_lines(folder, rows, **settings):
    """Writes rows as lines of the environment; a setting of None is unknown.

    A row is (seed, chain, [(task, success)]), or with (task, success, done) where it is known what was done.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for seed, chain, commands in rows:
        line = {
            "seed": seed,
            "chain": chain,
            "scene": "D",
            "commands": [
                {"task": t, "sentence": t, "success": s, "steps": 9, **({"done": done[0]} if done else {})}
                for t, s, *done in commands
            ],
            "successes": sum(s for _, s, *_ in commands),
            "assets": "built-in",
            "control_mode": "rel",
            "steps_per_command": 360,
            **settings,
        }
        with (folder / EPISODES_FILE).open("a") as file:
            file.write(json.dumps(line) + "\n")
    return folder


def chain_line(seed, fulfilled):
    """A row for `write_lines`: the benchmark's chain of that seed, with so many commands fulfilled."""
    chain = seed % 1000
    tasks = load_chains()[chain].tasks[: fulfilled + 1]
    return seed, chain, [(task, i < fulfilled) for i, task in enumerate(tasks)]


def write_plan(folder, **entries):
    """Writes the eval_config.json of `lansar-eval`: chains from seed 0 on unless told otherwise."""
    folder.mkdir(parents=True, exist_ok=True)
    plan = {"seed": 0, "suites": {"lh_mtlc": ["lh_mtlc"]}, **entries}
    (folder / "eval_config.json").write_text(json.dumps(plan))
    return folder


def write_policy(folder, *features, **options):
    """Writes the config.json of a policy that reads these features, such as `state` or `environment_state 58`."""
    folder.mkdir(parents=True, exist_ok=True)
    inputs = {
        f"observation.{name}": {"shape": [int(size or 24)]} for name, _, size in (f.partition(" ") for f in features)
    }
    (folder / "config.json").write_text(json.dumps({"input_features": inputs, **options}))
    return str(folder)
