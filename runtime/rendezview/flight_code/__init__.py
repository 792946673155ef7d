"""Models for other machines: flight code in C99, trees in ONNX."""

from rendezview.flight_code.c_code import write_c
from rendezview.flight_code.onnx_trees import write_onnx

__all__ = ["write_c", "write_onnx"]
