"""Options of the LanSAR policy, `--policy.type=lansar`."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode
from lerobot.optim import AdamWConfig, OptimizerConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from ..clip.config import ClipConfig
from ..clip.model import embedding_size
from ..datasets import feature_problems
from .network import NetworkConfig
from .optimizer import MuonConfig
from .scaling import ENVIRONMENT_STATE_DIM, STATE_DIM, encoded_sizes
from .scheduler import LinearWarmupDecaySchedulerConfig

CHOICES = {
    "mlp_norm": ("batch", "layer"),
    "orientation": ("euler", "sincos"),
    "target": ("commanded", "achieved"),
    "window_start": ("episode", "anywhere", "mixed"),
    "control_mode": ("abs", "rel"),
    "dtype": ("float32", "bfloat16"),
    "optimizer": ("adamw", "muon"),
}


@PreTrainedConfig.register_subclass("lansar")
@dataclass
class LanSARConfig(PreTrainedConfig):
    """Every option of LanSAR: network, data, loss, optimizer, inference.

    The defaults are the thesis' sizes (Table 4.2) with the choices that docs/RESULTS.md found better at a size that a
    CPU can train: targets from the commanded action, predictions executed without scaling, blocks also seen from the
    hand, and the command in the context. Sines and cosines for angles and half of the windows from anywhere in a
    demonstration made no difference there.
    `configs/thesis/baseline.yaml` follows the thesis to the letter.

    A resumed or fine-tuned run keeps the checkpoint's scaling statistics, because its weights depend on them. Options
    that weights or scaling depend on must stay as they were trained (`TRAINED_OPTIONS` in modeling_lansar.py).
    """

    # Hidden size; both numbers of attention heads must divide it.
    hidden: int = 512
    # Layers of the context encoder.
    context_layers: int = 6
    # Attention heads of the context encoder.
    context_heads: int = 16
    # Layers of the decoder.
    decoder_layers: int = 6
    # Attention heads of the decoder. Table 4.2 has 6, which does not divide 512.
    decoder_heads: int = 8
    # Width of the feed-forward layers.
    feedforward: int = 2048
    # Dropout probability, the same everywhere in the network.
    dropout: float = 0.1
    # Longest history in control steps, in training and at inference.
    window: int = 64
    # Normalisation in the MLPs: batch (thesis), or layer for small batches.
    mlp_norm: str = "batch"
    # The context includes the static and the gripper picture, as CLIP embeddings.
    use_images: bool = True
    # The context includes the state of robot, blocks and scene. Without, no observation.environment_state is needed.
    # The decoder sees the robot's state in any case.
    use_spatial_context: bool = True
    # The context includes the command, which also decides what its CLS token attends to.
    command_in_context: bool = True
    # The command stands once at the front of the decoder's sequences instead of before every step (Table 5.3).
    command_prepended: bool = False

    # How Euler angles enter the network: euler (as they are) or sincos (sines and cosines: a block's angles jump at
    # +-pi). Either way the network predicts wrapped differences.
    orientation: str = "sincos"
    # Block positions are also given relative to the TCP, with finer resolution near it, so that the network need not
    # learn to subtract positions.
    egocentric_blocks: bool = True
    # Blocks and furniture are also given as what has changed since the command began, which no window may reach back
    # to. Needs demonstrations that are whole subtasks (lansar-record --mode=chains or windows), each from its command.
    since_command: bool = False
    # What the motion head learns to predict: commanded (recorded action minus current pose) or achieved (next pose
    # minus current pose, thesis).
    target: str = "commanded"
    # Where training windows start: episode (at the demonstration's start, thesis), anywhere (at the sampled frame) or
    # mixed (half of each).
    window_start: str = "mixed"
    # In training, each command is replaced by a random sentence for the same CALVIN task. Needs the dataset's column
    # calvin.task.
    paraphrases: bool = False
    # In training, normal noise of this standard deviation (in m and rad) is added to the robot state, but not to the
    # last gripper action.
    state_noise: float = 0.0
    # Weight of a contrastive loss between commands and the windows that carry them out; windows of the same CALVIN task
    # are no negatives. Above 0 it needs the dataset's column calvin.task.
    contrastive_weight: float = 0.0
    # float32, or bfloat16 for mixed-precision training on a GPU that supports it.
    dtype: str = "float32"
    # In training, the two transformers are compiled (torch.compile): a minute at the start, fewer and larger kernels
    # afterwards. Other kernels round differently.
    compile_model: bool = False

    # Beta of the smooth L1 losses (Eq 4.3, 4.4).
    smooth_l1_beta: float = 0.1
    # adamw (thesis), or muon: Muon for the matrices of the hidden layers and AdamW for everything else.
    optimizer: str = "adamw"
    # Peak learning rate.
    learning_rate: float = 4e-4
    # Weight decay.
    weight_decay: float = 0.01
    # Share of the updates in which the learning rate rises; afterwards it falls to 0.
    warmup_fraction: float = 0.04

    # What select_action returns where the environment does not say what it takes (--env.type=calvin does): abs (TCP
    # pose to go to, in m and rad) or rel (difference to the current pose in units of 0.02 m and 0.05 rad, clipped to
    # +-1).
    control_mode: str = "abs"
    # The history is cleared after this many steps, and whenever the command changes.
    history_clear_steps: int = 120
    # Number of oldest steps dropped when the window is full; 0 means half a window. Dropping steps moves all positions,
    # so the rest of the window is decoded again: at every step with 1 (thesis), once in 32 steps with half of 64.
    window_slide: int = 0
    # Predicted position differences are multiplied by position_scale_start - position_scale_slope * history / window;
    # the thesis has 3 and 1 (Eq 4.8).
    position_scale_start: float = 1.0
    # See position_scale_start.
    position_scale_slope: float = 0.0
    # Predicted yaw differences are multiplied by this; the thesis has 1.5 (section 4.3.1).
    yaw_scale: float = 1.0

    # Which CLIP embeds commands and pictures.
    clip: ClipConfig = field(default_factory=ClipConfig)
    # CLIP's image encoder is trained with the policy (section 6.5.1), which needs a GPU for more than a trial; a window
    # then costs two pictures a step. Pictures are read from the dataset, decoded once into its folder.
    finetune_clip: bool = False
    # Peak learning rate of the image encoder; with --use_policy_training_preset=false it has that of everything else.
    clip_learning_rate: float = 1e-5

    # Upload the trained policy; needs --policy.repo_id=you/name.
    push_to_hub: bool = False
    # Tags of the uploaded policy, beside robotics, lerobot and lansar.
    tags: list[str] | None = field(default_factory=lambda: ["calvin", "lerobot_policy_lansar"])
    # Leave this as it is: LanSAR scales with its own statistics, kept in the checkpoint, so LeRobot's normaliser must
    # change nothing.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ENV": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.IDENTITY,
        }
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"--policy.{name}={getattr(self, name)!r} is not one of {', '.join(choices)}.")
        for heads in ("context_heads", "decoder_heads"):
            if self.hidden % getattr(self, heads):
                raise ValueError(f"--policy.{heads}={getattr(self, heads)} must divide --policy.hidden={self.hidden}.")
        for name in ("window", "context_layers", "decoder_layers", "history_clear_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"--policy.{name}={getattr(self, name)} must be at least 1.")
        for name in ("state_noise", "contrastive_weight"):
            if getattr(self, name) < 0:
                raise ValueError(f"--policy.{name}={getattr(self, name)} must be 0 or more.")
        if not 0 <= self.window_slide <= self.window:
            raise ValueError(
                f"--policy.window_slide={self.window_slide} must be between 1 and --policy.window={self.window}, or "
                "0 for half a window."
            )
        self.window_slide = self.window_slide or max(1, self.window // 2)
        if not (self.use_images or self.use_spatial_context):
            raise ValueError(
                "--policy.use_images=false and --policy.use_spatial_context=false together leave the context empty: "
                "keep one of them."
            )

        if self.finetune_clip and not self.use_images:
            raise ValueError("--policy.finetune_clip=true needs --policy.use_images=true.")
        if self.since_command and not self.use_spatial_context:
            raise ValueError("--policy.since_command=true needs --policy.use_spatial_context=true, which it extends.")

    @property
    def network(self) -> NetworkConfig:
        """What the network needs of these options."""
        state, block, scene = encoded_sizes(self.orientation, self.egocentric_blocks, self.since_command)
        return NetworkConfig(
            state_dim=state,
            block_dim=block,
            scene_dim=scene,
            clip_dim=embedding_size(self.clip.model),
            hidden=self.hidden,
            context_layers=self.context_layers,
            context_heads=self.context_heads,
            decoder_layers=self.decoder_layers,
            decoder_heads=self.decoder_heads,
            feedforward=self.feedforward,
            dropout=self.dropout,
            window=self.window,
            mlp_norm=self.mlp_norm,
            use_images=self.use_images,
            use_spatial_context=self.use_spatial_context,
            command_in_context=self.command_in_context,
            command_prepended=self.command_prepended,
            contrastive=self.contrastive_weight > 0,
        )

    def validate_features(self) -> None:
        """Checks the features that LeRobot found in the dataset or environment, when the policy is built.

        Raises:
            ValueError: Features are missing or have the wrong shape; the message names each.
        """
        features = {**(self.input_features or {}), **(self.output_features or {})}
        if not features:
            return  # a policy built by hand; its inputs are checked in `select_action`
        sizes = {OBS_STATE: STATE_DIM, ACTION: 7}
        if self.use_spatial_context:
            sizes[OBS_ENV_STATE] = ENVIRONMENT_STATE_DIM
        problems = feature_problems(features, sizes)
        if problems:
            needed = [f"{name} ({size},)" for name, size in sizes.items()]
            raise ValueError(
                f"LanSAR cannot use these features: {'; '.join(problems)}. It needs {', '.join(needed)} in CALVIN's "
                "conventions, as lansar-convert writes them and --env.type=calvin provides them. Leave task_in_state "
                f"off: LanSAR reads the command itself. Without {OBS_ENV_STATE} set --policy.use_spatial_context=false."
            )
        kinds = {FeatureType.VISUAL: self.use_images, FeatureType.ENV: self.use_spatial_context}
        for name in [k for k, f in (self.input_features or {}).items() if not kinds.get(f.type, True)]:
            del self.input_features[name]  # type: ignore[index]

    def get_optimizer_preset(self) -> OptimizerConfig:
        if self.optimizer == "muon":
            return MuonConfig(lr=self.learning_rate, weight_decay=self.weight_decay)
        return AdamWConfig(lr=self.learning_rate, weight_decay=self.weight_decay)

    def get_scheduler_preset(self) -> LinearWarmupDecaySchedulerConfig:
        return LinearWarmupDecaySchedulerConfig(warmup_fraction=self.warmup_fraction)

    # None: LeRobot reads single frames. `windows.py` makes windows of them, much faster than delta timestamps.
    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None
