"""Fine-tuning on a recording without ground truth, ``lightning adapt``."""
