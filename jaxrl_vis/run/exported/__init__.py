"""Export of trained policies to files that run without this project: ONNX, StableHLO, safetensors."""
