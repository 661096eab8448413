"""What can be set about an export; `conf/export.yaml` holds the values that are used."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(kw_only=True)
class ExportConfig:
    """One export, of the averaged weights in ``checkpoint`` to the file ``output``.

    ``tolerance`` is how far any logit of the ONNX file may be from the network's before it is refused.
    """

    checkpoint: str
    output: str
    opset: int = 18
    tolerance: float = 1e-3
