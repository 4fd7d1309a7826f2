"""What the files beside a policy say: its inputs, and the look of the pictures that it was trained on."""

import json
from pathlib import Path
from typing import Any

from ..calvin import SCENE_OBS_NAMES, TASKS
from ..command import CommandError
from ..datasets import MANIFEST, find_dataset, reads_scene
from .published import GRIPPER, ROBOT, SCENE, STATIC, TASK

LOOK = ("renderer", "assets", "image_size")
"""What decides how the desk looks in a policy's pictures; entries of an episode's line and of a manifest's `look`."""


class Policy:
    """A policy in a folder or on the hub.

    Args:
        path: `--policy.path` of its evaluation.
        download: Whether to ask the hub for what is not on this machine.

    Raises:
        CommandError: There is no policy.
    """

    def __init__(self, path: str, download: bool = True):
        self._download = download
        try:
            file = self._file(path, "config.json")
        except (OSError, ValueError) as error:
            raise CommandError(
                f"--policy_path={path} is neither a pretrained_model folder with a config.json nor a policy that "
                f"the hub returns: {error}"
            ) from error
        self._path = path
        try:
            self._config = json.loads(file.read_text())
        except ValueError as error:
            raise CommandError(f"{file} is not JSON: {error}") from error
        self._inputs = self._config.get("input_features") or {}

    @property
    def reads_scene_state(self) -> bool:
        """Whether it reads the simulator's own state."""
        reads = reads_scene(self._config.get("type"), self._config.get("use_spatial_context", True))
        return reads and self._environment_state_size not in (None, len(TASKS))

    @property
    def _environment_state_size(self) -> int | None:
        """How many numbers of `environment_state` it reads; None: unknown, or none."""
        return next(iter(self._inputs.get("observation.environment_state", {}).get("shape") or []), None)

    @property
    def reads(self) -> list[str]:
        """Its inputs beside language, in the words of `published`."""
        pictures = [key for key in self._inputs if key.startswith("observation.image")]
        if self._config.get("use_images"):  # LanSAR sees both cameras, through embeddings that are not among its inputs
            found = [STATIC, GRIPPER]
        else:
            cameras = {STATIC: "static", GRIPPER: "gripper"}
            found = [words for words, camera in cameras.items() if any(camera in key for key in pictures)]
            found = found or (["pictures"] if pictures else [])
        state = [ROBOT] if "observation.state" in self._inputs else []
        task = [TASK] if self._environment_state_size in (len(TASKS), len(SCENE_OBS_NAMES) + len(TASKS)) else []
        return [*found, *state, *([SCENE] if self.reads_scene_state else []), *task]

    @property
    def action_steps(self) -> int:
        """How many actions it carries out before it looks again."""
        return int(self._config.get("n_action_steps") or 1)

    def trained_look(self) -> dict[str, Any] | None:
        """What is known of `LOOK` for the pictures that it was trained on; None if it reads none or nothing is known.

        Its training's options, beside it, name the dataset, whose manifest names the look.
        """
        if not self._config.get("use_images") and not any(key.startswith("observation.image") for key in self._inputs):
            return None
        try:
            dataset = json.loads(self._file(self._path, "train_config.json").read_text())["dataset"]
            look = json.loads(self._manifest(dataset).read_text())["look"]
        except (OSError, ValueError, KeyError):
            return None
        known = {key: look[key] for key in LOOK if look.get(key) is not None}
        return {"image_size": 0, **known} if "image_size" in look else known  # 0 or none: the cameras' own

    def _manifest(self, dataset: dict[str, Any]) -> Path:
        """The manifest of the dataset that a training's options name: on this machine, or else from the hub."""
        root = dataset.get("root")
        try:
            file = find_dataset(dataset["repo_id"], None if root is None else Path(root)) / MANIFEST
        except FileNotFoundError:
            file = Path()
        return file if file.is_file() else self._fetch(dataset["repo_id"], MANIFEST, "dataset", dataset.get("revision"))

    def _file(self, path: str, name: str) -> Path:
        """A policy's file: in a folder, or else from the hub."""
        file = Path(path) / name
        return file if file.is_file() else self._fetch(path, name)

    def _fetch(self, repo_id: str, name: str, kind: str = "model", revision: str | None = None) -> Path:
        from huggingface_hub import hf_hub_download  # late: most reports need no hub

        only_here = not self._download
        return Path(hf_hub_download(repo_id, name, repo_type=kind, revision=revision, local_files_only=only_here))


def differences(trained: dict[str, Any], settings: dict[str, Any]) -> str | None:
    """How the look of an evaluation differs from that of a training, in words; None if it does not.

    Args:
        trained: What `Policy.trained_look` returned.
        settings: The evaluation's. What either lacks is not compared.
    """
    found = []
    for key, wanted in trained.items():
        values = settings.get(key)
        seen = values if isinstance(values, list) else [] if values is None else [values]
        others = [str(value) for value in seen if _same_look(value) != _same_look(wanted)]
        if others:
            found.append(f"{key} {wanted} (evaluated: {', '.join(others)})")
    return ", ".join(found) or None


def _same_look(value: Any) -> Any:
    """Our renderers and PyBullet's of the same name have one look."""
    return value.removeprefix("pybullet_") if isinstance(value, str) else value
