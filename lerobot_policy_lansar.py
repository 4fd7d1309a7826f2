"""What LeRobot imports when it looks for plugins: registers policy `lansar` and environment `calvin` with it."""

import lerobot_lansar.envs.configuration_calvin
import lerobot_lansar.policy  # noqa: F401
