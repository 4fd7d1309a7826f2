"""`lansar-eval`: in any number of processes, killed and resumed, the same episodes with the same results."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lerobot_lansar.benchmark import EPISODES_FILE, load_chains
from lerobot_lansar.envs.configuration_calvin import CalvinEnvConfig
from lerobot_lansar.envs.episodes import append_episode
from lerobot_lansar.evaluation.evaluate import write_eval_info
from lerobot_lansar.evaluation.options import EvaluateConfig, EvaluateEvalConfig

COMMON = [
    "--policy.device=cpu",
    "--env.type=calvin",
    "--env.cameras=[]",
    "--env.steps_per_command=60",
    "--env.render_fps=1",
    "--seed=4",
]


def command(name, checkpoint, folder, *options):
    script = Path(sys.executable).with_name(name)
    return [script, f"--policy.path={checkpoint}", f"--output_dir={folder}", *COMMON, *options]


def run(*arguments):
    environment = {**os.environ, "HF_HUB_OFFLINE": "1"}
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=600, env=environment)


def lines(folder):
    return [json.loads(line) for line in (folder / EPISODES_FILE).read_text().splitlines()]


def results(folder):
    """What happened in each episode, by seed, to the last digit of the state in which it ended."""
    found = {line["seed"]: (line["commands"], line["end"]) for line in lines(folder)}
    assert len(found) == len(lines(folder)), "no episode was played twice"
    return found


def filmed(folder):
    """Names of the videos, each of which holds pictures."""
    import av

    for file in (folder / "videos").rglob("*.mp4"):
        with av.open(str(file)) as container:
            assert len(list(container.decode(video=0))) > 1
    return sorted(str(file.relative_to(folder)) for file in (folder / "videos").rglob("*.mp4"))


def kill_a_worker(parent):
    """Kills one of the processes that a running command has started; returns the command's exit code."""
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
    workers = [int(c) for c in children if "spawn_main" in Path(f"/proc/{c}/cmdline").read_text()]
    os.kill(workers[-1], signal.SIGKILL)
    return parent.wait(timeout=60)


@pytest.fixture(scope="module")
def undisturbed(checkpoint, tmp_path_factory):
    folder = tmp_path_factory.mktemp("one") / "eval"
    done = run("lansar-eval", checkpoint, folder, "--chains=8", "--workers=1", "--eval.batch_size=3", "--videos=3")
    assert done.returncode == 0, done.stderr[-3000:]
    assert "average length" in done.stderr
    return folder


def test_a_killed_evaluation_goes_on_with_the_same_results(checkpoint, undisturbed, tmp_path):
    folder = tmp_path / "eval"
    options = ["--chains=8", "--workers=2", "--eval.batch_size=2", "--videos=3"]
    begun = subprocess.Popen(command("lansar-eval", checkpoint, folder, *options), stderr=subprocess.PIPE, text=True)
    file, deadline = folder / EPISODES_FILE, time.time() + 300
    while not file.exists() and time.time() < deadline and begun.poll() is None:
        time.sleep(0.02)
    assert kill_a_worker(begun) == 2
    assert "a worker process was killed" in begun.stderr.read()
    before = file.read_bytes()
    assert 1 <= before.count(b"\n") < 8
    assert not (folder / "eval_info.json").exists()
    file.write_bytes(before + b'{"seed": 11, "chain"')  # as if it had been killed while it wrote
    done = run("lansar-eval", checkpoint, folder, *options)
    assert done.returncode == 0, done.stderr[-3000:]
    assert file.read_bytes().startswith(before), "finished episodes stay as they were"
    assert results(folder) == results(undisturbed)
    assert filmed(folder) == [f"videos/lh_mtlc_0/eval_episode_{k}.mp4" for k in range(3)]
    assert len({str(end) for _, end in results(folder).values()}) == 8, "episodes differ, so that this can fail"


