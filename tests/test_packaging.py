"""The distribution: LeRobot must find it, importing it must stay cheap, and it must be complete."""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points, metadata
from pathlib import Path

import pytest
import yaml

from lerobot_lansar import paths
from lerobot_lansar.command import CommandError
from scripts.absolute_links import RELATIVE_LINK, absolute

ROOT = Path(__file__).resolve().parents[1]


def test_distribution_name_is_the_one_lerobot_looks_for():
    # LeRobot compares the metadata's name literally and imports a module of that name: hyphens would hide the plugin.
    assert metadata("lerobot_policy_lansar")["Name"] == "lerobot_policy_lansar"


def test_every_command_is_installed():
    words = ("record", "play", "convert", "embed", "verify", "replay", "eval", "report", "attention", "path")
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


def test_loading_the_desk_prints_nothing_and_works_with_closed_streams():
    # pybullet alone prints "pybullet build time: ..." when it is imported
    code = "import lerobot_lansar.desk, sys, os; print('out'); sys.stderr and print('err', file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("out\n", "err\n")
    for closed in (">&-", "2>&-", ">&- 2>&-"):
        subprocess.run(["sh", "-c", f'"$0" -c "$1" {closed}', sys.executable, code], check=True)


def test_shipped_files_are_found_by_name_from_any_folder(tmp_path):
    command = Path(sys.executable).parent / "lansar-path"
    for name in ("configs/thesis/baseline", "configs/thesis/baseline.yaml"):
        done = subprocess.run([command, name], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert Path(done.stdout.strip()).samefile(ROOT / "configs/thesis/baseline.yaml")
    listed = subprocess.run([command], cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split()
    expected = {"checkpoints/desk-d", "configs/lansar", "configs/thesis/eval_perturbed_0.5_5"}
    assert expected <= set(listed)


def test_an_unknown_shipped_name_is_answered_with_similar_ones():
    for name in ("baseline", "configs/thesis/basline", "configs/baseline.yaml"):
        with pytest.raises(CommandError, match=r"did you mean configs/thesis/baseline\?"):
            paths.shipped_path(name)
    with pytest.raises(CommandError, match="lansar-path without a name lists"):
        paths.shipped_path("qqq")


def test_a_wheel_carries_what_lansar_path_finds_and_finds_it_there(tmp_path, monkeypatch):
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert paths.CONFIGS in wheel["only-include"]
    assert wheel["sources"] == {paths.CONFIGS: f"lerobot_lansar/{paths.CONFIGS}"}
    (tmp_path / "lerobot_lansar/configs/thesis").mkdir(parents=True)
    file = tmp_path / "lerobot_lansar/configs/thesis/mine.yaml"
    file.touch()
    checkpoint = tmp_path / "lerobot_lansar/checkpoints/mine"
    checkpoint.mkdir(parents=True)
    (checkpoint / "config.json").touch()
    monkeypatch.setattr(paths, "__file__", str(tmp_path / "lerobot_lansar/paths.py"))
    assert paths.shipped() == {"configs/thesis/mine": file, "checkpoints/mine": checkpoint}


def test_the_readmes_links_exist_and_a_release_makes_them_absolute():
    text = (ROOT / "README.md").read_text()
    links = [path.partition("#")[0] for _, _, path in RELATIVE_LINK.findall(text)]
    assert len(links) > 10
    assert [path for path in links if not (ROOT / path).exists()] == []
    released = absolute(text, "https://github.com/you/repository", "v1")
    assert RELATIVE_LINK.findall(released) == []
    assert "](https://github.com/you/repository/raw/v1/docs/images/desks.png)" in released
    assert "](https://github.com/you/repository/blob/v1/docs/desk.md)" in released


def test_workflows_test_the_pythons_that_the_package_declares():
    classifiers = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["classifiers"]
    jobs = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text())["jobs"]
    declared = [match[1] for line in classifiers if (match := re.fullmatch(r".*Python :: (3\.\d+)", line))]
    assert jobs["tests"]["strategy"]["matrix"]["python"] == declared


def test_no_installation_advice_leaves_numpy_unpinned():
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "scripts").glob("*.sh")]
    advice = [line for page in pages for line in page.read_text().splitlines() if "install" in line]
    assert any("numpy>=" in line for line in advice)
    assert [line for line in advice if re.search(r"[ ']numpy(?![>=<])[ ']", line) and "pip install" in line] == []


def test_every_file_that_the_documentation_names_exists():
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "Makefile", *(ROOT / "docs").glob("*.md")]
    pages += (ROOT / "scripts").iterdir()
    named = {
        (page.name, path)
        for page in pages
        if page.is_file()
        for path in re.findall(
            r"(?<![\w/])(?:configs|docs|benchmarks|examples|scripts|tests)/[\w./]*\.\w+", page.read_text()
        )
    }
    assert len(named) > 10
    assert [entry for entry in sorted(named) if not (ROOT / entry[1]).exists()] == []


def test_no_two_test_files_share_a_name():
    # pytest imports files of folders that are no packages by their names alone.
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))
