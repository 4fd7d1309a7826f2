"""`lansar-eval`: LeRobot's evaluation of a policy on the desk, in several processes and resumable.

evaluate    the command: which episodes are missing, who runs them, `eval_info.json` at the end
options     its options
worker      one process: LeRobot's `rollout` over its share of the episodes
stream      an environment that plays one episode after the other, as one long episode
rows        a policy that is reset in each environment where a command begins
loading     a policy and its processors, as LeRobot's evaluation builds them
"""
