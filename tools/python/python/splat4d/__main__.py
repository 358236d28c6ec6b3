"""The command line: ``python -m splat4d ARGS``."""

import os
import subprocess
import sys
from pathlib import Path


def main() -> int:
    """Runs the program that lies in the package, with this process's arguments; its exit code."""
    windows = os.name == "nt"
    program = Path(__file__).parent / "bin" / ("splat4d.exe" if windows else "splat4d")
    if not program.is_file():
        print(f"error: {program} is missing: the package was built without it", file=sys.stderr)
        return 1
    command = [str(program), *sys.argv[1:]]
    if windows:
        return subprocess.call(command)
    # The same process: signals and the exit code are the program's own.
    os.execv(program, command)


if __name__ == "__main__":
    sys.exit(main())
