"""Calibration: gain, dark rate and defects of the pixels of one sensor, measured and corrected."""

from spikekit.calibration.calibration import Calibration, correct_spikes, read_calibration, write_calibration
from spikekit.calibration.defects import fill_defects

__all__ = ["Calibration", "correct_spikes", "fill_defects", "read_calibration", "write_calibration"]
