"""How fast it is, beside what there is to compare with: ``python -m benchmarks``."""
