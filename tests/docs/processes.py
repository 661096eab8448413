"""``python`` for shell blocks without its slow start: a process with the libraries forks for every command.

Run as a program it is that process: ``python processes.py SOCKET``.
"""

import contextlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]

LOADED = (
    "torch", "kornia", "scipy.optimize", "hydra", "matplotlib.pyplot", "rasterio", "pyogrio", "ezdxf",
    "v2hdm.cli.compose", "v2hdm.cli.commands.map", "v2hdm.verdict.check", "v2hdm.pipeline.detect_images",
    "v2hdm.mosaic.result", "v2hdm.localization", "v2hdm.calibration", "v2hdm.adjust.kernels.engine",
    "rosbags.highlevel",
)  # fmt: skip

CLIENT = """#!{python} -IS
import json, os, socket, sys
asked = socket.socket(socket.AF_UNIX)
asked.connect({address!r})
socket.send_fds(asked, [b"3"], [0, 1, 2])
asked.sendall(json.dumps([sys.argv[1:], os.getcwd(), dict(os.environ)]).encode())
asked.shutdown(socket.SHUT_WR)
told = asked.recv(8)
sys.exit(int(told) if told else 70)
"""


@contextlib.contextmanager
def python_in(folder: Path) -> Iterator[Path]:
    """A folder for ``PATH`` with the quick ``python`` and ``v2hdm``, as long as the context lasts."""
    address = str(folder / "socket")
    client = folder / "python"
    client.write_text(CLIENT.format(python=sys.executable, address=address))
    client.chmod(0o755)
    script = folder / "v2hdm"
    script.write_text(f'#!/bin/bash\nexec {client} -m v2hdm "$@"\n')
    script.chmod(0o755)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    server = subprocess.Popen([sys.executable, __file__, address], env=environment, cwd=folder)
    try:
        for _ in range(600):
            if Path(address).exists() or server.poll() is not None:
                break
            time.sleep(0.1)
        yield folder
    finally:
        server.terminate()
        server.wait()


def serve(address: str) -> None:
    """Fork for every command that is asked for, until SIGTERM."""
    sys.path[0] = str(ROOT)
    for name in LOADED:
        with contextlib.suppress(ModuleNotFoundError):
            __import__(name)
    listening = socket.socket(socket.AF_UNIX)
    listening.bind(address + ".new")
    listening.listen()
    Path(address + ".new").rename(address)
    # What has ended is waited for, so that its CPU time is part of what the tests took.
    signal.signal(signal.SIGCHLD, lambda *_: _wait_for_the_ended())
    while True:
        connection, _ = listening.accept()
        if os.fork() == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            listening.close()
            _work(connection)
        connection.close()


def _wait_for_the_ended() -> None:
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def _work(connection: socket.socket) -> None:
    """Be ``python ARGUMENTS`` on the asker's terminal, and end."""
    _, passed, _, _ = socket.recv_fds(connection, 1, 3)
    for number, fd in enumerate(passed):
        os.dup2(fd, number)
        os.close(fd)
    arguments, folder, environment = json.loads(b"".join(iter(lambda: connection.recv(65536), b"")))
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    code = 70
    try:
        _run(arguments)
        code = 0
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else int(left.code is not None)
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 1
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        connection.sendall(str(code).encode())
        os._exit(0)


def _run(arguments: list[str]) -> None:
    from tests.docs.smaller import smaller

    if arguments[0] == "-c":
        sys.argv = ["-c", *arguments[2:]]
        exec(arguments[1], {"__name__": "__main__"})
        return
    if arguments[0] != "-m":
        sys.argv = arguments
        runpy.run_path(arguments[0], run_name="__main__")
        return
    module, *words = arguments[1:]
    if module.startswith("v2hdm."):  # as v2hdm.map, which a user may write
        module, words = "v2hdm", [module.removeprefix("v2hdm."), *words]
    sys.argv = [module, *(smaller(words) if module == "v2hdm" else words)]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    serve(sys.argv[1])
