"""The door: `python -m export checkpoint=runs/train/best.pt output=v2hdm/detection/default.onnx`."""

from __future__ import annotations

import sys
from pathlib import Path

import hydra
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue
from rich.console import Console

from export.config import ExportConfig
from export.onnx_file import export_checkpoint
from train.checkpoint import load_checkpoint
from v2hdm.errors import ConfigError, V2hdmError

_CONF = Path(__file__).resolve().parents[1] / "conf"

ConfigStore.instance().store(name="export_schema", node=ExportConfig)


def run(composed: DictConfig) -> str:
    """Export as configured; returns what there is to say about it."""
    try:
        config = OmegaConf.to_object(composed)
    except MissingMandatoryValue as error:
        raise ConfigError(
            f"{error.full_key}= is missing: `python -m export checkpoint=... output=...`"
        ) from error
    assert isinstance(config, ExportConfig)
    checkpoint = load_checkpoint(Path(config.checkpoint))
    output = Path(config.output)
    difference = export_checkpoint(checkpoint, output, config.opset, config.tolerance)
    size_mb = output.stat().st_size / 1e6
    iou = checkpoint.metrics.get("mean_iou", float("nan"))
    return f"{output}: {size_mb:.2f} MB, step {checkpoint.step}, mean IoU {iou:.3f}, parity {difference:.1e}"


@hydra.main(version_base="1.3", config_path=str(_CONF), config_name="export")
def main(composed: DictConfig) -> None:
    """Export a checkpoint to ONNX."""
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    try:
        console.print(run(composed))
    except V2hdmError as error:
        console.print(f"[red]error:[/] {error}")
        sys.exit(2)


if __name__ == "__main__":
    main()
