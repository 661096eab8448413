"""Ray, started on this machine or joined: nothing calls outside, and nothing of it outlives the fleet."""

from __future__ import annotations

import logging
import os
import secrets
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

from v2hdm.errors import ConfigError
from v2hdm.extras import need
from v2hdm.pipeline.config import RunConfig

LOCAL = "local"  # the address of a Ray of our own on this machine
RETRIES = 3  # how often work is begun anew whose worker died
_OBJECT_STORE_BYTES = 1 << 30

_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_USAGE_STATS_PROMPT_ENABLED": "0",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_DEDUP_LOGS": "0",
}
"""Ray reports no usage to anybody."""

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Workers share the cores among them; linear algebra of one takes one."""

DETECTORS_A_GPU = 8  # actors on one GPU: each takes memory there, and most of an image's time is the CPU's

NO_GPU = (
    "device=cuda or detector.device=cuda is set, and none of Ray's machines has a GPU: set them to cpu, or "
    "start Ray where there is one"
)


@contextmanager
def cluster(address: str, workers: int) -> Iterator[Any]:
    """The module ``ray``, connected to a running cluster (``auto`` finds that of this machine).

    ``local`` starts one here of so many cores, 0 for all; it ends with the block or the process. Raises
    ConfigError where Ray is not installed, or there is no cluster at the address.
    """
    with ExitStack() as stack:
        for name in _ONE_THREAD:
            if name in os.environ:
                stack.callback(os.environ.__setitem__, name, os.environ[name])
            else:
                stack.callback(os.environ.pop, name, None)
        os.environ.update(_QUIET | _ONE_THREAD)
        if address == LOCAL:
            # A secret of this process's own: else Ray keeps one in the home folder for all.
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
            folder = tempfile.TemporaryDirectory(prefix="v2hdm-ray-", ignore_cleanup_errors=True)
            options: dict[str, Any] = {
                "num_cpus": workers or None,
                "include_dashboard": False,
                "object_store_memory": _OBJECT_STORE_BYTES,
                "_temp_dir": stack.enter_context(folder),
            }
        else:
            options = {"runtime_env": {"env_vars": _ONE_THREAD}}
        ray = need("ray", "fleet", "a fleet", ConfigError)
        logging.getLogger("ray").setLevel(logging.ERROR)
        stack.callback(ray.shutdown)
        try:
            ray.init(address=address, log_to_driver=False, configure_logging=False, **options)
        except (ConnectionError, ValueError, RuntimeError) as error:
            why = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ConfigError(
                f"--address {address}: no Ray answers there ({why}); start it with `ray start`, with the "
                "same RAY_AUTH_TOKEN, or leave --address out"
            ) from error
        yield ray


@dataclass(frozen=True)
class Shares:
    """Ray's share of a GPU for an actor that detects and for a mapping task."""

    detector: float
    mapping: float

    @classmethod
    def of(cls, configs: Sequence[RunConfig]) -> Shares:
        """A whole GPU for a mapping task, or for all actors on it; half for each where both are on GPUs."""
        both = "cuda" in {one.detector.device for one in configs} & {one.device for one in configs}
        part = 0.5 if both else 1.0
        return cls(part / DETECTORS_A_GPU, part)


def wants_gpu(config: RunConfig) -> bool:
    """Whether a run has work for a GPU."""
    return "cuda" in (config.device, config.detector.device)
