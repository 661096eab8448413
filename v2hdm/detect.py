"""``python -m v2hdm.detect`` is ``v2hdm detect``."""

import sys

from v2hdm.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["detect", *sys.argv[1:]]))
