"""The losses of a training run (Figure 6.9), kept beside the weights in every checkpoint.

LeRobot prints losses and can send them to wandb, but leaves no file of its own.
"""

import json
from pathlib import Path

from ..datasets import LOSSES_FILE

EVERY = 20
"""Training batches whose losses are averaged to one entry; a checkpoint ends an entry early."""


class Losses:
    """Collects the losses of one process, batch by batch.

    Attributes:
        entries: The content of `LOSSES_FILE` so far.
        updates: Training batches so far.
    """

    def __init__(self) -> None:
        self.entries: list[dict[str, float]] = []
        self.updates = 0
        self._training: list[float] = []
        self._held_out: list[float] = []

    def add(self, loss: float, training: bool) -> None:
        """Adds the loss of one batch; the held-out batches between two updates become one entry, their mean."""
        if not training:
            self._held_out.append(loss)
            return
        self._close("held_out", self._held_out)
        self.updates += 1
        self._training.append(loss)
        if len(self._training) == EVERY:
            self._close("training", self._training)

    def save(self, folder: Path) -> None:
        """Writes `LOSSES_FILE` into a folder, unless there is no loss."""
        self._close("training", self._training)
        self._close("held_out", self._held_out)
        if self.entries:
            (folder / LOSSES_FILE).write_text(json.dumps(self.entries))

    def load(self, folder: Path) -> None:
        """Goes on after the losses of a checkpoint; one without the file is of an older version."""
        file = folder / LOSSES_FILE
        if file.is_file():
            self.entries = json.loads(file.read_text())
            self.updates = int(max(entry["update"] for entry in self.entries))

    def _close(self, kind: str, losses: list[float]) -> None:
        """Turns the losses collected since the last entry of their kind into a new one."""
        if losses:
            self.entries.append({"update": self.updates, kind: sum(losses) / len(losses)})
            losses.clear()
