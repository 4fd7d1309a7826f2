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
    observation.environment_state  (B, n, 24) with `use_spatial_context`
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

from ..clip.commands import CommandStep, Features
from ..clip.model import Clip
from ..clip.store import IMAGE_FEATURES
from .configuration_lansar import LanSARConfig
from .windows import Windows, get_current

CLIP_IMAGE = {"static": "observation.clip.static", "gripper": "observation.clip.gripper"}

VALID_STEPS = "valid_steps"
START = "start_environment_state"
COUNTS = "counts"
COMMAND_TASKS = "command_tasks"


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
            if not key.startswith("observation.images.") and key != OBS_ENV_STATE  # of the sampled frames
        }
        observation[OBS_STATE] = window["state"]
        if "environment_state" in window:
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
class ClipStep(CommandStep):
    """Adds the CLIP embeddings of commands and pictures, unless the batch has those of its pictures already.

    Attributes:
        use_images: Whether the policy reads pictures' embeddings.
    """

    use_images: bool = True
    _windows: Windows | None = field(default_factory=get_current, init=False, repr=False)

    def _identity(self, clip: Clip) -> str:
        return clip.weights_sha256 if self.use_images else clip.text_sha256

    def _made_with(self) -> dict[str, str]:
        info = self._windows.clip_info if self._windows is not None else {}
        return super()._made_with() | {"dataset's pictures were embedded": info.get("weights_sha256", "")}

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        new = super().__call__(transition)
        observation = new[TransitionKey.OBSERVATION]
        if self.use_images:
            for name, key in CLIP_IMAGE.items():
                if key not in observation:
                    observation[key] = self.clip().encode_images(picture_of(observation, IMAGE_FEATURES[name]))
        return new

    def get_config(self) -> dict[str, Any]:
        return super().get_config() | {"use_images": self.use_images}


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
    reads_embeddings = config.use_images and not config.finetune_clip
    clip = ClipStep(config.clip.model, config.clip.pretrained, use_images=reads_embeddings)
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
