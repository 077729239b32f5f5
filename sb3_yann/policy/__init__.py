"""The Stable-Baselines3 policy that starts as a linear MPC."""
