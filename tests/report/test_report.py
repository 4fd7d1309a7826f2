"""`lansar-report` on one evaluation: every figure and every note is checked against facts worked out by hand."""

import json
import sys

import numpy as np
import pytest
from eval_files import write_eval, write_lines, write_policy

from lerobot_lansar.benchmark import EPISODES_FILE, Chain
from lerobot_lansar.command import CommandError
from lerobot_lansar.report import episodes
from lerobot_lansar.report import report as report_module
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
    monkeypatch.setattr(episodes, "load_chains", lambda: chains)


def row_of(folder, **options):
    """The one evaluation of a report."""
    (table,) = report(ReportConfig(str(folder), **options))["tables"]
    (row,) = table["evaluations"]
    return row


def counts(row):
    return {task: (c["successes"], c["attempts"]) for task, c in row["tasks"].items()}


def test_every_figure_follows_from_eval_info_alone(tmp_path):
    row = row_of(write_eval(tmp_path, ("calvin", [5.0, 2.0, 0.0, 1.0])))
    assert row["in_a_row"] == [0.75, 0.5, 0.25, 0.25, 0.25]
    assert row["average_length"] == 2.0 == sum([5, 2, 0, 1]) / 4
    # chain 0: all; 1: two, then fails push_into_drawer; 2: fails close_drawer; 3: led off, then fails led on
    assert counts(row)["turn_on_led"] == (2, 3)
    assert counts(row)["close_drawer"] == (1, 2)
    assert counts(row)["push_into_drawer"] == (0, 1)
    assert "turn_off_lightbulb" not in row["tasks"], "never attempted"
    assert row["local_success_rate"] == 8 / 11
    assert row["seeds"] == [1000, 1003]


def test_another_seed_means_other_chains(tmp_path):
    folder = write_eval(tmp_path, ("calvin", [0.0]))
    known = row_of(folder, seed=3)
    assert list(known["tasks"]) == ["turn_off_led"]
    supposed = row_of(folder)["notes"]
    (warning,) = set(supposed) - set(known["notes"])
    assert "--seed was 1000" in warning
    assert list(row_of(folder, seed=2000)["tasks"]) == ["open_drawer"]


def test_the_report_is_saved_as_page_json_and_text(tmp_path):
    out = tmp_path / "report"
    content = report(ReportConfig(str(write_eval(tmp_path / "eval", ("calvin", [5.0, 2.0]))), out))
    assert json.loads((out / "report.json").read_text()) == content
    text = (out / "report.md").read_text()
    # Wilson's intervals of 2 of 2 and 1 of 2; two chains of 5 and 2
    assert "| 100.0 [34.2, 100.0] | 100.0 [34.2, 100.0] | 50.0 [9.5, 90.5] " in text
    assert "| 3.500 [2.00, 5.00] |" in text
    assert "2 of the benchmark's 1000 chains" in text
    assert sorted(p.name for p in out.iterdir()) == ["report.html", "report.json", "report.md"]
    assert [p.name for p in (tmp_path / "eval").iterdir()] == ["eval_info.json"], "nothing else is touched"


def test_what_is_missing_is_said_first(tmp_path):
    report(ReportConfig(str(write_eval(tmp_path, ("calvin", [5.0])))))
    lines = (tmp_path / "report.md").read_text().splitlines()
    assert lines[2].endswith(": 0 of 1 chain missing")
    page = (tmp_path / "report.html").read_text()
    assert page.index("0 of 1 chain missing") < page.index("Measured on")


def test_single_tasks_are_reported_per_task_without_chains(tmp_path):
    row = row_of(write_eval(tmp_path, ("open_drawer", [1.0, 0.0, 1.0]), ("turn_on_led", [1.0])))
    assert counts(row) == {"turn_on_led": (1, 1), "open_drawer": (2, 3)}
    assert "in_a_row" not in row
    assert row["kind"] == "single tasks"


def test_single_tasks_with_lines_and_equal_seeds_are_kept_apart(tmp_path):
    folder = write_eval(tmp_path, ("open_drawer", [1.0, 0.0]), ("turn_on_led", [0.0, 1.0]))
    rows = [(s, None, [("open_drawer", s == 7)]) for s in (7, 8)]
    write_lines(folder, rows + [(s, None, [("turn_on_led", s == 8)]) for s in (7, 8)])
    assert counts(row_of(folder)) == {"open_drawer": (1, 2), "turn_on_led": (1, 2)}


@pytest.mark.parametrize("with_lines", [True, False])
def test_a_suites_entries_are_reported_by_task(tmp_path, with_lines):
    folder = write_eval(tmp_path, ("drawer", [1.0, 0.0]), ("drawer", [0.0, 0.0]))
    if with_lines:
        write_lines(folder, [(s, None, [("close_drawer", False)]) for s in (7, 8)])
        write_lines(folder, [(s, None, [("open_drawer", s == 7)]) for s in (7, 8)])
    assert counts(row_of(folder)) == {"open_drawer": (1, 2), "close_drawer": (0, 2)}


