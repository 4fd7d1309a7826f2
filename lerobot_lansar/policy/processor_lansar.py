"""LanSAR's preprocessing as LeRobot pipeline steps: windows for training, CLIP embeddings always.

    training                                            evaluation
    sampled frames  {index (B,), task, ...}             env observation {state (B, 15), images, task, ...}
      WindowStep    state, environment_state and          does nothing (no index)
                    action (the targets): (B, n, ...)
      ClipStep      embeds the task sentence              embeds the task sentence
                    (pictures are embedded already)       and the pictures

With `finetune_clip` the policy itself embeds pictures.

The batch then holds, in training and (without the axis n) in evaluation:

    observation.state              (B, n, 15)
    observation.environment_state  (B, n, 24)
    observation.clip.command       (B, D)
    observation.clip.static        (B, n, D) with `use_images`, unless `finetune_clip`
    observation.clip.gripper       (B, n, D) likewise
    task                           B sentences

and in training only:

    observation.images.static      (N, H, W, 3) uint8, the pictures of the valid steps; with `finetune_clip`
    observation.images.gripper     (N, H, W, 3) uint8, likewise
    start_environment_state        (B, 1, 24) when the command began; with `since_command`
    action                         (B, n, 7), the targets
    valid_steps                    (N,) which of the B * n steps are not padding
    counts                         (B, n) 1 where the demonstrator acted, 0 where a policy did; missing without such
    command_tasks                  (B, tasks) 1 for the tasks that a command can mean; for the contrastive loss
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs.types import PipelineFeatureType, PolicyFeature
from lerobot.processor import (
    EnvTransition,
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
    TransitionKey,
)
from lerobot.processor.factory import make_default_policy_processor_steps, make_policy_processor_pipelines
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from ..clip.config import ClipConfig
from ..clip.model import Clip, weights_are_public
from ..clip.store import IMAGE_FEATURES
from .configuration_lansar import LanSARConfig
from .windows import Windows, get_current

CLIP_COMMAND = "observation.clip.command"
CLIP_IMAGE = {"static": "observation.clip.static", "gripper": "observation.clip.gripper"}

VALID_STEPS = "valid_steps"
START = "start_environment_state"
COUNTS = "counts"
COMMAND_TASKS = "command_tasks"

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


@ProcessorStepRegistry.register("lansar_windows")
@dataclass
class WindowStep(ProcessorStep):
    """Replaces sampled frames by the windows that they stand for (`windows.py`); leaves batches without `index` alone.

    It has no options: LeRobot would restore saved ones in a resumed or fine-tuned run. The windows belong to the policy
    being trained, so options on the command line apply there too.
    """

    windows: Windows | None = field(default_factory=get_current, init=False, repr=False)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        if "index" not in extra:
            return transition
        if self.windows is None:
            raise RuntimeError(
                "A dataset batch reached LanSAR's preprocessor, but no policy was built for training in this "
                "process: build it with its dataset_meta before the preprocessor, as lerobot-train does."
            )
        window = self.windows.batch(extra["index"].reshape(-1).cpu().numpy())
        observation = {
            key: value
            for key, value in (transition.get(TransitionKey.OBSERVATION) or {}).items()
            if not key.startswith("observation.images.")  # of the sampled frames
        }
        observation[OBS_STATE] = window["state"]
        observation[OBS_ENV_STATE] = window["environment_state"]
        keys = IMAGE_FEATURES if self.windows.pictures else CLIP_IMAGE
        observation.update({key: window[name] for name, key in keys.items() if name in window})
        new = transition.copy()
        new[TransitionKey.OBSERVATION] = observation
        new[TransitionKey.ACTION] = window["target"]
        new[TransitionKey.COMPLEMENTARY_DATA] = {
            **extra,
            "task": self.windows.paraphrase(extra["task"]),
            VALID_STEPS: window["valid_steps"],
        }
        if "start" in window:
            new[TransitionKey.COMPLEMENTARY_DATA][START] = window["start"]
        if "counts" in window:
            new[TransitionKey.COMPLEMENTARY_DATA][COUNTS] = window["counts"]
        if (command_tasks := self.windows.command_tasks(extra["task"])) is not None:
            new[TransitionKey.COMPLEMENTARY_DATA][COMMAND_TASKS] = command_tasks
        return new

    def transform_features(self, features: Features) -> Features:
        return features


def picture_of(observation: dict[str, Any], key: str) -> Tensor:
    """An observation's pictures from one camera.

    Raises:
        ValueError: There are none.
    """
    if key not in observation:
        raise ValueError(
            f"This LanSAR reads pictures, but there is no {key}. Evaluate with "
            "--env.cameras='[static,gripper]', or train one without pictures (--policy.use_images=false)."
        )
    return observation[key]


@ProcessorStepRegistry.register("lansar_clip")
@dataclass
class ClipStep(ProcessorStep):
    """Adds the CLIP embeddings of commands and pictures, unless the batch has those of its pictures already.

    The checkpoint stores weights that cannot be downloaded by name (from a local file, or random) with this step.

    Attributes:
        model, pretrained: See `ClipConfig`.
        use_images: Whether the policy reads pictures' embeddings.
        weights_sha256: Hash of the CLIP that the policy was trained with; "" before training.
    """

    model: str
    pretrained: str
    use_images: bool = True
    weights_sha256: str = ""
    _clip: Clip | None = field(default=None, init=False, repr=False)
    _weights: dict[str, Tensor] | None = field(default=None, init=False, repr=False)
    _commands: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False)
    _windows: Windows | None = field(default_factory=get_current, init=False, repr=False)

    def clip(self, device: torch.device | str | None = None) -> Clip:
        """The CLIP, built at first use and moved to `device` if one is given.

        Raises:
            ValueError: The policy or the dataset's embeddings were made with another CLIP.
        """
        if self._clip is None:
            clip = Clip(ClipConfig(self.model, self.pretrained), device or "cpu", self._weights)
            made_with = {"policy was trained": self.weights_sha256}
            if self._windows is not None and self._windows.clip_info:
                made_with["dataset's pictures were embedded"] = self._windows.clip_info["weights_sha256"]
            for what, expected in made_with.items():
                if expected and expected != clip.weights_sha256:
                    raise ValueError(
                        f"The {what} with other weights of CLIP {self.model} (sha256 {expected[:12]}...) "
                        f"than pretrained={self.pretrained!r} has now (sha256 {clip.weights_sha256[:12]}...). "
                        "Convert the dataset again, or train a new policy with --policy.clip.pretrained as it was then."
                    )
            self._clip, self.weights_sha256, self._weights = clip, clip.weights_sha256, None
        if device is not None and self._clip.device != torch.device(device):
            self._clip.to(device)
            self._commands.clear()
        return self._clip

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        observation = dict(transition.get(TransitionKey.OBSERVATION) or {})
        commands = (transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get("task")
        if not commands:
            raise ValueError("LanSAR needs a command: neither the dataset nor the environment gave a `task`.")
        clip = self.clip(observation[OBS_STATE].device)
        for sentence in set(commands) - self._commands.keys():
            # One at a time, so that the stored embedding does not depend on the rest of the batch.
            self._commands[sentence] = clip.encode_texts([sentence])[0]
        observation[CLIP_COMMAND] = torch.stack([self._commands[sentence] for sentence in commands])
        if self.use_images:
            for name, key in CLIP_IMAGE.items():
                if key not in observation:
                    observation[key] = clip.encode_images(picture_of(observation, IMAGE_FEATURES[name]))
        new = transition.copy()
        new[TransitionKey.OBSERVATION] = observation
        return new

    def get_config(self) -> dict[str, Any]:
        sha256 = self.clip().weights_sha256
        return {
            "model": self.model,
            "pretrained": self.pretrained,
            "use_images": self.use_images,
            "weights_sha256": sha256,
        }

    def state_dict(self) -> dict[str, Tensor]:
        if weights_are_public(ClipConfig(self.model, self.pretrained)):
            return {}
        weights = self.clip().model.state_dict()
        return {name: value.detach().cpu().contiguous().clone() for name, value in weights.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self._weights, self._clip = dict(state), None

    def transform_features(self, features: Features) -> Features:
        return features


def make_lansar_pre_post_processors(
    config: LanSARConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """The pipelines of a new LanSAR. All of LeRobot's own steps stay, since its commands override them by name.

    Args:
        config: The policy's options.
        dataset_stats: LeRobot's statistics, kept by its (inactive) normaliser.

    Returns:
        Preprocessor and postprocessor.
    """
    steps = make_default_policy_processor_steps(config, dataset_stats)
    clip = ClipStep(config.clip.model, config.clip.pretrained, config.use_images and not config.finetune_clip)
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            WindowStep(),
            steps.to_device,
            clip,
            steps.normalize,
        ],
        output_steps=[steps.unnormalize, steps.to_cpu],
    )