def test_the_lines_say_what_was_evaluated(checkpoint, undisturbed):
    assert sorted(results(undisturbed)) == list(range(4, 12))
    for line in lines(undisturbed):
        assert line["commands"][0]["task"] == load_chains()[line["chain"]].tasks[0]
        assert (line["policy"], line["policy_reset"]) == (str(checkpoint), "command")
    described = json.loads((undisturbed / "eval_config.json").read_text())
    assert (described["policy"], described["seed"], described["n_episodes"]) == (str(checkpoint), 4, 8)
    assert described["suites"] == {"lh_mtlc": ["lh_mtlc"]}
    assert described["command"].startswith("lansar-eval --policy.path=")
    assert described["request"]["policy"]["pretrained_path"] is None, "its weights are known, wherever they lie"


@pytest.mark.parametrize("executor", ["slurm", "ray"])
def test_other_executors_give_the_same(executor, checkpoint, undisturbed, slurm, tmp_path, monkeypatch):
    if executor == "ray":
        pytest.importorskip("ray", reason="needs the extra ray")
    monkeypatch.setenv("PATH", slurm)
    options = ["--chains=8", "--workers=2", "--videos=0", f"--executor={executor}", "--slurm.partition=cpu"]
    done = run("lansar-eval", checkpoint, tmp_path / "eval", *options)
    assert done.returncode == 0, done.stderr[-3000:]
    assert results(tmp_path / "eval") == results(undisturbed)
    assert json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]["n_episodes"] == 8


def test_more_chains_are_added_to_those_that_were_played(checkpoint, undisturbed, tmp_path):
    folder = shutil.copytree(undisturbed, tmp_path / "eval")
    before, info = (folder / EPISODES_FILE).read_bytes(), (folder / "eval_info.json").read_bytes()
    same = run("lansar-eval", checkpoint, folder, "--chains=8")
    assert same.returncode == 0, same.stderr
    assert (folder / "eval_info.json").read_bytes() == info, "nothing was missing"
    seconds = json.loads((folder / "eval_config.json").read_text())["seconds"]
    done = run("lansar-eval", checkpoint, folder, "--chains=10", "--workers=1", "--eval.batch_size=3")
    assert done.returncode == 0, done.stderr[-3000:]
    after = (folder / EPISODES_FILE).read_bytes()
    assert after.startswith(before)
    assert after.count(b"\n") == 10
    assert json.loads((folder / "eval_info.json").read_text())["overall"]["n_episodes"] == 10
    assert json.loads((folder / "eval_config.json").read_text())["seconds"] > seconds > 0
    fewer = run("lansar-eval", checkpoint, folder, "--chains=8")
    assert fewer.returncode == 0, fewer.stderr[-3000:]
    assert json.loads((folder / "eval_info.json").read_text())["overall"]["n_episodes"] == 8, "as was asked for last"
    assert (folder / EPISODES_FILE).read_bytes() == after


def test_a_batch_may_be_larger_than_lerobots_default_number_of_episodes():
    assert EvaluateEvalConfig(batch_size=100).batch_size == 100


def test_eval_info_counts_what_the_lines_say(checkpoint, tmp_path):
    config = EvaluateConfig.__new__(EvaluateConfig)
    config.output_dir, config.seed, config.videos = tmp_path, 0, 2
    config.env, config.eval = CalvinEnvConfig(task="lh_mtlc,turn_on_led"), EvaluateEvalConfig(n_episodes=3)
    for seed, (count, led) in enumerate([(5, True), (0, False), (2, True)]):
        tasks = load_chains()[seed].tasks[: count + 1]
        commands = [{"task": task, "success": i < count, "steps": 1} for i, task in enumerate(tasks)]
        append_episode(tmp_path, {"seed": seed, "chain": seed, "commands": commands})
        single = [{"task": "turn_on_led", "success": led, "steps": 1}]
        append_episode(tmp_path, {"seed": seed, "chain": None, "commands": single})
    video = tmp_path / "videos" / "lh_mtlc_0" / "eval_episode_1.mp4"
    video.parent.mkdir(parents=True)
    video.touch()
    write_eval_info(config, 0.0)
    info = json.loads((tmp_path / "eval_info.json").read_text())
    chains, led = (entry["metrics"] for entry in info["per_task"])
    assert (chains["sum_rewards"], chains["max_rewards"]) == ([5, 0, 2], [1, 0, 1])
    assert (chains["successes"], led["successes"]) == ([True, False, False], [True, False, True])
    assert (chains["video_paths"], led["video_paths"]) == ([str(video)], [])
    assert info["per_group"]["lh_mtlc"]["avg_sum_reward"] == pytest.approx(7 / 3)
    assert info["overall"]["pc_success"] == pytest.approx(50)
    assert info["overall"]["n_episodes"] == 6


