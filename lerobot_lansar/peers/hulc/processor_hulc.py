"""HULC's pipelines under the name by which LeRobot looks for them."""

from typing import Any

from ..processor import Pipelines, make_pipelines
from .configuration_hulc import HULCConfig


def make_hulc_pre_post_processors(
    config: HULCConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> Pipelines:
    """The pipelines of a new HULC."""
    return make_pipelines(config, dataset_stats)
