"""Linear models from equations and simulators, by finite differences."""
