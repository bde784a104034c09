"""Calibration: gain, dark rate and defects of the pixels of one sensor, measured and corrected."""

from spikekit.calibration.calibration import Calibration, correct_spikes
from spikekit.calibration.defects import fill_defects
from spikekit.calibration.files import read_calibration, write_calibration

__all__ = ["Calibration", "correct_spikes", "fill_defects", "read_calibration", "write_calibration"]
