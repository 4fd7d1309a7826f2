"""What LeRobot imports when it looks for plugins: registers policies and environment with it."""

import lerobot_lansar.act_depth
import lerobot_lansar.envs.configuration_calvin
import lerobot_lansar.peers
import lerobot_lansar.policy  # noqa: F401
