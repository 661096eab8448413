"""The training door: ``python -m train [key=value ...]``."""

from __future__ import annotations

import sys

from v2hdm.door import answer_signals, open_door

_INTERRUPTED = "interrupted; what was saved until then is kept"


def main() -> int:
    """Run the door, whose arguments are Hydra overrides (``--help`` lists them); returns its exit code."""
    return open_door("train", "train", _INTERRUPTED, _train)


def _train() -> None:
    from train.config import TrainConfig
    from train.console import train
    from v2hdm.config import compositions, to_dataclass

    for composed in compositions("train", TrainConfig):
        train(to_dataclass(composed, TrainConfig, "set it on the command line"))


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
