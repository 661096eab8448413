"""Passwords and tokens of a URL are in no message, no log and no file."""

import logging
from pathlib import Path

import pytest

from v2hdm.cli.main import _Line, run
from v2hdm.errors import ConfigError, DriveError, masked, one_line

SECRET = "wJalr/XUtn+FEMI"  # of letters as those of stores have
URLS = [
    f"s3://user:{SECRET}@bucket/x",
    f"s3://{SECRET}@bucket/x",
    f"https://user:{SECRET}@host/x.tif",
    f"https://host/x.tif?sig={SECRET}",
    f"https://host/x.tif?a=b&X-Amz-Signature={SECRET}&c=d",
    f"https://host/x.tif#access_token={SECRET}",
    f"rtsp://admin:{SECRET}@10.0.0.1:554/stream",
    f"ftp://user:p@{SECRET}@host/x",
    f"abfs://user:{SECRET}@account/x",
]
COMMANDS = {
    "cache": ["map", "drive.path=drive", "cache='{}'"],
    "output": ["map", "drive.path=drive", "output='{}'"],
    "drive": ["map", "drive.path='{}'"],
    "base": ["map", "drive.path=drive", "map.base='{}'"],
    "corrections": ["map", "drive.path=drive", "map.corrections='{}'"],
    "background": ["map", "drive.path=drive", "report.background='{}'"],
    "model": ["map", "drive.path=drive", "detector.model='{}'"],
    "survey": ["map", "drive.path=drive", "mapping.survey.file='{}'"],
    "unknown key": ["map", "drive.where='{}'"],
    "wrong type": ["map", "workers='{}'"],
    "unquoted": ["map", "output={}", "cache={}"],
    "simulate": ["simulate", "+run=port1", "cache='{}'"],
    "experiment": ["experiment", "output='{}'"],
    "fleet": ["fleet", "{}", "--table", "table"],
    "table": ["fleet", "a.yaml", "--table", "{}"],
    "check": ["check", "{}"],
    "write": ["check", "drive", "--write", "{}"],
    "detect": ["detect", "{}"],
    "camera": ["detect", "drive", "--camera", "{}"],
    "detections": ["detect", "drive", "--output", "{}"],
    "drawings": ["detect", "drive", "--draw", "{}"],
    "whole number": ["detect", "drive", "--threads", "{}"],
    "report": ["report", "{}"],
    "labels": ["labels", "result", "--output", "{}"],
    "another drive": ["labels", "result", "--drive", "{}"],
    "export": ["export", "{}", "--format", "csv"],
    "exports": ["export", "map.geojson", "--format", "csv", "--output", "{}"],
    "view": ["view", "result", "--corrections", "{}"],
    "view background": ["view", "result", "--background", "{}"],
    "cache list": ["cache", "list", "--cache", "{}"],
    "no command": ["{}"],
    "no option": ["map", "--{}"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_repeats_a_secret_and_no_file_or_folder_has_it(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    for url in URLS:
        arguments = [word.format(url) for word in COMMANDS[name]]
        try:
            code = run(arguments)
        except SystemExit as ended:
            code = ended.code
        printed = capsys.readouterr()
        assert code == 2, url
        output = printed.out + printed.err
        assert SECRET not in output.replace("\n", "")
        assert SECRET.split("/")[1] not in output.replace("\n", ""), output
    for path in tmp_path.rglob("*"):
        assert SECRET.split("/")[1] not in str(path)
        if path.is_file():
            assert SECRET not in path.read_text()


def test_the_configuration_that_is_shown_or_kept_is_without_secrets(capsys):
    assert run(["map", "--cfg", "job", f"drive.path='{URLS[0]}'", f"map.base='{URLS[3]}'"]) == 0
    shown = capsys.readouterr().out
    assert SECRET not in shown
    assert "path: s3://***@bucket/x" in shown


def test_errors_of_the_library_and_log_lines_are_without_secrets():
    for url in URLS:
        for collapsed in (url, str(Path(url)), f"error: '{url}': no such", f'{{"url": "{url}"}}'):
            assert SECRET not in str(DriveError(f"{collapsed}: no such file"))
            assert SECRET not in one_line(collapsed)
            record = _Line("v2hdm", logging.INFO, "", 0, "reading %s", (collapsed,), None)
            assert SECRET not in record.getMessage()


@pytest.mark.parametrize(
    "text",
    [
        "abfs://container@account.dfs.core.windows.net/results: no such bucket",
        "s3://bucket/results/port2: failed (timeout); check the network",
        "https://github.com/x/y#readme is it?",
        "C:/data/me@work/drive.yaml: no such file",
        "/home/me@work/drive.yaml: line 3: expected a text",
        "is it s3://bucket/x? give another",
        "",
    ],
)
def test_what_is_no_secret_stays_as_it_is(text):
    assert masked(text) == text.replace("#readme", "#***")


def test_a_secret_in_a_store_url_is_refused_as_such():
    from v2hdm.store.remote import place_of

    for url in (URLS[0], "s3://token@bucket/x"):
        with pytest.raises(ConfigError, match="credentials belong where s3fs looks for them"):
            place_of(url, "output=")
