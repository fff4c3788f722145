"""`python -m jaxclamp` is the command line."""

import sys

from jaxclamp.cli import main

if __name__ == "__main__":
    sys.exit(main())
