"""Environments that LeRobot's own configuration makes (huggingface/lerobot)."""
