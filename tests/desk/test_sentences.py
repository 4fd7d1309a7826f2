"""The grammar of commands: enough sentences, some held out, and the right words in each."""

import itertools

import pytest

from lerobot_lansar.calvin import TASKS
from lerobot_lansar.desk import DeskError
from lerobot_lansar.desk.sentences import COMMANDS, expand, load_commands


def test_every_task_has_ten_training_and_three_validation_sentences():
    for split, minimum in (("training", 10), ("validation", 3)):
        assert list(COMMANDS[split]) == list(TASKS)
        assert all(len(listed) >= minimum for listed in COMMANDS[split].values())


def test_no_sentence_occurs_in_both_splits_or_means_two_tasks():
    listed = [s for split in COMMANDS.values() for sentences in split.values() for s in sentences]
    assert len(set(listed)) == len(listed)


def test_colours_and_sides_are_those_of_the_task():
    for split, task in itertools.product(COMMANDS, TASKS):
        words = set(task.split("_"))
        for sentence in COMMANDS[split][task]:
            spoken = set(sentence.split())
            for choice in ({"red", "blue", "pink"}, {"left", "right"}):
                assert spoken & choice == words & choice, (task, sentence)
            assert "{" not in sentence
            assert "(" not in sentence
            assert sentence == " ".join(sentence.split())


OPPOSITES = ({"open", "pull"}, {"close", "shut"}), ({"on"}, {"off"})
PLACES = {"table": {"table"}, "slider": {"cabinet", "shelf", "door"}, "drawer": {"drawer"}}


def test_places_and_opposites_are_those_of_the_task():
    """`lift_*` and `place_*` name their own place and no other (`lift_*_table` may name none); tasks that open, close,
    turn on or turn off do not name the opposite."""
    for split, task in itertools.product(COMMANDS, TASKS):
        for sentence in COMMANDS[split][task]:
            spoken = set(sentence.replace(",", "").split())
            if task.startswith(("lift_", "place_")):
                place = task.rsplit("_", 1)[-1]
                named = {p for p, names in PLACES.items() if spoken & names}
                assert named == {place} or (place == "table" and not named), (task, sentence)
            words = set(task.split("_"))
            for one, other in (pair for a, b in OPPOSITES for pair in ((a, b), (b, a))):
                if words & one and not task.startswith(("lift_", "place_")):
                    assert not spoken & other, (task, sentence)


def test_patterns_expand_to_every_choice():
    assert set(expand("a (b|c (d|)) e")) == {"a b e", "a c d e", "a c e"}
    assert expand("(x|y) (|z)") == ["x", "x z", "y", "y z"]


def test_a_file_replaces_the_sentences_of_its_tasks(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("open_drawer: [pull]\nclose_drawer: shut it\n")
    for split in COMMANDS:
        commands = load_commands(file, split)
        assert commands["open_drawer"] == ["pull"]
        assert commands["close_drawer"] == ["shut it"]
        assert commands["turn_on_led"] == COMMANDS[split]["turn_on_led"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("juggle: [x]", "names the unknown task 'juggle'"),
        ("- a", "must map task names to sentences"),
        ("open_drawer: 3", "open_drawer must be a sentence"),
        ("a: [", "is not YAML"),
    ],
)
def test_malformed_files_are_refused_by_name(tmp_path, content, message):
    file = tmp_path / "own.yaml"
    file.write_text(content)
    with pytest.raises(DeskError, match=message):
        load_commands(file, "training")
