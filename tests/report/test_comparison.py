"""Several evaluations: tables side by side, published rows, and the thesis' tables from one file."""

import json
import sys

import pytest
import yaml
from eval_files import chain_line, write_lines, write_plan, write_policy

from lerobot_lansar.command import CommandError
from lerobot_lansar.report import report as report_module
from lerobot_lansar.report.options import EvaluationConfig, TableConfig
from lerobot_lansar.report.report import ReportConfig, report

THESIS = "configs/thesis/tables.yaml"


def evaluation(folder, lengths, policy=None, **settings):
    """Chains 0, 1, … with so many commands fulfilled."""
    rows = [chain_line(seed, length) for seed, length in enumerate(lengths)]
    return str(write_lines(folder, rows, policy=policy, **settings))


@pytest.fixture
def two(tmp_path):
    """A policy that sees the scene state, and one that does not, on the same four chains."""
    lansar = write_policy(tmp_path / "train/lansar", "state", "environment_state")
    act = write_policy(tmp_path / "train/act", "state", "images.static")
    return [
        evaluation(tmp_path / "a", [5, 5, 2, 0], lansar, policy_reset="command"),
        evaluation(tmp_path / "b", [3, 5, 1, 0], act, policy_reset="batch"),
    ]


def test_evaluations_stand_side_by_side(tmp_path, two):
    (table,) = report(ReportConfig(two, tmp_path / "out", ["LanSAR", "ACT"]))["tables"]
    assert [row["label"] for row in table["evaluations"]] == ["LanSAR", "ACT"]
    (paired,) = table["differences"]
    assert (paired["evaluation"], paired["baseline"], paired["chains"]) == ("ACT", "LanSAR", 4)
    assert paired["average_length"] == -0.75
    assert paired["in_a_row"] == [0, -0.25, 0, -0.25, -0.25]
    text = (tmp_path / "out/report.md").read_text()
    assert "| ACT − LanSAR" in text
    assert "−0.750 [−1.50, +0.00]" in text
    assert table["standard_deviation"] is None


def test_a_comparison_says_who_is_privileged_and_what_differs(tmp_path, two):
    (table,) = report(ReportConfig(two, tmp_path / "out", ["LanSAR", "ACT"]))["tables"]
    notes = "\n".join(table["notes"])
    assert "Privileged: LanSAR reads the simulator's own scene state." in notes
    assert "The evaluations differ in policy reset at each (command, batch)." in notes
    assert [row["reads"] for row in table["evaluations"]] == [
        ["robot state", "scene state (privileged)"],
        ["static picture", "robot state"],
    ]


def test_published_rows_on_the_built_in_desk_are_called_not_comparable_right_above(tmp_path, two):
    report(ReportConfig(two, tmp_path / "out", ["LanSAR", "ACT"], published="thesis_5.5"))
    lines = (tmp_path / "out/report.md").read_text().splitlines()
    start = lines.index("## Comparison")
    assert lines[start + 2].startswith("* Not comparable: published rows were measured on CALVIN's original assets")
    rows = [line.split(" |")[0] for line in lines[start:] if line.startswith("| published: ")]
    assert [row.strip("| ") for row in rows[:2]] == ["published: MCIL, ABCD→D", "published: GR-1, ABCD→D"]
    assert len(rows) == 8
    page = (tmp_path / "out/report.html").read_text()
    assert page.index("Not comparable: published") < page.index("published: GR-1")


def test_published_rows_beside_original_assets_stand_without_that_warning(tmp_path):
    folder = evaluation(tmp_path / "a", [5, 4], assets="original")
    content = report(ReportConfig(folder, published=["thesis_5.1"]))
    assert not any("Not comparable" in note for note in content["tables"][0]["notes"])
    (published,) = content["tables"][0]["published"]
    assert published["rows"][0]["local_success_rate"] == 1697 / 2604
    assert "| published: LanSAR, ABCD→D " in (tmp_path / "a/report.md").read_text()


def test_perturbed_evaluations_end_with_their_standard_deviation(tmp_path):
    folders = [
        evaluation(tmp_path / str(every), lengths, "p", perturbation_every=every, perturbation_scale=float(every > 0))
        for every, lengths in ((0, [5, 0]), (50, [5, 5]))
    ]
    (table,) = report(ReportConfig(folders, tmp_path / "out"))["tables"]
    assert table["standard_deviation"] == [0.25] * 5
    assert "| standard deviation" in (tmp_path / "out/report.md").read_text()


