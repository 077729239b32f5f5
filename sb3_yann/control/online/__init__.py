"""The law of a linear MPC solved at each point: for problems that have too many regions."""
