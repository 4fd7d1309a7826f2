"""CALVIN for LeRobot: the desk as an environment, its demonstrations as LeRobotDatasets, LanSAR as a policy.

Importing this package registers the environment with gymnasium and nothing else, so the desk can be used without the
twenty seconds that importing LeRobot takes. `lerobot_policy_lansar` registers policy and environment with LeRobot.
"""

import gymnasium

gymnasium.register(id="lerobot_lansar/Calvin-v0", entry_point="lerobot_lansar.envs.calvin:CalvinEnv")
