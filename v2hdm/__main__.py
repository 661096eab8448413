"""``python -m v2hdm NAME`` is ``v2hdm NAME``."""

import sys

from v2hdm.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
