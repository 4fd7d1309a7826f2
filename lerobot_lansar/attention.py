"""`lansar-attention`: what a LanSAR attends to during one rollout (Figures 6.1 and 6.4 to 6.8 of the thesis).

    lansar-attention --policy.path=DIR --env.type=calvin --env.task=rotate_red_block_right --seed=0

Runs one episode with LeRobot's own rollout and writes into `--output_dir`:

    context_attention.png   how much each modality is attended to in the context encoder at every step, above it frames
    decoder_attention.png   what the decoder attends to at the steps of `--decoder_steps`, below their frames
    rollout.mp4             the static camera
    attention.npz           the weights themselves, see `save`
"""

import logging
import sys
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib
import numpy as np
import torch
from lerobot.configs import parser
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.envs.factory import make_env, make_env_pre_post_processors
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.io_utils import write_video
from lerobot.utils.random_utils import set_seed

from .command import run_command
from .envs.configuration_calvin import CalvinEnvConfig
from .policy.modeling_lansar import LanSARPolicy
from .policy.network import recorded_attention

matplotlib.use("Agg")
import matplotlib.pyplot as plt

FRAMES = 9  # of a rollout, above its heat map


@dataclass
class AttentionConfig(EvalPipelineConfig):
    """Options of `lerobot-eval`, and which of the decoder's decisions to draw."""

    # Control steps, counted from 0, at which the decoder's attention is drawn; those after the episode's end are not.
    decoder_steps: list[int] = field(default_factory=lambda: [0, 30])


@dataclass
class Attention:
    """Attention weights of one rollout of T control steps; heads and layers are not mixed.

    Attributes:
        tokens: Names of the k tokens of a timestep, CLS first.
        context: (T, layers, heads, k, k) float32, rows attend to columns. In the last layer CLS alone attends, since
            only it is read; the other rows are NaN.
        decoder: Per step {"self" and "cross": (layers, heads, s) float32}: from the newest X to the s tokens of the
            window, C and X (self) or C and E (cross) in turn.
        frames: (T, 200, 200, 3) uint8, the static camera before each step.
        commands: The T commands in force.
        prepended: Whether C stands only once, at the front of the window.
    """

    tokens: list[str]
    context: np.ndarray
    decoder: list[dict[str, np.ndarray]]
    frames: np.ndarray
    commands: list[str]
    prepended: bool

    def per_modality(self) -> np.ndarray:
        """How much each token is attended to at each step, (T, k): k times the mean over the tokens that attend, over
        heads and over layers. A step's values add up to k; 1 is what indifference would give.
        """
        return len(self.tokens) * np.nanmean(self.context, axis=3).mean(axis=(1, 2))

    def save(self, path: Path) -> None:
        """Writes `tokens`, `context`, `commands`, `prepended` and, for each step t, `decoder_self_t` and
        `decoder_cross_t` into one .npz file (no pickles).
        """
        decoder = {
            f"decoder_{kind}_{t}": weights for t, step in enumerate(self.decoder) for kind, weights in step.items()
        }
        np.savez_compressed(
            path,
            tokens=self.tokens,
            context=self.context,
            commands=self.commands,
            prepended=self.prepended,
            **decoder,  # type: ignore[arg-type]
        )


def observe(config: AttentionConfig) -> Attention:
    """Runs one episode, of the first of `--env.task`'s tasks, from `--seed`.

    Raises:
        ValueError: The policy is no LanSAR.
        DeskError: The environment cannot be had.
    """
    if config.policy is None or config.policy.type != "lansar" or not config.policy.pretrained_path:
        found = "none" if config.policy is None else f"an untrained policy of type {config.policy.type}"
        raise ValueError(f"lansar-attention needs a LanSAR checkpoint, --policy.path=DIR; got {found}")
    if any(step < 0 for step in config.decoder_steps):
        raise ValueError(f"--decoder_steps={config.decoder_steps}: control steps are counted from 0")
    set_seed(config.seed)
    if isinstance(config.env, CalvinEnvConfig):
        config.env.control_mode = config.policy.control_mode  # there is only one that fits
    envs = make_env(config.env, n_envs=1)
    env = next(iter(next(iter(envs.values())).values()))
    policy = make_policy(config.policy, env_cfg=config.env).eval()
    assert isinstance(policy, LanSARPolicy)
    overrides = {"device_processor": {"device": str(policy.config.device)}}
    preprocessor, postprocessor = make_pre_post_processors(
        config.policy, pretrained_path=str(config.policy.pretrained_path), preprocessor_overrides=overrides
    )
    env_preprocessor, env_postprocessor = make_env_pre_post_processors(config.env, config.policy)
    network = policy.network
    context: list[np.ndarray] = []
    decoder: list[dict[str, np.ndarray]] = []
    frames: list[np.ndarray] = []
    commands: list[str] = []

    def collect(_: LanSARPolicy) -> None:
        k = len(network.context_tokens)
        layers = [weights.pop()[0].float().cpu().numpy() for weights in in_context.values()]  # (heads, k or 1, k)
        context.append(
            np.stack([np.pad(w, ((0, 0), (0, k - w.shape[1]), (0, 0)), constant_values=np.nan) for w in layers])
        )
        newest = {name: weights.pop()[0, :, -1].float().cpu().numpy() for name, weights in in_decoder.items()}
        decoder.append(
            {
                kind: np.stack([w for name, w in newest.items() if name.endswith(f"{kind}_attention")])
                for kind in ("self", "cross")
            }
        )
        commands.append(env.call("task_description")[0])

    try:
        with (
            torch.no_grad(),
            recorded_attention(network.context_layers) as in_context,
            recorded_attention(network.decoder_layers) as in_decoder,
        ):
            rollout(
                env,
                policy,
                env_preprocessor,
                env_postprocessor,
                preprocessor,
                postprocessor,
                seeds=None if config.seed is None else [config.seed],
                render_callback=lambda env: frames.append(env.call("render")[0]),
                predicted_latents_callback=collect,
            )
    finally:
        env.close()
    return Attention(
        list(network.context_tokens),
        np.stack(context),
        decoder,
        np.stack(frames[: len(context)]),
        commands,
        network.config.command_prepended,
    )


