"""Push, interrupt, kill, push again, load back: the real client over HTTP against a server on loopback."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fake_calvin import write_calvin
from hub_server import TOKEN, Hub, launcher

from dataset_convert import convert
from dataset_convert.options import ConvertConfig
from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.datasets import find_dataset

REPOSITORY = Path(__file__).parents[2]

LAUNCH = launcher("dataset_convert.convert")


@pytest.fixture
def hub():
    with Hub() as running:
        yield running


@pytest.fixture
def launch(hub, tmp_path):
    """Starts one of the commands as a user of that hub."""

    def command(name, *arguments, home):
        start = [str(Path(sys.executable).parent / name)]
        if name == "lansar-convert":
            start = [sys.executable, "-c", LAUNCH]
        environment = {
            **os.environ,
            "HF_ENDPOINT": hub.url,
            "HF_TOKEN": TOKEN,
            "HF_HOME": str(tmp_path / home),
            "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "HF_HUB_OFFLINE": "0",
            "WANDB_MODE": "disabled",
        }
        environment.pop("HF_LEROBOT_HOME", None)
        return subprocess.Popen(
            [*start, *arguments],
            env=environment,
            cwd=tmp_path,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    return command


@pytest.fixture
def run(launch):
    """Runs one of the commands to its end; returns (exit code, output)."""

    def command(name, *arguments, home):
        process = launch(name, *arguments, home=home)
        printed, _ = process.communicate()
        return process.returncode, printed

    return command


@pytest.mark.timeout(1800)  # eight commands, each of which imports LeRobot
def test_a_dataset_goes_to_the_hub_and_comes_back(hub, launch, run, tmp_path):
    calvin = write_calvin(tmp_path / "calvin", rgb=True, length=11)  # no two files are equal
    clip = ClipConfig(model="lansar-desk", pretrained="")
    out = convert.convert(ConvertConfig(calvin.root, "me/desk", tmp_path / "out", embed=True, clip=clip))
    arguments = [
        "lansar-convert",
        f"--root={calvin.root}",
        "--repo_id=me/desk",
        f"--output_dir={out}",
        "--embed=true",
        "--clip.model=lansar-desk",
        "--clip.pretrained=",
        "--push_to_hub=true",
        "--private=true",
    ]

    hub.fail_after = 3  # the line is cut in the middle
    code, printed = run(*arguments, home="home")
    assert code == 2, printed
    assert "cannot upload" in printed
    assert "run this again to go on" in printed
    assert "Traceback" not in printed
    assert hub.files("me/desk") == {}, "nothing half-uploaded is visible"

    assert len(hub.uploads) == 3
    hub.fail_after, hub.delay = None, 0.2  # slow enough to be killed in the middle
    process = launch(*arguments, home="home")
    while len(hub.uploads) < 6 and process.poll() is None:
        time.sleep(0.01)
    process.kill()
    process.communicate()
    assert process.returncode == -9
    assert hub.files("me/desk") == {}, "nothing half-uploaded is visible"

    hub.delay = 0
    code, printed = run(*arguments, home="home")
    assert code == 0, printed
    assert len(hub.uploads) == len(set(hub.uploads)), "what had arrived was not sent again"
    repository = hub.repositories["me/desk"]
    assert repository.private
    assert repository.tags == {"v3.0": repository.commits[-1][0]}
    stored = hub.files("me/desk")
    local = {p.relative_to(out).as_posix(): p.read_bytes() for p in out.rglob("*") if p.is_file()}
    local = {name: content for name, content in local.items() if not name.startswith(".cache/")}
    assert stored.keys() - {".gitattributes"} == local.keys()
    for name in local.keys() - {"README.md"}:
        assert stored[name] == local[name], name
    card = stored["README.md"].decode()
    for part in ("license: mit", "- calvin", "Privileged state", "lansar-desk", "lerobot-train", "SHA-256"):
        assert part in card
    assert str(tmp_path) not in card

    # another machine: an empty cache
    code, printed = run(
        "lerobot-train",
        f"--config_path={REPOSITORY / 'configs/lansar.yaml'}",
        "--dataset.repo_id=me/desk",
        "--steps=2",
        "--batch_size=4",
        "--save_freq=2",
        f"--output_dir={tmp_path / 'train'}",
        "--policy.use_images=true",
        "--policy.clip.model=lansar-desk",
        "--policy.clip.pretrained=",
        "--policy.device=cpu",
        home="elsewhere",
    )
    assert code == 0, printed[-3000:]
    config = json.loads((tmp_path / "train/checkpoints/last/pretrained_model/config.json").read_text())
    assert config["type"] == "lansar"
    code, printed = run("lansar-verify", f"--root={calvin.root}", "--repo_id=me/desk", home="elsewhere")
    assert code == 0, printed
    assert f"{tmp_path / 'elsewhere/lerobot/hub'}" in printed, "what was downloaded, not what was pushed"
    assert "clip: as lansar-desk" in printed
    code, printed = run(*arguments, home="home")
    assert code == 0, "a second push of the same dataset is no error"


def test_a_dataset_is_found_where_lerobot_reads_it(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"no dataset me/desk in .*, nor among .*/hub: .*--dataset_dir"):
        find_dataset("me/desk", None)
    cache = tmp_path / "hub/datasets--me--desk"
    for folder in (cache / "refs", cache / "snapshots/0123", tmp_path / "me/desk/meta"):
        folder.mkdir(parents=True)
    (cache / "refs/v3.0").write_text("0123")
    assert find_dataset("me/desk", None) == cache / "snapshots/0123"
    (tmp_path / "me/desk/meta/info.json").touch()
    assert find_dataset("me/desk", None) == tmp_path / "me/desk"
    (tmp_path / "me/desk/.cache/huggingface/download").mkdir(parents=True)  # by an earlier LeRobot, which it mistrusts
    assert find_dataset("me/desk", None) == cache / "snapshots/0123"
    assert find_dataset("me/desk", tmp_path / "mine") == tmp_path / "mine"


def test_the_card_tells_the_known_defects(tmp_path):
    calvin = write_calvin(tmp_path / "calvin", tasks=("lift_red_block_table", "lift_blue_block_table") * 3, length=5)
    index = calvin.root / "training/lang_annotations/auto_lang_ann.npy"
    annotations = np.load(index, allow_pickle=True).item()
    annotations["language"]["task"][0] = "lift_pink_block_table"  # the red one rises
    np.save(index, annotations, allow_pickle=True)
    calvin.rewrite(112, actions=np.full(7, np.nan))
    (calvin.root / "validation").mkdir()
    for frame in (103, 113):
        shutil.copy(calvin.file(frame), calvin.root / "validation")
    out = convert.convert(ConvertConfig(calvin.root, "me/desk", tmp_path / "out", images="none", skip_bad=True))
    card = (out / "README.md").read_text()
    defects = card[card.index("### Known defects") : card.index("### Train and evaluate")]
    for part in (
        "training and validation share 103, 113; in episodes here: 1.",
        "6 annotated windows of the split lift a block",
        "that the task names except in 1 (1 × red instead of pink in scene D)",
        "1 defective episodes",
        "frames 110-114: training/episode_0000112.npz",
    ):
        assert part in defects, defects
