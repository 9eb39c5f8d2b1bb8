"""Run the command line: `python -m rigidjax`, and the script `rigidjax`."""

import sys

from rigidjax.cli.command import main

if __name__ == "__main__":
    sys.exit(main())
