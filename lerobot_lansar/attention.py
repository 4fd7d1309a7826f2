"""`lansar-attention`: what a LanSAR attends to during one rollout (Figures 6.1 and 6.4 to 6.8 of the thesis).

    lansar-attention --policy.path=DIR --env.type=calvin --env.task=rotate_red_block_right --seed=0

Runs one episode with LeRobot's own rollout and writes into `--output_dir`:

    context_attention.png   attention to each modality in the context encoder at every step, under frames
    decoder_attention.png   the decoder's attention at the steps of `--decoder_steps`, under their frames
    rollout.mp4             the static camera
    attention.npz           the weights themselves, see `Attention.save`
"""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import parser
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.envs.factory import make_env
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.io_utils import write_video
from lerobot.utils.random_utils import set_seed
from matplotlib.axes import Axes
from matplotlib.figure import Figure  # not pyplot: a bare figure is drawn by Agg and needs no closing
from matplotlib.image import AxesImage

from .command import run_command
from .envs.configuration_calvin import CalvinEnvConfig
from .evaluation.loading import load_policy
from .policy.modeling_lansar import LanSARPolicy
from .policy.network import recorded_attention

FRAMES = 9
"""How many frames of the rollout are shown above its heat map."""
KINDS = {"self": "X", "cross": "E"}
"""The decoder's kinds of attention, and the tokens that each attends to besides C."""


@dataclass
class AttentionConfig(EvalPipelineConfig):
    """The options of `lerobot-eval`, and the steps at which to draw the decoder's attention."""

    # Control steps, counted from 0, at which the decoder's attention is drawn; steps after the episode's end are
    # ignored.
    decoder_steps: list[int] = field(default_factory=lambda: [0, 30])


@dataclass
class Attention:
    """Attention weights of one rollout of T control steps, by layer and head.

    Attributes:
        tokens: Names of the k tokens of a timestep, CLS first.
        context: (T, layers, heads, k, k) float32, rows attend to columns. In the last layer only CLS is read, so only
            CLS attends and the other rows are NaN.
        decoder: For each step {"self" and "cross": (layers, heads, s) float32}, the attention of the newest X to the s
            tokens of the window: C and X in turn (self) or C and E in turn (cross).
        frames: (T, 200, 200, 3) uint8, the static camera before each step.
        commands: The command at each of the T steps.
        prepended: C stands only once, at the front of the window.
    """

    tokens: list[str]
    context: np.ndarray
    decoder: list[dict[str, np.ndarray]]
    frames: np.ndarray
    commands: list[str]
    prepended: bool

    def per_modality(self) -> np.ndarray:
        """Attention to each token at each step, (T, k): k times the mean over attending tokens, heads and layers.

        A step's values add up to k; uniform attention gives 1 everywhere.
        """
        return len(self.tokens) * np.nanmean(self.context, axis=3).mean(axis=(1, 2))

    def save(self, path: Path) -> None:
        """Writes one .npz file without pickles.

        It holds `tokens`, `context`, `commands`, `prepended` and, for each step t, `decoder_self_t` and
        `decoder_cross_t`.
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


class Recorder:
    """Collects a rollout's `Attention`, step by step.

    Args:
        policy: The LanSAR that acts.
        env: A vector environment with one environment.
    """

    def __init__(self, policy: LanSARPolicy, env: Any) -> None:
        self._network, self._env = policy.network, env
        self._context: list[np.ndarray] = []
        self._decoder: list[dict[str, np.ndarray]] = []
        self._frames: list[np.ndarray] = []
        self._commands: list[str] = []

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Within this context, the network records the weights that `add_step` collects."""
        with (
            recorded_attention(self._network.context_layers) as self._new_context,
            recorded_attention(self._network.decoder_layers) as self._new_decoder,
        ):
            yield

    def add_frame(self, env: Any) -> None:
        """Keeps the static camera's picture; called before each step and after the last."""
        self._frames.append(env.call("render")[0])

    def add_step(self, _: LanSARPolicy) -> None:
        """Keeps the weights of the action just chosen, and the command that it was chosen for."""
        k = len(self._network.context_tokens)
        # Per layer (heads, k, k), in the last one (heads, 1, k).
        layers = [weights.pop()[0].float().cpu().numpy() for weights in self._new_context.values()]
        padded = [np.pad(w, ((0, 0), (0, k - w.shape[1]), (0, 0)), constant_values=np.nan) for w in layers]
        self._context.append(np.stack(padded))
        newest = {name: weights.pop()[0, :, -1].float().cpu().numpy() for name, weights in self._new_decoder.items()}
        by_kind = {kind: [w for name, w in newest.items() if name.endswith(f"{kind}_attention")] for kind in KINDS}
        self._decoder.append({kind: np.stack(weights) for kind, weights in by_kind.items()})
        self._commands.append(self._env.call("task_description")[0])

    def attention(self) -> Attention:
        """The weights, frames and commands collected so far."""
        return Attention(
            list(self._network.context_tokens),
            np.stack(self._context),
            self._decoder,
            np.stack(self._frames[: len(self._context)]),
            self._commands,
            self._network.config.command_prepended,
        )


