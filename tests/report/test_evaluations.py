"""Which folders make one evaluation, which episodes it lacks, where its videos are."""

from pathlib import Path

import pytest
from eval_files import chain_line, write_eval, write_lines, write_plan, write_policy

from lerobot_lansar.benchmark import EPISODES_FILE
from lerobot_lansar.command import CommandError
from lerobot_lansar.report.evaluation import group, merge, read_part, set_labels
from lerobot_lansar.report.report import ReportConfig, report


def lines(folder, seeds, fulfilled=1, **settings):
    """A folder with chains of these seeds."""
    return write_lines(folder, [chain_line(seed, fulfilled) for seed in seeds], **settings)


def groups(*folders):
    """Seeds of the evaluations that these folders make."""
    return [[e.seed for e in evaluation.episodes] for evaluation in group(read_part(f) for f in folders)]


def test_parts_of_one_evaluation_are_merged(tmp_path):
    a = lines(tmp_path / "a", [0, 1], policy="p")
    b = lines(tmp_path / "b", [2, 3], policy="p")
    assert groups(a, b) == [[0, 1, 2, 3]]


def test_a_policy_is_known_by_its_weights_wherever_they_lie(tmp_path):
    folders = [lines(tmp_path / name, [seed], policy=policy) for seed, (name, policy) in enumerate(("ap", "bq", "cp"))]
    for folder, weights in zip(folders, ("1", "1", "2"), strict=True):
        write_plan(folder, seed=None, request={"weights of the policy": {"model.safetensors": weights}})
    assert groups(*folders) == [[0, 1], [2]]
    with pytest.raises(ValueError, match="are of different weights of p"):
        merge([read_part(folders[0]), read_part(folders[2])])
    moved = write_policy(tmp_path / "moved", "state")
    assert report(ReportConfig([str(f) for f in folders[:2]], tmp_path / "out", policy_path=moved))["tables"]


@pytest.mark.parametrize(
    ("seeds", "settings"),
    [
        ([1, 2], {"policy": "p"}),  # seed 1 twice
        ([2, 3], {"policy": "q"}),
        ([2, 3], {}),  # nobody knows whose
        ([2, 3], {"policy": "p", "sentence": "random"}),
        ([2, 3], {"policy": "p", "assets": "original"}),
        ([2, 3], {"policy": "p", "policy_reset": "batch"}),
    ],
)
def test_other_evaluations_are_compared(tmp_path, seeds, settings):
    a = lines(tmp_path / "a", [0, 1], policy="p")
    b = lines(tmp_path / "b", seeds, **settings)
    assert groups(a, b) == [[0, 1], seeds]


def test_a_newer_version_goes_on_with_an_evaluation(tmp_path):
    a = lines(tmp_path / "a", [0], policy="p", version="0.1.0")
    b = lines(tmp_path / "b", [1], policy="p", version="0.2.0")
    assert groups(a, b) == [[0, 1]]


def test_a_given_policy_merges_parts_that_do_not_know_theirs(tmp_path):
    folders = [lines(tmp_path / name, [seed]) for name, seed in (("a", 0), ("b", 1))]
    assert groups(*folders) == [[0], [1]]
    assert len(group(read_part(folder, policy="p") for folder in folders)) == 1
    content = report(ReportConfig([str(folder) for folder in folders], tmp_path / "out"))
    assert "give --policy_path and they are merged" in content["tables"][0]["notes"][-1]


def test_one_given_policy_cannot_stand_for_several(tmp_path):
    folders = [str(lines(tmp_path / name, [0], policy=name)) for name in "ab"]
    with pytest.raises(CommandError, match="the evaluations name 2: a, b"):
        report(ReportConfig(folders, tmp_path / "out", policy_path="moved"))


def test_chains_and_single_tasks_are_not_merged(tmp_path):
    a = lines(tmp_path / "a", [0], policy="p")
    b = write_lines(tmp_path / "b", [(1, None, [("open_drawer", True)])], policy="p")
    assert len(group([read_part(a), read_part(b)])) == 2


@pytest.mark.parametrize(
    ("seeds", "settings", "message"),
    [
        ([0], {}, "both hold the episode of seed 0"),
        ([1], {"sentence": "random"}, "have different settings"),
        ([1], {"policy": "q"}, "are of different policies, p and q"),
    ],
)
def test_folders_said_to_be_one_evaluation_must_be(tmp_path, seeds, settings, message):
    a = lines(tmp_path / "a", [0], policy="p")
    b = lines(tmp_path / "b", seeds, **{"policy": "p", **settings})
    with pytest.raises(ValueError, match=message):
        merge([read_part(a), read_part(b)])


def test_missing_episodes_are_those_of_the_plan(tmp_path):
    part = read_part(write_plan(lines(tmp_path, [0, 2, 3, 4]), n_episodes=4))
    assert [e.seed for e in part.episodes] == [0, 2, 3], "seed 4 filled LeRobot's last batch"
    assert merge([part]).missing == [("lh_mtlc", 1)]


def test_a_plan_counts_the_seeds_of_every_task(tmp_path):
    rows = [(seed, None, [(task, True)]) for seed in (5, 6) for task in ("open_drawer", "close_drawer")]
    write_lines(tmp_path, rows[:-1])
    write_plan(tmp_path, seed=5, n_episodes=2, suites={"drawer": ["open_drawer", "close_drawer"]})
    assert merge([read_part(tmp_path)]).missing == [("close_drawer", 6)]


def test_the_plans_of_merged_parts_add_up(tmp_path):
    a = write_plan(lines(tmp_path / "a", [0, 1]), n_episodes=2)
    b = write_plan(lines(tmp_path / "b", [500]), n_episodes=3, seed=500)
    assert merge([read_part(a), read_part(b)]).missing == [("lh_mtlc", 501), ("lh_mtlc", 502)]


