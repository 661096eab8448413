"""An export on the terminal: a progress bar, and what came of it."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from export.config import ExportConfig, Precision, check_export
from export.manifest import record_network
from export.onnx_file import export_float, export_int8
from export.source import Source, read_source
from train.bar import Share, share_of_work
from v2hdm.store.inputs import note_input, refuse_input


def run(config: ExportConfig, tell: Share = lambda share, doing: None) -> str:
    """Export as configured; returns what there is to say about it.

    Raises:
        ConfigError: The checkpoint cannot be read or the file cannot be written.
        DetectorError: The file would not do what the network does.
    """
    check_export(config)
    source = read_source(Path(config.checkpoint))
    output = Path(config.output)
    parity = _export(source, output, config, tell)
    precision = f"precision={config.precision.value}"
    record_network(
        output, f"python -m export checkpoint={config.checkpoint} output={config.output} {precision}"
    )
    size_mb = output.stat().st_size / 1e6
    iou = source.label["metrics"].get("mean_iou", float("nan"))
    return f"{output}: {size_mb:.2f} MB, step {source.label['steps']}, mean IoU {iou:.3f}, {parity}"


def _export(source: Source, output: Path, config: ExportConfig, tell: Share) -> str:
    """Export, and say how near the file is to the network."""
    if config.precision is Precision.float32:
        return f"parity {export_float(source, output, config.opset, config.tolerance):.1e}"
    parity = export_int8(source, output, config.opset, config.int8, tell)
    return (
        f"int8: {parity.paint_changed:.1%} of paint changed, its outline by {parity.outline_px:.3f} px "
        f"({parity.outline_bias_px:+.3f} outwards), classes {parity.kinds_agree:.1%} the same, "
        f"lanes {parity.lanes_agree:.1%}, moved by {parity.lane_offset_px:.3f} px"
    )


def export(config: ExportConfig) -> None:
    """Export a checkpoint to ONNX."""
    note_input(Path(config.checkpoint))
    refuse_input(Path(config.output))
    console = Console(stderr=True)
    with share_of_work(console, "reading", transient=True) as tell:
        line = run(config, tell)
    console.print(line, soft_wrap=True, highlight=False)
