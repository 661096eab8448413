"""YAML that others wrote means the same, and fails in the same words, whichever parser reads it."""

import random
from pathlib import Path

import pytest
import yaml

from v2hdm.errors import DriveError
from v2hdm.safe import texts

CONF = Path(__file__).parents[2] / "conf"
LETTERS = [
    *" \t\n:-[]{}#'\"&*!|>%@`,?~\r\x85\u2028\xa0\xe9._+\\\0\ufeff19",
    "? ",
    "---\n",
    "<<: ",
    "&a ",
    "*a",
    "1:2",
]


def mutated(seed):
    """A few lines of our own files with some letters put in, or others in their place."""
    chosen = random.Random(seed)
    files = sorted(CONF.rglob("*.yaml"))
    lines = chosen.choice(files).read_text(encoding="utf-8").splitlines(keepends=True)
    start = chosen.randrange(len(lines))
    text = "".join(lines[start : start + chosen.randint(1, 6)])
    for _ in range(chosen.randint(1, 4)):
        place = chosen.randint(0, len(text))
        text = text[:place] + chosen.choice(LETTERS) + text[place + chosen.choice([0, 0, 0, 1, 2]) :]
    return text


def read(text):
    try:
        return repr(texts.parse_yaml(text, "drive.yaml", DriveError))
    except DriveError as error:
        return str(error)


@pytest.mark.skipif(not yaml.__with_libyaml__, reason="PyYAML was built without libyaml")
def test_libyaml_reads_what_pyyaml_reads_and_refuses_in_its_words(monkeypatch):
    cases = [mutated(seed) for seed in range(1500)]
    by_libyaml = [read(text) for text in cases]
    monkeypatch.setattr(texts, "_BY_LIBYAML", None)
    assert by_libyaml == [read(text) for text in cases]
    assert any(answer.startswith("drive.yaml") for answer in by_libyaml)
