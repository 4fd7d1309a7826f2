"""Options that MCIL and HULC share."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from lerobot.optim import AdamConfig

from ...clip.config import ClipConfig
from ...clip.model import embedding_size
from ..inputs import check_features
from .network import NetworkConfig, convolved

CHOICES = {
    "plan": ("discrete", "continuous"),
    "recognition": ("transformer", "rnn"),
    "action_frame": ("hand", "world"),
    "decoder_sees": ("gripper", "both"),
    "control_mode": ("rel", "abs"),
}


@dataclass
class LatentPlanConfig(PreTrainedConfig):
    """One policy with latent plans; `mcil` and `hulc` are two sets of its values, and other mixtures of them work too.

    The values here are HULC's, as published (docs/peers.md says where each comes from).
    """

    # Frames in a training window at most; each window's are drawn between min_window and this.
    window: int = 32
    # Frames in a training window at least.
    min_window: int = 20
    # Static pictures are brought to this height and width, pixels.
    static_size: int = 200
    # Gripper pictures are brought to this height and width, pixels.
    gripper_size: int = 84
    # In training, static pictures are moved by up to so many pixels in each direction.
    static_shift: int = 10
    # In training, gripper pictures are moved by up to so many pixels in each direction.
    gripper_shift: int = 4
    # Numbers that each camera's picture becomes.
    visual_features: int = 64
    # Numbers that a goal becomes.
    goal_features: int = 32
    # Width of the recurrent and feed-forward layers.
    hidden: int = 2048

    # Plans: discrete (plan_size choices among plan_classes) or continuous (plan_size numbers).
    plan: str = "discrete"
    # Choices, or numbers, of a plan.
    plan_size: int = 32
    # Among how many a choice of a discrete plan is.
    plan_classes: int = 32
    # What recognises a plan in a window: transformer, or rnn (in both directions).
    recognition: str = "transformer"
    # Layers of that transformer.
    recognition_layers: int = 2
    # Attention heads of that transformer.
    recognition_heads: int = 8
    # Dropout of that transformer.
    recognition_dropout: float = 0.1
    # Width after that transformer.
    recognition_features: int = 4096

    # Logistic distributions in the mixture of each of an action's numbers.
    mixtures: int = 10
    # Bins in [-1, 1] that each of an action's numbers falls into.
    bins: int = 10
    # Weight of a cross-entropy for the gripper (closed or open); 0: it is a number like the others.
    gripper_weight: float = 1.0
    # Relative actions are learned in the frame of the hand (hand) or of the world (world).
    action_frame: str = "hand"
    # What the decoder sees beside plan and goal: the gripper's picture (gripper), or both.
    decoder_sees: str = "gripper"

    # Weight of the divergence between proposed and recognised plans.
    kl_weight: float = 0.01
    # Share of the divergence that moves the proposal; the rest moves the recognition.
    kl_balance: float = 0.8
    # Weight of the contrastive loss between commands and the windows in which they are fulfilled; 0: none.
    contrastive_weight: float = 3.0
    # It takes the windows that begin in so many last frames in which a window can begin.
    contrastive_starts: int = 8
    # Windows are also learned with their own last picture as the goal, which needs no command.
    picture_goals: bool = True

    # Control steps after which a rollout draws a new plan.
    replan_steps: int = 30
    # rel or abs: the dataset's actions, and the environment's. Checked against both where they say so.
    control_mode: str = "rel"

    # Learning rate, constant.
    learning_rate: float = 2e-4

    # Which CLIP embeds the commands.
    clip: ClipConfig = field(default_factory=ClipConfig)

    # Upload the trained policy; needs --policy.repo_id=you/name.
    push_to_hub: bool = False
    # Tags of the uploaded policy.
    tags: list[str] | None = field(default_factory=lambda: ["calvin", "lerobot_policy_lansar"])
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.IDENTITY,
        }
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"--policy.{name}={getattr(self, name)!r} is not one of {', '.join(choices)}.")
        if not 2 <= self.min_window <= self.window:
            raise ValueError(
                f"--policy.min_window={self.min_window} must be between 2 and --policy.window={self.window}."
            )
        for name in ("static_size", "gripper_size"):
            if convolved(getattr(self, name)) < 1:
                raise ValueError(f"--policy.{name}={getattr(self, name)} must be at least 36 pixels.")
        if self.recognition == "transformer" and 2 * self.visual_features % self.recognition_heads:
            raise ValueError(
                f"--policy.recognition_heads={self.recognition_heads} must divide twice --policy.visual_features="
                f"{self.visual_features}."
            )
        if self.action_frame == "hand" and self.control_mode != "rel":
            raise ValueError("--policy.action_frame=hand needs --policy.control_mode=rel.")
        if self.bins < 2:
            raise ValueError(f"--policy.bins={self.bins} must be at least 2.")

    @property
    def network(self) -> NetworkConfig:
        """What the network needs of these options."""
        return NetworkConfig(
            gripper_size=self.gripper_size,
            visual_features=self.visual_features,
            command_features=embedding_size(self.clip.model),
            goal_features=self.goal_features,
            hidden=self.hidden,
            discrete_plan=self.plan == "discrete",
            plan_size=self.plan_size,
            plan_classes=self.plan_classes,
            recognition=self.recognition,
            recognition_features=self.recognition_features,
            recognition_layers=self.recognition_layers,
            recognition_heads=self.recognition_heads,
            recognition_dropout=self.recognition_dropout,
            window=self.window,
            mixtures=self.mixtures,
            bins=self.bins,
            separate_gripper=self.gripper_weight > 0,
            decoder_sees=self.decoder_sees,
            contrastive=self.contrastive_weight > 0,
        )

    def validate_features(self) -> None:
        """Checks the features that LeRobot found in the dataset or environment, and leaves out those it does not read.

        Raises:
            ValueError: Features are missing or have the wrong shape; the message names each.
        """
        check_features(self, reads_state=self.action_frame == "hand")

    def get_optimizer_preset(self) -> AdamConfig:
        return AdamConfig(lr=self.learning_rate, grad_clip_norm=0.0)  # 0: none, as published

    def get_scheduler_preset(self) -> None:
        return None

    @property
    def observation_delta_indices(self) -> list[int]:
        return list(range(self.window))

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.window))

    @property
    def reward_delta_indices(self) -> None:
        return None

    @property
    def drop_n_last_frames(self) -> int:
        """Frames at a demonstration's end in which no window can begin."""
        return self.min_window - 1
