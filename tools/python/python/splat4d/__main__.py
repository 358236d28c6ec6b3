"""The command line: ``python -m splat4d ARGS``."""

import sys

from ._program import main

if __name__ == "__main__":
    sys.exit(main())
