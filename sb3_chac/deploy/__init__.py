"""Deployment: policies as ONNX files, and a runtime for them that needs neither torch nor Stable-Baselines3."""
