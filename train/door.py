"""What the doors of training and export share: a user's mistake is one line on stderr and exit code 2."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from v2hdm.errors import ConfigError, V2hdmError

CONF = Path(__file__).resolve().parents[1] / "conf"
"""Where the configuration of the doors is."""

_NOISE = re.compile(r"(full_key|reference_type|object_type|Set the environment|See https?:|Error merging)")


def open_door(config_name: str, work: Callable[[DictConfig], None]) -> None:
    """Compose `conf/<config_name>.yaml` with the command line and do the work it describes.

    Errors that a user can mend end the process with code 2.
    """
    # Hydra prints composition errors its own way and exits with 1 unless told to raise them.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    composed: list[DictConfig] = []
    compose = hydra.main(version_base="1.3", config_path=str(CONF), config_name=config_name)(composed.append)
    try:
        try:
            compose()  # Hydra makes the output folder
        except OSError as error:
            raise ConfigError(
                f"{error.filename}: no folder can be made there ({error.strerror}); set another output="
            ) from None
        for config in composed:  # none after --help
            work(config)
    except (HydraException, OmegaConfBaseException) as error:
        _fail(explain(error))
    except V2hdmError as error:
        _fail(error)
    except KeyboardInterrupt:
        _fail("interrupted; what was saved until then is kept")


def explain(error: Exception) -> ConfigError:
    """One line for an error of Hydra or OmegaConf."""
    root: BaseException = error
    while root.__cause__ is not None:
        root = root.__cause__
    text = f"{error}\n{root}"
    lines = [line.strip() for line in text.splitlines()]
    message = "; ".join(dict.fromkeys(line for line in lines if line and not _NOISE.match(line)))
    key = re.search(r"full_key: (\S+)", text)
    where = f" of {key.group(1)}" if key else ""
    return ConfigError(f"configuration{where}: {message}; --help lists the keys")


def _fail(message: object) -> None:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)
