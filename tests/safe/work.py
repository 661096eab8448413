"""Work for a child that ends in every way there is."""

import ctypes
import logging
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.safe.child import next_step


def answer(*arguments):
    logging.getLogger("v2hdm.io.somewhere").warning("a line %d", 1)
    print("a library's own words", file=sys.stderr)
    print("on stdout, too")
    return {"arguments": list(arguments), "heavy": sorted({"torch", "numba", "hydra"} & set(sys.modules))}


def refuse():
    raise DriveError("a.bag: is cut off; copy it again")


def fail(path):
    Path(path).write_text("never")


def forked_by():
    return os.getppid()


def surroundings():
    return {
        "folder": str(Path.cwd()),
        "said": os.environ.get("V2HDM_SAID"),
        "temporary": tempfile.gettempdir(),
    }


seen: list[str] = []


def remember(word):
    os.environ["V2HDM_SAID"] = word
    os.chdir("/")
    seen.append(word)
    return seen


def take_memory(count):
    return np.ones(count, np.uint8).size


def take_time():
    while True:
        pass


def take_time_in_steps():
    for _ in range(10):
        begin_s = time.process_time()
        while time.process_time() - begin_s < 0.25:
            pass
        next_step()
    return "done"


def fill(path):
    with Path(path).open("wb") as file:
        for _ in range(100):
            file.write(bytes(1_000_000))


def crash():
    ctypes.string_at(0)


def wait(path):
    Path(path).write_text(f"{os.getpid()} {os.environ['TMPDIR']}")
    time.sleep(60)
