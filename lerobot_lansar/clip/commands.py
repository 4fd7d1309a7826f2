"""The LeRobot pipeline step that gives a policy the CLIP embeddings of its commands."""

from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs.types import PipelineFeatureType, PolicyFeature
from lerobot.processor import EnvTransition, ProcessorStep, ProcessorStepRegistry, TransitionKey
from torch import Tensor

from .config import ClipConfig
from .model import Clip, weights_are_public

CLIP_COMMAND = "observation.clip.command"

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


@ProcessorStepRegistry.register("lansar_clip_commands")
@dataclass
class CommandStep(ProcessorStep):
    """Adds the embeddings of a batch's sentences as `observation.clip.command`, (B, D) float32.

    The checkpoint stores weights that cannot be had by name (from a local file, or random) with this step.

    Attributes:
        model, pretrained: See `ClipConfig`.
        weights_sha256: Hash of the CLIP that the policy was trained with, of its text encoder alone if the policy reads
            no embeddings of pictures; "" before training.
    """

    model: str
    pretrained: str
    weights_sha256: str = ""
    _clip: Clip | None = field(default=None, init=False, repr=False)
    _weights: dict[str, Tensor] | None = field(default=None, init=False, repr=False)
    _commands: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False)

    def clip(self, device: torch.device | str | None = None) -> Clip:
        """The CLIP, built at first use and moved to `device` if one is given.

        Raises:
            ValueError: What the policy learns from, or the policy itself, was made with another CLIP.
        """
        if self._clip is None:
            clip = Clip(ClipConfig(self.model, self.pretrained), device or "cpu", self._weights)
            for what, expected in self._made_with().items():
                if expected and expected not in (clip.weights_sha256, self._identity(clip)):
                    raise ValueError(
                        f"The {what} with other weights of CLIP {self.model} (sha256 {expected[:12]}...) "
                        f"than pretrained={self.pretrained!r} has now (sha256 {self._identity(clip)[:12]}...). "
                        "Convert the dataset again, or train a new policy with --policy.clip.pretrained as it was then."
                    )
            self._clip, self.weights_sha256, self._weights = clip, self._identity(clip), None
        if device is not None and self._clip.device != torch.device(device):
            self._clip.to(device)
            self._commands.clear()
        return self._clip

    def _identity(self, clip: Clip) -> str:
        """The hash of what the policy reads embeddings of."""
        return clip.text_sha256

    def _made_with(self) -> dict[str, str]:
        """What must have been made with the same weights, as the error says it, and their hash."""
        return {"policy was trained": self.weights_sha256}

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        observation = dict(transition.get(TransitionKey.OBSERVATION) or {})
        commands = (transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get("task")
        if not commands:
            raise ValueError("This policy needs a command: neither the dataset nor the environment gave a `task`.")
        devices = [value.device for value in observation.values() if isinstance(value, Tensor)]
        clip = self.clip(devices[0] if devices else None)
        for sentence in set(commands) - self._commands.keys():
            # One at a time, so that the stored embedding does not depend on the rest of the batch.
            self._commands[sentence] = clip.encode_texts([sentence])[0]
        observation[CLIP_COMMAND] = torch.stack([self._commands[sentence] for sentence in commands])
        new = transition.copy()
        new[TransitionKey.OBSERVATION] = observation
        return new

    def get_config(self) -> dict[str, Any]:
        sha256 = self._identity(self.clip())
        return {"model": self.model, "pretrained": self.pretrained, "weights_sha256": sha256}

    def state_dict(self) -> dict[str, Tensor]:
        if weights_are_public(ClipConfig(self.model, self.pretrained)):
            return {}
        weights = self.clip().model.state_dict()
        return {name: value.detach().cpu().contiguous().clone() for name, value in weights.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self._weights, self._clip = dict(state), None

    def transform_features(self, features: Features) -> Features:
        return features
