"""ACT that sees depth as a grey picture."""

from lerobot.policies.act.modeling_act import ACTPolicy
from torch import Tensor

from .configuration_act_depth import ACTDepthConfig


class ACTDepthPolicy(ACTPolicy):
    """LeRobot's ACT, which repeats the one channel of a depth map three times, as its backbone wants.

    The preprocessor has scaled depth by the dataset's mean and standard deviation before.
    """

    config_class = ACTDepthConfig
    name = "act_depth"

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict]:
        """ACT's loss."""
        return super().forward(self._three_channels(batch))

    def predict_action_chunk(self, batch: dict[str, Tensor]) -> Tensor:
        """ACT's next actions, (B, chunk, action)."""
        return super().predict_action_chunk(self._three_channels(batch))

    def _three_channels(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        pictures = {key: batch[key] for key in self.config.image_features if batch[key].shape[1] == 1}
        return {**batch, **{key: picture.expand(-1, 3, -1, -1) for key, picture in pictures.items()}}
