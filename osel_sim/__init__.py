"""osel_sim: simulation-in-the-loop evaluation of online foundation-model selection in robotics."""

__version__ = "0.1.0"
