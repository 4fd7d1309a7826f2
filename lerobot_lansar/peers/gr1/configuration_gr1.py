"""`--policy.type=gr1`: GR-1's options."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode
from lerobot.optim import AdamWConfig
from lerobot.optim.schedulers import CosineDecayWithWarmupSchedulerConfig

from ...clip.config import ClipConfig
from ...clip.model import embedding_size
from ..inputs import check_features
from .network import NetworkConfig


@PreTrainedConfig.register_subclass("gr1")
@dataclass
class GR1Config(PreTrainedConfig):
    """GR-1 (Wu et al. 2024), as published; docs/peers.md says where each value comes from."""

    # Steps of history, in training and at inference.
    window: int = 10
    # Hidden size of the causal transformer; both numbers of attention heads must divide it.
    hidden: int = 384
    # Layers of the causal transformer.
    layers: int = 12
    # Attention heads of the causal transformer.
    heads: int = 12
    # Dropout of the causal transformer.
    dropout: float = 0.1

    # A vision transformer of timm with a class token.
    image_encoder: str = "vit_base_patch16_224"
    # So many of its layers are used; 0: all.
    image_encoder_layers: int = 0
    # Pictures are brought to this height and width, pixels.
    image_size: int = 224
    # Its weights, which stay as they are: a file in timm's format, or MAE's mae_pretrain_vit_base.pth. Empty: random
    # weights, which are trained.
    image_encoder_weights: str = ""
    # Tokens that a picture's patches become.
    patch_tokens: int = 9
    # Layers of the resampler that makes them.
    resampler_layers: int = 3
    # Attention heads of the resampler.
    resampler_heads: int = 4
    # Size of each of these heads.
    resampler_head_size: int = 128
    # Layers of what draws later pictures.
    picture_layers: int = 2
    # Attention heads of what draws later pictures.
    picture_heads: int = 16

    # The picture so many steps later is predicted.
    later: int = 3
    # Weight of that prediction for each camera; 0: none.
    picture_weight: float = 0.1
    # Weight of the gripper's loss; the arm's is 1.
    gripper_weight: float = 0.01
    # In training, static pictures are moved by up to so many pixels in each direction, all of a window alike.
    static_shift: int = 10
    # In training, gripper pictures are moved by up to so many pixels in each direction, all of a window alike.
    gripper_shift: int = 4

    # Only the prediction of pictures is learned, from one camera and the command: any LeRobotDataset with pictures
    # serves. A policy is then made of it with --policy.path=... --policy.video_only=false.
    video_only: bool = False
    # The camera to learn from with video_only, such as observation.images.top; empty: the dataset's first.
    video_camera: str = ""

    # The dataset's actions, and the environment's. Checked against both where they say so.
    control_mode: str = "rel"

    # Peak learning rate.
    learning_rate: float = 1e-3
    # Weight decay.
    weight_decay: float = 0.0
    # Updates in which the learning rate rises.
    warmup_steps: int = 1000
    # Updates after which the learning rate has fallen to a hundredth.
    decay_steps: int = 20_000

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
        if self.hidden % self.heads or self.hidden % self.picture_heads or self.hidden % 4:
            raise ValueError(
                f"--policy.heads={self.heads}, --policy.picture_heads={self.picture_heads} and 4 must divide "
                f"--policy.hidden={self.hidden}."
            )
        if self.later < 1 or self.window < 2:
            raise ValueError(
                f"--policy.later={self.later} must be at least 1 and --policy.window={self.window} at least 2."
            )
        if self.video_only and not self.picture_weight:
            raise ValueError("--policy.video_only=true needs a --policy.picture_weight above 0.")
        if self.control_mode != "rel":
            raise ValueError(f"--policy.control_mode={self.control_mode!r}: GR-1's actions are relative, 'rel'.")

    @property
    def network(self) -> NetworkConfig:
        """What the network needs of these options."""
        return NetworkConfig(
            image_encoder=self.image_encoder,
            image_encoder_layers=self.image_encoder_layers,
            image_size=self.image_size,
            command_features=embedding_size(self.clip.model),
            hidden=self.hidden,
            layers=self.layers,
            heads=self.heads,
            dropout=self.dropout,
            window=self.window,
            patch_tokens=self.patch_tokens,
            resampler_layers=self.resampler_layers,
            resampler_heads=self.resampler_heads,
            resampler_head_size=self.resampler_head_size,
            picture_layers=self.picture_layers,
            picture_heads=self.picture_heads,
        )

    def validate_features(self) -> None:
        """Checks the features that LeRobot found in the dataset or environment, and leaves out those it does not read.

        Raises:
            ValueError: Features are missing or have the wrong shape; the message names each.
        """
        if not self.video_only:
            check_features(self, reads_state=True)
            return
        features = self.input_features
        if features:
            cameras = [k for k, f in features.items() if f.type is FeatureType.VISUAL and f.shape[0] == 3]
            self.video_camera = self.video_camera or (cameras[0] if cameras else "any camera")
            if self.video_camera not in cameras:
                raise ValueError(
                    f"--policy.video_only=true finds no {self.video_camera} in the dataset; it has {cameras}."
                )
            features.clear()  # those of the desk take their place when the policy is made

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.learning_rate, weight_decay=self.weight_decay, grad_clip_norm=1.0)

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=self.warmup_steps,
            num_decay_steps=self.decay_steps,
            peak_lr=self.learning_rate,
            decay_lr=self.learning_rate / 100,
        )

    @property
    def observation_delta_indices(self) -> list[int]:
        return list(range(self.window + (self.later if self.picture_weight else 0)))

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.window))

    @property
    def reward_delta_indices(self) -> None:
        return None

    @property
    def drop_n_last_frames(self) -> int:
        """Frames at a recording's end from which there is nothing to learn."""
        return self.later if self.video_only else 0