def check_options(config: AttentionConfig) -> None:
    """Checks the policy and the steps.

    Raises:
        ValueError: The policy is no trained LanSAR, the environment is not the desk, or a step is negative.
    """
    if not isinstance(config.env, CalvinEnvConfig):
        raise ValueError(f"lansar-attention runs the policy on the desk, --env.type=calvin; got {config.env.type}")
    if config.policy is None or config.policy.type != "lansar" or not config.policy.pretrained_path:
        found = "none" if config.policy is None else f"an untrained policy of type {config.policy.type}"
        raise ValueError(f"lansar-attention needs a LanSAR checkpoint, --policy.path=DIR; got {found}")
    if any(step < 0 for step in config.decoder_steps):
        raise ValueError(f"--decoder_steps={config.decoder_steps}: control steps are counted from 0")


def observe(config: AttentionConfig) -> Attention:
    """Runs one episode, of the first of `--env.task`'s tasks, from `--seed`.

    Raises:
        ValueError: See `check_options`.
        DeskError: The environment cannot be made.
    """
    check_options(config)
    set_seed(config.seed)
    envs = make_env(config.env, n_envs=1)
    env = next(iter(next(iter(envs.values())).values()))
    assert config.policy is not None
    policy, processors = load_policy(config.policy, config.env)
    lansar = policy if isinstance(policy, LanSARPolicy) else policy.get_base_model()  # under LoRA's adapters
    recorder = Recorder(lansar, env)
    try:
        with torch.no_grad(), recorder.recording():
            rollout(
                env,
                policy,
                *processors,
                seeds=None if config.seed is None else [config.seed],
                render_callback=recorder.add_frame,
                predicted_latents_callback=recorder.add_step,
            )
    finally:
        env.close()
    return recorder.attention()


def plot_context_attention(attention: Attention, path: Path) -> None:
    """Heat map of attention to each modality (rows) at each step (columns), under frames (Figure 6.4)."""
    steps = len(attention.context)
    shown = np.unique(np.linspace(0, steps - 1, FRAMES).round().astype(int))
    figure = Figure(figsize=(12, 5.5), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1, 2))  # type: ignore[misc]
    for axes, step in zip(np.atleast_1d(above.subplots(1, len(shown))), shown, strict=True):
        axes.imshow(attention.frames[step])
        axes.set_title(f"step {step}", fontsize=8)
        axes.axis("off")
    axes = below.subplots()
    image = heat_map(axes, attention.per_modality().T)
    axes.set(xlabel="control step", yticks=range(len(attention.tokens)), yticklabels=attention.tokens)
    for step in [t for t in range(1, steps) if attention.commands[t] != attention.commands[t - 1]]:
        axes.axvline(step - 0.5, color="white", linewidth=1)
    below.colorbar(image, ax=axes, label="attention (1 = uniform)")
    sentences = list(dict.fromkeys(attention.commands))
    axes.set_title("context encoder: " + "; ".join(f"“{sentence}”" for sentence in sentences), fontsize=10)
    figure.savefig(path, dpi=130)


def plot_decoder_attention(attention: Attention, steps: list[int], path: Path) -> None:
    """Heat maps of attention from the newest step to the window's tokens, one row per decoder layer, mean over heads
    (Figure 6.1). Above them the static camera's picture of that step.
    """
    steps = [step for step in steps if step < len(attention.decoder)] or [len(attention.decoder) - 1]
    figure = Figure(figsize=(1 + 5.5 * len(steps), 8), layout="constrained")
    grid = figure.subplots(3, len(steps), squeeze=False)
    for column, step in enumerate(steps):
        grid[0, column].imshow(attention.frames[step])
        grid[0, column].set_title(f"step {step}: “{attention.commands[step]}”", fontsize=9)
        grid[0, column].axis("off")
        for axes, kind in zip(grid[1:, column], KINDS, strict=True):
            weights = attention.decoder[step][kind].mean(axis=1)  # (layers, s)
            image = heat_map(axes, weights)
            label_tokens(axes, window_tokens(weights.shape[1], KINDS[kind], attention.prepended))
            axes.set(yticks=range(len(weights)), ylabel="layer", title=f"{kind}-attention")
            figure.colorbar(image, ax=axes)
    figure.savefig(path, dpi=130)


def heat_map(axes: Axes, values: np.ndarray) -> AxesImage:
    """Draws `values` from 0 upwards."""
    return axes.imshow(values, aspect="auto", interpolation="nearest", cmap="viridis", vmin=0)


def window_tokens(count: int, other: str, prepended: bool) -> list[str]:
    """Names of the first `count` tokens of a window: C0 X0 C1 X1 ... or, prepended, C X0 X1 ... (`other` is X or E)."""
    if prepended:
        return ["C", *(f"{other}{i}" for i in range(count - 1))]
    return [("C" if i % 2 == 0 else other) + str(i // 2) for i in range(count)]


def label_tokens(axes: Axes, names: list[str]) -> None:
    """Labels the columns: up to 16 all of them, otherwise some of the odd ones, which are X or E."""
    count = len(names)
    labelled = range(count) if count <= 16 else range(1, count, 2 * (count // 32 + 1))
    axes.set(xticks=labelled, xticklabels=[names[i] for i in labelled])
    axes.tick_params(axis="x", labelrotation=90, labelsize=7)


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
