"""The door to the experiment: ``python -m v2hdm.experiment`` compares all methods on both ports.

Arguments are Hydra overrides (``--help`` lists them). docs/experiment.md describes it.
"""

from __future__ import annotations

import sys

from v2hdm.door import answer_signals, open_door

_INTERRUPTED = "interrupted; finished drives and detections are kept, the same command goes on from there"
_PORTS = "name ports (+run@ports.port1=port1) or set what is missing on the command line"


def main() -> int:
    """Run the door; 0, or 2 where a user must mend something."""
    return open_door("v2hdm.experiment", "map", _INTERRUPTED, _experiment)


def _experiment() -> None:
    import torch  # noqa: F401  # its absence is told before that of what is built on it

    from v2hdm import config
    from v2hdm.experiment.plan import ExperimentConfig
    from v2hdm.experiment.view import experiment_on_terminal

    for composed in config.compositions("experiment", ExperimentConfig):
        settings = config.to_dataclass(composed, ExperimentConfig, _PORTS)
        experiment_on_terminal(settings, config.to_yaml(composed))


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
