"""README.md as a new user walks it: every command in its order, in an empty folder, at tiny sizes."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[1] / "README.md"

SIZES = {
    "--episodes=3400 --workers=2": "--episodes=2 --tasks=[open_drawer,turn_on_led]",
    "--chains=1000": "--chains=2",
    "--eval.n_episodes=50": "--eval.n_episodes=1 --eval.batch_size=1",
    "eval.n_episodes=10 ": "eval.n_episodes=1 eval.batch_size=1 ",
}
"""What a README says to what is run; each must occur."""

ADDED = {
    "lansar-play": "--keys=d10",  # there is no display
    "lerobot-train --config_path": "--steps=2",
    "lerobot-train --policy.type=act": "--steps=2 --batch_size=2 --num_workers=0 --policy.dim_model=32 "
    "--policy.n_heads=2 --policy.dim_feedforward=64 --policy.pretrained_backbone_weights=null",
    "lansar-eval": "--env.steps_per_command=5 --env.render_fps=2 --workers=1",
    "lerobot-eval": "--env.steps_per_command=5 --env.render_fps=2",
    "lerobot eval": "env.steps_per_command=5 env.render_fps=2",
    "lansar-replay": "--output_dir=outputs/replay",
    "lansar-attention": "--env.steps_per_command=5",
}
"""Beginning of a command to the options added to it: fewer steps, and nothing that is downloaded."""

NOT_RUN = ("make ",)
"""Commands that set up what runs this test, or take long; other tests run their parts."""


def commands():
    """The commands of all bash blocks, a line each."""
    blocks = re.findall(r"^```bash\n(.*?)^```", README.read_text(), re.DOTALL | re.MULTILINE)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [re.sub(r"\s+", " ", line.split(" #")[0]).strip() for line in lines if not line.startswith(NOT_RUN)]


def tiny(command):
    """The command at a size that takes seconds."""
    for size, smaller in SIZES.items():
        command = command.replace(size, smaller)
    return " ".join([command, *(options for start, options in ADDED.items() if command.startswith(start))])


def test_every_size_that_the_walk_replaces_is_in_the_readme():
    text = "\n".join(commands())
    assert [size for size in SIZES if size not in text] == []
    assert [start for start in ADDED if not any(command.startswith(start) for command in commands())] == []


@pytest.mark.slow
def test_every_command_of_the_readme_runs_in_its_order_outside_the_checkout(tmp_path):
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "HF_HOME": str(tmp_path / "hf"),
        "OMP_NUM_THREADS": "1",
    }
    ran = [tiny(command) for command in commands()]
    assert len(ran) > 10
    for command in ran:
        done = subprocess.run(
            ["bash", "-c", command], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}{done.stderr[-3000:]}"
    for result in ("chains", "tasks", "act"):
        assert (tmp_path / "outputs/eval" / result / "episodes.jsonl").is_file()
    assert "average length" in (tmp_path / "outputs/eval/chains/report.md").read_text()
    assert "ACT" in (tmp_path / "outputs/report/report.html").read_text()
    assert list((tmp_path / "outputs/replay").glob("*.mp4"))
    assert (tmp_path / "outputs/attention/context_attention.png").is_file()


def test_the_python_of_the_readme_runs():
    (code,) = re.findall(r"^```python\n(.*?)^```", README.read_text(), re.DOTALL | re.MULTILINE)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
