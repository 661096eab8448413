"""A Dask scheduler and its workers, started as a user does, on this machine alone."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from distributed import Client

ROOT = Path(__file__).parents[2]
DASK = Path(sys.executable).with_name("dask")
WAIT_S = 90.0  # for a process to be there, on a machine that does much else


def free_port():
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return listening.getsockname()[1]


class Machines:
    """Processes of ``dask scheduler`` and ``dask worker``; all end with :meth:`close`."""

    def __init__(self, folder, scheme="tcp", files=()):
        self.folder = folder
        self.files = list(files)
        port = free_port()
        self.address = f"{scheme}://127.0.0.1:{port}"
        self.processes = []
        address = (
            ["--host", self.address] if scheme == "tls" else ["--host", "127.0.0.1", "--port", str(port)]
        )
        self.scheduler = self._start("scheduler", *address, "--no-dashboard", *self.files)
        end_s = time.monotonic() + WAIT_S
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
            except OSError:
                assert time.monotonic() < end_s
                assert self.scheduler.poll() is None, self.log("scheduler", 0)
                time.sleep(0.1)

    def _start(self, kind, *arguments, cwd=None, environment=None, most_bytes=None):
        log = (self.folder / f"{kind}-{len(self.processes)}.log").open("w")
        variables = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **(environment or {})}
        limited = [] if most_bytes is None else ["prlimit", f"--fsize={most_bytes}"]
        process = subprocess.Popen(
            [*limited, DASK, kind, *arguments], cwd=cwd or ROOT, stdout=log, stderr=log,
            start_new_session=True, env=os.environ | variables,
        )  # fmt: skip
        log.close()
        self.processes.append(process)
        return process

    def worker(self, *arguments, **how):
        """Start a worker; it can write files of ``most_bytes``, as if its disk were full."""
        options = arguments or ("--nthreads", "1")
        host = ["--host", "127.0.0.1"]
        name = ["--local-directory", str(self.folder), "--no-dashboard", "--death-timeout", "30"]
        return self._start("worker", self.address, *host, *name, *options, *self.files, **how)

    def wait_for(self, workers):
        """Wait until so many workers are there."""
        with Client(self.address) as client:
            client.wait_for_workers(workers, timeout=WAIT_S)

    def log(self, kind, number):
        return (self.folder / f"{kind}-{number}.log").read_text()

    def close(self):
        for process in self.processes[::-1]:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGTERM)
        for process in self.processes:
            try:
                process.wait(timeout=15)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
