"""Print what an extra of the package needs, a requirement a line: ``python .ci/needed.py map``.

So it is installed while the package itself is compiled; it runs before anything is installed.
"""

import re
import sys
import tomllib
from pathlib import Path

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
_OWN_EXTRAS = re.compile(rf"{PROJECT['name']}\[([a-z,]+)\]")


def needed(extra: str) -> list[str]:
    """The requirements of the base install and of an extra, with those of the extras that it names."""
    requirements = dict.fromkeys(PROJECT["dependencies"])
    for line in PROJECT["optional-dependencies"][extra]:
        named = _OWN_EXTRAS.fullmatch(line)
        if named is None:
            requirements[line] = None
            continue
        for name in named[1].split(","):
            requirements |= dict.fromkeys(needed(name))
    return [*requirements]


if __name__ == "__main__":
    print(*needed(sys.argv[1]), sep="\n")
