"""Trained policies as files that run without this project: ONNX, StableHLO, safetensors."""
