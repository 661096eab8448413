"""Arguments of the commands that fit a few weights to photographs and renders."""

from __future__ import annotations

import argparse
from pathlib import Path


def fit_arguments(about: str | None, photographs: int, renders: int) -> argparse.Namespace:
    """The arguments of a command that says ``about`` itself.

    Names are ``labels`` and ``images``, paths, and how many ``photographs`` and ``renders`` are shown to the
    detector, which these default to.
    """
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("labels", type=Path)
    parser.add_argument("images", type=Path)
    parser.add_argument("--photographs", type=int, default=photographs)
    parser.add_argument("--renders", type=int, default=renders)
    return parser.parse_args()
