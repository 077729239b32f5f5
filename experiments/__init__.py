"""The paper's experiments, with more seeds and more to compare with: ``python -m experiments``."""
