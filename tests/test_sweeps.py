"""A sweep does each of its jobs, in a folder of its own."""

from __future__ import annotations

from pathlib import Path

import pytest

from export.config import ExportConfig
from v2hdm.cli.compose import Job, work_on
from v2hdm.cli.main import Command
from v2hdm.errors import ConfigError

COMMAND = Command("export", "Exports.")


def sweep(folder: Path) -> list[str]:
    return ["--multirun", "checkpoint=a", "opset=18,19", f"output={folder / 'net.onnx'}"]


def test_each_job_has_a_folder_and_the_first_code_that_is_not_0_is_the_sweeps(tmp_path: Path) -> None:
    def work(job: Job) -> int:
        folder = Path(job.folder(str(tmp_path)))
        folder.mkdir()
        (folder / "opset").write_text(str(job.settings.opset))
        return 3 if job.settings.opset == 19 else 0

    assert work_on(COMMAND, "export", ExportConfig, work, sweep(tmp_path), "") == 3
    written = {path.parent.name: path.read_text() for path in tmp_path.glob("*/opset")}
    assert written == {"0-opset=18": "18", "1-opset=19": "19"}


def test_a_job_that_fails_names_itself_and_the_others_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done: list[int] = []

    def work(job: Job) -> None:
        if job.settings.opset == 18:
            raise ConfigError("not this one")
        done.append(job.settings.opset)

    assert work_on(COMMAND, "export", ExportConfig, work, sweep(tmp_path), "") == 2
    assert done == [19]
    assert "error: job 0-opset=18: not this one" in capsys.readouterr().err.splitlines()
