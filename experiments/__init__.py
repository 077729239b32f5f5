"""The paper's experiments, with more seeds and more to compare with: ``python -m experiments``."""

import sb3_yann

FINGERPRINT = f"{sb3_yann.__version__}-3"
"""Results of another version are not taken for those of this one."""
