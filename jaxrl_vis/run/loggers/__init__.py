"""Outputs of a run: terminal, TensorBoard, Weights & Biases."""
