"""Tables and plots from what ``lerobot-eval`` wrote; knows neither the desk nor the policy."""
