"""The networks, torch only: what `python -m train` trains and `python -m export` turns into ONNX."""

from models.marking_net import MarkingNet, NetConfig, Prediction

__all__ = ["MarkingNet", "NetConfig", "Prediction"]
