"""The paper's claims, tables, figures and words, from the drives that ``v2hdm experiment`` has measured.

In the wheel this folder is ``v2hdm/paper``.
"""

from .claims import Claim, claims, filled, words
from .figures import save_figures
from .tables import latex, write_tables

__all__ = ["Claim", "claims", "filled", "latex", "save_figures", "words", "write_tables"]
