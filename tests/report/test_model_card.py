"""--push_to_hub: the real client writes results into a model's card on a hub on loopback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from eval_files import chain_line, write_lines, write_plan

from lerobot_lansar.report.hub import merge_index, model_index
from lerobot_lansar.report.report import ReportConfig, report

sys.path.insert(0, str(Path(__file__).parents[1] / "convert"))
from hub_server import TOKEN, Hub, Repository, launcher

LAUNCH = launcher("lerobot_lansar.report.report")

CARD = """---
license: apache-2.0
tags:
- robotics
model-index:
- name: Mine
  results:
  - task: {type: other}
    dataset: {name: Another, type: another}
    metrics: [{type: accuracy, value: 0.5}]
---
# My policy

Text of mine.
"""


def put(hub, repo_id, **files):
    """Puts a model with these files onto the hub, as its first commit."""
    entries = {}
    for name, text in files.items():
        blob = f"{name:0<40}"
        hub.blobs[blob] = text.encode()
        entries[name.replace("_", ".")] = (blob, len(text), None)
    hub.repositories[repo_id] = Repository(private=False, commits=[("0" * 40, entries)])


def push(hub, home, *arguments):
    environment = {
        **os.environ,
        "HF_ENDPOINT": hub.url,
        "HF_TOKEN": TOKEN,
        "HF_HOME": str(home),
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "HF_HUB_OFFLINE": "0",
    }
    command = [sys.executable, "-c", LAUNCH, *arguments]
    return subprocess.run(command, env=environment, text=True, capture_output=True, check=False)


def header(hub, repo_id):
    return yaml.safe_load(hub.files(repo_id)["README.md"].decode().split("---")[1])


def test_results_reach_the_card_and_a_second_push_replaces_them(tmp_path):
    first = write_lines(tmp_path / "first", [chain_line(k, 2) for k in range(4)])
    second = write_lines(tmp_path / "second", [chain_line(k, 3) for k in range(4)])
    with Hub() as hub:
        put(hub, "me/policy", README_md=CARD)
        for folder in (first, second):
            done = push(hub, tmp_path / "home", f"--eval_dir={folder}", "--push_to_hub=me/policy")
            assert done.returncode == 0, done.stderr
        metadata = header(hub, "me/policy")
        (index,) = metadata["model-index"]
        assert (metadata["license"], index["name"]) == ("apache-2.0", "Mine")
        assert "Text of mine." in hub.files("me/policy")["README.md"].decode()
        other, ours = index["results"]
        assert other == {
            "task": {"type": "other"},
            "dataset": {"name": "Another", "type": "another"},
            "metrics": [{"type": "accuracy", "value": 0.5}],
        }
        assert ours["metrics"][0]["value"] == 3
        assert "built-in desk, not comparable with CALVIN" in ours["dataset"]["name"]
        assert ours["dataset"]["args"]["assets"] == "built-in"


def test_a_model_without_a_card_gets_one_and_a_missing_model_is_an_error(tmp_path):
    folder = write_lines(tmp_path / "eval", [chain_line(0, 5)])
    with Hub() as hub:
        put(hub, "me/bare")
        put(hub, "me/broken", README_md="---\nmodel-index: none\n---\n")
        done = push(hub, tmp_path / "home", f"--eval_dir={folder}", "--push_to_hub=me/bare")
        assert done.returncode == 0, done.stderr
        assert hub.files("me/bare")["README.md"].decode().rstrip().endswith("# bare")
        assert header(hub, "me/bare")["model-index"][0]["results"][0]["metrics"][0]["value"] == 5
        for name, message in (("none", "cannot write the card"), ("broken", "README.md is malformed")):
            done = push(hub, tmp_path / "home", f"--eval_dir={folder}", f"--push_to_hub=me/{name}")
            assert done.returncode == 2
            assert f"--push_to_hub=me/{name}: " in done.stderr
            assert message in done.stderr
            assert "Traceback" not in done.stderr


def results_of(folder, **options):
    (table,) = report(ReportConfig(str(folder), **options))["tables"]
    return model_index(table["evaluations"][0], "policy")[0]["results"]


def test_an_entry_tells_the_protocol(tmp_path):
    folder = write_lines(tmp_path, [chain_line(k, 2) for k in range(4)], policy_reset="batch", version="0.1.0")
    write_plan(tmp_path, n_episodes=5)
    (entry,) = results_of(folder)
    assert entry["dataset"]["name"].startswith("CALVIN LH-MTLC, scene D (built-in desk")
    known = entry["dataset"]["args"]
    assert {key: known[key] for key in ("steps_per_command", "episodes", "missing", "first_seed", "last_seed")} == {
        "steps_per_command": 360,
        "episodes": 4,
        "missing": 1,
        "first_seed": 0,
        "last_seed": 3,
    }
    assert (known["policy_reset"], known["version"]) == ("batch", "0.1.0")
    assert known["privileged_scene_state"] == "unknown"
    assert known["sentence"] == "unknown"
    names = [metric["name"] for metric in entry["metrics"]]
    assert names[:2] == ["Average length (of 5)", "At least 1 in a row (%)"]
    assert len(names) == 7


def test_evaluations_of_other_desks_and_settings_are_different_datasets(tmp_path):
    ours = results_of(write_lines(tmp_path / "ours", [chain_line(0, 2)]))
    calvin = results_of(write_lines(tmp_path / "calvin", [chain_line(0, 2)], assets="original"))
    unknown = results_of(write_lines(tmp_path / "unknown", [chain_line(0, 2)], assets=None))
    assert calvin[0]["dataset"]["type"] == "calvin"
    assert ours[0]["dataset"]["type"] == unknown[0]["dataset"]["type"] == "calvin-built-in-desk"
    assert "CALVIN's original assets" in calvin[0]["dataset"]["name"]
    assert "unknown desk, not comparable with CALVIN" in unknown[0]["dataset"]["name"]
    disturbed = [
        results_of(
            write_lines(tmp_path / f"{scale}", [chain_line(0, 2)], perturbation_every=5, perturbation_scale=scale)
        )
        for scale in (0.5, 2.5)
    ]
    more = results_of(write_lines(tmp_path / "more", [chain_line(k, 2) for k in range(2)]))
    again = results_of(write_lines(tmp_path / "again", [chain_line(0, 3)]))
    index: list = []
    for results in (ours, calvin, *disturbed, more, again):
        index = merge_index(index, [{"name": "policy", "results": results}])
    assert index[0]["results"] == [*calvin, *disturbed[0], *disturbed[1], *more, *again], "only the same is replaced"


def test_single_tasks_are_pushed_as_a_whole_and_by_group(tmp_path):
    rows = [(s, None, [(task, ok)]) for s in (0, 1) for task, ok in (("open_drawer", True), ("turn_on_led", s == 0))]
    (entry,) = results_of(write_lines(tmp_path, rows))
    metrics = {metric["name"]: metric["value"] for metric in entry["metrics"]}
    assert metrics == {
        "Success per attempted command (%)": 75.0,
        "drawer: open_drawer (%)": 100.0,
        "lights: turn_on_led (%)": 50.0,
    }


@pytest.mark.parametrize("labels", [None, ["A", "B"]])
def test_only_one_evaluation_can_be_pushed(tmp_path, labels):
    folders = [str(write_lines(tmp_path / name, [chain_line(0, 1)])) for name in "ab"]
    config = ReportConfig(folders, tmp_path / "report", labels, push_to_hub="me/policy")
    with pytest.raises(Exception, match="results of one evaluation, but these are 2"):
        report(config)
    assert not (tmp_path / "report").exists(), "nothing half-done"
