"""Tables and plots from what `lerobot-eval` wrote, and what a LanSAR attends to in a rollout (`attention.py`)."""
