"""From eval_info.json and episodes.jsonl to the tables: every figure is checked against numbers worked out by hand."""

import json
import sys

import numpy as np
import pytest

from lerobot_lansar.benchmark import EPISODES_FILE, Chain
from lerobot_lansar.command import CommandError
from lerobot_lansar.report import report as report_module
from lerobot_lansar.report import results
from lerobot_lansar.report.report import ReportConfig, report

CHAINS = [
    ["open_drawer", "turn_on_led", "close_drawer", "turn_off_led", "stack_block"],
    ["turn_on_led", "open_drawer", "push_into_drawer", "close_drawer", "turn_off_led"],
    ["close_drawer", "open_drawer", "turn_on_led", "turn_off_led", "stack_block"],
    ["turn_off_led", "turn_on_led", "turn_off_lightbulb", "close_drawer", "open_drawer"],
]


@pytest.fixture(autouse=True)
def _few_chains(monkeypatch):
    """Four chains instead of 1000: seed 1000 is chain 0 here as well."""
    chains = tuple(Chain(tuple(tasks), np.zeros(15), np.zeros(24)) for tasks in CHAINS)
    monkeypatch.setattr(results, "load_chains", lambda: chains)


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
    """Writes (seed, chain, [(task, success)]) rows as lines of the environment."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed, chain, commands in rows:
        line = {
            "seed": seed,
            "chain": chain,
            "scene": "D",
            "commands": [{"task": t, "sentence": t, "success": s, "steps": 9} for t, s in commands],
            "successes": sum(s for _, s in commands),
            "assets": "built-in",
            "control_mode": "rel",
            "steps_per_command": 360,
            **settings,
        }
        with (folder / EPISODES_FILE).open("a") as file:
            file.write(json.dumps(line) + "\n")


def test_every_figure_follows_from_eval_info_alone(tmp_path):
    summary = report(ReportConfig(write_eval(tmp_path, ("calvin", [5.0, 2.0, 0.0, 1.0]))))
    assert summary["in_a_row"] == [0.75, 0.5, 0.25, 0.25, 0.25]
    assert summary["average_length"] == 2.0 == sum([5, 2, 0, 1]) / 4
    # chain 0: all; 1: two, then fails push_into_drawer; 2: fails close_drawer; 3: led off, then fails led on
    assert summary["tasks"]["turn_on_led"] == {"successes": 2, "attempts": 3, "rate": 2 / 3}
    assert summary["tasks"]["close_drawer"] == {"successes": 1, "attempts": 2, "rate": 0.5}
    assert summary["tasks"]["push_into_drawer"] == {"successes": 0, "attempts": 1, "rate": 0}
    assert "turn_off_lightbulb" not in summary["tasks"], "never attempted"
    assert summary["local_success_rate"] == 8 / 11
    assert summary["seeds"] == [1000, 1003]


def test_another_seed_means_other_chains(tmp_path):
    folder = write_eval(tmp_path, ("calvin", [0.0]))
    known = report(ReportConfig(folder, seed=3))
    assert list(known["tasks"]) == ["turn_off_led"]
    supposed = report(ReportConfig(folder))["notes"]
    (warning,) = set(supposed) - set(known["notes"])
    assert "--seed was 1000" in warning
    assert list(report(ReportConfig(folder, seed=2000))["tasks"]) == ["open_drawer"]


def test_the_report_is_saved_as_json_text_and_plots(tmp_path):
    out = tmp_path / "report"
    summary = report(ReportConfig(write_eval(tmp_path / "eval", ("calvin", [5.0, 2.0])), output_dir=out))
    assert json.loads((out / "report.json").read_text()) == summary
    text = (out / "report.md").read_text()
    assert "| chains | 100.0 % | 100.0 % | 50.0 % | 50.0 % | 50.0 % | 3.500 |" in text
    assert "2 of the benchmark's 1000 chains" in text
    for name in ("in_a_row.png", "tasks.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    assert [p.name for p in (tmp_path / "eval").iterdir()] == ["eval_info.json"], "nothing else is touched"


def test_single_tasks_are_reported_per_task_without_chains(tmp_path):
    folder = write_eval(tmp_path, ("open_drawer", [1.0, 0.0, 1.0]), ("turn_on_led", [1.0]))
    summary = report(ReportConfig(folder))
    assert summary["tasks"]["open_drawer"] == {"successes": 2, "attempts": 3, "rate": 2 / 3}
    assert summary["tasks"]["turn_on_led"]["attempts"] == 1
    assert "in_a_row" not in summary
    assert not (folder / "in_a_row.png").exists()


def test_single_tasks_with_lines_and_equal_seeds_are_kept_apart(tmp_path):
    folder = write_eval(tmp_path, ("open_drawer", [1.0, 0.0]), ("turn_on_led", [0.0, 1.0]))
    rows = [(s, None, [("open_drawer", s == 7)]) for s in (7, 8)]
    write_lines(folder, rows + [(s, None, [("turn_on_led", s == 8)]) for s in (7, 8)])
    summary = report(ReportConfig(folder))
    assert {task: c["successes"] for task, c in summary["tasks"].items()} == {
        "open_drawer": 1,
        "turn_on_led": 1,
    }


@pytest.mark.parametrize("with_lines", [True, False])
def test_a_suites_entries_are_reported_by_task(tmp_path, with_lines):
    folder = write_eval(tmp_path, ("drawer", [1.0, 0.0]), ("drawer", [0.0, 0.0]))
    if with_lines:
        write_lines(folder, [(s, None, [("close_drawer", False)]) for s in (7, 8)])
        write_lines(folder, [(s, None, [("open_drawer", s == 7)]) for s in (7, 8)])
    tasks = report(ReportConfig(folder))["tasks"]
    assert {task: (c["successes"], c["attempts"]) for task, c in tasks.items()} == {
        "open_drawer": (1, 2),
        "close_drawer": (0, 2),
    }


def test_lines_tell_the_task_of_a_group_with_another_name(tmp_path):
    folder = write_eval(tmp_path, ("calvin", [1.0, 0.0]))
    write_lines(folder, [(0, None, [("open_drawer", True)]), (1, None, [("open_drawer", False)])])
    summary = report(ReportConfig(folder))
    assert summary["tasks"] == {"open_drawer": {"successes": 1, "attempts": 2, "rate": 0.5}}
    assert "in_a_row" not in summary


def test_lines_give_the_settings_and_surplus_episodes_do_not_count(tmp_path):
    folder = write_eval(tmp_path / "eval", ("calvin", [1.0, 0.0]))
    commands = [("stack_block", True), ("turn_off_led", False)]  # a chain list of the user's own
    rows = [(50, 0, commands), (51, 1, commands[1:]), (52, 2, commands)]
    write_lines(tmp_path / "lines", rows)
    summary = report(ReportConfig(folder, results_dir=tmp_path / "lines"))
    assert summary["tasks"]["stack_block"]["attempts"] == 1
    assert summary["tasks"]["turn_off_led"]["attempts"] == 2
    assert summary["seeds"] == [50, 51]
    expected = {"scene": "D", "assets": "built-in", "control_mode": "rel", "steps_per_command": 360}
    assert {key: value for key, value in summary["settings"].items() if value is not None} == expected


def test_episodes_that_ended_before_their_time_are_counted(tmp_path):
    folder = write_eval(tmp_path, ("calvin", [0.0, 0.0]))
    write_lines(folder, [(0, 0, [("open_drawer", False)])], reason=None, sentence="random")
    write_lines(folder, [(1, 1, [("turn_on_led", False)])], reason="simulation diverged", sentence="random")
    summary = report(ReportConfig(folder))
    assert summary["ended_early"] == 1
    assert summary["settings"]["sentence"] == "random"
    assert any(note.startswith("1 episodes failed because the desk refused") for note in summary["notes"])


def test_lines_of_another_evaluation_are_noticed(tmp_path):
    folder = write_eval(tmp_path, ("calvin", [2.0]))
    write_lines(folder, [(0, 0, [("open_drawer", False)])])
    with pytest.raises(ValueError, match="of another evaluation"):
        report(ReportConfig(folder))


def test_lines_of_two_evaluations_in_one_folder_are_noticed(tmp_path):
    folder = write_eval(tmp_path, ("calvin", [0.0]))
    write_lines(folder, [(0, 0, [("open_drawer", False)]), (0, 0, [("open_drawer", True)])])
    with pytest.raises(ValueError, match="several evaluations"):
        report(ReportConfig(folder))


@pytest.mark.parametrize(
    ("config", "privileged"),
    [
        ({"input_features": {"observation.state": {}, "observation.environment_state": {}}}, True),
        ({"input_features": {"observation.state": {}, "observation.images.static": {}}}, False),
        ({"input_features": {"observation.environment_state": {}}, "use_spatial_context": False}, False),
    ],
)
def test_privileged_scene_state_is_stated(tmp_path, config, privileged):
    (tmp_path / "config.json").write_text(json.dumps(config))
    summary = report(ReportConfig(write_eval(tmp_path / "eval", ("calvin", [0.0])), policy_path=str(tmp_path)))
    assert summary["policy_reads_scene_state"] is privileged
    assert any("privileged" in note for note in summary["notes"]) is privileged


def test_the_policy_may_be_one_on_the_hub(tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    folder = tmp_path / "hub/models--you--policy"
    (folder / "snapshots/abc").mkdir(parents=True)
    (folder / "refs").mkdir()
    (folder / "refs/main").write_text("abc")
    (folder / "snapshots/abc/config.json").write_text('{"input_features": {"observation.environment_state": {}}}')
    config = ReportConfig(write_eval(tmp_path / "eval", ("calvin", [0.0])), policy_path="you/policy")
    assert report(config)["policy_reads_scene_state"] is True
    for missing in ("you/other", "outputs/train/no/such/folder"):
        config.policy_path = missing
        with pytest.raises(CommandError, match=f"--policy_path={missing} is neither"):
            report(config)


def trained_on(folder, look, *features):
    """A policy that reads these features, and its dataset with this look in its manifest."""
    manifest = folder / "data" / "meta" / "calvin_source.json"
    manifest.parent.mkdir(parents=True)
    manifest.write_text(json.dumps({"request": {}, **({} if look is None else {"look": look})}))
    (folder / "config.json").write_text(json.dumps({"input_features": {key: {} for key in features}}))
    options = {"dataset": {"repo_id": "you/desk", "root": str(manifest.parents[1]), "revision": None}}
    (folder / "train_config.json").write_text(json.dumps(options))
    return str(folder)


PUBLIC = {"renderer": "gl", "assets": "original", "image_size": None}


@pytest.mark.parametrize(
    ("look", "features", "settings", "note"),
    [
        (PUBLIC, ["static"], {"renderer": "gl", "assets": "original", "image_size": 0}, None),
        (PUBLIC, ["static"], {"renderer": "pybullet_gl", "assets": "original", "image_size": 0}, None),
        (PUBLIC, ["static"], {"renderer": "tiny", "assets": "original"}, "renderer gl (evaluated: tiny)"),
        (PUBLIC, ["static"], {"renderer": "gl"}, "assets original (evaluated: built-in)"),
        (PUBLIC, ["static"], {"renderer": None, "assets": "original", "image_size": None}, None),
        ({**PUBLIC, "image_size": 128}, ["static"], {"assets": "original", "image_size": 0}, "image_size 128"),
        (PUBLIC, ["static"], {"assets": "original", "image_size": 128}, "image_size 0 (evaluated: 128)"),
        ({"assets": "original"}, ["static"], {"renderer": "tiny", "assets": "original", "image_size": 64}, None),
        (PUBLIC, [], {"renderer": "tiny"}, None),
        (None, ["static"], {"renderer": "tiny"}, None),
    ],
)
def test_another_look_than_the_datasets_is_noticed(tmp_path, look, features, settings, note):
    policy = trained_on(tmp_path / "policy", look, *(f"observation.images.{name}" for name in features))
    folder = write_eval(tmp_path / "eval", ("calvin", [0.0]))
    write_lines(folder, [(1000, 0, [("open_drawer", False)])], **settings)
    notes = [note for note in report(ReportConfig(folder, policy_path=policy))["notes"] if "another look" in note]
    assert len(notes) == (note is not None)
    assert note is None or note in notes[0]


def test_only_original_assets_are_called_comparable(tmp_path):
    folder = write_eval(tmp_path, ("calvin", [0.0]))
    assert any("not comparable" in note for note in report(ReportConfig(folder))["notes"])
    write_lines(folder, [(1000, 0, [("open_drawer", False)])], assets="original")
    assert not any("not comparable" in note for note in report(ReportConfig(folder))["notes"])


def run_main(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["lansar-report", *arguments])
    try:
        code = report_module.main()
    except SystemExit as stop:
        code = stop.code
    return code, capsys.readouterr()


def test_the_command_prints_the_tables(tmp_path, monkeypatch, capsys):
    folder = write_eval(tmp_path, ("calvin", [5.0, 2.0, 0.0, 1.0]))
    code, printed = run_main(monkeypatch, capsys, f"--eval_dir={folder}")
    assert code == 0
    assert "average length" in printed.out
    assert "open_drawer" in printed.out
    assert "Local success rate (all attempted commands): 72.73 %" in printed.out


def test_errors_are_one_message_and_exit_code_2(tmp_path, monkeypatch, capsys):
    for arguments, message in [
        ([f"--eval_dir={tmp_path}"], "eval_info.json is missing"),
        ([], "eval_dir"),
        ([f"--eval_dir={tmp_path}", "--seed=abc"], "seed"),
        ([f"--eval_dir={write_eval(tmp_path / 'a', ('calvin', [7.5]))}"], "sum of rewards 7.5"),
        ([f"--eval_dir={write_eval(tmp_path / 'b', ('calvin', []))}"], "holds no episode"),
        ([f"--eval_dir={tmp_path / 'a'}", f"--results_dir={tmp_path / 'a'}"], "holds no episodes.jsonl"),
    ]:
        code, printed = run_main(monkeypatch, capsys, *arguments)
        assert code == 2
        assert message in printed.err
        assert "Traceback" not in printed.err


def test_a_damaged_line_is_named(tmp_path, monkeypatch, capsys):
    folder = write_eval(tmp_path, ("calvin", [0.0]))
    (folder / EPISODES_FILE).write_text('{"seed": 0}\n')
    code, printed = run_main(monkeypatch, capsys, f"--eval_dir={folder}")
    assert code == 2
    assert "episodes.jsonl, line 1" in printed.err
