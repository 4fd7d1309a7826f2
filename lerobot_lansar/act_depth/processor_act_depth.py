"""ACT's pipelines under the name by which LeRobot looks for them."""

from typing import Any

import torch
from lerobot.policies.act.processor_act import make_act_pre_post_processors
from lerobot.processor import PolicyAction, PolicyProcessorPipeline

from .configuration_act_depth import ACTDepthConfig


def make_act_depth_pre_post_processors(
    config: ACTDepthConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """Makes ACT's pipelines, which scale pictures and depth by the dataset's statistics."""
    return make_act_pre_post_processors(config, dataset_stats)
