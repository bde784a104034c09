"""Files of weights, checkpoints and settings; no code in a file is executed."""
