"""All `lansar-…` commands report errors in the same way and end with the same exit codes."""

import importlib
import subprocess
import sys
from importlib.metadata import entry_points

import pytest
from draccus.utils import ParsingError

from lerobot_lansar.command import CommandError, run_command
from lerobot_lansar.jobs.work import WorkerDied

COMMANDS = sorted(e.name for e in entry_points(group="console_scripts") if e.name.startswith("lansar-"))


@pytest.mark.parametrize(("returned", "code"), [(None, 0), (0, 0), (1, 1)])
def test_the_exit_code_is_what_the_function_returns(capsys, returned, code):
    assert run_command("lansar-test", lambda: returned) == code
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("kind", [OSError, ValueError, CommandError, WorkerDied, ParsingError])
def test_an_error_that_the_user_can_fix_is_one_message_and_exit_code_2(capsys, kind):
    def function():
        raise kind("give --this instead")

    assert run_command("lansar-test", function) == 2
    assert capsys.readouterr().err == "lansar-test: error: give --this instead\n"


def test_a_mistake_of_ours_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError):
        run_command("lansar-test", lambda: 1 // 0)


@pytest.mark.parametrize(("resumable", "hint"), [(False, ""), (True, "; the same command goes on where it stopped")])
def test_ctrl_c_is_exit_code_130_and_says_what_can_be_resumed(capsys, resumable, hint):
    def function():
        raise KeyboardInterrupt

    assert run_command("lansar-test", function, resumable) == 130
    assert capsys.readouterr().err == f"lansar-test: interrupted{hint}\n"


@pytest.mark.parametrize("text", [False, True])
def test_a_failed_program_is_named_with_its_own_message(capsys, text):
    script = "import sys; sys.exit('no such partition')"
    assert (
        run_command(
            "lansar-test",
            lambda: subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=text),
        )
        == 2
    )
    printed = capsys.readouterr().err
    assert printed.startswith(f"lansar-test: error: `{sys.executable} -c 'import sys; ")
    assert printed.endswith("` failed with exit code 1: no such partition\n")


def test_a_failed_program_whose_message_was_not_captured_is_named_too(capsys):
    def function():
        raise subprocess.CalledProcessError(3, "sbatch job.sh")  # a shell's command line

    assert run_command("lansar-test", function) == 2
    assert capsys.readouterr().err == "lansar-test: error: `sbatch job.sh` failed with exit code 3\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_runs_under_its_own_name(monkeypatch, command):
    (entry,) = entry_points(group="console_scripts", name=command)
    names = []
    monkeypatch.setattr(
        importlib.import_module(entry.module), "run_command", lambda name, *_, **__: names.append(name) or 130
    )
    assert entry.load()() == 130
    assert names == [command]
