"""Push, interrupt, push again, load back: the real client over HTTP against a server on loopback."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fake_calvin import write_calvin
from hub_server import TOKEN, Hub

from dataset_convert import convert
from dataset_convert.convert import ClipOptions, ConvertConfig

REPOSITORY = Path(__file__).parents[2]

LAUNCH = """
import os, sys
import httpx
import huggingface_hub

class Loopback(httpx.HTTPTransport):
    def handle_request(self, request):
        here = httpx.URL(os.environ["HF_ENDPOINT"])
        request.url = request.url.copy_with(scheme=here.scheme, host=here.host, port=here.port)
        request.headers["Host"] = here.netloc.decode()
        request.headers["Authorization"] = "Bearer " + os.environ["HF_TOKEN"]
        return super().handle_request(request)

huggingface_hub.set_client_factory(
    lambda: httpx.Client(mounts={"https://huggingface.co": Loopback()}, follow_redirects=True, timeout=60)
)
from dataset_convert.convert import main
sys.exit(main())
"""
"""``lansar-convert`` with the one address that the hub's client has written into its code, that of the card's check
(huggingface_hub 1.x asks https://huggingface.co whatever HF_ENDPOINT says), led to the loopback too."""


@pytest.fixture
def hub():
    with Hub() as running:
        yield running


@pytest.fixture
def run(hub, tmp_path):
    """Runs one of the commands as a user of that hub; returns (exit code, output)."""

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
        done = subprocess.run(
            [*start, *arguments],
            env=environment,
            cwd=tmp_path,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        return done.returncode, done.stdout

    return command


def test_a_dataset_goes_to_the_hub_and_comes_back(hub, run, tmp_path):
    calvin = write_calvin(tmp_path / "calvin", rgb=True, length=10)
    clip = ClipOptions(model="lansar-tiny", pretrained="")
    out = convert.convert(ConvertConfig(calvin.root, "me/desk", tmp_path / "out", embed=True, clip=clip))
    arguments = [
        "lansar-convert", f"--root={calvin.root}", "--repo_id=me/desk", f"--output_dir={out}", "--embed=true",
        "--clip.model=lansar-tiny", "--clip.pretrained=", "--push_to_hub=true", "--private=true",
    ]  # fmt: skip

    hub.fail_after = 3  # the line is cut in the middle
    code, printed = run(*arguments, home="home")
    assert code == 2, printed
    assert "cannot upload" in printed
    assert "run this again to go on" in printed
    assert "Traceback" not in printed
    assert hub.files("me/desk") == {}, "nothing half-uploaded is visible"

    sent = hub.uploads.copy()
    assert len(sent) == 3
    hub.fail_after = None
    code, printed = run(*arguments, home="home")
    assert code == 0, printed
    assert not set(sent) & set(hub.uploads[3:]), "what had arrived was not sent again"
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
    for part in ("license: mit", "- calvin", "Privileged state", "lansar-tiny", "lerobot-train", "SHA-256"):
        assert part in card
    assert str(tmp_path) not in card

    # another machine: an empty cache
    code, printed = run(
        "lerobot-train", f"--config_path={REPOSITORY / 'configs/lansar_small.yaml'}", "--dataset.repo_id=me/desk",
        "--steps=2", "--batch_size=4", "--save_freq=2", f"--output_dir={tmp_path / 'train'}",
        "--policy.use_images=true", "--policy.clip.model=lansar-tiny", "--policy.clip.pretrained=",
        "--policy.device=cpu", home="elsewhere",
    )  # fmt: skip
    assert code == 0, printed[-3000:]
    config = json.loads((tmp_path / "train/checkpoints/last/pretrained_model/config.json").read_text())
    assert config["type"] == "lansar"
    code, printed = run(
        "lansar-verify",
        f"--root={calvin.root}",
        "--repo_id=me/desk",
        f"--dataset_dir={out}",
        home="elsewhere",
    )
    assert code == 0, printed
    code, printed = run(*arguments, home="home")
    assert code == 0, "a second push of the same dataset is no error"