def test_without_a_plan_only_lerobots_own_results_tell_that_nothing_is_missing(tmp_path):
    assert merge([read_part(lines(tmp_path / "a", [0]))]).missing is None
    finished = write_eval(lines(tmp_path / "b", [0], 2), ("lh_mtlc", [2.0]))
    assert merge([read_part(finished)]).missing == []
    report(ReportConfig(str(tmp_path / "a")))
    assert "1 chain; how many are missing is unknown" in (tmp_path / "a/report.md").read_text()


@pytest.mark.parametrize("entry", [{}, {"seed": 0}, {"n_episodes": 3, "suites": {}}])
def test_a_plan_may_lack_anything(tmp_path, entry):
    lines(tmp_path, [0])
    write_plan(tmp_path, **{"suites": None, "seed": None, **entry})
    part = read_part(tmp_path)
    assert (part.expected, len(part.episodes)) == (None, 1)


def test_the_plan_names_the_policy_where_lines_do_not(tmp_path):
    assert read_part(write_plan(lines(tmp_path, [0]), policy="you/policy")).policy == "you/policy"


def test_an_interrupted_last_line_is_a_missing_episode(tmp_path):
    write_plan(lines(tmp_path, [0, 1]), n_episodes=3)
    file = tmp_path / EPISODES_FILE
    whole = file.read_text()
    for cut in (whole + '{"seed": 2, "cha', whole + whole.splitlines()[0].replace('"seed": 0', '"seed": 2')):
        file.write_text(cut)
        assert merge([read_part(tmp_path)]).missing == [("lh_mtlc", 2)]
    file.write_text('{"seed": 0, "ch\n' + whole)
    with pytest.raises(ValueError, match=r"episodes\.jsonl, line 1: not an episode"):
        read_part(tmp_path)


def test_an_evaluation_that_has_just_begun_is_said_to_have(tmp_path):
    with pytest.raises(FileNotFoundError, match="no episode has finished yet"):
        read_part(write_plan(tmp_path, n_episodes=3))


def test_lines_and_lerobots_results_must_agree(tmp_path):
    with pytest.raises(ValueError, match="of another evaluation"):
        read_part(write_eval(lines(tmp_path, [0], 0), ("lh_mtlc", [2.0])))


def test_one_folder_is_of_one_evaluation(tmp_path):
    a = lines(lines(tmp_path / "a", [0], 0), [0], 2)
    with pytest.raises(ValueError, match="two different episodes of seed 0"):
        read_part(a)
    b = lines(lines(tmp_path / "b", [0], policy="p"), [1], policy="q")
    with pytest.raises(ValueError, match="of several policies: p, q"):
        read_part(b)
    assert len(read_part(lines(lines(tmp_path / "c", [0]), [0])).episodes) == 1, "the same line twice is one episode"


@pytest.mark.parametrize("planned", [True, False])
def test_videos_are_numbered_from_the_first_seed(tmp_path, planned):
    lines(tmp_path, [0, 1, 2])
    if planned:  # seed 10 of the plan is chain 10
        (tmp_path / EPISODES_FILE).unlink()
        write_plan(lines(tmp_path, [11, 12, 13]), seed=10, n_episodes=4)
    video = tmp_path / "videos/lh_mtlc_0/eval_episode_1.mp4"
    video.parent.mkdir(parents=True)
    video.touch()
    assert read_part(tmp_path).videos == {("lh_mtlc", 11 if planned else 1): video}


def test_a_groups_videos_are_numbered_by_task(tmp_path):
    write_lines(tmp_path, [(s, None, [(task, True)]) for s in (7, 8) for task in ("open_drawer", "close_drawer")])
    for name in ("drawer_0/eval_episode_0", "drawer_1/eval_episode_1"):
        (tmp_path / "videos" / name).parent.mkdir(parents=True)
        (tmp_path / "videos" / f"{name}.mp4").touch()
    assert {key: path.parent.name for key, path in read_part(tmp_path).videos.items()} == {
        ("open_drawer", 7): "drawer_0",
        ("close_drawer", 8): "drawer_1",
    }


@pytest.mark.parametrize(
    ("paths", "labels"),
    [
        (["out/{}/checkpoints/last/pretrained_model"], ["lansar", "act"]),
        (["same"], ["a", "b"]),  # one policy: by the folders
        (["out/checkpoints/{}/pretrained_model"], ["lansar", "act"]),
    ],
)
def test_names_are_what_paths_do_not_share(tmp_path, paths, labels):
    folders = [
        lines(tmp_path / folder, [0], policy=paths[0].format(name)) for folder, name in (("a", "lansar"), ("b", "act"))
    ]
    evaluations = group(read_part(folder) for folder in folders)
    set_labels(evaluations)
    assert [evaluation.label for evaluation in evaluations] == labels


@pytest.mark.parametrize(
    ("path", "label"),
    [
        ("outputs/train/lansar/checkpoints/last/pretrained_model", "lansar"),
        ("you/policy", "policy"),
        ("outputs/train/lansar/checkpoints/003000/pretrained_model", "lansar"),
    ],
)
def test_a_single_evaluation_is_named_after_its_policy(tmp_path, path, label):
    evaluations = group([read_part(lines(tmp_path, [0], policy=path))])
    set_labels(evaluations)
    assert evaluations[0].label == label


def test_two_evaluations_never_have_one_name(tmp_path):
    part = read_part(lines(tmp_path / "x", [0]))
    evaluations = group([part, part])
    set_labels(evaluations)
    assert [Path(e.label).name for e in evaluations] == ["x (1)", "x (2)"]