def test_an_evaluation_of_a_file_may_be_spread_over_folders(tmp_path):
    a = str(write_lines(tmp_path / "a", [chain_line(0, 5)]))
    b = str(write_lines(tmp_path / "b", [chain_line(1, 0)]))
    table = TableConfig("Both", [EvaluationConfig("one", [a, b])])
    content = report(ReportConfig(output_dir=tmp_path / "out", tables=[table]))
    assert content["tables"][0]["evaluations"][0]["average_length"] == 2.5


def thesis_evaluations(folder, *names):
    """Evaluations as configs/thesis/tables.yaml names them."""
    for name in names:
        numbers = name.split("_")[1:] if name.startswith("perturbed") else (0, 0)
        every, scale = int(numbers[1]), float(numbers[0])
        path = folder / "outputs/eval/thesis" / name
        evaluation(path, [5, 2, 0], f"outputs/thesis/{name}", perturbation_every=every, perturbation_scale=scale)
        write_plan(path, n_episodes=3)


def run_thesis(tmp_path, monkeypatch, capsys, request):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lansar-report", f"--config_path={request.config.rootpath / THESIS}"])
    return report_module.main(), capsys.readouterr()


def test_one_file_makes_all_of_the_thesis_tables(tmp_path, monkeypatch, capsys, request):
    perturbed = ("perturbed_5_50", "perturbed_2.5_25", "perturbed_0.5_5")
    thesis_evaluations(tmp_path, "baseline", "prepended", "no_space", "no_images", "abc", *perturbed)
    losses = tmp_path / "outputs/thesis/baseline/checkpoints/last/pretrained_model/losses.json"
    losses.parent.mkdir(parents=True)
    losses.write_text('[{"update": 100, "training": 0.5}, {"update": 200, "training": 0.4, "held_out": 0.6}]')
    code, printed = run_thesis(tmp_path, monkeypatch, capsys, request)
    assert code == 0, printed.err
    content = json.loads((tmp_path / "outputs/report/thesis/report.json").read_text())
    assert content["left_out"] == []
    assert [table["title"].split(":")[0] for table in content["tables"]] == [
        "Tables 5.1 and 5.2, Figure 5.1",
        "Table 5.3, Figure 5.2",
        "Table 5.4",
        "Table 5.5",
    ]
    for table in content["tables"]:  # as many rows as the thesis has of its own
        published = [row["label"] for row in table["published"][0]["rows"] if "LanSAR" in row["label"]]
        assert len(table["evaluations"]) == (len(published) or 4)
    assert content["tables"][2]["standard_deviation"] == [0] * 5
    assert content["trainings"][0]["held_out"] == [[200, 0.6]]
    assert printed.out.count("of 3 chains missing") == 8, "every evaluation once"


def test_a_table_whose_evaluation_is_not_there_yet_is_left_out_with_a_note(tmp_path, monkeypatch, capsys, request):
    thesis_evaluations(tmp_path, "baseline", "prepended", "no_space")
    code, printed = run_thesis(tmp_path, monkeypatch, capsys, request)
    assert code == 0, printed.err
    content = json.loads((tmp_path / "outputs/report/thesis/report.json").read_text())
    assert [table["title"][:10] for table in content["tables"]] == ["Tables 5.1"]
    assert "Left out: Table 5.3" in printed.out
    assert "outputs/eval/thesis/no_images is not a folder" in printed.out
    assert [row["label"] for row in content["tables"][0]["evaluations"]] == ["LanSAR"]


def test_nothing_there_yet_is_an_error(tmp_path, monkeypatch, capsys, request):
    code, printed = run_thesis(tmp_path, monkeypatch, capsys, request)
    assert code == 2
    assert "nothing to report yet: Tables 5.1" in printed.err
    assert list(tmp_path.iterdir()) == []


def test_the_files_trainings_and_tables_are_where_the_other_files_put_them(request):
    """What tables.yaml names must be what the experiments' own files train and evaluate."""
    tables = yaml.safe_load((request.config.rootpath / THESIS).read_text())
    files = {path.stem for path in (request.config.rootpath / "configs/thesis").glob("*.yaml")}
    named = {row["eval_dir"].rpartition("/")[2] for table in tables["tables"] for row in table["evaluations"]}
    assert {name if name in files else f"eval_{name}" for name in named} <= files


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"eval_dir": "x"}, "not both"),
        ({"labels": ["a"]}, "go with --eval_dir"),
        ({"published": "thesis_5.1"}, "names it in each table"),
    ],
)
def test_options_that_contradict_a_file_are_refused(tmp_path, options, message):
    table = TableConfig("T", [EvaluationConfig("a", "a")])
    with pytest.raises(CommandError, match=message):
        report(ReportConfig(output_dir=tmp_path / "out", tables=[table], **options))