def test_lines_tell_the_task_of_a_group_with_another_name(tmp_path):
    folder = write_eval(tmp_path, ("calvin", [1.0, 0.0]))
    write_lines(folder, [(0, None, [("open_drawer", True)]), (1, None, [("open_drawer", False)])])
    row = row_of(folder)
    assert counts(row) == {"open_drawer": (1, 2)}
    assert "in_a_row" not in row


def test_lines_give_the_settings_and_surplus_episodes_do_not_count(tmp_path):
    folder = write_eval(tmp_path, ("calvin", [1.0, 0.0]))
    commands = [("stack_block", True), ("turn_off_led", False)]  # a chain list of the user's own
    write_lines(folder, [(50, 0, commands), (51, 1, commands[1:]), (52, 2, commands)])
    row = row_of(folder)
    assert counts(row) == {"stack_block": (1, 1), "turn_off_led": (0, 2)}
    assert row["seeds"] == [50, 51]
    expected = {"scene": "D", "assets": "built-in", "control_mode": "rel", "steps_per_command": 360}
    assert {key: value for key, value in row["settings"].items() if value is not None} == expected


def test_episodes_that_ended_before_their_time_are_counted(tmp_path):
    write_lines(tmp_path, [(0, 0, [("open_drawer", False)])], reason=None)
    write_lines(tmp_path, [(1, 1, [("turn_on_led", False)])], reason="simulation diverged")
    row = row_of(tmp_path)
    assert row["ended_early"] == 1
    assert any(note.startswith("1 episode failed because the desk refused") for note in row["notes"])
    assert "simulation diverged" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("settings", "note"),
    [
        ({"policy_reset": "command"}, None),
        ({"policy_reset": "batch"}, "up to 99 stale actions after each fulfilled command"),
        ({}, "is unknown"),
    ],
)
def test_when_the_policy_was_reset_is_stated(tmp_path, settings, note):
    policy = write_policy(tmp_path / "policy", "state", n_action_steps=100)
    write_lines(tmp_path / "eval", [(0, 0, [("open_drawer", False)])], policy=policy, **settings)
    notes = [text for text in row_of(tmp_path / "eval")["notes"] if "reset" in text]
    assert len(notes) == (note is not None)
    assert note is None or note in notes[0]


@pytest.mark.parametrize(
    ("settings", "note"),
    [
        ({"steps_per_command": 200}, "Not CALVIN's protocol: steps per command 200."),
        ({"sentence": "random"}, "Not CALVIN's protocol: sentence random."),
        ({"perturbation_every": 50}, "Not CALVIN's protocol: perturbation every 50."),
        ({"sentence": "first", "perturbation_every": 0}, None),
    ],
)
def test_another_protocol_than_calvins_is_stated(tmp_path, settings, note):
    write_lines(tmp_path, [(0, 0, [("open_drawer", False)])], **settings)
    notes = [text for text in row_of(tmp_path)["notes"] if "protocol" in text]
    assert notes == ([] if note is None else [note])


@pytest.mark.parametrize(
    ("features", "options", "reads"),
    [
        (["state", "environment_state"], {}, ["robot state", "scene state (privileged)"]),
        (["state", "images.static"], {}, ["static picture", "robot state"]),
        (["images.static", "images.gripper"], {}, ["static picture", "gripper picture"]),
        (["environment_state"], {"use_spatial_context": False}, []),
        (["state", "environment_state"], {"type": "smolvla"}, ["robot state"]),
        (["environment_state 58"], {}, ["scene state (privileged)", "commanded task (34 numbers)"]),
        (["state", "environment_state 34"], {}, ["robot state", "commanded task (34 numbers)"]),
        (
            ["state", "environment_state"],
            {"use_images": True, "use_spatial_context": True},
            ["static picture", "gripper picture", "robot state", "scene state (privileged)"],
        ),
    ],
)
def test_what_the_policy_reads_is_stated(tmp_path, features, options, reads):
    policy = write_policy(tmp_path / "policy", *features, **options)
    row = row_of(write_eval(tmp_path / "eval", ("calvin", [0.0])), policy_path=policy)
    assert row["reads"] == reads
    privileged = "scene state (privileged)" in reads
    assert row["policy_reads_scene_state"] is privileged
    assert any("privileged" in note for note in row["notes"]) is privileged


