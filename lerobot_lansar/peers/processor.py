"""The peers' pipelines: LeRobot's own steps, and CLIP's embeddings of the commands."""

from typing import Any

from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.factory import make_default_policy_processor_steps, make_policy_processor_pipelines

from ..clip.commands import CommandStep

Pipelines = tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]


def make_pipelines(config: Any, dataset_stats: dict[str, Any] | None) -> Pipelines:
    """Preprocessor and postprocessor of a new policy that reads commands.

    Args:
        config: The policy's options, with `clip`, which embeds the commands.
        dataset_stats: LeRobot's statistics, for the normaliser.
    """
    steps = make_default_policy_processor_steps(config, dataset_stats)
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            steps.to_device,
            CommandStep(config.clip.model, config.clip.pretrained),
            steps.normalize,
        ],
        output_steps=[steps.unnormalize, steps.to_cpu],
    )
