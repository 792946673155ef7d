"""Models for other machines: flight code in C99, trees in ONNX."""

from rendezview.export.c_code import write_c
from rendezview.export.onnx_trees import write_onnx

__all__ = ["write_c", "write_onnx"]
