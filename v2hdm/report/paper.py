"""The document as ``report.pdf``, by WeasyPrint (the extra ``pdf``)."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from v2hdm.errors import ConfigError, need
from v2hdm.records import Drive
from v2hdm.report.page.document import paper_text
from v2hdm.store import names
from v2hdm.store.files import whole_file


def check_paper(where: str) -> Any:
    """WeasyPrint; raises ConfigError, which says what to install, where it or its Pango is missing."""
    try:
        return need("weasyprint", "pdf", where, ConfigError)
    except OSError:
        raise ConfigError(
            f"{where} needs Pango, which draws WeasyPrint's text, and this system has none: install it "
            "(Debian: apt install libpango-1.0-0 libpangoft2-1.0-0; macOS: brew install pango)"
        ) from None


def write_paper(folder: Path, drive: Drive | None, comparison: Path | None = None) -> Path:
    """Write ``report.pdf`` into a result folder, atomically, and return its path.

    ``drive`` supplies the images, ``comparison`` is a folder of ``v2hdm compare``. Raises ConfigError without
    WeasyPrint, MapFileError for a damaged file.
    """
    weasyprint = check_paper("report.pdf")
    for name in ("weasyprint", "fontTools"):  # each reports glyphs and properties that it leaves out
        logging.getLogger(name).setLevel(logging.ERROR)
    text = paper_text(folder, drive, comparison)
    with whole_file(folder / names.PAPER) as partial:
        within = weasyprint.URLFetcher(allowed_protocols=["data"])  # what lies in the document itself
        weasyprint.HTML(string=text, url_fetcher=within).write_pdf(str(partial), pdf_tags=True)
    return folder / names.PAPER
