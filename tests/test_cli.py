"""`lerobot WORD key=value` hands over to LeRobot's own commands."""

import os
import sys

import pytest

from lerobot_lansar import cli


@pytest.mark.parametrize(
    ("command", "arguments", "expected"),
    [
        (
            "train",
            ["policy=lansar", "dataset.repo_id=me/desk", "steps=10", "--policy.push_to_hub=false"],
            ["--policy.type=lansar", "--dataset.repo_id=me/desk", "--steps=10", "--policy.push_to_hub=false"],
        ),
        ("train", ["policy=me/model"], ["--policy.path=me/model"]),
        ("train", ["policy.type=act", "env=calvin"], ["--policy.type=act", "--env.type=calvin"]),
        ("eval", ["policy=me/model", "env=calvin"], ["--policy.path=me/model", "--env.type=calvin"]),
        (
            "eval",
            ["policy=checkpoint", "env.control_mode=abs"],
            ["--policy.path=checkpoint", "--env.control_mode=abs"],
        ),
        ("eval", ["env.cameras=[static,gripper]"], ["--env.cameras=[static,gripper]"]),
        (
            "edit-dataset",
            ["--repo_id", "me/desk", "new_root=a=b"],
            ["--repo_id", "me/desk", "--new_root=a=b"],
        ),
        ("train", ["-h"], ["-h"]),
        ("find-cameras", ["opencv"], ["opencv"]),
        ("train", ["--rename_map", '{"a": "b=c"}'], ["--rename_map", '{"a": "b=c"}']),
    ],
)
def test_options_are_rewritten_in_lerobots_style(command, arguments, expected):
    assert cli.translate(command, arguments) == expected


def test_a_checkpoint_folder_to_train_from_is_a_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.translate("train", ["policy=mine"]) == ["--policy.type=mine"]
    (tmp_path / "mine").mkdir()
    assert cli.translate("train", ["policy=mine"]) == ["--policy.path=mine"]


def test_the_real_command_replaces_this_process(monkeypatch):
    called = []
    monkeypatch.setattr(os, "execv", lambda path, arguments: called.append((path, arguments)))
    monkeypatch.setattr(sys, "argv", ["lerobot", "train", "policy=lansar"])
    cli.main()
    path, arguments = called[0]
    assert os.path.basename(path) == "lerobot-train"
    assert os.access(path, os.X_OK)
    assert arguments == [path, "--policy.type=lansar"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly"], "there is no lerobot-fly here; commands: "),
        (["train", "lansar"], "'lansar' is neither key=value"),
    ],
)
def test_a_mistake_is_explained_with_exit_code_2(monkeypatch, capsys, arguments, message):
    monkeypatch.setattr(sys, "argv", ["lerobot", *arguments])
    assert cli.main() == 2
    printed = capsys.readouterr().err
    assert printed.startswith("lerobot: error: ")
    assert message in printed


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_help_explains_and_lists_the_commands(monkeypatch, capsys, arguments):
    monkeypatch.setattr(sys, "argv", ["lerobot", *arguments])
    assert cli.main() == 0
    printed = capsys.readouterr().out
    assert "policy=lansar" in printed
    assert "train" in printed.split("Commands: ")[1]
