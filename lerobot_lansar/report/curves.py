"""Training and held-out losses of any LeRobot training, from what it left in its folder.

In this order: `losses.json` in a checkpoint, which LanSAR writes; the file that wandb keeps on this machine; a log,
which is what `lerobot-train` printed.
"""

import json
import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from ..command import CommandError
from ..datasets import LOSSES_FILE

Losses = tuple[dict[int, float], dict[int, float]]
"""Update to loss, of training and of held-out data."""

_TRAINING = re.compile(r"\bstep:(\d+)([KMBTQ]?) smpl:\S+ .*?\bloss:(\S+)")
"""LeRobot's line for each `log_freq` updates: `step:1K smpl:96K ep:… epch:… loss:0.455 grdn:…`, its step rounded."""
_HELD_OUT = re.compile(r"\bstep (\d+): eval_loss=(\S+)")
"""LeRobot's line for each evaluation on held-out data: `step 500: eval_loss=0.8411`."""
_LOG_FREQ = re.compile(r"'log_freq': (\d+)")
"""The option, as `lerobot-train` prints it at its start."""
_UNITS = {unit: 1000**power for power, unit in enumerate(("", "K", "M", "B", "T", "Q"))}


def read_training(path: Path, label: str | None = None) -> dict[str, Any]:
    """Reads the losses of one training.

    Args:
        path: `--output_dir` of the training, one of its checkpoints, or a log of it.
        label: Its name; the name of the folder or file by default.

    Returns:
        {"label", "folder", "source": the file that was read, "training": [[update, loss]], "held_out": the same}. A
        loss that was not finite is None.

    Raises:
        FileNotFoundError: There is no such folder or file, or no losses in it.
        ValueError: A file is malformed.
        CommandError: wandb's file is there, but not wandb.
    """
    if path.is_dir():
        source, (training, held_out) = _from_folder(path)
    elif path.is_file():
        source, (training, held_out) = path.name, _from_logs([path])
    else:
        raise FileNotFoundError(f"--train_dir={path} is neither a folder nor a log")
    if not training and not held_out:
        raise FileNotFoundError(
            f"--train_dir={path} tells no losses: it has no checkpoint with {LOSSES_FILE}, no file of wandb and no "
            "*.log of lerobot-train with a loss in it. Keep what lerobot-train prints (lerobot-train … 2>&1 | tee "
            f"train.log) and give that file, or train with --wandb.enable=true --wandb.mode=offline"
        )
    return {
        "label": label or path.resolve().name,
        "folder": str(path),
        "source": source,
        "training": _pairs(training),
        "held_out": _pairs(held_out),
    }


def _pairs(losses: dict[int, float]) -> list[list[Any]]:
    return [[update, loss if math.isfinite(loss) else None] for update, loss in sorted(losses.items())]


def _from_folder(folder: Path) -> tuple[str, Losses]:
    """The first source that tells anything, and what it tells."""
    checkpoints = folder / "checkpoints"
    numbered = [p for p in checkpoints.glob(f"*/pretrained_model/{LOSSES_FILE}") if p.parts[-3].isdecimal()]
    newest = sorted(numbered, key=lambda p: int(p.parts[-3]), reverse=True)
    checkpoint = Path("pretrained_model", LOSSES_FILE)
    for path in (folder / LOSSES_FILE, folder / checkpoint, checkpoints / "last" / checkpoint, *newest):
        if path.is_file():
            return path.relative_to(folder).as_posix(), _from_json(path)
    runs = sorted(folder.glob("wandb/*run-*/run-*.wandb"), key=lambda path: path.parent.name.removeprefix("offline-"))
    runs = [run for run in runs if not run.parent.is_symlink()]
    if runs:
        losses = _from_wandb(runs)
        if any(losses):
            return ", ".join(run.relative_to(folder).as_posix() for run in runs), losses
    logs = sorted(folder.glob("*.log"), key=lambda path: path.stat().st_mtime)
    return ", ".join(log.name for log in logs), _from_logs(logs)