def test_the_policy_may_be_one_on_the_hub(tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    folder = tmp_path / "hub/models--you--policy"
    write_policy(folder / "snapshots/abc", "environment_state")
    (folder / "refs").mkdir()
    (folder / "refs/main").write_text("abc")
    evaluation = write_eval(tmp_path / "eval", ("calvin", [0.0]))
    assert row_of(evaluation, policy_path="you/policy")["policy_reads_scene_state"] is True
    for missing in ("you/other", "outputs/train/no/such/folder"):
        with pytest.raises(CommandError, match=f"--policy_path={missing} is neither"):
            row_of(evaluation, policy_path=missing)


def test_only_a_policy_that_the_user_names_is_looked_for_on_the_hub(tmp_path, monkeypatch):
    asked = []

    def ask(repo_id, name, local_files_only, **_):
        asked.append((repo_id, local_files_only))
        raise OSError("not here")

    monkeypatch.setattr("huggingface_hub.hf_hub_download", ask)
    write_lines(tmp_path, [(0, 0, [("open_drawer", False)])], policy="you/policy")
    row_of(tmp_path)
    with pytest.raises(CommandError, match="not here"):
        row_of(tmp_path, policy_path="you/policy")
    assert asked == [("you/policy", True), ("you/policy", False)]


def test_a_policy_that_has_moved_is_unknown_until_its_new_place_is_given(tmp_path):
    write_lines(tmp_path / "eval", [(0, 0, [("open_drawer", False)])], policy="gone/far/away")
    row = row_of(tmp_path / "eval")
    assert row["policy"] == "gone/far/away"
    assert row["policy_reads_scene_state"] is None
    assert any("unknown: give --policy_path" in note for note in row["notes"])
    moved = write_policy(tmp_path / "moved", "state")
    assert row_of(tmp_path / "eval", policy_path=moved)["policy_reads_scene_state"] is False


def trained_on(folder, look, *features, **options):
    """A policy that reads these features, and its dataset with this look in its manifest."""
    manifest = folder / "data" / "meta" / "calvin_source.json"
    manifest.parent.mkdir(parents=True)
    manifest.write_text(json.dumps({"request": {}, **({} if look is None else {"look": look})}))
    training = {"dataset": {"repo_id": "you/desk", "root": str(manifest.parents[1]), "revision": None}}
    (folder / "train_config.json").write_text(json.dumps(training))
    return write_policy(folder, *features, **options)


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
        (PUBLIC, ["embeddings"], {"renderer": "tiny", "assets": "original"}, "renderer gl (evaluated: tiny)"),
        (None, ["static"], {"renderer": "tiny"}, None),
    ],
)
def test_another_look_than_the_datasets_is_noticed(tmp_path, look, features, settings, note):
    embedded = features == ["embeddings"]  # LanSAR's pictures are not among its inputs
    inputs = () if embedded else (f"images.{name}" for name in features)
    policy = trained_on(tmp_path / "policy", look, *inputs, use_images=embedded)
    folder = write_lines(tmp_path / "eval", [(1000, 0, [("open_drawer", False)])], **settings)
    notes = [note for note in row_of(folder, policy_path=policy)["notes"] if "another look" in note]
    assert len(notes) == (note is not None)
    assert note is None or note in notes[0]


def test_only_original_assets_are_called_comparable(tmp_path):
    folder = write_eval(tmp_path, ("calvin", [0.0]))
    assert any("not comparable" in note for note in row_of(folder)["notes"])
    write_lines(folder, [(1000, 0, [("open_drawer", False)])], assets="original")
    assert not any("not comparable" in note for note in row_of(folder)["notes"])


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
    assert "local success rate (all attempted commands) 72.73 % [43.4, 90.3]" in printed.out


def test_errors_are_one_message_and_exit_code_2(tmp_path, monkeypatch, capsys):
    (tmp_path / "empty").mkdir()
    a = write_eval(tmp_path / "a", ("calvin", [7.5]))
    ok = write_eval(tmp_path / "ok", ("calvin", [1.0]))
    both = f"--eval_dir=[{ok},{ok}]"
    for arguments, message in [
        ([f"--eval_dir={tmp_path / 'empty'}"], "holds neither episodes.jsonl nor eval_info.json"),
        ([f"--eval_dir={tmp_path / 'none'}"], "is not a folder"),
        ([], "give --eval_dir"),
        ([f"--eval_dir={ok}", "--seed=abc"], "seed"),
        ([f"--eval_dir={a}"], "sum of rewards 7.5"),
        ([f"--eval_dir={write_eval(tmp_path / 'b', ('calvin', []))}"], "holds no episode"),
        ([both], "give the report its own folder, --output_dir"),
        ([both, f"--output_dir={tmp_path}", "--labels=[one]"], "--labels has 1 names, but there are 2 evaluations"),
        ([both, f"--output_dir={tmp_path}", "--policy_path=[one]"], "--policy_path lists 1 policies"),
        ([f"--eval_dir={ok}", "--published=5.5"], "choose among thesis_5.1"),
    ]:
        code, printed = run_main(monkeypatch, capsys, *arguments)
        assert code == 2
        assert message in printed.err
        assert "Traceback" not in printed.err
    assert not list(tmp_path.rglob("report.*")), "nothing is written"


def test_a_damaged_line_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / EPISODES_FILE).write_text('{"seed": 0}\n')
    code, printed = run_main(monkeypatch, capsys, f"--eval_dir={tmp_path}")
    assert code == 2
    assert "episodes.jsonl, line 1" in printed.err
