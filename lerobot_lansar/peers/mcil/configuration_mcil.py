"""`--policy.type=mcil`: MCIL's options, as CALVIN's authors train it."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode

from ..latent_plan.configuration import LatentPlanConfig


@PreTrainedConfig.register_subclass("mcil")
@dataclass
class MCILConfig(LatentPlanConfig):
    """Multicontext imitation learning (Lynch and Sermanet 2021): what differs from HULC."""

    # In training, static pictures are moved by up to so many pixels in each direction.
    static_shift: int = 0
    # In training, gripper pictures are moved by up to so many pixels in each direction.
    gripper_shift: int = 0
    # Plans: discrete (plan_size choices among plan_classes) or continuous (plan_size numbers).
    plan: str = "continuous"
    # Choices, or numbers, of a plan.
    plan_size: int = 256
    # What recognises a plan in a window: transformer, or rnn (in both directions).
    recognition: str = "rnn"
    # Bins in [-1, 1] that each of an action's numbers falls into.
    bins: int = 256
    # Weight of a cross-entropy for the gripper (closed or open); 0: it is a number like the others.
    gripper_weight: float = 0.0
    # Relative actions are learned in the frame of the hand (hand) or of the world (world).
    action_frame: str = "world"
    # What the decoder sees beside plan and goal: the gripper's picture (gripper), or both.
    decoder_sees: str = "both"
    # Weight of the contrastive loss between commands and the windows in which they are fulfilled; 0: none.
    contrastive_weight: float = 0.0
    # rel or abs: the dataset's actions, and the environment's. Checked against both where they say so.
    control_mode: str = "abs"
    # Absolute actions are brought to [-1, 1] by the dataset's smallest and largest values.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )
