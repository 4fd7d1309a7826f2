"""LanSAR's preprocessing as LeRobot pipeline steps: windows for training, CLIP embeddings for both.

    training                                            evaluation
    sampled frames  {index (B,), task, ...}             env observation {state (B, 15), images, task, ...}
      WindowStep    state, environment_state,             passes (no index)
                    action = targets: (B, n, ...)
      ClipStep      command from the task string          command from the task string
                    (pictures are embedded already)       pictures -> embeddings

After it a batch has, with n steps in training and without that axis in evaluation:

    observation.state (B, n, 15), observation.environment_state (B, n, 24), action (B, n, 7), valid_steps (N,)
    in training: places of the steps that are no padding among the B * n, observation.clip.command (B, D),
    observation.clip.static (B, n, D), observation.clip.gripper (B, n, D), task [B], and for the contrastive loss
    command_group (B, tasks), 1 for the tasks that a command asks for
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs.types import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import PolicyProcessorPipeline, ProcessorStep, ProcessorStepRegistry
from lerobot.processor.factory import make_default_policy_processor_steps, make_policy_processor_pipelines
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from ..clip.model import Clip, ClipConfig, weights_are_public
from ..clip.store import IMAGE_FEATURES
from .configuration_lansar import LanSARConfig
from .windows import Windows, get_current

CLIP_COMMAND = "observation.clip.command"
CLIP_IMAGE = {"static": "observation.clip.static", "gripper": "observation.clip.gripper"}

VALID_STEPS = "valid_steps"
COMMAND_GROUP = "command_group"

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


@ProcessorStepRegistry.register("lansar_windows")
@dataclass
class WindowStep(ProcessorStep):
    """Replaces sampled frames by the windows they stand for (`windows.py`); passes batches without `index`.

    It has no options of its own: the windows belong to the policy being trained, so that options given on the
    command line hold in a resumed or fine-tuned run too, where LeRobot would restore a step's saved ones.
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
            if not key.startswith("observation.images.")  # their embeddings come instead
        }
        observation[OBS_STATE] = window["state"]
        observation[OBS_ENV_STATE] = window["environment_state"]
        observation.update({key: window[name] for name, key in CLIP_IMAGE.items() if name in window})
        new = transition.copy()
        new[TransitionKey.OBSERVATION] = observation
        new[TransitionKey.ACTION] = window["target"]
        new[TransitionKey.COMPLEMENTARY_DATA] = {
            **extra,
            "task": self.windows.say(extra["task"]),
            VALID_STEPS: window["valid_steps"],
        }
        if (group := self.windows.groups(extra["task"])) is not None:
            new[TransitionKey.COMPLEMENTARY_DATA][COMMAND_GROUP] = group
        return new

    def transform_features(self, features: Features) -> Features:
        return features


@ProcessorStepRegistry.register("lansar_clip")
@dataclass
class ClipStep(ProcessorStep):
    """Adds the CLIP embeddings of commands and pictures; an embedding that is there already is used as it is.

    Weights that cannot be fetched by name (a local file, or untrained) travel in the checkpoint with this
    step.

    Attributes:
        model, pretrained: See `ClipConfig`.
        use_images: Whether the policy looks at pictures.
        weights_sha256: Of the CLIP the policy was trained with; "" before training.
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
        """The CLIP, built at first use; moved to `device` if one is named.

        Raises:
            ValueError: It is not the one the policy or the dataset's embeddings were made with.
        """
        if self._clip is None:
            mine = ClipConfig(self.model, self.pretrained)
            if self._windows is not None and self._windows.clip != mine:
                raise ValueError(
                    f"The checkpoint was trained with {mine}; --policy.clip.model={self._windows.clip.model} and "
                    f"--policy.clip.pretrained={self._windows.clip.pretrained} cannot be changed when resuming or "
                    "fine-tuning. Leave them out."
                )
            clip = Clip(mine, device or "cpu", self._weights)
            made_with = {"policy was trained": self.weights_sha256}
            if self._windows is not None and self._windows.clip_info:
                made_with["dataset's pictures were embedded"] = self._windows.clip_info["weights_sha256"]
            for what, expected in made_with.items():
                if expected and expected != clip.weights_sha256:
                    raise ValueError(
                        f"The {what} with other weights of CLIP {self.model} (sha256 {expected[:12]}...) "
                        f"than pretrained={self.pretrained!r} gives (sha256 {clip.weights_sha256[:12]}...). "
                        "Convert the dataset again, or set --policy.clip.pretrained of a new policy to those used then."
                    )
            self._clip, self.weights_sha256, self._weights = clip, clip.weights_sha256, None
        if device is not None and self._clip.device != torch.device(device):
            self._clip.to(device)
            self._commands.clear()
        return self._clip

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        observation = dict(transition.get(TransitionKey.OBSERVATION) or {})
        tasks = (transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get("task")
        if not tasks:
            raise ValueError("LanSAR needs a command: no `task` in the batch (from the dataset, or the env).")
        clip = self.clip(observation[OBS_STATE].device)
        for sentence in set(tasks) - self._commands.keys():
            # One at a time: it is kept, and must not depend on what else was in the first batch.
            self._commands[sentence] = clip.encode_texts([sentence])[0]
        observation[CLIP_COMMAND] = torch.stack([self._commands[sentence] for sentence in tasks])
        if self.use_images:
            for name, key in CLIP_IMAGE.items():
                if key not in observation:
                    observation[key] = self._embed(clip, observation, IMAGE_FEATURES[name])
        new = transition.copy()
        new[TransitionKey.OBSERVATION] = observation
        return new

    def _embed(self, clip: Clip, observation: dict[str, Any], key: str) -> Tensor:
        if key not in observation:
            raise ValueError(
                f"This LanSAR looks at pictures, but there is no {key}. Evaluate with "
                "--env.cameras='[static,gripper]', or train one without pictures (--policy.use_images=false)."
            )
        return clip.encode_images(observation[key])

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
        return {name: value.detach().cpu().clone() for name, value in weights.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self._weights, self._clip = dict(state), None

    def transform_features(self, features: Features) -> Features:
        return features


def make_lansar_pre_post_processors(
    config: LanSARConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """The pipelines of a new LanSAR; LeRobot's own steps all stay, its commands override them by name.

    Args:
        config: The policy's options.
        dataset_stats: LeRobot's statistics, kept by its (inactive) normaliser.

    Returns:
        Preprocessor and postprocessor.
    """
    steps = make_default_policy_processor_steps(config, dataset_stats)
    clip = ClipStep(config.clip.model, config.clip.pretrained, config.use_images)
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
