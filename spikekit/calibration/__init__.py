"""Calibration: gain, dark rate and defects of the pixels of one sensor, measured and corrected."""

from spikekit.calibration.calibration import Calibration
from spikekit.calibration.defects import fill_defects
from spikekit.calibration.files import read_calibration, write_calibration
from spikekit.calibration.spikes import correct_spikes

__all__ = ["Calibration", "correct_spikes", "fill_defects", "read_calibration", "write_calibration"]
