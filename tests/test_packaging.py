"""The distribution: LeRobot must find it, and importing it must stay cheap."""

import re
import subprocess
import sys
from importlib.metadata import entry_points, metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def test_distribution_name_is_the_one_lerobot_looks_for():
    # LeRobot compares the metadata's name literally and imports a module of that name: hyphens would hide the plugin.
    assert metadata("lerobot_policy_lansar")["Name"] == "lerobot_policy_lansar"


def test_every_command_is_installed():
    words = ("record", "play", "convert", "embed", "verify", "replay", "report", "attention")
    commands = {entry.name: entry for entry in entry_points(group="console_scripts")}
    for name in ("lerobot", *(f"lansar-{word}" for word in words)):
        assert callable(commands[name].load())


@pytest.mark.parametrize(
    ("module", "libraries"),
    [
        ("lerobot_lansar.desk", ["lerobot", "torch"]),
        ("lerobot_lansar.envs.calvin", ["lerobot", "torch"]),
        ("lerobot_lansar.report.report", ["lerobot", "torch", "pybullet"]),
        ("lerobot_lansar.policy.modeling_lansar", ["pybullet"]),
    ],
)
def test_a_room_loads_no_library_that_only_others_need(module, libraries):
    code = f"import sys, {module}; print([name for name in {libraries} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("[]")


def test_lerobots_own_discovery_registers_policy_and_environment():
    code = (
        "from lerobot.utils.import_utils import register_third_party_plugins as r; r(); "
        "from lerobot.configs.policies import PreTrainedConfig as P; from lerobot.envs.configs import EnvConfig as E; "
        "print('lansar' in P.get_known_choices(), 'calvin' in E.get_known_choices())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("True True")


def test_every_file_that_the_documentation_names_exists():
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "Makefile", *(ROOT / "docs").glob("*.md")]
    pages += (ROOT / "scripts").iterdir()
    named = {
        (page.name, path)
        for page in pages
        if page.is_file()
        for path in re.findall(r"(?<![\w/])(?:configs|docs|benchmarks|scripts|tests)/[\w./]*\.\w+", page.read_text())
    }
    assert len(named) > 10
    assert [entry for entry in sorted(named) if not (ROOT / entry[1]).exists()] == []
