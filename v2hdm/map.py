"""The mapping door: ``python -m v2hdm.map +run=port2`` turns a drive into a map and a calibration.

Hydra lives only here and in :mod:`v2hdm.config`. What a user got wrong ends in one line on stderr
and exit code 2.
"""

from __future__ import annotations

import os
import sys

from v2hdm.errors import MissingExtraError, V2hdmError

EXIT_USER_ERROR = 2


def main() -> None:
    """Run the door; the arguments are Hydra overrides (``--help`` lists the configuration)."""
    # Hydra prints composition errors its own way and exits with 1 unless told to raise them.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    try:
        _run_hydra()
    except V2hdmError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        _fail("interrupted; finished renderings are kept in the cache, no result was written")


def _run_hydra() -> None:
    try:
        import hydra
        import torch  # noqa: F401  # checked here, so that its absence is one clear line
        from hydra.errors import HydraException
        from omegaconf import DictConfig
        from omegaconf.errors import OmegaConfBaseException
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"python -m v2hdm.map needs {error.name}: install the mapping extra, pip install 'v2hdm[map]'"
        ) from error
    from v2hdm import config, console

    config.register_schemas()

    failures: list[V2hdmError] = []

    @hydra.main(config_path=str(config.conf_dir()), config_name="map", version_base="1.3")
    def run_composed(composed: DictConfig) -> None:
        # Carried past Hydra, which would announce it with lines of its own.
        try:
            console.run_on_terminal(config.to_run_config(composed), config.to_yaml(composed))
        except V2hdmError as error:
            failures.append(error)

    try:
        run_composed()
    except (HydraException, OmegaConfBaseException) as error:
        raise config.explain(error, sys.argv[1:]) from error
    for failure in failures:
        raise failure


def _fail(message: str) -> None:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(EXIT_USER_ERROR)


if __name__ == "__main__":
    main()
