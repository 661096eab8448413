"""Whatever a user gives ends in a value or in one line that says what is wrong."""

import os
import tarfile
from pathlib import Path

import cv2
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.faults.cases import all_cases
from tests.faults.judge import HYDRA_DOORS, Case, judge
from tests.faults.pictures import chunk_of_4_gb, damaged_inside
from tests.faults.readers import READERS, refusal
from v2hdm.detection.frames import read_bgr
from v2hdm.errors import ConfigError, DriveError, V2hdmError
from v2hdm.safe.pixels import read_header
from v2hdm.safe.texts import parse_json, parse_yaml, read_text, read_yaml, shown, take_name
from v2hdm.store.files import replace_text
from v2hdm.store.inputs import protected_inputs

CASES = all_cases()
QUICK = [
    case
    for number, case in enumerate(CASES)
    if case.door not in HYDRA_DOORS or number % 8 == 0 or "inputs" in case.says
]
"""Doors that load torch and Hydra take half a second a case: of those every eighth, and on inputs all."""


@pytest.mark.parametrize("case", QUICK, ids=[case.name for case in QUICK])
def test_a_bad_input_ends_well(case, tmp_path):
    outcome = judge(case, tmp_path)
    assert not outcome.faults(case), outcome.error


def test_the_judge_sees_what_a_command_may_not_do(tmp_path):
    def run(case):
        Path("precious.txt").unlink()
        Path("new").touch()
        return 1, "Traceback: <class 'x'>", ""

    case = Case("a", "v2hdm check", (), lambda root: None, "a cause")
    faults = " ".join(judge(case, tmp_path, run).faults(case))
    for words in ("code 1", "traceback", "0 lines", "does not say", "changed or removed", "left"):
        assert words in faults


CORPUS = Path(__file__).with_name("corpus.tar.xz")


def inputs():
    """By reader."""
    members: dict[str, list[bytes]] = {}
    with tarfile.open(CORPUS) as archive:
        for member in archive:
            stream = archive.extractfile(member)
            members.setdefault(member.name.split("/")[0], []).append(stream.read())
    return members


INPUTS = inputs()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("reader", INPUTS)
def test_what_fuzzing_has_reached_is_read_or_refused(reader, tmp_path):
    write, read = READERS[reader]
    path = tmp_path / "file"
    write(path)  # and what belongs beside it
    for data in INPUTS[reader]:
        path.write_bytes(data)
        assert "\n" not in (refusal(lambda: read(path), V2hdmError) or "")


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**12), 10**12) | st.floats(allow_nan=False) | st.text(),
    lambda below: st.lists(below, max_size=4) | st.dictionaries(st.text(), below, max_size=4),
    max_leaves=12,
)


@given(st.dictionaries(st.text(), PLAIN, max_size=4))
def test_what_yaml_writes_of_plain_values_is_read_as_it_was(content):
    try:
        text = yaml.safe_dump(content, allow_unicode=True)
        is_known = yaml.safe_load(text) == content
    except yaml.YAMLError:
        is_known = False
    if is_known:
        assert parse_yaml(text, "here", DriveError) == content


@given(st.text() | st.binary().map(lambda data: data.decode("utf-8", "replace")))
@example("\ufeff")
@example("%YAML 9.9\n---\na: 1")
@example("1: 2\n? \n")
def test_any_text_is_plain_values_or_one_line(text):
    for parse in (parse_yaml, parse_json):
        assert "\n" not in (refusal(lambda parse=parse: parse(text, "here", DriveError), DriveError) or "")


@given(st.text(max_size=80))
def test_a_name_that_is_taken_names_one_entry_of_a_folder(text):
    said = refusal(lambda: take_name(text, "here", DriveError), DriveError)
    if said is not None:
        assert said.isprintable()
        return
    name = take_name(text, "here", DriveError)
    path = Path("/folder") / f"calibration_{name}.yaml"
    assert path.parent == Path("/folder")
    assert Path("/folder", name).parent == Path("/folder")
    assert name.isprintable()
    assert len(path.name.encode()) < 230


@given(PLAIN)
def test_what_is_shown_of_a_value_is_a_short_piece_of_one_line(content):
    text = shown(content)
    assert len(text) <= 300
    assert "\n" not in text
    assert "None" not in text or "None" in str(content)


Cut = tuple[float, float, bytes]
CUTS = st.lists(
    st.tuples(st.floats(0, 1), st.floats(0, 0.2), st.binary(max_size=6) | st.sampled_from(
        [b"nan", b"1e999", b"-1", b"[", b"{", b"&a", b"*a", b"!!x ", b"\t", b"\n", b"null", b"true", b"\xff"]
    )),
    min_size=1, max_size=3,
)  # fmt: skip


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", READERS)
@settings(max_examples=40)
@given(cuts=CUTS)
def test_a_file_that_was_damaged_is_read_or_refused(tmp_path_factory, name, cuts):
    write, read = READERS[name]
    path = tmp_path_factory.mktemp("damaged") / "file"
    write(path)
    data = path.read_bytes()
    for at, length, new in cuts:
        begin = int(at * len(data))
        data = data[:begin] + new + data[begin + int(length * len(data)) :]
    path.write_bytes(data)
    assert "\n" not in (refusal(lambda: read(path), V2hdmError) or "")


@pytest.mark.parametrize("name", READERS)
def test_what_is_whole_is_read(tmp_path, name):
    write, read = READERS[name]
    write(tmp_path / "file")
    assert read(tmp_path / "file") is not None


@pytest.mark.parametrize("name", READERS)
def test_what_a_command_reads_it_does_not_write_over(tmp_path, name):
    write, read = READERS[name]
    write(tmp_path / "file")
    before = (tmp_path / "file").read_bytes()
    with protected_inputs():
        read(tmp_path / "file")
        with pytest.raises(ConfigError, match="is one of the inputs"):
            replace_text(tmp_path / "file", "ours")
    assert (tmp_path / "file").read_bytes() == before


@pytest.mark.parametrize("read", [lambda path: read_text(path, DriveError), read_header])
def test_a_file_larger_than_any_is_refused_before_it_is_read(read, tmp_path):
    (tmp_path / "a").touch()
    os.truncate(tmp_path / "a", 1 << 32)
    with pytest.raises(DriveError, match="4295 MB"):
        read(tmp_path / "a")


def test_yaml_of_more_bytes_than_any_is_refused_before_it_is_read(tmp_path):
    (tmp_path / "a").touch()
    os.truncate(tmp_path / "a", 1 << 25)
    with pytest.raises(DriveError, match="has 34 MB, 17 MB at most"):
        read_yaml(tmp_path / "a", DriveError)


def test_the_decoders_complaints_are_kept_from_the_terminal(tmp_path, capfd):
    (tmp_path / "a.jpg").write_bytes(damaged_inside())
    with pytest.raises(DriveError, match="damaged"):
        read_bgr(tmp_path / "a.jpg")
    assert capfd.readouterr().err == ""


def test_a_chunk_that_ends_beyond_its_png_is_no_work_of_the_decoders(tmp_path, monkeypatch):
    # It would allocate and clear the 4 GB that the chunk says it has.
    (tmp_path / "a.png").write_bytes(chunk_of_4_gb())
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("the decoder was asked"))
    with pytest.raises(DriveError, match="damaged"):
        read_bgr(tmp_path / "a.png")
