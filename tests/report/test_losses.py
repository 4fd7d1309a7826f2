"""Losses of trainings, from each source that LeRobot and LanSAR leave behind."""

import json
import math
import re
import time

import pytest
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker

from lerobot_lansar.report.curves import read_training
from lerobot_lansar.report.report import ReportConfig, report


def checkpoint(folder, step, **files):
    """A checkpoint with these files beside its weights."""
    place = folder / "checkpoints" / str(step) / "pretrained_model"
    place.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (place / name.replace("__", ".")).write_text(text)
    return folder


def kept(*rows):
    """What LanSAR writes: (update, training loss, held-out loss) rows, where None is left out."""
    kinds = ("training", "held_out")
    entries = [
        {"update": row[0], kind: loss}
        for row in rows
        for kind, loss in zip(kinds, row[1:], strict=False)
        if loss is not None
    ]
    return json.dumps(entries)


def printed(steps, losses, log_freq=200):
    """What `lerobot-train` prints, made by its own tracker."""
    lines = [f" 'log_freq': {log_freq},"]
    for step, loss in zip(steps, losses, strict=True):
        meters = {"loss": AverageMeter("loss", ":.3f"), "kld_loss": AverageMeter("kld_loss", ":.3f")}
        tracker = MetricsTracker(96, 10_000, 100, meters, initial_step=step)
        tracker.loss, tracker.kld_loss = loss, 9.0
        lines.append(f"Training:  1%|INFO 2026-01-01 00:00:00 ot_train.py:641 {tracker}")
    return "\n".join(lines) + "\n"


def test_losses_that_lansar_wrote_come_first(tmp_path):
    checkpoint(tmp_path, "000100", losses__json=kept((10, 0.9)))
    checkpoint(tmp_path, "000200", losses__json=kept((10, 0.9), (20, 0.5, 0.7), (30, None, 0.6)))
    (tmp_path / "train.log").write_text(printed([200], [0.1]))
    found = read_training(tmp_path, "mine")
    assert (found["label"], found["source"]) == ("mine", "checkpoints/000200/pretrained_model/losses.json")
    assert found["training"] == [[10, 0.9], [20, 0.5]]
    assert found["held_out"] == [[20, 0.7], [30, 0.6]]
    checkpoint(tmp_path, "last", losses__json=kept((1, 2, 3)))
    assert read_training(tmp_path)["training"] == [[1, 2.0]], "last is the newest, whatever its number"
    checkpoint(tmp_path, "000300_copy", losses__json=kept((5, 0.3)))
    for one in ("checkpoints/000100/pretrained_model", "checkpoints/000100"):
        assert read_training(tmp_path / one)["training"] == [[10, 0.9]], "one checkpoint may be named"
    (tmp_path / "checkpoints/last/pretrained_model/losses.json").unlink()
    assert read_training(tmp_path)["source"] == "checkpoints/000200/pretrained_model/losses.json", (
        "the copy has no number"
    )


def test_losses_that_are_not_finite_are_kept_as_unknown(tmp_path):
    checkpoint(tmp_path, "last", losses__json=kept((1, math.nan), (2, 0.5, math.inf)))
    content = report(ReportConfig(train_dir=str(tmp_path)))
    assert content["trainings"][0]["training"] == [[1, None], [2, 0.5]]
    json.loads((tmp_path / "report.json").read_text(), parse_constant=pytest.fail)


def test_a_malformed_file_is_named(tmp_path):
    checkpoint(tmp_path, "last", losses__json=kept((1, "high")))
    with pytest.raises(ValueError, match=r"losses\.json: not LanSAR"):
        read_training(tmp_path)


def test_rounded_steps_of_a_log_are_counted(tmp_path):
    steps = list(range(200, 12_001, 200))  # 1K five times, from 10K on as well
    log = tmp_path / "train.log"
    log.write_text(printed(steps, [0.5] * len(steps)) + "INFO … step 500: eval_loss=0.8411\n")
    assert "step:1K smpl:96K" in log.read_text()
    found = read_training(tmp_path)
    assert [step for step, _ in found["training"]] == steps
    assert found["held_out"] == [[500, 0.8411]]
    assert {loss for _, loss in found["training"]} == {0.5}, "the loss itself, not one whose name ends in loss"


def test_the_log_of_a_resumed_training_begins_where_its_first_step_may_be(tmp_path):
    log = tmp_path / "train.log"
    log.write_text(printed([8000, 9000, 10_000], [3, 2, 1], log_freq=1000))
    assert read_training(log)["training"] == [[8000, 3], [9000, 2], [10_000, 1]]


def test_a_log_without_its_options_takes_them_from_the_checkpoint(tmp_path):
    text = re.sub(r" 'log_freq': .*\n", "", printed([300, 600], [2, 1]))
    (tmp_path / "train.log").write_text(text)
    with pytest.raises(FileNotFoundError, match="tells --log_freq"):
        read_training(tmp_path)
    checkpoint(tmp_path, "last", train_config__json='{"log_freq": 300}')
    assert read_training(tmp_path)["training"] == [[300, 2], [600, 1]]


def test_the_file_that_wandb_keeps_is_read(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_SILENT", "true")
    with wandb.init(mode="offline", dir=tmp_path, project="test") as run:  # as lerobot.common.wandb_utils logs
        for step in (100, 200):
            run.log({"train/loss": 10 / step, "train/steps": step}, step=step)
        run.log({"eval/eval_loss": 0.75}, step=200)
    (tmp_path / "train.log").write_text(printed([200], [9.0]))
    deadline = time.time() + 30
    while not (found := read_training(tmp_path))["held_out"] and time.time() < deadline:
        time.sleep(0.1)  # wandb's own process may still be writing
    assert found["training"] == [[100, 0.1], [200, 0.05]]
    assert found["held_out"] == [[200, 0.75]]
    (file,) = tmp_path.glob("wandb/offline-run-*/run-*.wandb")
    file.write_bytes(file.read_bytes()[:-200])  # a run that was killed
    assert read_training(tmp_path)["training"][0] == [100, 0.1]


def test_a_training_that_left_nothing_says_how_to_get_losses(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"tells no losses.*tee train\.log.*--wandb\.enable=true"):
        read_training(tmp_path)
    with pytest.raises(FileNotFoundError, match="neither a folder nor a log"):
        read_training(tmp_path / "none")


def test_several_trainings_are_plotted_together(tmp_path):
    folders = []
    for name in ("a", "b"):
        folders.append(str(checkpoint(tmp_path / name, "last", losses__json=kept((1, 2), (2, 1, 1.5)))))
    report(ReportConfig(train_dir=folders, output_dir=tmp_path / "out"))
    page = (tmp_path / "out/report.html").read_text()
    for entry in ("a, training", "a, held out", "b, training", "b, held out"):
        assert f">{entry}</text>" in page
    assert 'aria-label="Losses of a, b"' in page
    assert "* held out: 1 values, the last 1.5 at update 2" in (tmp_path / "out/report.md").read_text()
