"""``python -m v2hdm.map`` is ``v2hdm map``."""

import sys

from v2hdm.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["map", *sys.argv[1:]]))
