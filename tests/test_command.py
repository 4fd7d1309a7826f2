"""All `lansar-…` commands explain their options, report errors in the same way and end with the same exit codes."""

import importlib
import subprocess
import sys
from dataclasses import dataclass, field, is_dataclass
from importlib.metadata import entry_points

import draccus
import pytest
from draccus.utils import ParsingError
from draccus.wrappers import docstring
from huggingface_hub.utils import validate_repo_id

from dataset_convert.embed import EmbedConfig
from dataset_convert.options import ConvertConfig
from dataset_convert.verify import VerifyConfig
from lerobot_lansar.attention import AttentionConfig
from lerobot_lansar.command import CommandError, run_command
from lerobot_lansar.demos.record_config import RecordConfig
from lerobot_lansar.demos.teleop import TeleopConfig
from lerobot_lansar.envs.configuration_calvin import CalvinEnvConfig
from lerobot_lansar.jobs.work import WorkerDied
from lerobot_lansar.policy.configuration_lansar import LanSARConfig
from lerobot_lansar.policy.scheduler import LinearWarmupDecaySchedulerConfig
from lerobot_lansar.replay.replay import ReplayConfig
from lerobot_lansar.report.report import ReportConfig

COMMANDS = sorted(e.name for e in entry_points(group="console_scripts") if e.name.startswith("lansar-"))

OPTIONS = [
    RecordConfig,
    TeleopConfig,
    ConvertConfig,
    EmbedConfig,
    VerifyConfig,
    ReplayConfig,
    ReportConfig,
    AttentionConfig,
    CalvinEnvConfig,
    LanSARConfig,
    LinearWarmupDecaySchedulerConfig,
]
"""Options of all commands, and what LeRobot's commands take of ours."""


def own_options(options):
    """Class and name of every option that is ours, also in groups of options."""
    for name, kind in options.__annotations__.items():
        yield options, name
        if is_dataclass(kind) and not kind.__module__.startswith("lerobot."):
            yield from own_options(kind)


@pytest.mark.parametrize("options", OPTIONS)
def test_every_option_is_explained_by_help(options):
    """draccus takes the text from the comment above the field; argparse would trip over a percent sign in it."""
    for group, name in own_options(options):
        text = docstring.get_preferred_help_text(docstring.get_attribute_docstring(group, name))
        assert text, name
        assert text.endswith("."), name
        assert "%" not in text, name


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


@dataclass
class Options:
    path: str = "here"
    numbers: list[int] = field(default_factory=list)

    def __post_init__(self):
        if self.path == "nowhere":
            raise ValueError("--path=nowhere: give another")
        validate_repo_id(self.path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--path=nowhere", "error: --path=nowhere: give another\n"),
        ("--path=a/b/c", "error: there is no such folder, nor can it be on the hub: Repo id must be in the form"),
        ("--numbers=[1", "error: an option is not valid YAML (a list is written '[a,b]', in quotes): while parsing"),
        ("--config_path=bad.yaml", 'while parsing a flow sequence in "bad.yaml", line 1, column 10'),
    ],
)
def test_the_reason_that_draccus_hides_is_told(tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.yaml").write_text("numbers: [1")
    monkeypatch.setattr(sys, "argv", ["lansar-test", options])
    assert run_command("lansar-test", lambda: print(draccus.parse(Options))) == 2
    assert message in capsys.readouterr().err


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
