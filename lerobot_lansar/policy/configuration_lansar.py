"""Options of the LanSAR policy, `--policy.type=lansar`."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode
from lerobot.optim import AdamWConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from ..clip.model import ClipConfig, embedding_size
from .network import NetworkConfig
from .scaling import STATE_DIM, encoded_sizes
from .scheduler import LinearWarmupDecaySchedulerConfig

CHOICES = {
    "mlp_norm": ("batch", "layer"),
    "orientation": ("euler", "sincos"),
    "target": ("commanded", "achieved"),
    "window_start": ("episode", "anywhere", "mixed"),
    "control_mode": ("abs", "rel"),
    "dtype": ("float32", "bfloat16"),
}


@PreTrainedConfig.register_subclass("lansar")
@dataclass
class LanSARConfig(PreTrainedConfig):
    """Every option of LanSAR: network, data, loss, optimizer, inference.

    The thesis to the letter is `configs/thesis/baseline.yaml`. The defaults here are its sizes (Table 4.2) with
    what docs/RESULTS.md found better at a size that a CPU trains: targets from the commanded action and
    inference that takes the prediction as it is, blocks as the hand sees them, a context that knows the command,
    windows that do not all start with the demonstration.

    A resumed or fine-tuned run keeps the checkpoint's scaling statistics, which its weights are made for; leave
    `target`, `orientation`, `egocentric_blocks` and `clip` as they were trained.

    Attributes:
        hidden, context_layers, context_heads, decoder_layers, decoder_heads, feedforward, dropout: Table 4.2;
            8 decoder heads, since the table's 6 do not divide 512.
        window: Longest history in steps, in training and at inference.
        mlp_norm: Normalisation in the MLPs. "batch" as in the thesis; "layer" for small batches.
        use_images: Static and gripper picture (CLIP embeddings) are part of the context.
        use_spatial_context: Robot, block and scene state are part of the context (the decoder always sees the
            robot).
        command_in_context: The command is also a token of the context, and CLS asks with it which of the others matter.
        command_prepended: The command stands once at the front instead of before every step (Table 5.3).
        orientation: How euler angles enter the network. "euler" as they are, "sincos" without the +-pi jump
            (the gripper's roll sits there). Predicted are wrapped differences either way.
        egocentric_blocks: Blocks also come as seen from the TCP, with finer steps near it, so that the network
            need not learn to subtract two positions.
        target: What the motion head learns: "commanded" = the recorded action minus the current pose;
            "achieved" = the next pose minus the current pose (thesis).
        window_start: Which windows are trained on, see `windows.py`. "episode" = from the demonstration's
            start (thesis), "anywhere" = from the sampled frame, "mixed" = half of each.
        paraphrases: In training a window's command is replaced by a random one among the dataset's sentences for
            the same CALVIN task (the dataset's column calvin.task).
        state_noise: In training the robot state (but not the last gripper action) is disturbed by normal noise of this
            standard deviation, in its own units, m and rad.
        contrastive_weight: Weight of a contrastive loss between commands and the windows that carry them out; those
            of the same CALVIN task are not held against each other (the dataset's column calvin.task).
        dtype: "float32", or "bfloat16" for mixed-precision training on a GPU that has it.
        smooth_l1_beta: Beta of Eq 4.3, 4.4.
        learning_rate, weight_decay, warmup_fraction: AdamW and its schedule (Table 4.2).
        control_mode: What `select_action` returns. "abs": target pose (m, rad); "rel": the difference to the
            pose in units of (0.02 m, 0.05 rad), clipped to +-1. Must be the env's own (`--env.control_mode`).
        history_clear_steps: The history is forgotten after this many steps (and whenever the command
            changes).
        window_slide: Once the window is full, its oldest steps are forgotten so many at a time. 1 as in the
            thesis: every position changes at every step, so the whole window is decoded again. Half a window
            (what 0, the default, stands for) decodes one step most of the time.
        position_scale_start, position_scale_slope: Predicted position differences are multiplied by
            start - slope * history / window; the thesis has 3 and 1 (Eq 4.8).
        yaw_scale: Predicted yaw differences are multiplied by this; 1.5 in the thesis (section 4.3.1).
        clip: Which CLIP embeds commands and pictures.
    """

    hidden: int = 512
    context_layers: int = 6
    context_heads: int = 16
    decoder_layers: int = 6
    decoder_heads: int = 8
    feedforward: int = 2048
    dropout: float = 0.1
    window: int = 64
    mlp_norm: str = "batch"
    use_images: bool = True
    use_spatial_context: bool = True
    command_in_context: bool = True
    command_prepended: bool = False

    orientation: str = "sincos"
    egocentric_blocks: bool = True
    target: str = "commanded"
    window_start: str = "mixed"
    paraphrases: bool = False
    state_noise: float = 0.0
    contrastive_weight: float = 0.0
    dtype: str = "float32"

    smooth_l1_beta: float = 0.1
    learning_rate: float = 4e-4
    weight_decay: float = 0.01
    warmup_fraction: float = 0.04

    control_mode: str = "abs"
    history_clear_steps: int = 120
    window_slide: int = 0
    position_scale_start: float = 1.0
    position_scale_slope: float = 0.0
    yaw_scale: float = 1.0

    clip: ClipConfig = field(default_factory=ClipConfig)

    # Uploading is asked for, not the default: --policy.push_to_hub=true --policy.repo_id=you/name.
    push_to_hub: bool = False

    # LanSAR scales with statistics of its own, kept in the checkpoint; LeRobot's normaliser changes nothing.
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
                f"--policy.window_slide={self.window_slide} must lie between 1 and --policy.window={self.window}, or "
                "be 0 for half a window."
            )
        self.window_slide = self.window_slide or max(1, self.window // 2)
        if not (self.use_images or self.use_spatial_context):
            raise ValueError(
                "--policy.use_images=false and --policy.use_spatial_context=false together leave nothing "
                "to see: keep one of them."
            )

    @property
    def network(self) -> NetworkConfig:
        """The network's part of the options."""
        state, block, scene = encoded_sizes(self.orientation, self.egocentric_blocks)
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
        """Check the features LeRobot found in the dataset or env; called when the policy is built.

        Raises:
            ValueError: Naming every feature that is missing or of the wrong shape.
        """
        features = {**(self.input_features or {}), **(self.output_features or {})}
        if not features:
            return  # built by hand: the tensors themselves are checked when they come
        problems = []
        for name, size in ((OBS_STATE, STATE_DIM), (OBS_ENV_STATE, 24), (ACTION, 7)):
            if name not in features:
                problems.append(f"{name} is missing")
            elif tuple(features[name].shape) != (size,):
                problems.append(f"{name} has shape {tuple(features[name].shape)}, not ({size},)")
        if problems:
            raise ValueError(
                f"LanSAR cannot use these features: {'; '.join(problems)}. It needs observation.state (15,), "
                "observation.environment_state (24,) and action (7,) in CALVIN's conventions, as "
                "lansar-convert writes them and --env.type=calvin provides them, without task_in_state: LanSAR reads "
                "the command itself."
            )
        if not self.use_images and self.input_features:
            for name in [k for k, f in self.input_features.items() if f.type is FeatureType.VISUAL]:
                del self.input_features[name]

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.learning_rate, weight_decay=self.weight_decay)

    def get_scheduler_preset(self) -> LinearWarmupDecaySchedulerConfig:
        return LinearWarmupDecaySchedulerConfig(warmup_fraction=self.warmup_fraction)

    # Windows come from memory-mapped arrays (windows.py): LeRobot's own windowed reading is slow.
    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None
