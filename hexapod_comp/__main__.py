# PYTHON_ARGCOMPLETE_OK
"""``python -m hexapod_comp`` is the command ``hexapod_comp``."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