def plot_context_attention(attention: Attention, path: Path) -> None:
    """Heat map: attention to each modality (rows) at each step (columns), under frames of the rollout (Figure 6.4)."""
    weights, steps = attention.per_modality(), len(attention.context)
    shown = np.unique(np.linspace(0, steps - 1, FRAMES).round().astype(int))
    figure = plt.figure(figsize=(12, 5.5), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1, 2))  # type: ignore[misc]
    for axes, step in zip(np.atleast_1d(above.subplots(1, len(shown))), shown, strict=True):
        axes.imshow(attention.frames[step])
        axes.set_title(f"step {step}", fontsize=8)
        axes.axis("off")
    axes = below.subplots()
    image = axes.imshow(weights.T, aspect="auto", interpolation="nearest", cmap="viridis", vmin=0)
    axes.set(xlabel="control step", yticks=range(len(attention.tokens)), yticklabels=attention.tokens)
    for step in [t for t in range(1, steps) if attention.commands[t] != attention.commands[t - 1]]:
        axes.axvline(step - 0.5, color="white", linewidth=1)
    below.colorbar(image, ax=axes, label="attention (1 = indifferent)")
    sentences = list(dict.fromkeys(attention.commands))
    axes.set_title("context encoder: " + "; ".join(f"“{sentence}”" for sentence in sentences), fontsize=10)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def plot_decoder_attention(attention: Attention, steps: list[int], path: Path) -> None:
    """Heat maps: from the newest step to the window's tokens, per decoder layer, mean over heads (Figure 6.1); above
    them the static camera's picture of that step.
    """
    steps = [step for step in steps if step < len(attention.decoder)] or [len(attention.decoder) - 1]
    figure, grid = plt.subplots(3, len(steps), figsize=(1 + 5.5 * len(steps), 8), squeeze=False, layout="constrained")
    for column, step in enumerate(steps):
        grid[0, column].imshow(attention.frames[step])
        grid[0, column].set_title(f"step {step}: “{attention.commands[step]}”", fontsize=9)
        grid[0, column].axis("off")
        for axes, (kind, other) in zip(grid[1:, column], (("self", "X"), ("cross", "E")), strict=True):
            weights = attention.decoder[step][kind].mean(axis=1)  # (layers, tokens)
            count = weights.shape[1]
            if attention.prepended:
                names = ["C", *(f"{other}{i}" for i in range(count - 1))]
            else:
                names = [("C" if i % 2 == 0 else other) + str(i // 2) for i in range(count)]
            image = axes.imshow(weights, aspect="auto", interpolation="nearest", cmap="viridis", vmin=0)
            # every token, or some of the odd ones: X or E
            labelled = range(count) if count <= 16 else range(1, count, 2 * (count // 32 + 1))
            axes.set(
                xticks=labelled,
                xticklabels=[names[i] for i in labelled],
                yticks=range(len(weights)),
                ylabel="layer",
                title=f"{kind}-attention",
            )
            axes.tick_params(axis="x", labelrotation=90, labelsize=7)
            figure.colorbar(image, ax=axes)
    figure.savefig(path, dpi=130)
    plt.close(figure)


@parser.wrap()
def run(config: AttentionConfig) -> None:
    """Observes one rollout and writes the files."""
    attention = observe(config)
    folder = Path(str(config.output_dir))
    folder.mkdir(parents=True, exist_ok=True)
    attention.save(folder / "attention.npz")
    write_video(str(folder / "rollout.mp4"), list(attention.frames), config.env.fps)
    plot_context_attention(attention, folder / "context_attention.png")
    plot_decoder_attention(attention, config.decoder_steps, folder / "decoder_attention.png")
    share = attention.per_modality().mean(axis=0)
    for token, value in sorted(zip(attention.tokens, share, strict=True), key=lambda row: -row[1]):
        print(f"{token:8s} {value:6.3f}")
    print(f"{len(attention.context)} steps; attention.npz, rollout.mp4 and the plots are in {folder}")


def main() -> int:
    """Entry point of `lansar-attention`."""
    register_third_party_plugins()
    logging.basicConfig(level=logging.WARNING)
    return run_command("lansar-attention", run)


if __name__ == "__main__":
    sys.exit(main())
