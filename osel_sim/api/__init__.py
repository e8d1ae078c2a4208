"""One configuration and one function a command: what the command line, `--config FILE` and a notebook all call."""
