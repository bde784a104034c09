"""Fine-tuning on a recording, without truth: ``lightning adapt``, and what it is worth."""