def test_its_eval_info_is_lerobots(checkpoint, tmp_path):
    options = ["--env.task=drawer,turn_on_led", "--env.steps_per_command=5", "--eval.n_episodes=2"]
    found = {}
    for name, more in (
        ("lerobot-eval", ["--eval.batch_size=2", "--eval.use_async_envs=false", "--env.results_dir=/dev/null/no"]),
        ("lansar-eval", ["--workers=1"]),
    ):
        folder = tmp_path / name
        if name == "lerobot-eval":
            more = [*more[:-1], f"--env.results_dir={folder}"]
        done = run(name, checkpoint, folder, *options, *more)
        assert done.returncode == 0, done.stderr[-3000:]
        found[name] = json.loads((folder / "eval_info.json").read_text())
        for entry in (*found[name]["per_task"], *found[name]["per_group"].values(), found[name]["overall"]):
            numbers = entry.get("metrics", entry)
            numbers["video_paths"] = [str(Path(path).relative_to(folder)) for path in numbers["video_paths"]]
        found[name]["overall"] |= {"eval_s": 0, "eval_ep_s": 0}
        resets = {line["policy_reset"] for line in lines(folder)}
        assert resets == {"batch" if name == "lerobot-eval" else "command"}
    assert found["lansar-eval"] == found["lerobot-eval"]


REFUSED = [
    (["--chains=8", "--env.control_mode=abs"], "differs in --env.control_mode: give another --output_dir"),
    (["--chains=8", "--seed=5"], "differs in --seed"),
    (["--chains=0"], "--eval.n_episodes must be at least 1, got 0"),
    (["--chains=8", "--env.task=open_drawer"], "--chains counts chains of the benchmark"),
    (["--chains=8", "--env.results_dir=elsewhere"], "leave out --env.results_dir"),
    (["--chains=8", "--workers=0"], "--workers must be at least 1"),
    (["--chains=8", "--executor=slurm"], "--executor=slurm needs Slurm's sbatch"),
    (["--chains=8", "--eval.recording=true"], "works with lerobot-eval only"),
    (["--chains=8", "--env.task_in_state=true"], "set --env.task_in_state=false"),
]

IN_TURN = """
import contextlib, io, json, sys
from lerobot_lansar.evaluation import evaluate
for arguments in json.loads(sys.argv[1]):
    sys.argv = ["lansar-eval", *arguments]
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        code = evaluate.main()
    print(json.dumps([code, said.getvalue()]))
"""


def test_what_cannot_be_done_is_refused_in_one_message(checkpoint, undisturbed):
    before = {path: path.stat().st_mtime for path in undisturbed.rglob("*")}
    calls = [list(map(str, command("lansar-eval", checkpoint, undisturbed, *options)[1:])) for options, _ in REFUSED]
    calls.append([word for word in calls[0] if not word.startswith("--output_dir")])
    cases = [*REFUSED, (["no --output_dir"], "give --output_dir: an interrupted evaluation goes on in it")]
    done = subprocess.run([sys.executable, "-c", IN_TURN, json.dumps(calls)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for (options, expected), printed in zip(cases, done.stdout.splitlines(), strict=True):
        code, said = json.loads(printed)
        assert code == 2, options
        assert expected in said, options
    assert {path: path.stat().st_mtime for path in undisturbed.rglob("*") if path.name != "lock"} == {
        path: changed for path, changed in before.items() if path.name != "lock"
    }
