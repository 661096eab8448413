"""The door: `python -m export checkpoint=runs/train/best.pt output=v2hdm/detection/default.onnx`."""

from __future__ import annotations

import sys
from pathlib import Path

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from export.config import ExportConfig
from export.onnx_file import export_checkpoint
from train.checkpoint import load_checkpoint
from train.door import open_door
from v2hdm.errors import ConfigError

ConfigStore.instance().store(name="export_schema", node=ExportConfig)


def run(composed: DictConfig) -> str:
    """Export as configured; returns what there is to say about it.

    Raises:
        ConfigError: A value is missing or the checkpoint cannot be read.
    """
    missing = sorted(OmegaConf.missing_keys(composed))
    if missing:
        raise ConfigError(f"{', '.join(missing)} is missing: `python -m export checkpoint=... output=...`")
    config = OmegaConf.to_object(composed)
    assert isinstance(config, ExportConfig)
    checkpoint = load_checkpoint(Path(config.checkpoint))
    output = Path(config.output)
    difference = export_checkpoint(checkpoint, output, config.opset, config.tolerance)
    size_mb = output.stat().st_size / 1e6
    iou = checkpoint.metrics.get("mean_iou", float("nan"))
    return f"{output}: {size_mb:.2f} MB, step {checkpoint.step}, mean IoU {iou:.3f}, parity {difference:.1e}"


def main(composed: DictConfig) -> None:
    """Export a checkpoint to ONNX."""
    print(run(composed), file=sys.stderr)


if __name__ == "__main__":
    open_door("export", main)
