"""Ray, started on this machine or joined: nothing calls outside, and nothing of it outlives the fleet."""

from __future__ import annotations

import logging
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from v2hdm.errors import ConfigError
from v2hdm.extras import need
from v2hdm.pipeline import RunConfig

LOCAL = "local"
"""The address of a Ray of our own on this machine."""

RETRIES = 3
"""How often work is begun anew whose worker died."""

_OBJECT_STORE_BYTES = 1 << 30

_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_USAGE_STATS_PROMPT_ENABLED": "0",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_DEDUP_LOGS": "0",
}
"""No usage is told to anybody."""

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Workers share the cores among them; linear algebra of one takes one."""


@contextmanager
def cluster(address: str, workers: int) -> Iterator[Any]:
    """The module ``ray``, connected.

    Args:
        address: of a running cluster, ``auto`` for that of this machine; ``local`` starts one here, which
            ends with the block or the process.
        workers: cores that a local one uses; 0 takes all.

    Raises:
        ConfigError: Ray is not installed, or there is no cluster at the address.
    """
    os.environ.update(_QUIET)
    local = address == LOCAL
    given = {name: os.environ.get(name) for name in _ONE_THREAD}
    if local:
        # A secret of this process's own: else Ray keeps one in the home folder for all.
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    ray = need("ray", "fleet", "a fleet", ConfigError)
    logging.getLogger("ray").setLevel(logging.ERROR)
    folder = tempfile.mkdtemp(prefix="v2hdm-ray-") if local else None
    own: dict[str, Any] = {
        "num_cpus": workers or None,
        "include_dashboard": False,
        "object_store_memory": _OBJECT_STORE_BYTES,
        "_temp_dir": folder,
    }
    try:
        try:
            ray.init(
                address=address,
                log_to_driver=False,
                configure_logging=False,
                runtime_env=None if local else {"env_vars": dict.fromkeys(_ONE_THREAD, "1")},
                **(own if local else {}),
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            why = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ConfigError(
                f"--address {address}: no Ray answers there ({why}); start it with `ray start`, with the "
                "same RAY_AUTH_TOKEN, or leave --address out"
            ) from error
        yield ray
    finally:
        ray.shutdown()
        for name, value in given.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


EYES_A_GPU = 8
"""Actors that detect on one GPU: each takes memory there, and most of an image's time is the CPU's."""

NO_GPU = (
    "device=cuda or detector.device=cuda is set, and none of Ray's machines has a GPU: set them to cpu, or "
    "start Ray where there is one"
)


@dataclass(frozen=True)
class Shares:
    """The shares of a GPU that an actor that detects, and a mapping task, take on Ray's books."""

    eyes: float
    mapping: float

    @classmethod
    def of(cls, configs: Sequence[RunConfig]) -> Shares:
        """A whole GPU for a mapping task, and for so many actors; half where both are on GPUs."""
        detects = any(one.detector.device == "cuda" for one in configs)
        maps = any(one.device == "cuda" for one in configs)
        part = 0.5 if detects and maps else 1.0
        return cls(part / EYES_A_GPU, part)


def wants_gpu(config: RunConfig) -> bool:
    """Whether a run has work for a GPU."""
    return "cuda" in (config.device, config.detector.device)
