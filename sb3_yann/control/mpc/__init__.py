"""The linear MPC problem, its cost and its value."""