def _from_json(path: Path) -> Losses:
    training: dict[int, float] = {}
    held_out: dict[int, float] = {}
    try:
        for entry in json.loads(path.read_text()):
            for losses, kind in ((training, "training"), (held_out, "held_out")):
                if kind in entry:
                    losses[int(entry["update"])] = float(entry[kind])
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(f"{path}: not LanSAR's list of losses by update ({error!r})") from error
    return training, held_out


def _from_wandb(runs: Iterable[Path]) -> Losses:
    training: dict[int, float] = {}
    held_out: dict[int, float] = {}
    for run in runs:
        for step, values in _wandb_history(run):
            for losses, name in ((training, "train/loss"), (held_out, "eval/eval_loss")):
                if isinstance(values.get(name), int | float):
                    losses[step] = values[name]
    return training, held_out


def _wandb_history(run: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """(step, logged values) in wandb's own file; ends where an interrupted run's file is cut off."""
    try:
        from wandb.proto.wandb_internal_pb2 import Record  # type: ignore[attr-defined]
        from wandb.sdk.internal.datastore import DataStore
    except ImportError as error:
        raise CommandError(f"{run} is wandb's; install wandb to read it ({error})") from error
    store = DataStore()
    try:
        store.open_for_scan(str(run))
        while (data := store.scan_data()) is not None:
            record = Record()
            record.ParseFromString(data)
            if record.WhichOneof("record_type") == "history":
                items = record.history.item
                yield (
                    record.history.step.num,
                    {"/".join(i.nested_key) or i.key: json.loads(i.value_json) for i in items},
                )
    except AssertionError:
        return


def _from_logs(logs: Iterable[Path]) -> Losses:
    training: dict[int, float] = {}
    held_out: dict[int, float] = {}
    for log in logs:
        text = log.read_text(errors="replace")
        held_out |= {int(step): _number(log, loss) for step, loss in _HELD_OUT.findall(text)}
        lines = _TRAINING.findall(text)
        if lines:
            steps = _exact_steps([(int(count), unit) for count, unit, _ in lines], _log_freq(log, text))
            training |= {step: _number(log, loss) for step, (_, _, loss) in zip(steps, lines, strict=True)}
    return training, held_out


def _number(log: Path, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{log}: {text!r} is not a loss") from None


def _log_freq(log: Path, text: str) -> int:
    """Updates between two lines of a log: as printed in it, or else from the nearest checkpoint's options."""
    printed = _LOG_FREQ.findall(text)
    if printed:
        return int(printed[0])
    nearest = [
        log.parent / "train_config.json",
        log.parent / "checkpoints" / "last" / "pretrained_model" / "train_config.json",
        *sorted(log.parent.glob("*/checkpoints/last/pretrained_model/train_config.json")),
    ]
    for file in nearest:
        if file.is_file():
            return int(json.loads(file.read_text())["log_freq"])
    raise FileNotFoundError(
        f"{log} rounds its steps, and neither it nor a train_config.json near it tells --log_freq: put it into the "
        "--output_dir of its training"
    )


def _exact_steps(printed: list[tuple[int, str]], log_freq: int) -> list[int]:
    """The updates that rounded steps stand for: multiples of `log_freq`, counted on where the rounding allows.

    Args:
        printed: (1, "K") for `step:1K`.
        log_freq: Updates between two lines.
    """
    steps: list[int] = []
    for count, unit in printed:
        size = _UNITS[unit]
        following = steps[-1] + log_freq if steps else log_freq
        if abs(following - count * size) > size / 2:  # the log of a resumed training, or one training after another
            lowest = math.ceil((count - 0.5) * size / log_freq) * log_freq
            following = lowest if lowest <= (count + 0.5) * size else round(count * size / log_freq) * log_freq
        steps.append(following)
    return steps
