"""The CALVIN desk as a gymnasium environment, `lerobot_lansar/Calvin-v0`, and as LeRobot's `--env.type=calvin`.

calvin                  `CalvinEnv`: chains of the benchmark or single tasks, rewards, ends of episodes
pictures                pictures, depth and camera poses of its observations
spaces                  its observation and action spaces
control_mode            refuses an episode's first action if it plainly belongs to the other control mode
episodes                `episodes.jsonl`: one line per finished episode, which the report reads
configuration_calvin    `CalvinEnvConfig`: the options in LeRobot's commands
suites                  what `--env.task` stands for
command_line            refuses what LeRobot's other options make impossible
vector                  vector environments: forked workers, finished episodes freeze
"""

from .calvin import LH_MTLC, CalvinEnv

__all__ = ["LH_MTLC", "CalvinEnv"]
