"""The paper's experiments, with more seeds and more to compare with: ``python -m experiments``."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "examples"))  # they import each other by name
