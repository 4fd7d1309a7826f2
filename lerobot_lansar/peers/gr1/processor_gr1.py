"""GR-1's pipelines under the name by which LeRobot looks for them."""

from typing import Any

from ..processor import Pipelines, make_pipelines
from .configuration_gr1 import GR1Config


def make_gr1_pre_post_processors(
    config: GR1Config, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> Pipelines:
    """The pipelines of a new GR-1."""
    return make_pipelines(config, dataset_stats)
