"""The CALVIN desk as a gymnasium environment, `lerobot_lansar/Calvin-v0`, and as LeRobot's `--env.type=calvin`.

calvin                  `CalvinEnv`: chains of the benchmark or single tasks, rewards, ends of episodes
spaces                  its observation and action spaces
episodes                `episodes.jsonl`: one line per finished episode, which the report reads
configuration_calvin    `CalvinEnvConfig`: the options in LeRobot's commands, and vector environments
"""

from .calvin import LH_MTLC, CalvinEnv

__all__ = ["LH_MTLC", "CalvinEnv"]
