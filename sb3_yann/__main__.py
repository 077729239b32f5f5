"""``python -m sb3_yann`` is the command ``sb3-yann``."""

import sys

from sb3_yann.cli import main

if __name__ == "__main__":
    sys.exit(main())
