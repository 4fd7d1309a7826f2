"""MCIL's pipelines under the name by which LeRobot looks for them."""

from typing import Any

from ..processor import Pipelines, make_pipelines
from .configuration_mcil import MCILConfig


def make_mcil_pre_post_processors(
    config: MCILConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> Pipelines:
    """The pipelines of a new MCIL."""
    return make_pipelines(config, dataset_stats)
