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
    """Makes ACT's pipelines, which scale pictures and depth by the dataset's statistics.

    Raises:
        ValueError: LeRobot has put colours' statistics in the place of depth's, as it does with a held-out split.
    """
    for key, feature in config.image_features.items():
        mean = (dataset_stats or {}).get(key, {}).get("mean")
        if mean is not None and feature.shape[0] == 1 and torch.as_tensor(mean).numel() != 1:
            raise ValueError(
                f"LeRobot would scale {key} like colours, since --dataset.eval_split is not 0: add "
                "--dataset.use_imagenet_stats=false"
            )
    return make_act_pre_post_processors(config, dataset_stats)
